"""Poles of the sampled closed loop: plant, delay line and discrete PID, exactly as `simulate` steps them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.discretise import discretise
from ambid.physics.loop import Loop
from ambid.physics.models import model


def closed_loop_matrix(parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str = "one-axis") -> Array:
    """Return the matrix that carries [plant states, u[k-1], u[k-2], ..., I, D, x[k-1]] over one sample.

    Parameters
    ----------
    parameters : Mapping[str, float]
        Parameters of the model in SI units.
    loop : Loop
        Controller and delay.
    rate_hz : float
        Sampling rate in Hz.
    of : str
        Name of the linear model.

    Returns
    -------
    ndarray, shape (n_states + n_delayed + 3, ...)
        The loop's matrix; limits and quantisation are left out.
    """
    plant, period = model(of), 1.0 / rate_hz
    whole = math.floor(loop.delay)
    d, _ = discretise(plant.matrices(parameters), period, fraction=loop.delay - whole)
    n, line = d.A.shape[0], whole + (loop.delay > whole)
    total = n + line + 3
    i, dd, last = n + line, n + line + 1, n + line + 2
    unit = np.eye(total)
    position = unit[plant.states.index("position")] if "position" in plant.outputs else np.zeros(total)
    current = unit[plant.states.index("current")] if "current" in plant.outputs else np.zeros(total)
    derivative = (loop.filter_s * unit[dd] - loop.kd * (position - unit[last])) / (loop.filter_s + period)
    command = -loop.kp * position + unit[i] + derivative - loop.kc * current
    history = [command, *unit[n : n + line]]  # rows that give u[k], u[k-1], ...
    z = np.zeros((total, total))
    z[:n, :n] = d.A
    z[:n] += np.outer(d.B[:, 0], history[whole])
    if line > whole:
        z[:n] += np.outer(d.B_late[:, 0], history[whole + 1])
    for j in range(line):
        z[n + j] = history[j]
    z[i] = unit[i] - loop.ki * period * position
    z[dd], z[last] = derivative, position
    return z


def closed_loop_poles(
    parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str = "one-axis"
) -> NDArray[np.complex128]:
    """Return the poles of the sampled loop in the z plane; stable where all lie inside the unit circle.

    An integral without gain (ki = 0) is left out.

    Parameters
    ----------
    parameters : Mapping[str, float]
        Parameters of the model in SI units.
    loop : Loop
        Controller and delay.
    rate_hz : float
        Sampling rate in Hz.
    of : str
        Name of the linear model.

    Returns
    -------
    ndarray, shape (n_poles,), complex
        Sorted by falling modulus.

    Raises
    ------
    ModelError
        If the parameters carry the loop beyond the finite numbers.
    """
    with np.errstate(all="ignore"):
        z = closed_loop_matrix(parameters, loop, rate_hz, of=of)
    if not np.isfinite(z).all():
        given = ", ".join(f"{name} = {value:g}" for name, value in parameters.items())
        raise ModelError(f"the loop at {rate_hz:g} Hz is beyond all numbers ({given}). Correct the parameters")
    if loop.ki == 0.0:
        keep = np.arange(z.shape[0]) != z.shape[0] - 3
        z = z[np.ix_(keep, keep)]
    poles = np.linalg.eigvals(z).astype(np.complex128)
    return poles[np.argsort(-np.abs(poles))]
