"""The sequential loop of a rotor: a controller on each axis, delay lines, the coupled plant, stops.

Import it only from a module that is itself imported inside a function: it loads the compiler.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.simulation.kernels import order, quantise

Integers = NDArray[np.int64]

Linear = tuple[Array, Array, Array, Array]  # A, B, B_late and E of a sample


@compiled(error_model="numpy", inline="always")
def multiply(matrix: Array, vector: Array, into: Array) -> None:
    """Add a product to `into`; written out, so that no library's threads are asked for matrices as small as these."""
    for row in range(matrix.shape[0]):
        s = 0.0
        for column in range(matrix.shape[1]):
            s += matrix[row, column] * vector[column]
        into[row] += s


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
    equations: Linear,
    read: Array,
    roles: Integers,
    gains: Array,
    resolution: Array,
    limits: tuple[float, float, float],
    line: Array,
    stops: tuple[float, float],
    magnets: Array,
    pushes: Array,
    carried: Integers,
    x: Array,
    counts: Integers,
    measured: Array,
    command: Array,
    truth: Array,
) -> int:
    """Run the loop of all axes from its beginning.

    `excitation` (n, n_inputs); `noise` (n, n_outputs + n_disturbances); `offsets` (n, n_outputs) run-out, or (0, ...).
    `read` (n_outputs, n_states); `roles` (n_inputs, 2): outputs of position and current that each axis feeds back, -1:
    none; `gains` kp, ki T, kd, kc, tau, T; `limits` low, high and resolution of the commands; `line` (whole delay + 2,
    n_inputs), zero at first; `carried`: states that are currents. Filled: measured, command, truth = what each axis
    sees of the rotor, then the currents; counts = first contact, first limited sample (-1: none), limited samples.
    Returns the first sample that is not finite, -1 for none.
    """
    n, n_inputs, n_outputs = command.shape[0], command.shape[1], measured.shape[1]
    n_axes = magnets.shape[0]
    memory = np.zeros((n_inputs, 3))
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
        for j in range(n_inputs):
            error, moved, current = 0.0, 0.0, 0.0
            if roles[j, 0] >= 0:
                error = -measured[k, roles[j, 0]]
                moved = -error - memory[j, 2] if k > 0 else 0.0
                memory[j, 2] = -error
            if roles[j, 1] >= 0:
                current = measured[k, roles[j, 1]]
            command[k, j], memory[j, 0], memory[j, 1], limited = order(
                excitation[k, j], error, moved, current, memory[j, 0], memory[j, 1], gains, limits
            )
            line[0, j] = command[k, j]
            beyond = beyond or limited
        if beyond:
            counts[2] += 1
            if counts[1] < 0:
                counts[1] = k
        disturbance[:] = noise[k, n_outputs:]
        a, b, b_late, e = equations
        after[:] = 0.0
        multiply(a, x, after)
        multiply(b, line[whole], after)
        multiply(b_late, line[whole + 1], after)
        multiply(e, disturbance, after)
        x[:] = after
        if touch(x, magnets, pushes, stops) and counts[0] < 0:
            counts[0] = k + 1
    return -1
