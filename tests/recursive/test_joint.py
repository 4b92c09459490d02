"""Joint filters against dense textbook ones, and what they do with what is missing, wild or without information."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.joint import JointEkf, JointUkf
from tests.bearing.benches import run
from tests.recursive.joint_dense import Dense
from tests.recursive.joint_drifting import drifting_resistance
from tests.recursive.joint_starts import rates_of, start_of, truth_of

BOTH = pytest.mark.parametrize("kind", [JointEkf, JointUkf])


def dense_of(filter_, unscented):
    """The dense filter in the same state: what is known of a lost state is the compiled filter's."""
    start = filter_.start
    offset = np.array([start.offset_sd[d] for d in start.model.disturbances])
    return Dense(start, offset, 1e4 * filter_._state, unscented=unscented)


@pytest.mark.parametrize(
    ("name", "delay", "kind"),
    [
        ("bearing", 1.0, JointEkf),
        ("bearing", 0.4, JointEkf),
        ("thesis", 0.0, JointEkf),
        ("bearing", 1.0, JointUkf),
        ("bearing", 1.4, JointUkf),
        ("coil", 0.0, JointUkf),
        ("falling rotor", 1.0, JointUkf),
    ],
)
def test_square_roots_and_closed_forms_change_nothing(name, delay, kind):
    """Exact Jacobians by complex step and all 2 n + 1 points; 31 samples, before a first renewal of the matrices."""
    bench, unscented = run(name, 200, 3, delay=delay), kind is JointUkf
    offset = dict(zip(bench.model.disturbances, 2 * bench.disturbance, strict=True))
    free = tuple(k for k, v in bench.truth.items() if v and not (name == "falling rotor" and k == "m"))
    start = start_of(bench, 0.01 if unscented else 0.001, free=free, offset_sd=offset)
    compiled = kind(start)
    plain = dense_of(compiled, unscented)
    u, y = bench.signals.u[:31], bench.signals.y[:31].copy()
    if y.shape[1] > 1:
        y[20, 0] = y[25, 1] = np.nan
    errors, wanted = compiled.update(u, y), plain.run(u, y)
    first = int(delay) + 2  # the sample before starts the state and predicts nothing
    # the affine matrices of the extended filter leave out the second derivative
    close = 1e-6 if unscented else 5e-3
    np.testing.assert_allclose(errors[first:] / bench.sensor, wanted[first:] / bench.sensor, atol=close)
    sd = np.sqrt(np.diag(plain.covariance))
    np.testing.assert_allclose(compiled.estimate / sd, plain.estimate / sd, atol=close)
    np.testing.assert_allclose(compiled.covariance / np.outer(sd, sd), plain.covariance / np.outer(sd, sd), atol=close)


@BOTH
def test_converges_on_an_unstable_bearing_in_its_loop(kind):
    bench = run("bearing", 20_000, 4)
    filter_ = kind(start_of(bench, 0.03, seed=8))
    filter_.update(bench.signals.u, bench.signals.y)
    sd = np.sqrt(np.diag(filter_.covariance))
    assert np.all(sd[:5] < 0.006 * np.abs(truth_of(bench, filter_.names)[:5]))
    assert np.all(np.abs(filter_.estimate - truth_of(bench, filter_.names)) < 3.5 * sd)
    assert filter_.error == pytest.approx(1.0, abs=0.05)
    assert filter_.warnings == ()


@BOTH
@pytest.mark.parametrize(("factor", "word"), [(0.5, "too small"), (2.0, "too large")])
def test_wrong_noise_levels_are_said(kind, factor, word):
    bench = run("bearing", 6000, 4)
    start = start_of(bench, 0.01)
    filter_ = kind(replace(start, sensor_sd={k: factor * v for k, v in start.sensor_sd.items()}))
    filter_.update(bench.signals.u[:2000], bench.signals.y[:2000])
    assert filter_.warnings == ()  # too early to tell
    filter_.update(bench.signals.u[2000:], bench.signals.y[2000:])
    assert word in filter_.warnings[0]


def test_the_second_order_keeps_the_unscented_filter_true_from_a_far_start():
    """A resonance of 639 Hz without damping: 5 % of mass and k_i are far outside of what is linear."""
    bench = run("thesis", 10_000, 2)
    apart, said = {}, {}
    for kind in (JointEkf, JointUkf):
        filter_ = kind(start_of(bench, 0.05, seed=3))
        filter_.update(bench.signals.u, bench.signals.y)
        said[kind] = filter_.warnings
        sd = np.sqrt(np.diag(filter_.covariance))
        apart[kind] = np.abs((filter_.estimate - truth_of(bench, filter_.names)) / sd).max()
    assert apart[JointUkf] < 4.0
    assert apart[JointEkf] > 10.0
    assert "use JointUkf" in said[JointEkf][0]
    assert said[JointUkf] == ()


@BOTH
def test_a_missing_output_is_a_partial_update_and_a_missing_input_a_new_beginning(kind):
    bench = run("bearing", 3000, 6)
    u, y = bench.signals.u.copy(), bench.signals.y.copy()
    y[1000:1500:3, 0] = np.nan
    u[2000] = np.nan
    filter_ = kind(start_of(bench, 0.01))
    errors = filter_.update(u, y)
    assert (filter_.n_partial, filter_.n_rejected, filter_.n_used) == (167, 1, 2999)
    assert np.isnan(errors[1000:1500:3, 0]).all()
    assert np.isfinite(errors[1000:1500:3, 1]).all()
    assert np.isnan(errors[2000:2003]).all()
    # an ordinary prediction again within a few samples of two outputs
    assert np.all(np.sqrt(np.mean(errors[2020:] ** 2, axis=0)) < 1.3 * np.sqrt(np.mean(errors[500:1000] ** 2, axis=0)))
    sd = np.sqrt(np.diag(filter_.covariance))
    assert np.all(np.abs(filter_.estimate - truth_of(bench, filter_.names)) < 3.5 * sd)


@BOTH
@pytest.mark.parametrize("channel", ["voltage", "position", "blind"])
def test_wild_numbers_and_blindness_do_not_move_parameters(kind, channel):
    bench = run("bearing", 6000, 7)
    u, y = bench.signals.u.copy(), bench.signals.y.copy()
    if channel == "voltage":
        u[3000] = 1e200
    elif channel == "position":
        y[3000, 0] = -1e200
    else:
        y[3000:4000] = np.nan
    filter_ = kind(start_of(bench, 0.01))
    filter_.update(u, y)
    sd = np.sqrt(np.diag(filter_.covariance))
    assert np.all(np.isfinite(sd))
    assert np.all(np.abs(filter_.estimate - truth_of(bench, filter_.names)) < 4.0 * sd)
    assert filter_.n_rejected + filter_.n_partial >= 1


@BOTH
def test_mass_resistance_and_inductance_stay_positive(kind):
    """A record of another plant: resistance a tenth of what the start believes, with a wide start."""
    bench = run("coil", 4000, 8)
    other = replace(start_of(bench, 0.9), values={"R": 10 * bench.truth["R"], "L": bench.truth["L"]})
    filter_ = kind(replace(other, covariance=np.diag([(9 * bench.truth["R"]) ** 2, (0.3 * bench.truth["L"]) ** 2])))
    for k in range(0, 4000, 50):
        filter_.update(bench.signals.u[k : k + 50], bench.signals.y[k : k + 50])
        assert np.all(filter_.estimate[:2] > 0)


@BOTH
def test_a_quiet_plant_neither_winds_up_nor_drifts(kind):
    bench = run("bearing", 40_000, 9)
    quiet = bench.states * 0.0
    start = start_of(bench, 0.01, rates=rates_of({"R": 0.5, "k_i": 0.5, "m": 0.5}, bench.truth))
    filter_ = kind(start)
    filter_.update(quiet[:, 0], quiet[:, :2])
    truth = truth_of(bench, filter_.names)[:5]
    sd = np.sqrt(np.diag(filter_.covariance))[:5] / np.abs(truth)
    assert np.all(sd < 0.12)  # 0.7 without the limit
    assert np.all(np.abs(filter_.estimate[:5] / truth - 1.0) < 3 * sd)
    np.linalg.cholesky(filter_.covariance)


@BOTH
def test_follows_a_resistance_that_drifts(kind):
    record = drifting_resistance(seconds=1.5, share=0.2, seed=1)
    start = start_of(record.bench, 0.005, rates=rates_of({"R": 0.1}, record.bench.truth))
    filter_ = kind(start)
    found, sds = [], []
    for k in range(0, len(record.R), 1000):
        filter_.update(record.bench.signals.u[k : k + 1000], record.bench.signals.y[k : k + 1000])
        found.append(filter_.estimate)
        sds.append(np.sqrt(np.diag(filter_.covariance)))
    at = filter_.names.index("R")
    error = np.array(found)[5:, at] / record.R[999::1000][5:] - 1.0
    assert np.sqrt(np.mean(error**2)) < 0.02
    others = [j for j in range(5) if j != at]
    off = (np.array(found) - truth_of(record.bench, filter_.names)) / np.array(sds)
    assert np.all(np.abs(off[:, others]) < 3.5)
    assert np.mean(np.abs(error) < 2 * np.array(sds)[5:, at] / record.R[999::1000][5:]) > 0.75


def test_settings_that_make_no_filter_are_refused():
    bench = run("coil", 200, 1)
    with pytest.raises(EstimationError, match="Use JointEkf"):
        JointUkf(replace(start_of(bench), rate_hz=20.0))
