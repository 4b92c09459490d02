"""Subspace methods recover simulated plants: stable, unstable in a loop, many channels, series, delays, offsets."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import structure
from ambid.blackbox.model import pole_covariance, response_covariance
from ambid.blackbox.subspace import cva, moesp, n4sid, pbsid
from ambid.errors import EstimationError
from ambid.physics.linear_model import discretise
from tests.bearing.benches import run
from tests.blackbox.subspace.systems import COLOURED, DT, SERIES, UNSTABLE, modal, record
from tests.blackbox.systems import noise_response

METHODS = {"n4sid": n4sid, "moesp": moesp, "cva": cva, "pbsid": pbsid}
OMEGA = np.linspace(2.0, 300.0, 12)


def distance(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest distance of a true pole from the nearest found one."""
    return max(float(np.min(np.abs(found - p))) for p in truth)


@pytest.fixture(params=METHODS, name="method")
def _method(request):
    return METHODS[request.param]


@pytest.mark.parametrize("feedthrough", [False, True])
def test_data_without_noise_give_the_plant_to_rounding(method, feedthrough):
    plant = replace(COLOURED, D=np.array([[0.7 if feedthrough else 0.0]]))
    fit = method(record(plant, 800, 1, sd=0.0), {"n": 3})
    assert distance(fit.model.poles(), plant.poles()) < 1e-10
    assert fit.details["feedthrough"] is feedthrough
    np.testing.assert_allclose(fit.model.frequency_response(OMEGA), plant.frequency_response(OMEGA), rtol=1e-9)


def test_order_is_found_and_plant_and_noise_model_lie_within_their_spread(method):
    fit = method(record(COLOURED, 6000, 3), {})
    assert fit.orders == {"n": 3}
    error = fit.model.frequency_response(OMEGA) - COLOURED.frequency_response(OMEGA)
    spread = response_covariance(fit.model, fit.covariance, OMEGA)
    z = np.abs(error) / np.sqrt(np.trace(spread, axis1=3, axis2=4))
    assert np.max(z) < 4.0
    np.testing.assert_allclose(fit.noise_covariance, [[0.25]], rtol=0.08)
    np.testing.assert_allclose(noise_response(fit.model, OMEGA), noise_response(COLOURED, OMEGA), atol=0.5)


def test_offsets_are_estimated_beside_the_dynamics(method):
    data = record(COLOURED, 6000, 4, offsets=(300.0, -50.0))
    fit = method(data, {"n": 3})
    gain = fit.model.frequency_response(np.zeros(1))[0, 0, 0].real
    # whatever point of the static line was taken, it is on the true one
    assert fit.offsets.y[0] + gain * (300.0 - fit.offsets.u[0]) == pytest.approx(-50.0, abs=0.35)


def test_offset_is_right_where_a_transient_moves_the_mean():
    slow = replace(SERIES, A=np.array([[0.995, 0], [0, 0.3]]), K=np.array([[0.3], [0.1]]))
    data = record(slow, 4000, 5, sd=0.01)
    decay = 5.0 * 0.995 ** np.arange(4000.0)  # the free answer of a state that starts far away
    fit = pbsid(replace(data, y=data.y + decay[:, None]), {"n": 2})
    assert abs(fit.offsets.y[0] + 2.0) < 0.1 * abs(np.mean(decay))


def test_series_without_inputs(method):
    fit = method(record(SERIES, 6000, 2), {})
    assert fit.orders == {"n": 2}
    assert not fit.warnings
    assert distance(fit.model.poles(), SERIES.poles()) < 0.02
    omega = np.array([5.0, 40.0, 60.0, 200.0])
    np.testing.assert_allclose(noise_response(fit.model, omega), noise_response(SERIES, omega), rtol=0.08)


@pytest.mark.parametrize("name", ["n4sid", "pbsid"])
def test_four_inputs_four_outputs_order_eight(name):
    plant = modal(8, 4, 4, 5)
    fit = METHODS[name](record(plant, 3000, 2), {})
    assert fit.orders == {"n": 8}
    assert distance(fit.model.poles(), plant.poles()) < 0.003
    size = np.max(np.abs(plant.frequency_response(OMEGA)))
    assert np.max(np.abs(fit.model.frequency_response(OMEGA) - plant.frequency_response(OMEGA))) < 0.01 * size
    values = np.array(fit.details["singular_values"])
    assert values[7] > 10 * values[8]


def test_feedback_biases_the_classical_methods_and_they_say_so(method):
    data = record(UNSTABLE, 20_000, 1, hold=1.2)
    fit = method(data, {"n": 2})
    error = fit.model.frequency_response(OMEGA) - UNSTABLE.frequency_response(OMEGA)
    sd = np.sqrt(np.trace(response_covariance(fit.model, fit.covariance, OMEGA), axis1=3, axis2=4))
    if structure(fit.structure).feedback == "consistent":
        assert not fit.warnings
        assert np.max(np.abs(error) / sd) < 4.0
        assert fit.model.poles()[0].real == pytest.approx(
            1.05, abs=3 * pole_covariance(fit.model, fit.covariance)[0, 0, 0] ** 0.5
        )
    else:
        assert any("biased by feedback" in w for w in fit.warnings)
        assert np.max(np.abs(error) / np.abs(UNSTABLE.frequency_response(OMEGA))) > 0.1


@pytest.fixture(scope="module", name="bearing")
def _bearing():
    bench = run("bearing", 40_000, 1)
    s = bench.signals
    data = IOData(u=s.u, y=s.y, dt=1 / s.rate_hz, inputs=bench.model.inputs, outputs=bench.model.outputs, units={})
    return bench, data


@pytest.mark.parametrize("orders", [{"n": 4}, {}])
def test_unstable_bearing_in_its_loop_has_its_poles_within_one_per_cent(bearing, orders):
    bench, data = bearing
    space = bench.model.matrices(bench.truth)
    discrete = np.linalg.eigvals(discretise(space, data.dt)[0].A)
    fit = pbsid(data, orders)
    assert fit.model.order == 4  # three states of the plant, one of the delay
    assert not fit.warnings
    truth = np.log(discrete + 0j) / data.dt  # all are near 1 in z: compare where one per cent means something
    poles = fit.model.poles()
    found = np.log(poles[np.abs(poles) > 0.5]) / data.dt
    assert found.size == 3
    assert fit.details["condition_number"] > 1e10  # a band-limited input: it is the prior that makes this solvable
    for s in truth:
        assert np.min(np.abs(found - s)) < 0.01 * abs(s)


def test_classical_methods_warn_on_the_bearing_and_miss_its_poles(bearing):
    bench, data = bearing
    truth = np.linalg.eigvals(bench.model.matrices(bench.truth).A)
    fit = n4sid(data, {"n": 4})
    assert any("biased" in w for w in fit.warnings)
    poles = fit.model.poles()
    found = np.log(poles[np.abs(poles) > 0.5] + 0j) / data.dt
    assert max(float(np.min(np.abs(found - s)) / abs(s)) for s in truth) > 0.05


def test_units_do_not_matter_and_nothing_is_changed(method):
    data = record(COLOURED, 1500, 8)
    u, y = data.u.copy(), data.y.copy()
    other = replace(data, u=1e6 * data.u, y=1e-6 * data.y)
    one, two, again = method(data, {}), method(other, {}), method(data, {})
    assert np.array_equal(data.u, u)
    assert np.array_equal(data.y, y)
    assert np.array_equal(one.model.theta, again.model.theta)
    assert np.array_equal(one.covariance, again.covariance)
    np.testing.assert_allclose(two.model.poles(), one.model.poles(), rtol=1e-9)
    np.testing.assert_allclose(two.noise_covariance, 1e-12 * one.noise_covariance, rtol=1e-9)
    np.testing.assert_allclose(
        two.model.frequency_response(OMEGA), 1e-12 * one.model.frequency_response(OMEGA), rtol=1e-8
    )
    s1, s2 = (pole_covariance(f.model, f.covariance) for f in (one, two))
    np.testing.assert_allclose(s2, s1, rtol=1e-5, atol=1e-5 * np.max(s1))
    eigenvalues = np.linalg.eigvalsh(one.covariance)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


def test_residual_covariances_and_gain_fit_together(method):
    """K of the result is the stationary Kalman gain of its own Q, S, R."""
    from scipy.linalg import solve_discrete_are

    fit = method(record(COLOURED, 6000, 9), {"n": 3})
    Q, S, R = (np.array(fit.details[k]) for k in "QSR")
    A, C = fit.model.A, fit.model.C
    P = solve_discrete_are(A.T, C.T, 0.5 * (Q + Q.T), R, s=S)
    K = (A @ P @ C.T + S) @ np.linalg.inv(C @ P @ C.T + R)
    np.testing.assert_allclose(fit.model.K, K, rtol=0.05, atol=0.02)
    assert np.max(np.abs(np.linalg.eigvals(A - fit.model.K @ C))) < 1


@pytest.mark.parametrize(
    ("orders", "options", "says"),
    [
        ({"n": 0}, {}, "n = 0; it must be a whole number of at least 1"),
        ({"n": 2.5}, {}, "n = 2.5"),
        ({"n": True}, {}, "n = True"),
        ({"na": 2}, {}, "order 'na' is unknown"),
        ({"n": 9}, {"horizon": 5}, "identifies at most 4 states"),
        ({"n": 2}, {"horizon": 1}, "horizon = 1 samples"),
        ({"n": 2}, {"horizon": 300}, "longer record"),
        ({"n": 200}, {}, "Lower the order"),
    ],
)
def test_orders_that_break_a_rule_are_refused(method, orders, options, says):
    with pytest.raises(EstimationError, match=says):
        method(record(COLOURED, 500, 1), orders, **options)


def test_records_that_cannot_serve_are_refused(method):
    data = record(COLOURED, 500, 1)
    bad = data.y.copy()
    bad[17, 0] = np.nan
    with pytest.raises(EstimationError, match="'y0'"):
        method(replace(data, y=bad), {"n": 2})
    with pytest.raises(EstimationError, match="input 'u0' is constant"):
        method(replace(data, u=np.full_like(data.u, 0.1)), {"n": 2})
    with pytest.raises(EstimationError, match="longer record"):
        method(data.part(0, 12), {"n": 3})


def test_million_samples_need_little_memory():
    rng = np.random.default_rng(0)
    n = 1_000_000
    u = rng.standard_normal(n)
    y = lfilter([0, 1, 0.5], [1, -1.5, 0.7], u) + lfilter([1], [1, -0.9], 0.3 * rng.standard_normal(n))
    data = IOData(u=u[:, None], y=y[:, None], dt=DT, inputs=("u",), outputs=("y",), units={}, open_loop=True)
    tracemalloc.start()
    fit = n4sid(data, {"n": 3}, horizon=8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6  # a matrix of windows would take 272 MB for these 8 + 8 samples
    assert distance(fit.model.poles(), np.array([0.75 + 0.3708j, 0.75 - 0.3708j, 0.9])) < 0.003
