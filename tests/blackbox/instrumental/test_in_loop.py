"""A plant in a loop, known from its reference: the unstable rotor of a magnetic bearing, and a stable one."""

import numpy as np
import pytest
from scipy.signal import ss2tf

from ambid.blackbox.instrumental import cliv, iv4
from ambid.errors import EstimationError
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


def test_an_integrating_plant_is_not_disturbed_by_the_time_before_the_record():
    # 1000/(s (s + 5)), sampled fast: the noise filter's own transient never fades and was taken for the plant
    plant, sampled = second_order(0.0, 5.0, 1000.0, 0.002), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        r = np.repeat(rng.choice([-1.0, 1.0], 1000), 2)
        d = in_loop(rng, *plant, 0.002, n=2000, noise=0.01, colour=False, kp=6.0, kd=25.0, reference=r)
        sampled.append(np.abs(cliv(d, {"na": 2, "nb": 2, "nk": 1}).model.poles()) - [1.0, np.exp(-0.01)])
    assert np.max(np.abs(sampled)) < 0.002


def test_without_a_reference():
    d = _sprung(np.random.default_rng(1))
    with pytest.raises(EstimationError, match="Give reference"):
        cliv(io_data(d.u, d.y, dt=DT), {"na": 2, "nb": 2})


def test_weak_instruments_are_said():
    # a reference that moves the plant about as much as the loop's noise does: estimates are off by tens of sd
    said = 0
    for seed in range(8):
        weak = in_loop(np.random.default_rng(seed), *SPRUNG, DT, n=600, noise=1.0, kp=0.8, kd=2.0)
        said += any("instruments" in w and "weak" in w for w in cliv(weak, {"na": 2, "nb": 2}).warnings)
    assert said >= 7
    for seed in range(4):
        strong = in_loop(np.random.default_rng(seed), *SPRUNG, DT, n=2000, noise=0.02, kp=0.8, kd=2.0)
        fit = cliv(strong, {"na": 2, "nb": 2})
        assert not any("weak" in w for w in fit.warnings)
        assert fit.details["instrument_strength"][0] > 50
