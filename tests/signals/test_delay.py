"""Pure delay: on simulated plants open and closed loop, and on measured records."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.signals import find_delay
from ambid.signals.excitations import gaussian, prbs


def coil(u: np.ndarray, delay: int, noise: np.ndarray, pole: float = 0.9) -> np.ndarray:
    """First-order coil behind a hold, i(t+1) = pole i(t) + u(t - delay), with noise on the measured current."""
    i = np.zeros(u.size)
    for t in range(u.size - 1):
        i[t + 1] = pole * i[t] + (1 - pole) * (u[t - delay] if t >= delay else 0.0)
    return i + noise


@pytest.mark.parametrize("delay", [0, 1, 2, 7])
@pytest.mark.parametrize("pole", [0.5, 0.9, 0.99])
def test_delay_in_open_loop(delay, pole):
    rng = np.random.default_rng(1)
    u = prbs(4000, 1000.0, amplitude=1.0, hold=3)
    found = find_delay(u, coil(u, delay, 0.005 * rng.standard_normal(4000), pole))
    assert found.samples == delay
    assert found.confidence > 0.99
    assert f"delay {delay} sample" in str(found)


@pytest.mark.parametrize("delay", [0, 3, 10])
def test_delay_without_noise(delay):
    u = gaussian(2000, 1000.0, amplitude=1.0)
    assert find_delay(u, coil(u, delay, np.zeros(2000))).samples == delay


def closed_loop(delay: int, seed: int, n: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """Unstable plant y(t+1) = 1.1 y(t) + u(t-delay) + w under u(t) = -K y(t) + dither."""
    rng = np.random.default_rng(seed)
    gain = {0: 0.6, 1: 0.25, 2: 0.18}[delay]
    u, y = np.zeros(n), np.zeros(n)
    w, dither = rng.standard_normal(n), 0.5 * rng.standard_normal(n)
    for t in range(n):
        if t:
            y[t] = 1.1 * y[t - 1] + (u[t - 1 - delay] if t > delay else 0.0) + w[t]
        u[t] = -gain * y[t] + dither[t]
    return u, y


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_delay_under_feedback_where_correlation_is_wrong(delay):
    u, y = closed_loop(delay, seed=delay)
    found = find_delay(u, y)
    assert found.samples == delay
    assert found.confidence > 0.99
    # The feedback answers at once: the strongest correlation is at lag 0, before any delay of the plant.
    correlation = [abs(np.dot(u[: u.size - k], y[k:])) for k in range(6)]
    assert int(np.argmax(correlation)) == 0


def test_weights_are_those_of_the_plant():
    u, y = closed_loop(1, seed=5)
    found = find_delay(u, y)
    assert abs(found.coefficients[0]) < 4 * 0.03
    assert found.coefficients[1] == pytest.approx(1.0, abs=0.1)


def test_feedthrough_counts_from_lag_0():
    rng = np.random.default_rng(2)
    u = rng.standard_normal(3000)
    y = np.roll(u, 2) + 0.5 * u + 0.1 * rng.standard_normal(3000)
    assert find_delay(u, y, feedthrough=True).samples == 0
    assert find_delay(u, y, feedthrough=False).samples == 1  # lag 2, one of which the hold takes


def test_no_relation_gives_no_delay():
    rng = np.random.default_rng(3)
    wrong = [find_delay(rng.standard_normal(2000), rng.standard_normal(2000)).samples for _ in range(20)]
    assert wrong == [None] * 20
    assert "not found" in str(find_delay(rng.standard_normal(2000), rng.standard_normal(2000)))


def test_poor_excitation_gives_low_confidence():
    # A slow sine does not tell one sample from the next.
    rng = np.random.default_rng(4)
    u = np.sin(2 * np.pi * np.arange(3000) / 500.0) + 1e-4 * rng.standard_normal(3000)
    found = find_delay(u, coil(u, 2, 0.01 * rng.standard_normal(3000)))
    assert found.samples is None or found.confidence < 0.9


@pytest.mark.parametrize(
    ("u", "y", "settings", "message"),
    [
        (np.ones(500), np.arange(500.0), {}, "constant"),
        (np.arange(500.0), np.arange(400.0), {}, "shape"),
        (np.arange(500.0), np.full(500, np.nan), {}, "finite"),
        (np.arange(50.0), np.sin(np.arange(50.0)), {}, "too few"),
        (np.arange(500.0), np.sin(np.arange(500.0)), {"max_delay": -1}, "max_delay"),
    ],
)
def test_what_cannot_be_searched_is_refused(u, y, settings, message):
    with pytest.raises(EstimationError, match=message):
        find_delay(u, y, **settings)


@pytest.mark.parametrize("name", ["levitate_stairs_b", "levitate_updown_c", "levitate_sine_d", "levitate_sine_e"])
def test_measured_maglev_has_a_delay_of_one_sample(maglev, duty_to_voltage, name):
    r = maglev(name)
    voltage = np.interp(r["duty_upper"][2000:], *duty_to_voltage.T)
    found = find_delay(voltage, r["current_upper"][2000:])
    assert found.samples == 1
    assert found.confidence > 0.99


def test_measured_record_with_a_smooth_input_says_that_it_does_not_know(maglev, duty_to_voltage):
    # This controller's output holds 0.03 % of its power in the upper half of the spectrum.
    r = maglev("levitate_stairs_a")
    voltage = np.interp(r["duty_upper"][2000:], *duty_to_voltage.T)
    assert find_delay(voltage, r["current_upper"][2000:]).confidence < 0.6
