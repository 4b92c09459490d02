"""Records of one bench, and signals for a model, in scaled deviations from common levels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud

Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples, n_outputs) and inputs (n_samples, n_inputs) of each record, scaled."""

_FEWEST = 20  # rows of a record beyond its lags
_NUMBERS = ("theta", "u_level", "u_scale", "y_level", "y_scale")
_FAR = 2.0  # a mean of more than so many standard deviations makes powers of a signal alike


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaled:
    """Outputs and inputs of all records."""

    parts: Parts  # by record
    y_level: Array  # (n_outputs,), SI, mean and standard deviation over all records
    y_scale: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.y_level.size)

    def levels(self, record: IOData) -> dict[str, float]:
        """Return the level of each channel, SI."""
        values = (*self.u_level.tolist(), *self.y_level.tolist())
        return dict(zip((*record.inputs, *record.outputs), values, strict=True))


def scaled_records(
    structure: str, records: Sequence[IOData], *, lag: int, levels: str = "mean", fewest: int = _FEWEST
) -> Scaled:
    """Check that records belong together and scale them.

    `structure` is for messages; `lag` samples of each record are only past, and `fewest` more are needed. `levels` are
    what signals are deviations from: their means, zero, or (auto) means where signals stand far from zero; levels
    change what the terms of a polynomial mean.
    """
    if not records:
        raise EstimationError(f"{structure}: no record was given. Pass at least one")
    first = records[0]
    for r, x in enumerate(records):
        if (x.inputs, x.outputs) != (first.inputs, first.outputs):
            raise EstimationError(
                f"{structure}: record {r + 1} has channels {x.inputs} and {x.outputs}, the first {first.inputs} and "
                f"{first.outputs}; all must be of one bench. Name the same columns"
            )
        if abs(x.dt - first.dt) > 1e-6 * first.dt:
            raise EstimationError(
                f"{structure}: record {r + 1} is sampled at {1 / x.dt:g} Hz, the first at {1 / first.dt:g} Hz; the "
                "rates must agree. Resample one of them"
            )
        if x.n_samples < lag + fewest:
            raise EstimationError(
                f"{structure}: record {r + 1} has {x.n_samples} samples; {lag + fewest} are needed. "
                "Give a longer record, or a smaller model"
            )
    y, y_level, y_scale = _group(structure, [x.y for x in records], first.outputs, levels)
    u, u_level, u_scale = _group(structure, [x.u for x in records], first.inputs, levels)
    return Scaled(
        parts=tuple(zip(y, u, strict=True)), y_level=y_level, y_scale=y_scale, u_level=u_level, u_scale=u_scale
    )


def _group(
    structure: str, values: list[Array], names: tuple[str, ...], levels: str
) -> tuple[list[Array], Array, Array]:
    whole = np.concatenate(values)
    mean, sd = whole.mean(axis=0), whole.std(axis=0)
    for k, channel in enumerate(names):
        if not sd[k] > 1e-13 * max(abs(mean[k]), 1e-300):
            raise EstimationError(
                f"{structure}: {channel!r} is constant at {whole[0, k]:g} and carries no information. Excite it, "
                "or omit it"
            )
    off = np.abs(mean) > _FAR * sd if levels == "auto" else np.full(mean.shape, levels == "mean")
    level, scale = np.where(off, mean, 0.0), np.where(off, sd, np.hypot(mean, sd))
    return [(x - level) / scale for x in values], level, scale


@dataclass(frozen=True, kw_only=True, eq=False)
class ScaledModel(ABC):
    """What all models have that work on scaled deviations of the signals; implements part of `NonlinearModel`."""

    theta: Array  # (n_theta,), parameters for signals in deviations from `*_level`, in `unit` times those of the scaled
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors

    @property
    @abstractmethod
    def unit(self) -> Array | float:
        """What a scaled parameter of 1 is in `theta`."""

    @property
    @abstractmethod
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.u_level.size)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.y_level.size)

    @property
    def scaled_theta(self) -> Array:
        """Parameters for scaled signals."""
        return self.theta / self.unit

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other parameters."""
        return replace(self, theta=theta)

    def numbers_json(self) -> dict[str, Any]:
        """Return the fields that all models share as JSON-able values."""
        return {**{k: getattr(self, k).tolist() for k in _NUMBERS}, "cloud": self.cloud.as_json()}


def read_numbers(found: Mapping[str, Any], n_theta: int, m: int, p: int, n_cloud: int) -> dict[str, Any]:
    """Read back what `ScaledModel.numbers_json` made, of `m` inputs and `p` outputs."""
    sizes = zip(_NUMBERS, (n_theta, m, m, p, p), strict=True)
    return {**{k: finite(found[k], n, k) for k, n in sizes}, "cloud": Cloud.from_json(found["cloud"], n_cloud)}


def scaled(model: ScaledModel, u: Array, y: Array) -> tuple[Array, Array]:
    """Return outputs and inputs, given in SI, in a model's scaled units."""
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n = y.shape[0] if y.ndim else 0
    if (u.shape, y.shape) != ((n, model.n_inputs), (n, model.n_outputs)):
        raise EstimationError(
            f"inputs of shape {u.shape} and outputs of shape {y.shape} for a model of {model.n_inputs} and "
            f"{model.n_outputs} channels; time is axis 0. Pass (n_samples, n_channels)"
        )
    return (y - model.y_level) / model.y_scale, (u - model.u_level) / model.u_scale


def with_head(model: ScaledModel, u: Array, y: Array) -> tuple[Array, int]:
    """Return outputs as long as the inputs, and how many rows of `y` were taken over: `lag`, the others are zero."""
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    head = min(model.lag, u.shape[0])
    if y.ndim != 2 or y.shape[0] < head:
        raise EstimationError(f"{y.shape[0]} samples of the outputs; a simulation starts from {head}. Give more")
    whole = np.zeros((u.shape[0], y.shape[1]))
    whole[:head] = y[:head]
    return whole, head


def finite(value: Any, n: int, what: str) -> Array:
    """Return `n` stored numbers, shape (n,); raises ValueError about `what` where they are not finite."""
    out = np.array(value, dtype=np.float64).reshape(n)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{what} is not finite")
    return out
