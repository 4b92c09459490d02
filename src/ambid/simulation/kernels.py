"""The sequential loops of the simulator: controller, delay line, plant and stops of one axis, and of a rotor's axes.
Import it only from a module imported inside a function: it loads the compiler.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.physics.coenergy_law import coenergy_derivatives

Integers = NDArray[np.int64]

# The equations of a plant: A, B, B_late and E; or magnet, body, and fraction, period and steps of a sample, as
# `Standing.equations` has them.
Linear = tuple[Array, Array, Array, Array]
Nonlinear = tuple[Array, Array, tuple[float, float, int]]

# Of a `StateLaw`: A, B, C, D and G; all empty where there is none
Law = tuple[Array, Array, Array, Array, Array]

_energy: Callable[..., None] = compiled(coenergy_derivatives)


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def lie(x: float, i: float, p: float, voltage: float, h: float, magnet: Array, body: Array) -> tuple[float, float]:
    """Return current and lagging force a step later of a rotor that lies on a stop: without speed no voltage by it."""
    _, c1, p1 = rate_of_change(x, 0.0, i, p, voltage, 0.0, magnet, body)
    _, c2, p2 = rate_of_change(x, 0.0, i + 0.5 * h * c1, p + 0.5 * h * p1, voltage, 0.0, magnet, body)
    _, c3, p3 = rate_of_change(x, 0.0, i + 0.5 * h * c2, p + 0.5 * h * p2, voltage, 0.0, magnet, body)
    _, c4, p4 = rate_of_change(x, 0.0, i + h * c3, p + h * p3, voltage, 0.0, magnet, body)
    return i + h / 6.0 * (c1 + 2.0 * (c2 + c3) + c4), p + h / 6.0 * (p1 + 2.0 * (p2 + p3) + p4)


@compiled(error_model="numpy", inline="always")
def stop(x: float, v: float, low: float, high: float) -> tuple[float, float, bool]:
    """Stop the rotor at the ends of its range, without rebound; the flag says that it touched."""
    if x >= high:
        return high, min(v, 0.0), True
    if x <= low:
        return low, max(v, 0.0), True
    return x, v, False


@compiled(error_model="numpy", inline="always")
def quantise(value: float, step: float) -> float:
    """Return `value` on the grid of `step`; a step of zero leaves it."""
    return math.floor(value / step + 0.5) * step if step > 0.0 else value


@compiled(error_model="numpy", inline="always")
def order(
    feed: float,
    error: float,
    moved: float,
    carried: float,
    integral: float,
    derivative: float,
    gains: Array,
    limits: tuple[float, float, float],
) -> tuple[float, float, float, bool]:
    """Return command, next integral and derivative of the law of `Loop` on one axis, and whether it was limited.
    `feed`: ordered without feedback; `carried`: current beyond that at rest; `gains`: kp, ki T, kd, kc, tau, T;
    `limits`: low, high and resolution of the command.
    """
    derivative = (gains[4] * derivative - gains[2] * moved) / (gains[4] + gains[5])
    wanted = feed + (gains[0] * error + integral + derivative) - gains[3] * carried
    low, high, step = limits
    beyond = max(wanted - high, 0.0) + min(wanted - low, 0.0)
    # Anti-windup: while the command is limited the integral may only move back.
    growth = gains[1] * error
    if beyond * growth <= 0.0:
        integral += growth
    return min(max(quantise(wanted, step), low), high), integral, derivative, beyond != 0.0


@compiled(error_model="numpy", inline="always")
def multiply(matrix: Array, vector: Array, into: Array) -> None:
    """Add a product to `into`; written out, so that no library's threads are asked for matrices as small as these."""
    for row in range(matrix.shape[0]):
        s = 0.0
        for column in range(matrix.shape[1]):
            s += matrix[row, column] * vector[column]
        into[row] += s


@compiled(error_model="numpy")
def ordered(law: Law, z: Array, inputs: Array, into: Array) -> None:
    """Write what a `StateLaw` orders; zero without one."""
    into[:] = 0.0
    multiply(law[2], z, into)
    multiply(law[3], inputs, into)


@compiled(error_model="numpy")
def carry_law(law: Law, z: Array, inputs: Array, lost: Array) -> None:
    """Carry the states of a `StateLaw` over one sample in place; `lost`: what was ordered less what was wanted."""
    after = np.zeros(z.size)
    multiply(law[0], z, after)
    multiply(law[1], inputs, after)
    multiply(law[4], lost, after)
    z[:] = after


@compiled(error_model="numpy")
def advance_nonlinear(
    x: Array,
    late: float,
    now: float,
    timing: tuple[float, float, int],
    disturbance: Array,
    magnet: Array,
    body: Array,
    stops: tuple[float, float],
) -> bool:
    """Carry the state over one sample in place: first under the voltage `late`, then under `now`."""
    (fraction, period, substeps), (low, high) = timing, stops
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


@compiled(error_model="numpy", inline="always")
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
    """Carry the state over one sample in place with exact zero-order-hold matrices; voltages are deviations."""
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


@compiled(error_model="numpy")
def advance_plant(
    x: Array,
    centre: Array,
    voltages: tuple[float, float, float],
    disturbance: Array,
    equations: Linear | Nonlinear,
    stops: tuple[float, float],
    room: Array,
) -> bool:
    """Carry the state (position, velocity first if any) over one sample in place; tell whether the rotor touched a
    stop. `voltages`: before and after the delay's fraction, and at `centre`; `disturbance`: held, of the nonlinear
    plant force, then voltage.
    """
    late, now, rest = voltages
    if len(equations) == 3:  # known while compiling: each plant compiles its own equations alone
        magnet, body, timing = equations
        return advance_nonlinear(x, late, now, timing, disturbance, magnet, body, stops)
    else:
        a, b, b_late, e = equations
        advance_linear(x, centre, late - rest, now - rest, disturbance, a, b, b_late, e, room)
        touched = False
        if x.size > 1:
            x[0], x[1], touched = stop(x[0], x[1], stops[0], stops[1])
        return touched


@compiled(error_model="numpy")
def run(
    excitation: Array,
    setpoint: Array,
    noise: Array,
    force: Array,
    force_column: int,
    edges: Integers,
    equations: Linear | Nonlinear,
    sensor_gain: Array,
    x: Array,
    memory: Array,
    line: Array,
    counts: Integers,
    centre: Array,
    centre_input: float,
    outputs: Integers,
    roles: tuple[int, int],
    gains: Array,
    law: Law,
    offset: float,
    resolution: Array,
    limits: tuple[float, float, float],
    stops: tuple[float, float],
    gap: tuple[float, float],
    measured: Array,
    command: Array,
    states: Array,
) -> int:
    """Run the loop over some samples into measured, command, states; return the first that is not finite or outside the
    `gap` in which the equations hold, -1 for none.

    `noise` (n, n_outputs + n_disturbances); `force` (n,) adds to disturbance `force_column`, or is empty. `edges`
    (n_pieces + 1) bound stretches of `sensor_gain` (n_pieces, n_outputs) and, one axis more in front, of a linear
    plant's matrices. `outputs`: measured states; `roles`: columns of position and current (-1: none); `gains`: kp, ki
    T, kd, kc, tau, T; `offset`: the current's sensor without current; `limits`: low, high, resolution. Kept between
    calls: x; memory = integral, derivative, last position, law; line = newest commands, newest first (whole delay + 2);
    counts = samples done, first contact, first limited command (-1: none), limited commands.
    """
    at, current_at = roles
    integral, derivative, last = memory[0], memory[1], memory[2]
    whole, n_outputs, n = line.size - 2, outputs.size, command.size
    disturbance, room = np.empty(noise.shape[1] - n_outputs), np.empty(x.size)
    z, inputs, wanted, lost = memory[3:], np.zeros(law[3].shape[1]), np.zeros(1), np.zeros(1)
    for piece in range(edges.size - 1):
        gain = sensor_gain[piece]
        if len(equations) == 3:
            here: Linear | Nonlinear = equations
        else:
            here = (equations[0][piece], equations[1][piece], equations[2][piece], equations[3][piece])
        for k in range(edges[piece], edges[piece + 1]):
            for j in range(n_outputs):
                truth = x[outputs[j]]
                if not math.isfinite(truth):
                    return k
                measured[k, j] = quantise(gain[j] * truth + noise[k, j], resolution[j])
            for j in range(x.size):
                states[k, j] = x[j]
            error, moved, carried = 0.0, 0.0, 0.0
            if at >= 0:
                y = measured[k, at]
                error = setpoint[k] - y
                moved = y - last if counts[0] > 0 else 0.0
                last = y
            if current_at >= 0:
                carried = measured[k, current_at] - centre[outputs[current_at]] - offset
            feed = centre_input + excitation[k]
            if inputs.size > 0:
                inputs[0] = -error
                inputs[inputs.size - 1] = carried if current_at >= 0 else -error
                ordered(law, z, inputs, wanted)
                feed += wanted[0]
            command[k], integral, derivative, limited = order(
                feed, error, moved, carried, integral, derivative, gains, limits
            )
            if inputs.size > 0:
                lost[0] = command[k] - quantise(feed, limits[2])
                carry_law(law, z, inputs, lost)
            if limited:
                counts[3] += 1
                if counts[2] < 0:
                    counts[2] = counts[0]
            for j in range(whole + 1, 0, -1):
                line[j] = line[j - 1]
            line[0] = command[k]
            for j in range(disturbance.size):
                disturbance[j] = noise[k, n_outputs + j]
            if force.size > 0:
                disturbance[force_column] += force[k]
            voltages = (line[whole + 1], line[whole], centre_input)
            touched = advance_plant(x, centre, voltages, disturbance, here, stops, room)
            if touched and counts[1] < 0:
                counts[1] = counts[0] + 1
            counts[0] += 1
            # Beyond a pole face the equations hold no more, though they give finite numbers again.
            if not gap[0] < x[0] < gap[1] and k + 1 < n:
                return k + 1
    memory[0], memory[1], memory[2] = integral, derivative, last
    return -1


RotorLinear = tuple[Array, Array, Array, Array]  # A, B, B_late and E of a sample
# Of `rate`: entries of A without magnets, their places (n, 2), what forces do to the states (n_states, n_axes), poles
# and their axes, resistances, leakages; first states of the currents that flow and that act; fraction, period, steps
RotorNonlinear = tuple[Array, Integers, Array, Array, Integers, Array, Array, tuple[int, int], tuple[float, float, int]]


@compiled(error_model="numpy")
def rate(
    x: Array,
    motion: Array,
    moving: Array,
    voltage: Array,
    force: Array,
    plant: RotorNonlinear,
    into: Array,
    room: Array,
) -> bool:
    """Write the derivative of the states; tell whether all gaps are open. `motion`, `moving`, `voltage`, `force`
    (n_axes,): what each axis sees of the rotor and of its speed, with disturbances; `room` (n_axes, 3): inductances,
    what drives currents, force.
    """
    values, places, pushes, poles, axes, resistance, leakage, (flows, acts), _ = plant
    n = voltage.size
    into[:] = 0.0
    for k in range(values.size):
        into[places[k, 0]] += values[k] * x[places[k, 1]]
    room[:] = 0.0
    for j in range(n):
        room[j, 0] = leakage[j]
        room[j, 1] = voltage[j] - resistance[j] * x[flows + j]
        room[j, 2] = force[j]
    for p in range(poles.shape[0]):
        k, gap, current, sigma, side = poles[p]
        a = axes[p]
        gap -= side * motion[a]
        acting = current + side * x[acts + a]
        current += side * x[flows + a]
        closing = side * moving[a]
        if not gap > 0.0:
            return False
        r = math.sqrt(1.0 + sigma * current * current)
        pull = k / (gap * gap) * acting * acting / (1.0 + math.sqrt(1.0 + sigma * acting * acting))
        motional, own = k / (gap * gap) * current / r * closing, k / gap / (r * r * r)
        room[a, 2] += side * pull
        room[a, 1] -= side * motional
        room[a, 0] += own
    multiply(pushes, room[:, 2], into)
    for a in range(n):
        into[flows + a] = room[a, 1] / room[a, 0]
    return True


@compiled(error_model="numpy")
def advance_poles(
    x: Array,
    late: Array,
    now: Array,
    disturbance: Array,
    plant: RotorNonlinear,
    magnets: Array,
    pushes: Array,
    stops: tuple[float, float],
) -> tuple[bool, bool]:
    """Carry the states over one sample in place, by classical Runge-Kutta steps; tell of contact and of open gaps."""
    fraction, period, steps = plant[8]
    n, n_coordinates = magnets.shape
    at, total, slope = np.empty(x.size), np.empty(x.size), np.empty(x.size)
    motion, moving, voltage, room = np.empty(n), np.empty(n), np.empty(n), np.empty((n, 3))
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
                motion[:] = 0.0
                moving[:] = 0.0
                multiply(magnets, at, motion)
                multiply(magnets, at[n_coordinates:], moving)
                if not rate(at, motion, moving, voltage, disturbance, plant, slope, room):
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
    """Stop the rotor at the magnets' planes without rebound, in place; tell whether it touched. `magnets` (n_axes, n):
    what each axis sees of the first n states, their rates behind; `pushes` (n_axes, n): what moves an axis by one, by
    its force.
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
    equations: RotorLinear | RotorNonlinear,
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
    """Run the loop of all axes into measured, command, truth (what each axis sees of the rotor, then currents); return
    the first sample that is not finite or in which a gap closes, -1 for none.

    `excitation` (n, n_inputs); `noise` (n, n_outputs + n_disturbances); `offsets` (n, n_outputs) run-out, or (0, ...);
    `read` (n_outputs, n_states); `roles` (n_inputs, 2): outputs of position and current fed back, -1: none; `gains`:
    kp, ki T, kd, kc, tau, T; `limits`: low, high, resolution; `carried`: states that are currents. Going on: states
    `x`, `z` of the law, `line` (whole delay + 2, n_inputs), `memory` (n_inputs, 3): integral, derivative, last
    position, NaN at first; counts = first contact, first limited sample (-1: none), limited samples.
    """
    n, n_inputs, n_outputs = command.shape[0], command.shape[1], measured.shape[1]
    n_axes = magnets.shape[0]
    fed, wanted, lost = np.zeros(law[3].shape[1]), np.zeros(n_inputs), np.zeros(n_inputs)
    disturbance, after, inputs = np.empty(noise.shape[1] - n_outputs), np.empty(x.size), np.empty(n_outputs)
    whole = line.shape[0] - 2
    for k in range(n):
        inputs[:] = 0.0
        multiply(read, x, inputs)
        for j in range(n_outputs):
            if not math.isfinite(inputs[j]):
                return k
            run_out = offsets[k, j] if offsets.shape[0] > 0 else 0.0
            measured[k, j] = quantise(inputs[j] + run_out + noise[k, j], resolution[j])
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
