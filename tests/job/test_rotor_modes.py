"""Black box beside the physical rotor: the Laguerre operator on all axes of RMIT, stochastic subspace on UTRC."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.blackbox.frequency_subspace import frf_subspace
from ambid.signals.response import FrequencyResponse
from tests.rotor_benches import needs_simulator, record_of, truth

pytestmark = needs_simulator


def of_axes(quantity):
    return [f"{axis}_{quantity}" for axis in truth.AXES]


def thinned(frf: FrequencyResponse, step: int) -> FrequencyResponse:
    """Every so-many-th line: windows of the local method overlap, and their neighbours say nothing new."""
    s = slice(None, None, step)
    return replace(frf, frequency_hz=frf.frequency_hz[s], G=frf.G[s], covariance=frf.covariance[s])


def test_laguerre_operator_sees_all_axes_of_rmit():
    bench = replace(truth.BENCHES["rmit"], periods=2, band=(2.0, 400.0))
    found = ambid.frf(
        record_of(bench, 1), input=of_axes("voltage"), output=of_axes("position"), reference=of_axes("reference"),
        band=(5.0, 300.0),
    ).response  # fmt: skip
    true = truth.open_loop_frf(bench, found.frequency_hz)[:, :4]
    assert np.sqrt(np.mean((np.abs(found.G - true) / found.sd) ** 2)) == pytest.approx(1.0, abs=0.3)
    fit = frf_subspace(thinned(found, 9), {"n": 12}, delay=bench.delay / bench.rate)
    assert fit.details["condition"] < 1e3 < 1e6 < fit.details["condition_without"]
    known = np.linalg.eigvals(truth.plant(bench)[0][:-2, :-2])
    unstable = np.sort(known[known.real > 0].real)
    poles = fit.model.poles()
    assert np.sort(poles[poles.real > 0].real) == pytest.approx(unstable, rel=0.1)
    rest = known[known.imag > 0]
    for p in poles[poles.imag > 0]:
        assert np.min(np.abs(rest - p)) < 0.02 * abs(p)


@pytest.fixture(scope="module")
def utrc():
    return replace(truth.BENCHES["utrc-rest"], periods=2)


@pytest.fixture(scope="module")
def excited(utrc):
    """Modes of the loop by maximum likelihood, from one axis' excitation."""
    record = record_of(utrc, 1)
    return ambid.frf(
        record, input=of_axes("reference"), output=of_axes("position"), open_loop=True, modes="auto", band=(100, 1150)
    )


def test_modes_of_utrc_come_out_of_levitated_records(utrc, excited):
    free = truth.modal_of(utrc).omega[2:] / (2 * np.pi)
    assert [m.frequency_hz.value for m in excited.modes] == pytest.approx(
        free, rel=0.03
    )  # the loop moves them a little
