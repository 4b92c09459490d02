"""The sequential loop of a rotor: a controller on each axis, delay lines, the coupled plant, stops.

Import it only from a module that is itself imported inside a function: it loads the compiler.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.simulation.kernels import Law, carry_law, multiply, order, ordered, quantise

Integers = NDArray[np.int64]

Linear = tuple[Array, Array, Array, Array]  # A, B, B_late and E of a sample
# Of `rate`: entries of A without magnets, their places (n, 2), what forces do to the states (n_states, n_axes), poles
# and their axes, resistances, leakages; first states of the currents that flow and that act; fraction, period, steps
Nonlinear = tuple[Array, Integers, Array, Array, Integers, Array, Array, tuple[int, int], tuple[float, float, int]]


@compiled(error_model="numpy")
def rate(
    x: Array, seen: Array, moving: Array, voltage: Array, force: Array, plant: Nonlinear, into: Array, room: Array
) -> bool:
    """Write the derivative of the states; tell whether all gaps are open.

    `seen`, `moving` (n_axes,): what each axis sees of the rotor and of its speed; `voltage`, `force` (n_axes,): with
    disturbances; `room` (n_axes, n_axes + 2) is to work in: inductances, what drives the currents, force.
    """
    values, places, pushes, poles, axes, resistance, leakage, (flows, acts), _ = plant
    n = voltage.size
    into[:] = 0.0
    for k in range(values.size):
        into[places[k, 0]] += values[k] * x[places[k, 1]]
    room[:] = 0.0
    for j in range(n):
        room[j, j] = leakage[j]
        room[j, n] = voltage[j] - resistance[j] * x[flows + j]
        room[j, n + 1] = force[j]
    for p in range(poles.shape[0]):
        k, gap, current, sigma, d1, w1, d2, w2 = poles[p]
        a, b = axes[p, 0], axes[p, 1]
        gap -= d1 * seen[a]
        acting = current + w1 * x[acts + a]
        current += w1 * x[flows + a]
        closing = d1 * moving[a]
        if b >= 0:
            gap -= d2 * seen[b]
            acting += w2 * x[acts + b]
            current += w2 * x[flows + b]
            closing += d2 * moving[b]
        if not gap > 0.0:
            return False
        r = math.sqrt(1.0 + sigma * current * current)
        pull = k / (gap * gap) * acting * acting / (1.0 + math.sqrt(1.0 + sigma * acting * acting))
        motional, own = k / (gap * gap) * current / r * closing, k / gap / (r * r * r)
        room[a, n + 1] += d1 * pull
        room[a, n] -= w1 * motional
        room[a, a] += own * w1 * w1
        if b >= 0:
            room[b, n + 1] += d2 * pull
            room[b, n] -= w2 * motional
            room[b, b] += own * w2 * w2
            room[a, b] += own * w1 * w2
            room[b, a] += own * w1 * w2
    multiply(pushes, room[:, n + 1], into)
    for a in range(n):  # inductances are symmetric and positive: no pivots are sought
        for b in range(a + 1, n):
            if room[b, a] != 0.0:
                share = room[b, a] / room[a, a]
                for c in range(a, n + 1):
                    room[b, c] -= share * room[a, c]
    for a in range(n - 1, -1, -1):
        for c in range(a + 1, n):
            room[a, n] -= room[a, c] * room[c, n]
        room[a, n] /= room[a, a]
        into[flows + a] = room[a, n]
    return True


@compiled(error_model="numpy")
def advance_poles(
    x: Array,
    late: Array,
    now: Array,
    disturbance: Array,
    plant: Nonlinear,
    magnets: Array,
    pushes: Array,
    stops: tuple[float, float],
) -> tuple[bool, bool]:
    """Carry the states over one sample in place, by classical Runge-Kutta steps; tell of contact and of open gaps."""
    fraction, period, steps = plant[8]
    n, n_coordinates = magnets.shape
    at, total, slope = np.empty(x.size), np.empty(x.size), np.empty(x.size)
    seen, moving, voltage, room = np.empty(n), np.empty(n), np.empty(n), np.empty((n, n + 2))
    touched = False
    for part in range(2):
        length = period * (fraction if part == 0 else 1.0 - fraction)
        if length == 0.0:
            continue
        h = length / steps
        for j in range(n):
            voltage[j] = (late[j] if part == 0 else now[j]) + disturbance[n + j]
        for _ in range(steps):
            total[:] = x
            at[:] = x
            for stage in range(4):
                seen[:] = 0.0
                moving[:] = 0.0
                multiply(magnets, at, seen)
                multiply(magnets, at[n_coordinates:], moving)
                if not rate(at, seen, moving, voltage, disturbance, plant, slope, room):
                    return touched, False
                weight = h / 6.0 if stage in (0, 3) else h / 3.0
                step = 0.5 * h if stage < 2 else h
                for k in range(x.size):
                    total[k] += weight * slope[k]
                    at[k] = x[k] + step * slope[k]
            x[:] = total
            touched = touch(x, magnets, pushes, stops) or touched
    return touched, True


@compiled(error_model="numpy")
def touch(x: Array, magnets: Array, pushes: Array, stops: tuple[float, float]) -> bool:
    """Stop the rotor at the magnets' planes without rebound, in place; tell whether it touched.

    `magnets` (n_axes, n): what each axis sees of the n coordinates that come first in `x`, their rates after them;
    `pushes` (n_axes, n): what moves an axis by one and is done by a force on it.
    """
    touched = False
    n = magnets.shape[1]
    for j in range(magnets.shape[0]):
        at, speed = 0.0, 0.0
        for k in range(n):
            at += magnets[j, k] * x[k]
            speed += magnets[j, k] * x[n + k]
        end = stops[1] if at >= stops[1] else stops[0] if at <= stops[0] else math.nan
        if math.isnan(end):
            continue
        touched = True
        back = -speed if (at >= stops[1]) == (speed > 0.0) else 0.0
        for k in range(n):
            x[k] += pushes[j, k] * (end - at)
            x[n + k] += pushes[j, k] * back
    return touched


@compiled(error_model="numpy")
def run_rotor(
    excitation: Array,
    noise: Array,
    offsets: Array,
    equations: Linear | Nonlinear,
    read: Array,
    roles: Integers,
    gains: Array,
    law: Law,
    resolution: Array,
    limits: tuple[float, float, float],
    line: Array,
    stops: tuple[float, float],
    magnets: Array,
    pushes: Array,
    carried: Integers,
    x: Array,
    z: Array,
    memory: Array,
    counts: Integers,
    measured: Array,
    command: Array,
    truth: Array,
) -> int:
    """Run the loop of all axes from where it stands.

    `excitation` (n, n_inputs); `noise` (n, n_outputs + n_disturbances); `offsets` (n, n_outputs) run-out, or (0, ...).
    `read` (n_outputs, n_states); `roles` (n_inputs, 2): outputs of position and current that each axis feeds back, -1:
    none; `gains` kp, ki T, kd, kc, tau, T; `limits` low, high and resolution of the commands; `line` (whole delay +
    2, n_inputs); `carried`: states that are currents; states `x` of the plant, `z` of the law; `memory` (n_inputs, 3)
    of gains: integral, derivative, last position, NaN at first. All four go on. Filled: measured, command, truth =
    what each axis sees of the rotor, then the currents; counts = first contact, first limited sample (-1: none),
    limited samples. Returns the first sample that is not finite or in which a gap closes, -1 for none.
    """
    n, n_inputs, n_outputs = command.shape[0], command.shape[1], measured.shape[1]
    n_axes = magnets.shape[0]
    fed, wanted, lost = np.zeros(law[3].shape[1]), np.zeros(n_inputs), np.zeros(n_inputs)
    disturbance, after, seen = np.empty(noise.shape[1] - n_outputs), np.empty(x.size), np.empty(n_outputs)
    whole = line.shape[0] - 2
    for k in range(n):
        seen[:] = 0.0
        multiply(read, x, seen)
        for j in range(n_outputs):
            if not math.isfinite(seen[j]):
                return k
            run_out = offsets[k, j] if offsets.shape[0] > 0 else 0.0
            measured[k, j] = quantise(seen[j] + run_out + noise[k, j], resolution[j])
        truth[k] = 0.0
        multiply(magnets, x, truth[k])
        for j in range(carried.size):
            truth[k, n_axes + j] = x[carried[j]]
        beyond = False
        for row in range(whole + 1, 0, -1):
            line[row] = line[row - 1]
        if fed.size > 0:
            m = 0
            for j in range(2 * n_inputs):
                if roles[j // 2, j % 2] >= 0:
                    fed[m] = measured[k, roles[j // 2, j % 2]]
                    m += 1
            ordered(law, z, fed, wanted)
        for j in range(n_inputs):
            error, moved, current = 0.0, 0.0, 0.0
            if roles[j, 0] >= 0:
                error = -measured[k, roles[j, 0]]
                moved = -error - memory[j, 2] if math.isfinite(memory[j, 2]) else 0.0
                memory[j, 2] = -error
            if roles[j, 1] >= 0:
                current = measured[k, roles[j, 1]]
            command[k, j], memory[j, 0], memory[j, 1], limited = order(
                excitation[k, j] + wanted[j], error, moved, current, memory[j, 0], memory[j, 1], gains, limits
            )
            line[0, j] = command[k, j]
            lost[j] = command[k, j] - quantise(excitation[k, j] + wanted[j], limits[2])
            beyond = beyond or limited
        if fed.size > 0:
            carry_law(law, z, fed, lost)
        if beyond:
            counts[2] += 1
            if counts[1] < 0:
                counts[1] = k
        disturbance[:] = noise[k, n_outputs:]
        if len(equations) == 4:  # known while compiling: each plant compiles its own equations alone
            a, b, b_late, e = equations
            after[:] = 0.0
            multiply(a, x, after)
            multiply(b, line[whole], after)
            multiply(b_late, line[whole + 1], after)
            multiply(e, disturbance, after)
            x[:] = after
            touched = touch(x, magnets, pushes, stops)
        else:
            touched, open_gaps = advance_poles(
                x, line[whole + 1], line[whole], disturbance, equations, magnets, pushes, stops
            )
            if not open_gaps:
                return k
        if touched and counts[0] < 0:
            counts[0] = k + 1
    return -1
