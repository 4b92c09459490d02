"""The sequential loop of the simulator: controller, delay line, plant, stops."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.physics.coenergy_law import coenergy_derivatives

Integers = NDArray[np.int64]

# Numba looks for edits of a kernel's own file alone: after one of the co-energy, run make clean
_energy: Callable[..., None] = compiled(coenergy_derivatives)


@compiled
def magnet_at(x: float, i: float, magnet: Array) -> tuple[float, float, float]:
    """Return force, k_i and L of a `CoEnergy` (7 numbers) or a `LawMagnet` (12), as `Standing.nonlinear` has them."""
    if magnet.size > 7:
        w, dw = np.empty(12), np.empty((7, 9))
        _energy(x - magnet[11], i, magnet, magnet[9] != 0.0, magnet[10] != 0.0, w, dw)
        return w[0], w[2], w[3]
    j = magnet[6] + i
    gap_a, gap_b = 1.0 / (magnet[1] - x), 1.0 / (magnet[3] + x)
    flux_a, flux_b = (magnet[4] + j) * gap_a, (magnet[4] - j) * gap_b
    pull = 0.5 * (magnet[0] * flux_a * flux_a - magnet[2] * flux_b * flux_b)
    motional = magnet[0] * flux_a * gap_a + magnet[2] * flux_b * gap_b
    return pull, motional, magnet[0] * gap_a + magnet[2] * gap_b + magnet[5]


@compiled
def rate_of_change(
    x: float, v: float, i: float, p: float, voltage: float, force: float, magnet: Array, body: Array
) -> tuple[float, float, float]:
    """Return x'', i' and p' of the nonlinear plant; p lags the force."""
    pull, motional, inductance = magnet_at(x, i, magnet)
    lag = 0.0
    if body[4] < math.inf:
        lag = body[4] * (pull - p)
        pull = p
    acceleration = (pull - body[1] * v + force) / body[0] + body[3]
    if body[5] != 0.0:
        voltage -= body[5] * math.tanh(i / body[6])
    return acceleration, (voltage - body[2] * i - motional * v) / inductance, lag


@compiled
def runge_kutta(
    x: float, v: float, i: float, p: float, voltage: float, force: float, h: float, magnet: Array, body: Array
) -> tuple[float, float, float, float]:
    """Return position, velocity, current and lagging force one classical fourth-order step of `h` s later."""
    v1 = v
    a1, c1, p1 = rate_of_change(x, v, i, p, voltage, force, magnet, body)
    v2 = v + 0.5 * h * a1
    a2, c2, p2 = rate_of_change(x + 0.5 * h * v1, v2, i + 0.5 * h * c1, p + 0.5 * h * p1, voltage, force, magnet, body)
    v3 = v + 0.5 * h * a2
    a3, c3, p3 = rate_of_change(x + 0.5 * h * v2, v3, i + 0.5 * h * c2, p + 0.5 * h * p2, voltage, force, magnet, body)
    v4 = v + h * a3
    a4, c4, p4 = rate_of_change(x + h * v3, v4, i + h * c3, p + h * p3, voltage, force, magnet, body)
    sixth = h / 6.0
    return (
        x + sixth * (v1 + 2.0 * (v2 + v3) + v4),
        v + sixth * (a1 + 2.0 * (a2 + a3) + a4),
        i + sixth * (c1 + 2.0 * (c2 + c3) + c4),
        p + sixth * (p1 + 2.0 * (p2 + p3) + p4),
    )


@compiled
def lie(x: float, i: float, p: float, voltage: float, h: float, magnet: Array, body: Array) -> tuple[float, float]:
    """Return current and lagging force a step later of a rotor that lies on a stop: without speed no voltage by it."""
    _, c1, p1 = rate_of_change(x, 0.0, i, p, voltage, 0.0, magnet, body)
    _, c2, p2 = rate_of_change(x, 0.0, i + 0.5 * h * c1, p + 0.5 * h * p1, voltage, 0.0, magnet, body)
    _, c3, p3 = rate_of_change(x, 0.0, i + 0.5 * h * c2, p + 0.5 * h * p2, voltage, 0.0, magnet, body)
    _, c4, p4 = rate_of_change(x, 0.0, i + h * c3, p + h * p3, voltage, 0.0, magnet, body)
    return i + h / 6.0 * (c1 + 2.0 * (c2 + c3) + c4), p + h / 6.0 * (p1 + 2.0 * (p2 + p3) + p4)


@compiled
def stop(x: float, v: float, low: float, high: float) -> tuple[float, float, bool]:
    """Stop the rotor at the ends of its range, without rebound; the flag says that it touched."""
    if x >= high:
        return high, min(v, 0.0), True
    if x <= low:
        return low, max(v, 0.0), True
    return x, v, False


@compiled
def quantise(value: float, step: float) -> float:
    """Return `value` on the grid of `step`; a step of zero leaves it."""
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


@compiled
def advance_nonlinear(
    x: Array,
    late: float,
    now: float,
    fraction: float,
    disturbance: Array,
    period: float,
    substeps: int,
    magnet: Array,
    body: Array,
    low: float,
    high: float,
) -> bool:
    """Carry the state over one sample in place: first under the voltage `late`, then under `now`."""
    touched = False
    p, v, i = x[0], x[1], x[2]
    lagging = x[3] if x.size > 3 else 0.0
    for part in range(2):
        length = period * (fraction if part == 0 else 1.0 - fraction)
        if length == 0.0:
            continue
        voltage = min(max(late if part == 0 else now, body[7]), body[8]) + body[9] + disturbance[1]
        h = length / substeps
        for _ in range(substeps):
            if v == 0.0 and (p >= high or p <= low):
                push, _, _ = rate_of_change(p, v, i, lagging, voltage, disturbance[0], magnet, body)
                if (p >= high and push >= 0.0) or (p <= low and push <= 0.0):
                    i, lagging = lie(p, i, lagging, voltage, h, magnet, body)
                    touched = True
                    continue
            p, v, i, lagging = runge_kutta(p, v, i, lagging, voltage, disturbance[0], h, magnet, body)
            p, v, hit = stop(p, v, low, high)
            touched = touched or hit
    x[0], x[1], x[2] = p, v, i
    if x.size > 3:
        x[3] = lagging
    return touched


@compiled
def advance_linear(
    x: Array,
    centre: Array,
    late: float,
    now: float,
    disturbance: Array,
    a: Array,
    b: Array,
    b_late: Array,
    e: Array,
    deviation: Array,
) -> None:
    """Carry the state over one sample in place with exact zero-order-hold matrices; voltages are deviations.

    `deviation` (n_states,) is room to work in.
    """
    n = x.size
    for row in range(n):
        deviation[row] = x[row] - centre[row]
    for row in range(n):
        s = centre[row] + b[row] * now + b_late[row] * late
        for column in range(n):
            s += a[row, column] * deviation[column]
        for column in range(e.shape[1]):
            s += e[row, column] * disturbance[column]
        x[row] = s


@compiled
def run(
    linear: bool,
    excitation: Array,
    setpoint: Array,
    sensor_noise: Array,
    disturbance: Array,
    start: Array,
    centre: Array,
    centre_input: float,
    outputs: Integers,
    roles: tuple[int, int],
    a: Array,
    b: Array,
    b_late: Array,
    e: Array,
    magnet: Array,
    body: Array,
    gains: Array,
    delay: int,
    fraction: float,
    period: float,
    substeps: int,
    resolution: Array,
    input_limits: tuple[float, float, float],
    stops: tuple[float, float],
    gap: tuple[float, float],
) -> tuple[Array, Array, Array, int, int, int, int]:
    """Run the loop over all samples.

    `outputs` are the states that are measured, `roles` the columns among them of position and current (-1: none),
    `gains` kp, ki T, kd, kc, tau, T, and `input_limits` low, high and resolution of the command.
    """
    n, ny = sensor_noise.shape
    measured, command, states = np.empty((n, ny)), np.empty(n), np.empty((n, start.size))
    contact, saturated, n_saturated = -1, -1, 0
    x, room = start.copy(), np.empty(start.size)
    at, current_at = roles
    integral = derivative = last = 0.0
    low, high, step = input_limits
    for k in range(n):
        for j in range(ny):
            truth = x[outputs[j]]
            if not math.isfinite(truth):
                return measured, command, states, contact, saturated, n_saturated, k
            measured[k, j] = quantise(truth + sensor_noise[k, j], resolution[j])
        states[k] = x
        wanted, error = centre_input + excitation[k], 0.0
        if at >= 0:
            y = measured[k, at]
            error = setpoint[k] - y
            derivative = (gains[4] * derivative - (gains[2] * (y - last) if k > 0 else 0.0)) / (gains[4] + gains[5])
            last = y
            wanted += gains[0] * error + integral + derivative
        if current_at >= 0:
            wanted -= gains[3] * (measured[k, current_at] - centre[outputs[current_at]])
        beyond = max(wanted - high, 0.0) + min(wanted - low, 0.0)
        if beyond != 0.0:
            n_saturated += 1
            saturated = k if saturated < 0 else saturated
        # Anti-windup: while the command is limited the integral may only move back.
        growth = gains[1] * error
        if beyond * growth <= 0.0:
            integral += growth
        command[k] = min(max(quantise(wanted, step), low), high)
        now = command[k - delay] if k >= delay else centre_input
        late = command[k - delay - 1] if k > delay else centre_input
        if linear:
            advance_linear(x, centre, late - centre_input, now - centre_input, disturbance[k], a, b, b_late, e, room)
            touched = False
            if at >= 0:
                x[0], x[1], touched = stop(x[0], x[1], stops[0], stops[1])
        else:
            touched = advance_nonlinear(
                x, late, now, fraction, disturbance[k], period, substeps, magnet, body, stops[0], stops[1]
            )
            # Beyond a pole face the equations hold no more, though they give finite numbers again.
            if not gap[0] < x[0] < gap[1] and k + 1 < n:
                return measured, command, states, contact, saturated, n_saturated, k + 1
        if touched and contact < 0:
            contact = k + 1
    return measured, command, states, contact, saturated, n_saturated, -1
