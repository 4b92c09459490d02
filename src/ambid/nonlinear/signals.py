"""Signals as a nonlinear model takes them: checked against its channels, scaled, and the head of a free run."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError


class ScaledModel(Protocol):
    """A nonlinear model that works on scaled and centred signals.

    `n_inputs`: channels; `n_outputs`: channels; `lag`: samples of the past that a prediction needs; `u_level`: what is
    taken off, and what is one; `u_scale`: what is taken off, and what is one; `y_level`: what is taken off, and what is
    one; `y_scale`: what is taken off, and what is one.
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

    `u`: (n_samples, n_inputs), SI; `y`: (n_samples, n_outputs), SI.
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

    `u`: (n_samples, n_inputs); `y`: (at least lag, n_outputs). Returns `y`: (n_samples, n_outputs); `head`: rows taken
    over.
    """
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    head = min(model.lag, u.shape[0])
    if y.ndim != 2 or y.shape[0] < head:
        raise EstimationError(f"{y.shape[0]} samples of the outputs; a free run begins from {head}. Give more")
    whole = np.zeros((u.shape[0], y.shape[1]))
    whole[:head] = y[:head]
    return whole, head


def finite(value: Any, n: int, what: str) -> Array:
    """Return `n` stored numbers, shape (n,); raises ValueError about `what` where they are not finite."""
    out = np.array(value, dtype=np.float64).reshape(n)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{what} is not finite")
    return out
