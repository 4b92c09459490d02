"""Noise, quantisation, limits and anti-windup."""

import math

import numpy as np
import pytest

from ambid.physics.linear_model import discretise, model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.presets import preset
from ambid.simulation import LinearPlant, noise_at_snr, simulate, simulate_preset

PLANT = LinearPlant(model=model("one-axis"), parameters=preset("thesis").parameters)
RATE, N = 10_000.0, 40_000


def test_same_seed_same_numbers() -> None:
    p = preset("unstable-bearing")
    u = np.zeros(200)
    one, two, other = (simulate_preset(p, u, seed=s, nonlinear=True) for s in (7, 7, 8))
    for name in one.record.names:
        assert np.array_equal(one.record[name], two.record[name])
        assert not np.array_equal(one.record[name], other.record[name])
    drawn = simulate_preset(p, u, seed=np.random.default_rng(7), nonlinear=True)
    assert np.array_equal(drawn.record["position"], one.record["position"])


def test_one_level_does_not_change_the_other_numbers() -> None:
    quiet = simulate(PLANT, np.zeros(100), rate_hz=RATE, seed=1, noise=Noise(position=1e-6))
    loud = simulate(PLANT, np.zeros(100), rate_hz=RATE, seed=1, noise=Noise(position=1e-6, current=1e-3))
    assert np.array_equal(quiet.record["position"], loud.record["position"])


def spread_within(values: np.ndarray, sd: float) -> bool:
    """True where the sample variance lies within four standard errors of sd**2."""
    return abs(values.var() / sd**2 - 1.0) < 4.0 * math.sqrt(2.0 / values.size)


def white(values: np.ndarray) -> bool:
    """True where the correlation of neighbours lies within four standard errors of zero."""
    return abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 4.0 / math.sqrt(values.size)


def test_sensor_noise_has_its_rms_and_is_white() -> None:
    done = simulate(PLANT, np.zeros(N), rate_hz=RATE, seed=2, noise=Noise(position=3e-6, current=2e-3))
    assert not done.states.any()
    for name, sd in (("position", 3e-6), ("current", 2e-3)):
        assert spread_within(done.record[name], sd)
        assert white(done.record[name])


def test_process_noise_has_its_density_and_is_held() -> None:
    noise = Noise(force=0.02, voltage=0.003)
    done = simulate(PLANT, np.zeros(N), rate_hz=RATE, seed=3, noise=noise)
    d, _ = discretise(PLANT.model.matrices(PLANT.parameters), 1.0 / RATE)
    left = done.states[1:] - done.states[:-1] @ d.A.T
    drawn, rest, _, _ = np.linalg.lstsq(d.E, left.T, rcond=None)
    assert np.all(rest < 1e-20)  # held over the sample: two numbers explain three states
    for row, density in zip(drawn, (0.02, 0.003), strict=True):
        assert spread_within(row, density * math.sqrt(RATE / 2))
        assert white(row)


def test_nonlinear_process_noise_acts_like_the_linear() -> None:
    p = preset("unstable-bearing")
    noise = Noise.held(rate_hz=p.rate_hz, force=0.5, voltage=0.01)
    linear, bent = (simulate_preset(p, np.zeros(400), seed=4, nonlinear=b, noise=noise) for b in (False, True))
    assert bent.states[:, 0] == pytest.approx(linear.states[:, 0], abs=1e-3 * np.abs(linear.states[:, 0]).max())


def test_quantisation_rounds_to_the_grid() -> None:
    u = np.random.default_rng(0).standard_normal(N)
    noise = Noise(position_resolution=2e-6, current_resolution=1e-3, voltage_resolution=0.05)
    done = simulate(PLANT, u, rate_hz=RATE, seed=0, noise=noise)
    for name, step, truth in (
        ("position", 2e-6, done.states[:, 0]),
        ("current", 1e-3, done.states[:, 2]),
        ("voltage", 0.05, u),
    ):
        counts = done.record[name] / step
        assert counts == pytest.approx(np.round(counts), abs=1e-6)
        error = done.record[name] - truth
        assert np.abs(error).max() <= step / 2 * (1 + 1e-9)
        if name == "current":  # many steps large: uniform error
            assert error.std() == pytest.approx(step / math.sqrt(12), rel=0.05)


def test_command_is_limited_and_counted() -> None:
    u = 3.0 * np.sin(np.arange(1000) / 20.0)
    limits = Limits(voltage=(-2.0, 1.0), current=(-0.01, 0.01))
    done = simulate(PLANT, u, rate_hz=RATE, seed=0, limits=limits)
    beyond = (u < -2.0) | (u > 1.0)
    assert np.array_equal(done.record["voltage"], np.clip(u, -2.0, 1.0))
    assert done.n_saturated == beyond.sum()
    assert done.first_saturated == np.argmax(beyond)
    assert done.n_over_current == (np.abs(done.states[:, 2]) > 0.01).sum() > 0
    assert not done.within_limits
    assert len(done.warnings) == 2


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_integral_does_not_wind_up(sign: float) -> None:
    # a set point out of reach for a second, then back: the command leaves its limit at once
    parameters = {"m": 0.1, "k_x": 500.0, "k_i": sign * 10.0, "R": 1.0, "L": 0.01, "c": 2.0}
    plant = LinearPlant(model=model("one-axis"), parameters=parameters)
    loop = Loop(ki=sign * 2000.0)
    setpoint = np.where(np.arange(4000) < 2000, 0.1, 0.0)
    done = simulate(
        plant, np.zeros(4000), rate_hz=2000.0, seed=0, loop=loop, limits=Limits(voltage=(-1.0, 1.0)), setpoint=setpoint
    )
    v = sign * done.record["voltage"]
    assert v[1999] == 1.0
    assert v[2010] < 1.0  # wound up over 2000 samples it would stay there for thousands
    assert abs(done.states[-1, 0]) < 2e-3


def test_noise_at_snr() -> None:
    u = np.random.default_rng(1).standard_normal(N)
    clean = simulate(PLANT, u, rate_hz=RATE, seed=0)
    noisy = simulate(PLANT, u, rate_hz=RATE, seed=0, noise=noise_at_snr(clean, 40.0))
    for name in ("position", "current"):
        signal, noise = clean.record[name], noisy.record[name] - clean.record[name]
        assert 10 * math.log10(signal.var() / noise.var()) == pytest.approx(40.0, abs=0.2)
