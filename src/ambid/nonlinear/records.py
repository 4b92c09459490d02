"""Records of one bench in deviations from common levels, in common units: results do not depend on the user's units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError

Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples, n_outputs) and inputs (n_samples, n_inputs) of each record, scaled."""

_FEWEST = 20  # rows of a record beyond its lags
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
        raise EstimationError(f"{structure}: no record is given. Pass one at least")
    first = records[0]
    for r, x in enumerate(records):
        if (x.inputs, x.outputs) != (first.inputs, first.outputs):
            raise EstimationError(
                f"{structure}: record {r + 1} has channels {x.inputs} and {x.outputs}, the first {first.inputs} and "
                f"{first.outputs}; all must be of one bench. Name the same columns"
            )
        if abs(x.dt - first.dt) > 1e-6 * first.dt:
            raise EstimationError(
                f"{structure}: record {r + 1} has {1 / x.dt:g} Hz, the first {1 / first.dt:g} Hz; one model has one "
                "rate. Resample one of them"
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
                f"{structure}: {channel!r} does not move (constant at {whole[0, k]:g}); nothing can be learnt from it. "
                "Excite it, or leave it out"
            )
    off = np.abs(mean) > _FAR * sd if levels == "auto" else np.full(mean.shape, levels == "mean")
    level, scale = np.where(off, mean, 0.0), np.where(off, sd, np.hypot(mean, sd))
    return [(x - level) / scale for x in values], level, scale
