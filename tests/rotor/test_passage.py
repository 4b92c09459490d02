"""Run-ups and coast-downs: resonances and amplification factors against poles, and closed loops, that are known."""

import dataclasses
import functools

import numpy as np
import pytest

import ambid
from ambid.physics.presets import preset
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.record import Channel, Record
from ambid.rig import rig_of_preset
from ambid.rotor.passage import track_passage, whirl_of
from ambid.rotor.passage_fit import answers
from ambid.rotor.resonance import peaks, resonances
from ambid.simulation.plant import closed_loop_poles, excited_loop
from ambid.simulation.rotor_bench import RotorBench
from tests.tiers import long, runs

RPM = 30.0 / np.pi
RATE = 4000.0
PLANE = RotorModel(bearings=(Bearing(name="A", axes=("ax", "ay")),), polar=True, speed=1.0)
POLES = np.array([complex(-0.03 * 700.0, 700.0), complex(-0.4 * 300.0, 280.0)])
SHARES = np.array([6e-11 + 1.5e-11j, 4.5e-11 - 3e-11j])


def passed(w, alpha, s):
    """Return modal coordinates of a pole that unbalance drives at the speeds `w`, integrated sample by sample."""
    from scipy.signal import lfilter

    T, angle = 1.0 / RATE, np.cumsum(w) / RATE
    total = np.zeros(w.size, dtype=complex)
    for at, weight in ((-0.7745966692414834, 5 / 18), (0.0, 8 / 18), (0.7745966692414834, 5 / 18)):
        tau = 0.5 * T * (1.0 + at)
        now, turned = w + alpha * tau, angle + w * tau + 0.5 * alpha * tau**2
        total += weight * T * np.exp(s * (T - tau)) * (now**2 - 1j * alpha) * np.exp(1j * turned)
    moved = lfilter([1.0], [1.0, -np.exp(s * T)], total)
    return np.concatenate([[0.0], moved[:-1]])


@functools.cache
def clean(seconds, low, high):
    """Return angle, speed and the motion x + jy of a plane that runs through its poles, forward."""
    n = round(seconds * RATE)
    alpha = (high - low) / seconds
    w = low + alpha * np.arange(n) / RATE
    angle = low * np.arange(n) / RATE + 0.5 * alpha * (np.arange(n) / RATE) ** 2
    scale = np.exp(1j * (angle - np.cumsum(w) / RATE))  # the sum of the speeds is not quite the angle
    z = sum(c * passed(w, alpha, s) for c, s in zip(SHARES, POLES, strict=True))
    return angle, w, z * scale


def noisy(seconds, low, high, seed, noise=4e-7):
    """Return the record of a plane."""
    angle, w, z = clean(seconds, low, high)
    dirty = np.random.default_rng(seed).standard_normal((2, w.size)) * noise
    names = ("ax_position", z.real + dirty[0], "m"), ("ay_position", z.imag + dirty[1], "m"), ("angle", angle, "rad")
    return Record(rate_hz=RATE, channels=tuple(Channel(name=n, unit=u, values=x) for n, x, u in names))


def steady_truth():
    """Return the peak of the response at constant speed near the first pole."""
    w = np.linspace(400.0, 900.0, 20_001)
    size = np.abs(sum(c * w**2 / (1j * w - s) for c, s in zip(SHARES, POLES, strict=True)))
    return max(peaks(w, size), key=lambda p: p.size)


def one(seconds, low, high, seed):
    fit = resonances([track_passage(noisy(seconds, low, high, seed), PLANE)])
    return fit, next(r for r in fit.resonances if not r.critically_damped)
