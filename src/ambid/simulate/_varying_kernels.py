"""The sequential loop of the simulator for a linear plant whose matrices change from stretch to stretch."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.simulate._kernels import advance_linear, quantise, stop

Integers = NDArray[np.int64]


@compiled
def run_varying(
    excitation: Array,
    noise: Array,
    noise_size: Array,
    force: Array,
    force_column: int,
    edges: Integers,
    a: Array,
    b: Array,
    b_late: Array,
    e: Array,
    sensor_gain: Array,
    x: Array,
    memory: Array,
    line: Array,
    counts: Integers,
    centre: Array,
    settings: Array,
    outputs: Integers,
    roles: Integers,
    gains: Array,
    resolution: Array,
    limits: Array,
    measured: Array,
    command: Array,
    states: Array,
) -> int:
    """Run the loop over some samples and keep what the next call needs; the law is that of `_kernels.run`.

    `noise` (n, n_outputs + n_disturbances) are standard normal numbers, `noise_size` what they are multiplied with;
    `force` (n,) adds to the disturbance `force_column`, or is empty. `edges` (n_pieces + 1) bound the stretches of the
    matrices a (n_pieces, n, n), b, b_late (n_pieces, n), e and of sensor_gain (n_pieces, n_outputs). settings: centre
    input, set point. limits: low and high of command and of position, resolution of the command.

    Kept between calls: x (n,), memory = integral, derivative, last position; line = the newest commands, newest first
    (whole delay + 2); counts = samples done, first contact, first limited command (-1: none), limited commands.
    Filled: measured, command, states. Returns the first sample of these that is not finite, -1 for none.
    """
    at, current_at = roles[0], roles[1]
    integral, derivative, last = memory[0], memory[1], memory[2]
    centre_input, setpoint = settings[0], settings[1]
    whole = line.size - 2
    n_outputs, loaded = outputs.size, force.size > 0
    disturbance, room = np.empty(noise_size.size - n_outputs), np.empty(x.size)
    for piece in range(edges.size - 1):
        a_now, b_now, b_before, e_now, gain = a[piece], b[piece], b_late[piece], e[piece], sensor_gain[piece]
        for k in range(edges[piece], edges[piece + 1]):
            for j in range(n_outputs):
                truth = x[outputs[j]]
                if not math.isfinite(truth):
                    return k
                measured[k, j] = quantise(gain[j] * truth + noise[k, j] * noise_size[j], resolution[j])
            for row in range(x.size):
                states[k, row] = x[row]
            wanted, error = centre_input + excitation[k], 0.0
            if at >= 0:
                y = measured[k, at]
                error = setpoint - y
                moved = y - last if counts[0] > 0 else 0.0
                derivative = (gains[4] * derivative - gains[2] * moved) / (gains[4] + gains[5])
                last = y
                wanted += gains[0] * error + integral + derivative
            if current_at >= 0:
                wanted -= gains[3] * (measured[k, current_at] - centre[outputs[current_at]])
            beyond = max(wanted - limits[1], 0.0) + min(wanted - limits[0], 0.0)
            if beyond != 0.0:
                counts[3] += 1
                if counts[2] < 0:
                    counts[2] = counts[0]
            growth = gains[1] * error
            if beyond * growth <= 0.0:
                integral += growth
            command[k] = min(max(quantise(wanted, limits[4]), limits[0]), limits[1])
            for j in range(whole + 1, 0, -1):
                line[j] = line[j - 1]
            line[0] = command[k]
            late, now = line[whole + 1] - centre_input, line[whole] - centre_input
            for j in range(disturbance.size):
                disturbance[j] = noise[k, n_outputs + j] * noise_size[n_outputs + j]
            if loaded:
                disturbance[force_column] += force[k]
            advance_linear(x, centre, late, now, disturbance, a_now, b_now, b_before, e_now, room)
            if at >= 0:
                x[0], x[1], touched = stop(x[0], x[1], limits[2], limits[3])
                if touched and counts[1] < 0:
                    counts[1] = counts[0] + 1
            counts[0] += 1
    memory[0], memory[1], memory[2] = integral, derivative, last
    return -1
