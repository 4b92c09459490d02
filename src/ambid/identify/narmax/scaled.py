"""Records in units of their typical size, so that results do not depend on the user's units.

Levels are taken off only where a signal stands far from zero: they change what a polynomial's terms mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData

Array = NDArray[np.float64]

_FAR = 2.0  # a mean of more than so many standard deviations makes powers of a signal alike
_FEWEST = 10  # rows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaled:
    """Outputs and inputs of all records as deviations from common levels, in common units.

    Attributes
    ----------
    parts : tuple of (outputs, inputs), shapes (n_samples, n_outputs), (n_samples, n_inputs)
        By record.
    y_level, y_scale : ndarray, shape (n_outputs,), SI
    u_level, u_scale : ndarray, shape (n_inputs,), SI
    """

    parts: tuple[tuple[Array, Array], ...]
    y_level: Array
    y_scale: Array
    u_level: Array
    u_scale: Array

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.y_level.size)


def scaled_records(name: str, records: Sequence[IOData], *, lag: int, levels: str) -> Scaled:
    """Check that records belong together and scale them.

    Parameters
    ----------
    name : str
        Of the structure, for messages.
    records : sequence of IOData
    lag : int
        Samples of each record that are only past.
    levels : {"auto", "zero", "mean"}

    Returns
    -------
    Scaled

    Raises
    ------
    EstimationError
        If channels or rates differ, a record is too short, or a channel does not move in any of them.
    """
    first = records[0]
    for r, x in enumerate(records):
        if (x.inputs, x.outputs) != (first.inputs, first.outputs):
            raise EstimationError(
                f"{name}: record {r + 1} has channels {x.inputs} and {x.outputs}, the first {first.inputs} and "
                f"{first.outputs}; all must be of one bench. Name the same columns"
            )
        if abs(x.dt - first.dt) > 1e-6 * first.dt:
            raise EstimationError(
                f"{name}: record {r + 1} has {1 / x.dt:g} Hz, the first {1 / first.dt:g} Hz; one model has one rate. "
                "Resample one of them"
            )
        if x.n_samples < lag + _FEWEST:
            raise EstimationError(
                f"{name}: record {r + 1} has {x.n_samples} samples; lags up to {lag} need {lag + _FEWEST}. "
                "Give a longer record, or lower ny, nu, nk or ne"
            )
    y, y_level, y_scale = _group(name, [x.y for x in records], first.outputs, levels)
    u, u_level, u_scale = _group(name, [x.u for x in records], first.inputs, levels)
    return Scaled(
        parts=tuple(zip(y, u, strict=True)), y_level=y_level, y_scale=y_scale, u_level=u_level, u_scale=u_scale
    )


def _group(name: str, values: list[Array], names: tuple[str, ...], levels: str) -> tuple[list[Array], Array, Array]:
    whole = np.concatenate(values)
    mean, sd = whole.mean(axis=0), whole.std(axis=0)
    for k, channel in enumerate(names):
        if not sd[k] > 1e-13 * max(abs(mean[k]), 1e-300):
            raise EstimationError(
                f"{name}: {channel!r} does not move (constant at {whole[0, k]:g}); nothing can be learnt from it. "
                "Excite it, or leave it out"
            )
    far = np.abs(mean) > _FAR * sd if levels == "auto" else np.full(mean.shape, levels == "mean")
    level = np.where(far, mean, 0.0)
    scale = np.where(far, sd, np.hypot(mean, sd))
    return [(x - level) / scale for x in values], level, scale
