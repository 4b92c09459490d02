"""The controlled nonlinear bearing written straight: a Python loop with Runge-Kutta steps, or SciPy's `solve_ivp`.

The controller is the one of `ambid.physics.loop.Loop` (discrete-time PID with current feedback, limits, anti-windup, a
delay of one sample), the plant the one of `ambid.physics.nonlinear.NonlinearPlant`.
"""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp


def right_hand_side(state, voltage, force, plant):
    """x', x'' and i' of a differential pair with motional voltage."""
    x, v, i = state
    w = plant.magnet.coenergy
    gap_a, gap_b = 1.0 / (w.s_a - x), 1.0 / (w.s_b + x)
    flux_a, flux_b = (w.i0 + i) * gap_a, (w.i0 - i) * gap_b
    pull = 0.5 * (w.k_a * flux_a**2 - w.k_b * flux_b**2)
    motional = w.k_a * flux_a * gap_a + w.k_b * flux_b * gap_b
    inductance = w.k_a * gap_a + w.k_b * gap_b + w.leakage
    return (
        v,
        (pull - plant.c * v + force) / plant.m + plant.gravity,
        (voltage - plant.R * i - motional * v) / inductance,
    )


def runge_kutta(state, voltage, force, plant, h):
    """One classical fourth-order step in plain Python."""
    k1 = right_hand_side(state, voltage, force, plant)
    k2 = right_hand_side([s + 0.5 * h * k for s, k in zip(state, k1, strict=True)], voltage, force, plant)
    k3 = right_hand_side([s + 0.5 * h * k for s, k in zip(state, k2, strict=True)], voltage, force, plant)
    k4 = right_hand_side([s + h * k for s, k in zip(state, k3, strict=True)], voltage, force, plant)
    return [s + h / 6 * (a + 2 * (b + c) + d) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)]


def adaptive(state, voltage, force, plant, h):
    """One sample by `solve_ivp` (its default RK45, tolerances that resolve a nanometre)."""
    done = solve_ivp(
        lambda _, s: right_hand_side(s, voltage, force, plant), (0.0, h), state, rtol=1e-6, atol=[1e-10, 1e-8, 1e-7]
    )
    return done.y[:, -1].tolist()


def simulate(bench, excitation, step, noise):
    """Run plant and controller; returns position and current before each sample.

    `bench` is a preset with a delay of one sample, `noise` (n, 4) is added to position, current, force and voltage.
    """
    loop, plant, period = bench.loop, bench.plant, 1.0 / bench.rate_hz
    (low, high), stops = bench.limits.voltage, bench.limits.position
    state, integral, derivative, last, before = [0.0, 0.0, 0.0], 0.0, 0.0, 0.0, 0.0
    log = np.empty((len(excitation), 2))
    for k, added in enumerate(excitation):
        log[k] = state[0], state[2]
        x, i = state[0] + noise[k, 0], state[2] + noise[k, 1]
        change = loop.kd * (x - last) if k else 0.0
        derivative = (loop.filter_s * derivative - change) / (loop.filter_s + period)
        wanted = added - loop.kp * x + integral + derivative - loop.kc * i
        command, growth, last = min(max(wanted, low), high), -loop.ki * period * x, x
        if (wanted - command) * growth <= 0.0:
            integral += growth
        state = step(state, before + noise[k, 3], noise[k, 2], plant, period)
        if not stops[0] < state[0] < stops[1]:
            raise RuntimeError(f"the rotor touched a stop at sample {k}")
        before = command
    return log
