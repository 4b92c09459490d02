"""Parts of a record to fit on and parts to judge on: contiguous, a gap for the transient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.errors import EstimationError
from ambid.validate.blackbox.predictor import errors_elsewhere

FOLDS = 5
HELD_OUT = 0.3
_LEAST = 40  # samples of a part
_GAP = 50  # samples at the start of a part that are not judged, at most a tenth of it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fold:
    """One part to fit on, one to judge on."""

    fitted: IOData
    judged: IOData


def hold_out(data: IOData, part: float = HELD_OUT) -> Fold:
    """Hold the last part of a record out.

    `part`: 0 to 1.
    """
    if not 0 < part < 1:
        raise EstimationError(f"a hold-out of {part:g} of the record; it must be between 0 and 1. Give 0.3, say")
    cut = round(data.n_samples * (1 - part))
    if min(cut, data.n_samples - cut) < _LEAST:
        raise EstimationError(
            f"a hold-out of {part:g} of {data.n_samples} samples; each part needs {_LEAST}. Give a longer record, or a "
            "second one"
        )
    return Fold(fitted=data.part(0, cut), judged=data.part(cut, data.n_samples))


def folds(data: IOData, count: int = FOLDS) -> tuple[Fold, ...]:
    """Cut a record into blocks; each is judged once, by a fit to the longer part beside it.

    A fit needs samples without a break, so that it cannot use both sides of a block.

    `count`: number of blocks, at least 2.
    """
    if count < 2 or data.n_samples // count < _LEAST:
        raise EstimationError(
            f"{count} folds of {data.n_samples} samples; there must be 2 or more of at least {_LEAST} samples. Take "
            "fewer folds, or a longer record"
        )
    edges = np.linspace(0, data.n_samples, count + 1).round().astype(int).tolist()
    out = []
    for first, last in pairwise(edges):
        before = first >= data.n_samples - last
        fitted = data.part(0, first) if before else data.part(last, data.n_samples)
        out.append(Fold(fitted=fitted, judged=data.part(first, last)))
    return tuple(out)


def held_out_error(
    parts: Sequence[Fold], fitted: Callable[[IOData], BlackBoxFit], *, tick: Callable[[], None] | None = None
) -> float:
    """Return the root mean squared error on parts that a fit has not seen, relative to the outputs.

    `fitted`: makes a fit from data; `tick`: called before each fit. Returns 1 is as bad as the mean; over all outputs,
    each relative to its own variance. One-step errors; for an output-error model simulation errors. Infinite where a
    model cannot be run.
    """
    total, weight = 0.0, 0
    for fold in parts:
        if tick is not None:
            tick()
        fit = fitted(fold.fitted)
        found = errors_elsewhere(fit, fold.judged)
        e = found.one_step if found.claims_noise else found.simulation
        if e is None or not np.all(np.isfinite(e)):
            return float("inf")
        skip = min(_GAP, e.shape[0] // 10)
        size = np.maximum(np.var(fold.judged.y, axis=0), 1e-300)
        total += float(np.sum(np.mean(e[skip:] ** 2 / size, axis=1)))
        weight += e.shape[0] - skip
    return float(np.sqrt(total / weight))
