"""Estimates with a replayed record: a stable plant and an unstable one in closed loop, small."""

import pytest

from ambid.job import identify, signals_of
from ambid.physics.linear_model import model
from ambid.physics.presets import preset
from ambid.report.estimate_figures import Evidence
from ambid.rig import default_rig
from ambid.signals import excitation
from ambid.simulation import simulate_preset
from ambid.validation.second_record import replay


def evidence_of(name, n, band, seed=2):
    bench = preset(name)
    u = excitation("multisine", n, bench.rate_hz, amplitude=10.0, band=band, seed=seed)
    record = simulate_preset(bench, u, seed=seed).record
    estimate = identify(record, default_rig())
    return Evidence(estimate=estimate, run=replay(estimate, signals_of(record, model(estimate.model))), start_s=1.0)


@pytest.fixture(scope="session")
def stable():
    return evidence_of("thesis", 4000, (5.0, 2000.0))


@pytest.fixture(scope="session")
def unstable():
    return evidence_of("unstable-bearing", 3000, (10.0, 2000.0))
