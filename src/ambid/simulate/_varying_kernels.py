"""The sequential loop of the simulator for a linear plant whose matrices change from stretch to stretch."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ambid.simulate._kernels import advance_linear, quantise, stop

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@njit(cache=True, nogil=True)
def run_varying(
    excitation: Array,
    sensor_noise: Array,
    disturbance: Array,
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

    `edges` (n_pieces + 1) bound the stretches of the matrices a (n_pieces, n, n), b, b_late (n_pieces, n), e and
    sensor_gain (n_pieces, n_outputs). Kept between calls: x (n,), memory = integral, derivative, last position;
    line = the newest commands, newest first (whole delay + 2); counts = samples done, first contact, first limited
    command (-1: none), limited commands. settings: centre input, set point. limits: low and high of command and of
    position, resolution of the command. Filled: measured, command, states.

    Returns the first sample of these that is not finite, -1 for none.
    """
    at, current_at = roles[0], roles[1]
    integral, derivative, last = memory[0], memory[1], memory[2]
    centre_input, setpoint = settings[0], settings[1]
    whole = line.size - 2
    for piece in range(edges.size - 1):
        for k in range(edges[piece], edges[piece + 1]):
            for j in range(outputs.size):
                truth = x[outputs[j]]
                if not math.isfinite(truth):
                    return k
                measured[k, j] = quantise(sensor_gain[piece, j] * truth + sensor_noise[k, j], resolution[j])
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
            advance_linear(x, centre, late, now, disturbance[k], a[piece], b[piece], b_late[piece], e[piece])
            if at >= 0:
                x[0], x[1], touched = stop(x[0], x[1], limits[2], limits[3])
                if touched and counts[1] < 0:
                    counts[1] = counts[0] + 1
            counts[0] += 1
    memory[0], memory[1], memory[2] = integral, derivative, last
    return -1
