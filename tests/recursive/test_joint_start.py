"""Starts: from an off-line estimate, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.job import identify
from ambid.physics.presets import preset
from ambid.recursive.joint import JointEkf, JointUkf
from ambid.signals import multisine
from ambid.simulation import simulate_preset
from tests.bearing.benches import run
from tests.recursive.joint_starts import start_of

RATE = 20_000.0


@pytest.fixture(scope="module")
def bearing():
    bench = preset("unstable-bearing")
    u = multisine(20_000, RATE, amplitude=6.0, band=(5.0, 2000.0), seed=3, amplitude_is="rms")
    return simulate_preset(bench, u, seed=3).record


@pytest.fixture(scope="module")
def begun(bearing):
    return identify(bearing, to_s=0.4)


@pytest.mark.parametrize("kind", [JointEkf, JointUkf])
def test_goes_on_from_an_off_line_estimate_to_that_of_the_whole_record(bearing, begun, kind):
    """The start is 0.4 s of record with its covariance; the rest is 0.6 s."""
    whole = identify(bearing)
    filter_ = kind.from_estimate(begun, RATE)
    first = 8000
    filter_.update(bearing["voltage"][first:], np.column_stack([bearing["position"], bearing["current"]])[first:])
    p = len(whole.covariance_names)
    assert filter_.names[:p] == whole.covariance_names
    sd = np.sqrt(np.diag(whole.covariance))
    away = (filter_.estimate[:p] - [whole.values[k] for k in whole.covariance_names]) / sd
    before = (np.array([begun.values[k] for k in whole.covariance_names]) - list(whole.values.values())[:p]) / sd
    assert np.abs(before).max() > 0.5
    assert np.abs(away).max() < 0.3
    np.testing.assert_allclose(np.sqrt(np.diag(filter_.covariance))[:p], sd, rtol=0.1)


def test_takes_over_what_the_estimate_knows(begun):
    start = replace(JointEkf.from_estimate(begun, RATE, rates={"R": 0.01}).start, offset_sd={"force": 2.0})
    assert start.names == (*begun.covariance_names, "force_offset", "voltage_offset")
    assert start.delay == begun.delay["voltage"].samples + begun.delay["voltage"].fraction
    assert start.operating_point == {r: begun.operating_point[r] for r in ("voltage", "position", "current")}
    filter_ = JointEkf(start)
    np.testing.assert_allclose(filter_.estimate[:5], [begun.values[k] for k in begun.covariance_names], rtol=1e-12)
    np.testing.assert_allclose(filter_.covariance[:5, :5], begun.covariance, rtol=1e-9)
    assert np.sqrt(filter_.covariance[5, 5]) == pytest.approx(2.0)
    assert filter_.values["c"] == begun.values["c"]


def test_an_estimate_that_cannot_be_gone_on_from_is_refused(begun):
    with pytest.raises(EstimationError, match="failed"):
        JointEkf.from_estimate(replace(begun, status="failed"), RATE)
    with pytest.raises(EstimationError, match="10000 Hz"):
        JointEkf.from_estimate(begun, 10_000.0)
    gain = replace(begun, noise=replace(begun.noise, form="gain", disturbance_sd={}, sensor_sd={}))
    with pytest.raises(EstimationError, match="needs levels"):
        JointEkf.from_estimate(gain, RATE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rates": {"Rr": 1.0}}, "Did you mean 'R'"),
        ({"rates": {"R": -1.0}}, "must be zero or positive"),
        ({"sensor_sd": {"current": 0.0}}, "must be positive"),
        ({"sensor_sd": {}}, "lacks current"),
        ({"free": ()}, "no parameter is free"),
        ({"covariance": np.eye(3)}, "need"),
        ({"covariance": np.array([[1e-4, 1e-3], [1e-3, 1e-4]])}, "not positive definite"),
        ({"covariance": np.diag([100.0, 1e-12])}, "more than its size"),
        ({"values": {"R": -1.0, "L": 1.0}}, "must be positive"),
        ({"delay": -1.0}, "not negative"),
    ],
)
def test_rules_of_a_start(change, message):
    good = start_of(run("coil", 200, 1))
    with pytest.raises(EstimationError, match=message):
        replace(good, **change)
