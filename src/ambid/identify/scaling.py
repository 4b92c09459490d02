"""Scales of order one, from the data and a rough idea of the plant."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ambid.identify.problem import Scales
from ambid.physics.discretise import discretise
from ambid.physics.models import LinearModel

Array = NDArray[np.float64]


def noise_floor(y: Array) -> Array:
    """Return about the white noise of each output.

    Third differences remove smooth motion and amplify white noise by sqrt(1 + 9 + 9 + 1).

    Parameters
    ----------
    y : ndarray, shape (n_samples, n_outputs)

    Returns
    -------
    ndarray, shape (n_outputs,)
        Positive, in the unit of `y`.
    """
    floor = np.sqrt(np.mean(np.diff(y, n=3, axis=0) ** 2, axis=0) / 20)
    return np.asarray(np.maximum(floor, 1e-9 * np.std(y, axis=0)))


def scales_for(model: LinearModel, values: Mapping[str, float], u: Array, y: Array, rate_hz: float) -> Scales:
    """Return scales: sensor noise for outputs and states, what moves the outputs by that within two samples for disturbances.

    Parameters
    ----------
    model : LinearModel
    values : Mapping[str, float]
        Rough parameters, SI.
    u : ndarray, shape (n_samples, n_inputs), SI
    y : ndarray, shape (n_samples, n_outputs), SI
    rate_hz : float

    Returns
    -------
    Scales
    """
    output = noise_floor(y)
    discrete, _ = discretise(model.matrices(values), 1.0 / rate_hz)
    reach = np.maximum(np.abs(discrete.C @ discrete.E), np.abs(discrete.C @ discrete.A @ discrete.E))
    state = np.array([output[model.outputs.index(s)] if s in model.outputs else 0.0 for s in model.states])
    state[state == 0] = output[0] * rate_hz / 20  # velocity, the only state that is not measured
    return Scales(
        state=state,
        input=np.std(u, axis=0),
        output=output,
        disturbance=1 / np.max(reach / output[:, None], axis=0),
    )
