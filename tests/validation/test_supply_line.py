"""A ball under fast feedback of noisy signals, as on public benches, whose supply and base hold one line."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import ambid

M, K_X, K_I, R, L, RATE_HZ = 4.4e-3, -3.5, -0.1, 28.0, 2.05, 1000.0
RIG = """schema = "ambid.rig/1"
model = "one-axis"
channels.voltage = { column = "voltage", delay = "auto" }
channels.current = { column = "current" }
channels.position = { column = "position" }
parameters.m = { value = 4.4, unit = "g", role = "fixed" }
parameters.c = { value = 0.0, unit = "N s/m", role = "fixed" }
"""


def record(seed, n=6000):
    """Exact steps of m x'' = k_i i - k_x x + F, L i' = u + V - R i - k_i x' under u of position and current."""
    rng, period = np.random.default_rng(seed), 1.0 / RATE_HZ
    A = np.array([[0.0, 1.0, 0.0], [-K_X / M, 0.0, K_I / M], [0.0, -K_I / L, -R / L]])
    B = np.array([[0.0, 0.0], [0.0, 1.0 / M], [1.0 / L, 0.0]])
    step = expm(np.block([[A, B], [np.zeros((2, 5))]]) * period)
    z, u, before, rows = np.zeros(3), 0.0, np.zeros(2), np.zeros((n, 3))
    for k in range(n):
        y = z[[0, 2]] + [3.5e-6, 5e-3] * rng.standard_normal(2)
        moved = -3e-3 * min(max((k - 2000) / 700, 0.0), 1.0)
        u = -0.333 * u + 313.2e3 * (y[0] - moved) - 308.7e3 * (before[0] - moved) - 59.5 * y[1] - 19.5 * before[1]
        rows[k], before = (u, *y[::-1]), y
        line = np.sin(2.0 * np.pi * 1.39 * k * period)
        disturbances = np.array([1.5, 1.5e-3]) * rng.standard_normal(2) + line * np.array([0.3, 1e-3])
        z = step[:3, :3] @ z + step[:3, 3:] @ np.add(disturbances, [u, 0.0])
    return dict(zip(("voltage", "current", "position"), np.add(rows, [24.0, 0.857, 23.7e-3]).T, strict=True))


@pytest.fixture(scope="module")
def estimate(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "ball.toml"
    path.write_text(RIG)
    units = {"voltage": "V", "current": "A", "position": "m"}
    return ambid.identify(record(0), path, rate_hz=RATE_HZ, units=units)


def test_a_delay_far_from_where_the_search_begins_is_found(estimate):
    """Noise that is fed back makes minima of the likelihood at several delays; here 2.4 samples were taken for 0."""
    delay = estimate.delay["voltage"]
    assert (delay.samples, delay.fraction) == (0, 0.0)


def test_a_line_in_force_and_voltage_at_once_is_taken_in(estimate):
    """One channel alone leaves k_x at a fifth of what it is."""
    assert any(word.startswith("line") for word in estimate.extended)
    for name, true in (("k_x", K_X), ("k_i", K_I), ("R", R), ("L", L)):
        assert abs(estimate[name].value - true) < 3.0 * estimate[name].sd
        assert abs(estimate[name].value - true) < 0.2 * abs(true)
