"""A plant in a loop, known from its reference: the unstable rotor of a magnetic bearing, and a stable one."""

import numpy as np
import pytest
from scipy.signal import ss2tf

from ambid.blackbox.instrumental import cliv, iv4
from ambid.blackbox.instrumental_continuous import clsrivc, sampled_coefficients
from ambid.blackbox.model import pole_covariance
from ambid.errors import EstimationError
from ambid.signals import multisine
from tests.bearing.benches import SETTINGS, run
from tests.blackbox.instrumental.records import in_loop, io_data, monte_carlo, second_order
from tests.tiers import runs

DT = 1e-3
RISING = second_order(-(300.0**2), 0.0, 1e5, DT)  # poles at +-300 rad/s, like a rotor on its negative spring
SPRUNG = second_order(300.0**2, 60.0, 1e5, DT)


def _sampled(plant):
    num, den = ss2tf(*plant, np.array([[1.0, 0]]), np.zeros((1, 1)))
    return np.r_[den[1:], num[0, 1:]]


def _rising(rng, n=2000):
    return in_loop(rng, *RISING, DT, n=n, noise=0.02, kp=2.2, kd=8.0)


def _sprung(rng):
    return in_loop(rng, *SPRUNG, DT, n=2000, noise=0.1, kp=0.8, kd=2.0)


def test_unstable_plant_by_the_reference():
    n = runs(60, short=20)
    errors, scores = monte_carlo(_rising, lambda d: cliv(d, {"na": 2, "nb": 2}), _sampled(RISING), [1, 2, 4, 5], n)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(n))
    assert np.all(np.abs(scores.std(axis=0) - 1.03) < n.limit(0.28, centre=0))
    assert np.mean(np.abs(scores) < 1.96) > n.limit(0.9)
    # past inputs are no instruments in a loop
    biased = np.mean(
        [
            iv4(_rising(np.random.default_rng(s)), {"na": 2, "nb": 2}).model.theta[[1, 2, 4, 5]] - _sampled(RISING)
            for s in range(10)
        ],
        axis=0,
    )
    assert np.max(np.abs(biased) / errors.std(axis=0)) > 1


def test_unstable_plant_in_continuous_time():
    truth = np.array([1e5, 0.0, -(300.0**2)])
    n = runs(60, short=20)
    errors, scores = monte_carlo(_rising, lambda d: clsrivc(d, {"nb": 1, "nf": 2}), truth, [0, 2, 3], n)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * errors.std(axis=0) / np.sqrt(n))
    assert np.all(np.abs(scores.std(axis=0) - 1.03) < n.limit(0.28, centre=0))
    fit = clsrivc(_rising(np.random.default_rng(3)), {"nb": 1, "nf": 2})
    np.testing.assert_allclose(np.sort(fit.model.poles().real), [-300, 300], rtol=0.03)
    assert not fit.warnings
    # 1.0 and 0.3 were added to input and output: one line of operating points
    gain = -1e5 / 9e4
    assert fit.offsets.y[0] - gain * (fit.offsets.u[0] - 1.0) == pytest.approx(0.3, abs=0.05)


def test_an_integrating_plant_is_not_disturbed_by_the_time_before_the_record():
    # 1000/(s (s + 5)), sampled fast: the noise filter's own transient never fades and was taken for the plant
    plant, truth = second_order(0.0, 5.0, 1000.0, 0.002), np.array([1000.0, 5.0, 0.0])
    scores, sampled = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        r = np.repeat(rng.choice([-1.0, 1.0], 1000), 2)
        d = in_loop(rng, *plant, 0.002, n=2000, noise=0.01, colour=False, kp=6.0, kd=25.0, reference=r)
        fit = clsrivc(d, {"nf": 2, "nb": 1, "nk": 0})
        scores.append((fit.model.theta[[0, 2, 3]] - truth) / fit.sd[[0, 2, 3]])
        sampled.append(np.abs(cliv(d, {"na": 2, "nb": 2, "nk": 1}).model.poles()) - [1.0, np.exp(-0.01)])
    assert np.sqrt(np.mean(np.square(scores))) < 1.5
    assert np.max(np.abs(sampled)) < 0.002


def test_poles_within_one_percent():
    fit = clsrivc(_rising(np.random.default_rng(3), n=10_000), {"nb": 1, "nf": 2})
    np.testing.assert_allclose(np.sort(fit.model.poles().real), [-300, 300], rtol=0.01)


def test_a_wrong_delay_is_told():
    fit = clsrivc(_rising(np.random.default_rng(3)), {"nb": 1, "nf": 2, "nk": 1})
    assert any("nk" in w for w in fit.warnings)


def test_the_sampled_equivalent_and_its_derivative():
    step, theta = 0.3, np.array([1.3, 0.4, 0.9, 0.2, 0.5])  # p^2 + 0.4 p + 1.3; 0.2 + ...
    for nb in ((1,), (2,), (3,)):
        t = theta[: 2 + nb[0]]
        A = np.array([[0, 1], [-1.3, -0.4]])
        num = np.zeros(3)
        num[: nb[0]] = t[2:]
        from scipy.signal import cont2discrete

        C = np.array([num[:2] - num[2] * t[:2]])
        Ad, Bd, Cd, Dd, _ = cont2discrete((A, np.array([[0], [1.0]]), C, np.array([[num[2]]])), step)
        b, a = ss2tf(Ad, Bd, Cd, Dd)
        full = np.r_[a[1:], b[0] if nb[0] == 3 else b[0, 1:]]
        found = sampled_coefficients(t, 2, nb, step)
        np.testing.assert_allclose(found, full, rtol=1e-12, atol=1e-15)
        for k in range(t.size):
            moved = t.astype(complex)
            moved[k] += 1e-20j
            exact = sampled_coefficients(moved, 2, nb, step).imag / 1e-20
            h = 1e-6 * np.eye(t.size)[k]
            near = (sampled_coefficients(t + h, 2, nb, step) - sampled_coefficients(t - h, 2, nb, step)) / 2e-6
            np.testing.assert_allclose(exact, near, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("estimator", "orders"),
    [(cliv, {"na": 2, "nb": 2}), (clsrivc, {"nb": 1, "nf": 2})],
)
def test_without_a_reference(estimator, orders):
    d = _sprung(np.random.default_rng(1))
    with pytest.raises(EstimationError, match="Give reference"):
        estimator(io_data(d.u, d.y, dt=DT), orders)


def test_units_do_not_matter():
    d = _rising(np.random.default_rng(1))
    one = clsrivc(d, {"nb": 1, "nf": 2})
    other = clsrivc(io_data(1e3 * d.u, 1e-6 * d.y, reference=7 * d.reference, dt=1e-3), {"nb": 1, "nf": 2})
    np.testing.assert_allclose(other.model.theta, one.model.theta * [1e-9, 1, 1, 1], rtol=1e-6, atol=1e-5)


def test_fast_sampling_and_a_reference_of_narrow_band():
    # a bearing at 20 kHz, its poles near 110 rad/s: one sample is 1/180 of the fastest of them
    bench, s = run("bearing", 20_000, 1), SETTINGS["bearing"]
    r = multisine(20_000, s.rate_hz, amplitude=s.rms, band=s.band, seed=1, amplitude_is="rms", shape="flat")
    position = bench.model.outputs.index("position")
    d = io_data(bench.signals.u, bench.signals.y[:, position], reference=r, dt=1 / s.rate_hz)
    fit = clsrivc(d, {"nb": 1, "nf": 3, "nk": int(bench.delay)})
    truth = np.linalg.eigvals(bench.model.matrices(bench.truth).A)
    error = np.sort_complex(fit.model.poles()) - np.sort_complex(truth)
    spread = pole_covariance(fit.model, fit.covariance)[np.argsort(fit.model.poles())]
    np.testing.assert_array_less(np.abs(error), 3 * np.sqrt(np.trace(spread, axis1=1, axis2=2)))
    assert np.max(np.abs(error)) < 0.2 * np.max(np.abs(truth))


@pytest.mark.parametrize(("method", "orders"), [(cliv, {"na": 2, "nb": 2}), (clsrivc, {"nb": 1, "nf": 2})])
def test_weak_instruments_are_said(method, orders):
    # a reference that moves the plant about as much as the loop's noise does: estimates are off by tens of sd
    said = 0
    for seed in range(8):
        weak = in_loop(np.random.default_rng(seed), *SPRUNG, DT, n=600, noise=1.0, kp=0.8, kd=2.0)
        said += any("instruments" in w and "weak" in w for w in method(weak, orders).warnings)
    assert said >= 7
    for seed in range(4):
        strong = in_loop(np.random.default_rng(seed), *SPRUNG, DT, n=2000, noise=0.02, kp=0.8, kd=2.0)
        fit = method(strong, orders)
        assert not any("weak" in w for w in fit.warnings)
        assert fit.details["instrument_strength"][0] > 50
