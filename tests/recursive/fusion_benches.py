"""Simulated sensors on one axis, with known position, zeros and faults."""

from __future__ import annotations

import numpy as np

from ambid.recursive.fusion import FusedSensor, SensorFusion

RATE = 20_000.0
GAIN = 4000.0  # V/m
NOISE = 2e-3  # V: 0.5 um
SIGMA = NOISE / GAIN
Q = 1e-2  # (m/s²)²s


def sensors(n=3, **settings):
    settings = {"gain": GAIN, "noise_sd": NOISE, "resolution": 0.0} | settings
    return [FusedSensor(name="abcdef"[i], **settings) for i in range(n)]


def fusion(n=3, *, q=Q, settings=None, **more):
    return SensorFusion(RATE, sensors(n, **(settings or {})), q=q, **more)


def vibration(n, amplitude=15e-6, hz=50.0):
    return amplitude * np.sin(2 * np.pi * hz * np.arange(n) / RATE)


def readings(x, n_sensors=3, seed=0):
    """Values of sound sensors, V."""
    rng = np.random.default_rng(seed)
    return GAIN * x[:, None] + NOISE * rng.standard_normal((x.size, n_sensors))
