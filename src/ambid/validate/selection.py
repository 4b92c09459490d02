"""Choice of orders: a few good fits instead of hundreds.

Delays and a first size come from all ARX models at once (one triangular factor), subspace models of all orders from
one factorisation. Other structures are then fitted along one line of sizes, and from its best point orders move by one
as long as a criterion falls: some tens of fits, whatever the structure. Sources: Ljung 1999, sec. 16.4; Soederstrom and
Stoica 1989, ch. 11.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, cast, get_args

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, UsedOrders
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.structures import Structure, structure
from ambid.errors import EstimationError, nearest
from ambid.estimation.criteria import criteria, skipped
from ambid.validate._order_search import first_size, searched_orders
from ambid.validate.blackbox.predictor import errors
from ambid.validate.blackbox.score import autoregression
from ambid.validate.holdout import Fold, folds, held_out_error, hold_out

Criterion = Literal["aic", "aicc", "bic", "mdl", "fpe", "holdout", "kfold"]

_LONGEST = 20_000  # samples that a choice of orders looks at
_FINALISTS = 6  # candidates, of each of AIC and BIC, that are judged on held-out data


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """One choice of orders that was tried."""

    orders: UsedOrders
    n_estimated: int
    # criteria by name; what could not be computed is not there. For a structure without a noise model, of residuals
    # made white by an autoregression.
    scores: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Orders that were chosen, and from what."""

    structure: str
    criterion: Criterion
    orders: UsedOrders
    candidates: tuple[Candidate, ...]  # best first
    why: str  # one line for people
    samples: int  # how many samples were looked at

    def summary(self) -> dict[str, object]:
        """Return what was chosen and the best candidates, ready for JSON.

        Returns ``criterion``, ``why``, ``tried``, ``samples`` and ``best``: up to ten candidates.
        """
        return {
            "criterion": self.criterion,
            "why": self.why,
            "tried": len(self.candidates),
            "samples": self.samples,
            "best": [
                {"orders": dict(c.orders), "n_estimated": c.n_estimated, **c.scores} for c in self.candidates[:10]
            ],
        }


def select(
    structure_name: str,
    data: IOData,
    *,
    criterion: str = "bic",
    ranges: Mapping[str, tuple[int, int]] | None = None,
    tick: Callable[[str], None] | None = None,
) -> Selection:
    """Choose the orders of a structure.

    `structure_name`: as in `ambid.blackbox.structures`; `ranges`: least and largest value of an order; `tick`: called
    with the orders before each fit; may raise to interrupt.
    """
    of = structure(structure_name)
    by = _criterion(criterion)
    for key in ranges or {}:
        if key not in (*of.orders, "nk"):
            raise EstimationError(
                f"{of.name} has no order {key!r}.{nearest(key, of.orders)} Leave it out of the ranges"
            )
    part = data if data.n_samples <= _LONGEST else data.part(0, _LONGEST)
    trial = _Trial(of, part, by, tick)
    start = first_size(of, part, ranges or {})
    if of.kind == "state space":
        for n in range(start.bounds["n"][0], start.bounds["n"][1] + 1):
            trial.score({"n": n})
    else:
        searched_orders(of, start, part.n_inputs, trial.score)
    ranked = trial.ranked()
    if not ranked:
        raise EstimationError(
            f"{of.name}: no order could be fitted and judged by {by}: {trial.refusal or 'the models are unstable'}. "
            "Give orders, or take another criterion"
        )
    return Selection(
        structure=of.name,
        criterion=by,
        orders=dict(ranked[0].orders),
        candidates=tuple(ranked),
        why=_why(ranked, by),
        samples=part.n_samples,
    )


def _criterion(name: str) -> Criterion:
    known = get_args(Criterion)
    if name not in known:
        raise EstimationError(f"criterion {name!r} is not one of {', '.join(known)}.{nearest(name, known)}")
    return cast(Criterion, name)


class _Trial:
    """Fits candidates and scores them; a search by held-out data looks around with AIC first."""

    def __init__(self, of: Structure, data: IOData, criterion: Criterion, tick: Callable[[str], None] | None) -> None:
        self.of, self.data, self.criterion, self.tick = of, data, criterion, tick
        self.refusal = ""
        self.found = list[Candidate]()
        self.parts: tuple[Fold, ...] = ()
        if criterion in ("holdout", "kfold"):
            self.parts = (hold_out(data),) if criterion == "holdout" else folds(data)

    def score(self, orders: UsedOrders) -> float:
        """Fit, and return the score to search by; infinite where the estimator refuses."""
        self._say(orders)
        try:
            fit = self.of.estimator(self.data, orders)
        except EstimationError as refusal:
            self.refusal = self.refusal or str(refusal)
            return float("inf")
        scores = self._scores(fit)
        self.found.append(Candidate(orders=fit.orders, n_estimated=fit.n_estimated, scores=scores))
        return scores.get("aic" if self.parts else self.criterion, float("inf"))

    def _scores(self, fit: BlackBoxFit) -> dict[str, float]:
        found = errors(fit, self.data)
        e, size = found.one_step, fit.n_estimated
        if not np.all(np.isfinite(e)):
            return {}
        if not found.claims_noise:
            e, more = whitened(e)
            size += more
        return criteria(e, self.data.y, size)

    def ranked(self) -> list[Candidate]:
        """Return what could be scored by the criterion, best first."""
        if self.parts:
            best = [c for by in ("aic", "bic") for c in _ranked(self.found, by)[:_FINALISTS]]
            unique = [c for k, c in enumerate(best) if c not in best[:k]]
            self.found = [self._held_out(c) for c in unique]
        return _ranked(self.found, self.criterion)

    def _held_out(self, candidate: Candidate) -> Candidate:
        self._say(candidate.orders)
        try:
            error = held_out_error(self.parts, lambda part: self.of.estimator(part, candidate.orders))
        except EstimationError as refusal:
            self.refusal = self.refusal or str(refusal)
            return candidate
        more: dict[str, float] = {self.criterion: error} if np.isfinite(error) else {}
        return replace(candidate, scores={**candidate.scores, **more})

    def _say(self, orders: UsedOrders) -> None:
        if self.tick is not None:
            self.tick(", ".join(f"{k}={v}" for k, v in orders.items()))


def whitened(e: Array) -> tuple[Array, int]:
    """Filter the residuals of a model without noise model by an autoregression each, chosen by BIC.

    The likelihood of coloured residuals as if they were white falls for every extra pole that follows the noise: orders
    chosen by it are too high.

    `e`: (n_samples, n_outputs). Returns `e`: (n_samples, n_outputs), white; `n_estimated`: coefficients of the
    autoregressions.
    """
    from scipy.signal import lfilter

    filters = [autoregression(column[skipped(e.shape[0]) :]) for column in e.T]
    out = np.stack([lfilter(a, [1.0], column) for a, column in zip(filters, e.T, strict=True)], axis=1)
    return np.asarray(out), sum(a.size - 1 for a in filters)


def _ranked(candidates: list[Candidate], by: str) -> list[Candidate]:
    return sorted((c for c in candidates if by in c.scores), key=lambda c: (c.scores[by], c.n_estimated))


def _why(ranked: list[Candidate], by: Criterion) -> str:
    best = ranked[0]
    name = ", ".join(f"{k} = {v}" for k, v in best.orders.items())
    if len(ranked) == 1:
        return f"{name}: the only one that could be fitted"
    gap = ranked[1].scores[by] - best.scores[by]
    if by in ("holdout", "kfold"):
        share = 100 * gap / max(ranked[1].scores[by], 1e-300)
        return f"{name}: least error on data not used in the fit ({by}), {share:.2g} % below the next of {len(ranked)}"
    if by in ("mdl", "fpe"):
        share = 100 * gap / max(abs(ranked[1].scores[by]), 1e-300)
        return f"{name}: least {by.upper()}, {share:.2g} % below the next of {len(ranked)}"
    how = "clearly ahead of" if gap > 6 else "ahead of" if gap > 2 else "hardly better than"
    return f"{name}: least {by.upper()}, {how} the next of {len(ranked)} (difference {gap:.3g}; under 2 is chance)"
