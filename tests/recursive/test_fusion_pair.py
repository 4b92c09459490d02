"""A differential pair: temperature cancels in the position and shows in the sum."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive.fusion import FusedSensor, SensorFusion
from tests.recursive.fusion_benches import GAIN, NOISE, RATE, Q, vibration

PER_KELVIN = 1e-6 * GAIN  # V/K
N = 40_000


def pair(**settings):
    gains = (("upper", GAIN), ("lower", -GAIN))
    sensors = [FusedSensor(name=s, gain=g, noise_sd=NOISE, resolution=0.0, **settings) for s, g in gains]
    return SensorFusion(RATE, sensors, q=Q, temperature_rate=20.0)


def test_twenty_micrometres_of_drift_leave_less_than_a_tenth_of_one():
    x, warming = vibration(N), 20e-6 * np.linspace(0.0, 1.0, N)
    noise = NOISE * np.random.default_rng(1).standard_normal((N, 2))
    fused = pair(drift_rate=4e-5, warmth=PER_KELVIN)
    out = fused.update(GAIN * np.column_stack([x + warming, warming - x]) + noise)
    assert fused.events == ()
    assert abs(np.mean(out[-4000:, 0] - x[-4000:])) < 0.1e-6
    found, sd = fused.temperature
    assert found == pytest.approx(20.0, abs=4 * sd)
    assert sd < 0.5


def test_without_a_shared_temperature_the_drift_does_not_reach_the_position_either_but_costs_certainty():
    x, warming = vibration(N), 20e-6 * np.linspace(0.0, 1.0, N)
    noise = NOISE * np.random.default_rng(1).standard_normal((N, 2))
    fused = pair(drift_rate=0.08)
    out = fused.update(GAIN * np.column_stack([x + warming, warming - x]) + noise)
    assert abs(np.mean(out[-4000:, 0] - x[-4000:])) < 1e-6
    assert out[-1, 1] == pytest.approx(20e-6 * np.sqrt(2.0 / 2.0), rel=0.05)  # √(t/2) of two walks of 20 um/√s
