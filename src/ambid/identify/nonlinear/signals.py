"""Signals as a nonlinear model takes them: checked against its channels, scaled, and the head of a free run."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError

Array = NDArray[np.float64]


class ScaledModel(Protocol):
    """A nonlinear model that works on scaled and centred signals.

    Attributes
    ----------
    n_inputs, n_outputs : int
        Channels.
    lag : int
        Samples of the past that a prediction needs.
    u_level, u_scale, y_level, y_scale : ndarray, shapes (n_inputs,) and (n_outputs,), SI
        What is taken off, and what is one.
    """

    @property
    def n_inputs(self) -> int: ...  # noqa: D102
    @property
    def n_outputs(self) -> int: ...  # noqa: D102
    @property
    def lag(self) -> int: ...  # noqa: D102
    @property
    def u_level(self) -> Array: ...  # noqa: D102
    @property
    def u_scale(self) -> Array: ...  # noqa: D102
    @property
    def y_level(self) -> Array: ...  # noqa: D102
    @property
    def y_scale(self) -> Array: ...  # noqa: D102


def scaled(model: ScaledModel, u: Array, y: Array) -> tuple[Array, Array]:
    """Return outputs and inputs in a model's scaled units.

    Parameters
    ----------
    model : ScaledModel
    u : ndarray, shape (n_samples, n_inputs), SI
    y : ndarray, shape (n_samples, n_outputs), SI

    Returns
    -------
    y, u : ndarray, shapes (n_samples, n_outputs) and (n_samples, n_inputs)

    Raises
    ------
    EstimationError
        If they are not of the model's shape.
    """
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n = y.shape[0] if y.ndim else 0
    if (u.shape, y.shape) != ((n, model.n_inputs), (n, model.n_outputs)):
        raise EstimationError(
            f"inputs of shape {u.shape} and outputs of shape {y.shape} for a model of {model.n_inputs} and "
            f"{model.n_outputs} channels; time is axis 0. Pass (n_samples, n_channels)"
        )
    return (y - model.y_level) / model.y_scale, (u - model.u_level) / model.u_scale


def with_head(model: ScaledModel, u: Array, y: Array) -> tuple[Array, int]:
    """Return outputs as long as the inputs, of which only the first `lag` rows are taken over.

    Parameters
    ----------
    model : ScaledModel
    u : ndarray, shape (n_samples, n_inputs)
    y : ndarray, shape (at least lag, n_outputs)

    Returns
    -------
    y : ndarray, shape (n_samples, n_outputs)
    head : int
        Rows taken over.

    Raises
    ------
    EstimationError
        If there are fewer than `lag` rows.
    """
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    head = min(model.lag, u.shape[0])
    if y.ndim != 2 or y.shape[0] < head:
        raise EstimationError(f"{y.shape[0]} samples of the outputs; a free run begins from {head}. Give more")
    whole = np.zeros((u.shape[0], y.shape[1]))
    whole[:head] = y[:head]
    return whole, head
