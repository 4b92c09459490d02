"""Scales of order one, from the data and a rough idea of the plant."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.arrays import Array
from ambid.estimation.problem import Scales
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import LinearModel


def noise_floor(y: Array) -> Array:
    """Return about the white noise of each output.

    Third differences remove smooth motion and amplify white noise by sqrt(1 + 9 + 9 + 1).

    `y`: (n_samples, n_outputs). Returns (n_outputs,), positive, in the unit of `y`.
    """
    floor = np.sqrt(np.mean(np.diff(y, n=3, axis=0) ** 2, axis=0) / 20)
    return np.asarray(np.maximum(floor, 1e-9 * np.std(y, axis=0)))


def scales_for(
    model: LinearModel, values: Mapping[str, float], inputs: Array, outputs: Array, rate_hz: float
) -> Scales:
    """Return the scales of a predictor.

    Sensor noise for outputs and states; for disturbances, what moves the outputs by that within two samples.

    `values`: rough parameters, SI; `inputs`: (n_inputs,), SI, standard deviations of the inputs; `outputs`:
    (n_outputs,), SI, about the noise of the outputs, see `noise_floor`.
    """
    discrete, _ = discretise(model.matrices(values), 1.0 / rate_hz)
    reach = np.maximum(np.abs(discrete.C @ discrete.E), np.abs(discrete.C @ discrete.A @ discrete.E))
    state = np.array([outputs[model.outputs.index(s)] if s in model.outputs else 0.0 for s in model.states])
    state[state == 0] = outputs[0] * rate_hz / 20  # velocity, the only state that is not measured
    return Scales(
        state=state,
        input=inputs,
        output=outputs,
        disturbance=1 / np.max(reach / outputs[:, None], axis=0),
    )
