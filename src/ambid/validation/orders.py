"""Choice of orders: a few good fits instead of hundreds.

Delays and a first size come from all ARX models at once (one triangular factor), subspace models from one
factorisation; others are fitted along one line of sizes, then orders move by one while a criterion falls (Ljung 1999,
sec. 16.4; Soederstrom and Stoica 1989, ch. 11).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from types import MappingProxyType
from typing import Literal, cast, get_args

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, UsedOrders, compact_order
from ambid.blackbox.fit import BlackBoxFit, Structure, structure
from ambid.blackbox.prediction import errors, errors_elsewhere
from ambid.errors import EstimationError, nearest
from ambid.estimation.uncertainty import criteria, skipped
from ambid.signals.delay import lagged_triangle
from ambid.validation.residuals import autoregression

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
        """Return ``criterion``, ``why``, ``tried``, ``samples`` and ``best``, up to ten candidates, ready for JSON."""
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
    """Choose the orders of a structure of `ambid.blackbox.fit` within `ranges`, least and largest; `tick`: called with
    the orders before each fit; may raise to interrupt.
    """
    chosen = structure(structure_name)
    rule = _criterion(criterion)
    for key in ranges or {}:
        if key not in (*chosen.orders, "nk"):
            raise EstimationError(
                f"{chosen.name} has no order {key!r}.{nearest(key, chosen.orders)} Omit it from the ranges"
            )
    part = data if data.n_samples <= _LONGEST else data.part(0, _LONGEST)
    trial = _Trial(chosen, part, rule, tick)
    start = first_size(chosen, part, ranges or {})
    if chosen.kind == "state space":
        for n in range(start.bounds["n"][0], start.bounds["n"][1] + 1):
            trial.score({"n": n})
    else:
        search_orders(chosen, start, part.n_inputs, trial.score)
    ranked = trial.ranked()
    if not ranked:
        raise EstimationError(
            f"{chosen.name}: no order could be fitted and judged by {rule}: "
            f"{trial.refusal or 'the models are unstable'}. Give orders, or use another criterion"
        )
    return Selection(
        structure=chosen.name,
        criterion=rule,
        orders=dict(ranked[0].orders),
        candidates=tuple(ranked),
        why=_why(ranked, rule),
        samples=part.n_samples,
    )


def _criterion(name: str) -> Criterion:
    criteria = get_args(Criterion)
    if name not in criteria:
        raise EstimationError(f"criterion {name!r} is not one of {', '.join(criteria)}.{nearest(name, criteria)}")
    return cast(Criterion, name)


class _Trial:
    """Fits candidates and scores them; a search by held-out data looks around with AIC first."""

    def __init__(
        self, chosen: Structure, data: IOData, criterion: Criterion, tick: Callable[[str], None] | None
    ) -> None:
        self.of, self.data, self.criterion, self.tick = chosen, data, criterion, tick
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
        residuals = errors(fit, self.data)
        e, size = residuals.one_step, fit.n_estimated
        if not np.all(np.isfinite(e)):
            return {}
        if not residuals.claims_noise:
            e, more = whiten(e)
            size += more
        return criteria(e, self.data.y, size)

    def ranked(self) -> list[Candidate]:
        """Return what could be scored by the criterion, best first."""
        if self.parts:
            best = [c for rule in ("aic", "bic") for c in _ranked(self.found, rule)[:_FINALISTS]]
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


def whiten(e: Array) -> tuple[Array, int]:
    """Return residuals (n_samples, n_outputs) of a model without noise model, each whitened by an autoregression of
    BIC's order, and its coefficients' number: as if white, their likelihood falls for every pole that follows the
    noise, and orders come out too high.
    """
    from scipy.signal import lfilter

    filters = [autoregression(column[skipped(e.shape[0]) :]) for column in e.T]
    out = np.stack([lfilter(a, [1.0], column) for a, column in zip(filters, e.T, strict=True)], axis=1)
    return np.asarray(out), sum(a.size - 1 for a in filters)


def _ranked(candidates: list[Candidate], rule: str) -> list[Candidate]:
    return sorted((c for c in candidates if rule in c.scores), key=lambda c: (c.scores[rule], c.n_estimated))


def _why(ranked: list[Candidate], rule: Criterion) -> str:
    best = ranked[0]
    name = ", ".join(f"{k} = {v}" for k, v in best.orders.items())
    if len(ranked) == 1:
        return f"{name}: the only one that could be fitted"
    gap = ranked[1].scores[rule] - best.scores[rule]
    if rule in ("holdout", "kfold"):
        share = 100 * gap / max(ranked[1].scores[rule], 1e-300)
        return f"{name}: smallest error on held-out data ({rule}), {share:.2g} % below the next of {len(ranked)}"
    if rule in ("mdl", "fpe"):
        share = 100 * gap / max(abs(ranked[1].scores[rule]), 1e-300)
        return f"{name}: smallest {rule.upper()}, {share:.2g} % below the next of {len(ranked)}"
    how = "clearly better than" if gap > 6 else "better than" if gap > 2 else "about as good as"
    return f"{name}: smallest {rule.upper()}, {how} the next of {len(ranked)} (difference {gap:.3g})"


Point = tuple[int, ...]

_SIZES, _DELAYS, _TAPS = 10, 20, 60  # most states, delay in samples, coefficients of an impulse response
_PATIENCE = 3  # sizes without an improvement after which a line ends
_BUDGET = 40  # fits
_SLOW = 6  # most states, and half the fits, for the instrumental structures, whose fits take longer
_ARX_FITTED = 12  # ARX candidates that are fitted


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where a search begins."""

    bounds: Mapping[str, tuple[int, int]]  # least and largest value of each order
    nk: tuple[int, ...]  # its delays
    arx: tuple[ArxCandidate, ...]  # all ARX models that were compared


def first_size(chosen: Structure, data: IOData, ranges: Mapping[str, tuple[int, int]]) -> Start:
    """Compare ARX models of all sizes and delays within the user's `ranges`, as far as the record is long enough."""
    n_u = max(data.n_inputs, 1)
    room = max(data.n_samples // 10, 4)  # coefficients that a record of this length can tell
    slow = chosen.instrumental
    most = max(1, min(_SLOW if slow else _SIZES, room // (n_u + 1)))
    taps = max(1, min(_TAPS, room) // n_u) if chosen.name == "fir" else most
    lag = max(1, min(_DELAYS, room // n_u))
    bounds = {
        **dict.fromkeys(("na", "nf", "n"), (1, most)),
        **dict.fromkeys(("nc", "nd"), (0, min(most, 6))),
        "nb": (1, taps),
        "nk": (0 if data.open_loop else 1, lag),
        **ranges,
    }
    arx_bounds = {**bounds, "na": (0, 0)} if chosen.name == "fir" else bounds
    candidates = arx_candidates(data, arx_bounds)
    best = min(candidates, key=lambda c: c.bic)
    return Start(bounds=bounds, nk=best.nk, arx=candidates)


def search_orders(chosen: Structure, start: Start, n_inputs: int, score: Callable[[UsedOrders], float]) -> None:
    """Fit candidates, each once, until none of those around the best is better or the budget is spent."""
    if chosen.name in ("arx", "fir"):
        for orders in _finalists(chosen, start):
            score(orders)
        return
    keys = _coordinates(chosen, n_inputs)
    scores = dict[Point, float]()

    def at(point: Point) -> float:
        if point not in scores:
            scores[point] = score(_orders(keys, point))
        return scores[point]

    best = _line(keys, start, at)
    budget = _BUDGET // 2 if chosen.instrumental else _BUDGET
    while len(scores) < budget:
        around = [p for p in _moves(keys, best, start.bounds) if p not in scores][: budget - len(scores)]
        if not around:
            return
        there = min(around, key=at)
        if at(there) >= at(best):
            return
        best = there


def _finalists(of: Structure, start: Start) -> Iterator[UsedOrders]:
    """The ARX models that AIC or BIC puts first, and with them every other criterion."""
    chosen = list[ArxCandidate]()
    for penalty in (2.0, float(np.log(start.arx[0].n_rows))):
        ranked = sorted(start.arx, key=lambda c: c.n_rows * c.log_det + penalty * c.n_estimated)
        chosen += [c for c in ranked[: _ARX_FITTED // 2] if c not in chosen]
    for c in chosen:
        full: UsedOrders = {"na": c.na, "nb": c.nb, "nk": compact_order(c.nk)}
        yield {k: full[k] for k in of.orders}


Coordinate = tuple[str, int | None]


def _coordinates(chosen: Structure, n_inputs: int) -> tuple[Coordinate, ...]:
    """One coordinate for each order; for nb, nk and, where inputs have denominators of their own, nf one an input."""
    each = ("nb", "nk") if chosen.kind == "transfer function" else ("nb", "nf", "nk")
    return tuple((key, i) for key in chosen.orders for i in (range(n_inputs) if key in each else (None,)))


def _orders(keys: tuple[Coordinate, ...], point: Point) -> UsedOrders:
    out = dict[str, int | tuple[int, ...]]()
    for key in dict.fromkeys(k for k, _ in keys):
        out[key] = compact_order(tuple(v for (k, _), v in zip(keys, point, strict=True) if k == key))
    return out


def _line(keys: tuple[Coordinate, ...], start: Start, at: Callable[[Point], float]) -> Point:
    """All orders grow together, noise orders up to 2; the best size, and no further than it helps."""
    best, least, since = tuple[int, ...](), float("inf"), 0
    top = max((start.bounds[k][1] for k, _ in keys if k != "nk"), default=1)
    for size in range(1, top + 1):
        point = tuple(
            start.nk[i or 0]
            if key == "nk"
            else _within(min(size, 2) if key in ("nc", "nd") else size, start.bounds[key])
            for key, i in keys
        )
        value = at(point)
        if not best or value < least:
            best, least, since = point, value, 0
        else:
            since += 1
        if since >= _PATIENCE:
            break
    return best


def _moves(keys: tuple[Coordinate, ...], point: Point, bounds: Mapping[str, tuple[int, int]]) -> Iterator[Point]:
    """Neighbours within bounds: smaller ones first, a delay traded for a coefficient, pairs of one block together."""
    place = {key: j for j, key in enumerate(keys)}
    steps = list[dict[int, int]]()
    inputs = sorted({i for _, i in keys if i is not None})
    for first, second in (("nf", "nb"), ("na", "nb"), ("nc", "nd")):
        for i in inputs or [0]:
            pair = [place[k] for k in ((first, i), (first, None), (second, i), (second, None)) if k in place]
            if len(pair) == 2:
                steps += [dict.fromkeys(pair, -1), dict.fromkeys(pair, 1)]
    singles = [j for j, (key, _) in enumerate(keys) if key != "nk"]
    steps = [{j: -1} for j in singles] + steps
    for i in inputs:
        b, k = place.get(("nb", i)), place.get(("nk", i))
        if b is not None and k is not None:
            steps += [{k: 1, b: -1}, {k: -1, b: 1}, {k: 1}, {k: -1}]
    steps += [{j: 1} for j in singles]
    visited = set[Point]()
    for step in steps:
        moved = tuple(v + step.get(j, 0) for j, v in enumerate(point))
        inside = all(bounds[key][0] <= v <= bounds[key][1] for (key, _), v in zip(keys, moved, strict=True))
        if inside and moved not in visited:
            visited.add(moved)
            yield moved


def _within(value: int, bounds: tuple[int, int]) -> int:
    return min(max(value, bounds[0]), bounds[1])


Bounds = Mapping[str, tuple[int, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArxCandidate:
    """One choice of orders."""

    na: int  # nb for every input
    nb: int
    nk: tuple[int, ...]  # one for each input
    n_estimated: int  # over all outputs
    log_det: float  # sum over outputs of the log of the mean squared one-step error, SI squared
    n_rows: int  # samples used

    @property
    def bic(self) -> float:
        """Schwarz's criterion, up to a constant of the data."""
        return self.n_rows * self.log_det + self.n_estimated * float(np.log(self.n_rows))


def arx_candidates(data: IOData, bounds: Bounds) -> tuple[ArxCandidate, ...]:
    """Compare ARX models of all orders within `bounds`, least and largest na, nb, nk: all combinations for one input;
    for several, delays one input after the other, twice.
    """
    (na0, na1), (nb0, nb1), (nk0, nk1) = (bounds[k] for k in ("na", "nb", "nk"))
    first = max(na1, nk1 + nb1 - 1 if data.n_inputs else 0)
    width = na1 + data.n_inputs * (nb1 + nk1) + 2
    if data.n_samples - first < 2 * width:
        raise EstimationError(
            f"{data.n_samples} samples are too few to choose among ARX models of up to {width - 2} coefficients. "
            "Give orders, or a longer record"
        )
    triangles = [_triangle(data, o, na1, nb1 + nk1, first) for o in range(data.n_outputs)]
    n_rows = data.n_samples - first

    def candidate(na: int, nb: int, nk: tuple[int, ...]) -> ArxCandidate:
        u = [na1 + i * (nb1 + nk1) + k for i, d in enumerate(nk) for k in range(d, d + nb)]
        columns = [*range(na), *u, width - 2, width - 1]
        losses = (_loss(R[:, columns]) / n_rows for R in triangles)
        return ArxCandidate(
            na=na,
            nb=nb,
            nk=nk,
            n_estimated=data.n_outputs * (na + nb * data.n_inputs),
            log_det=float(sum(np.log(max(x, 1e-300)) for x in losses)),
            n_rows=n_rows,
        )

    candidates = list[ArxCandidate]()
    for na in range(na0, na1 + 1):
        if not data.n_inputs:
            candidates.append(candidate(na, 0, ()))
            continue
        for nb in range(nb0, nb1 + 1):
            candidates += [candidate(na, nb, nk) for nk in _delays(nk0, nk1, data.n_inputs)]
    if data.n_inputs > 1:
        for _ in range(2):
            for i in range(data.n_inputs):
                best = min(candidates, key=lambda c: c.bic)
                others = (tuple(d if j == i else k for j, k in enumerate(best.nk)) for d in range(nk0, nk1 + 1))
                sizes = {nb for nb in (best.nb - 1, best.nb, best.nb + 1) if nb0 <= nb <= nb1}
                candidates += [candidate(best.na, nb, nk) for nk, nb in product(others, sorted(sizes))]
    return tuple(candidates)


def _delays(least: int, most: int, n_inputs: int) -> Iterator[tuple[int, ...]]:
    yield from ((k,) * n_inputs for k in range(least, most + 1))


def _triangle(data: IOData, o: int, na: int, n_u_lags: int, first: int) -> Array:
    """R of [y(t-1)... y(t-na), u(t)... u(t-n+1) of each input, 1, y(t)]."""
    y, u = data.y[:, o] - data.y[:, o].mean(), data.u - data.u.mean(axis=0)
    past = [(y, k) for k in range(1, na + 1)] + [(x, k) for x in u.T for k in range(n_u_lags)]
    return lagged_triangle([*past, (np.ones(y.size), 0), (y, 0)], first)


def _loss(R: Array) -> float:
    """Sum of squares of the last column that the others leave."""
    triangle = np.asarray(np.linalg.qr(R, mode="r"), dtype=np.float64)
    return float(triangle[-1, -1] ** 2) if triangle.shape[0] == triangle.shape[1] else 0.0


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
    """Hold the last `part` (0 to 1) of a record out."""
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
    """Cut a record into `count` blocks, at least 2; each is judged once, by a fit to the longer part beside it, as a
    fit needs samples without a break.
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


def held_out_error(parts: Sequence[Fold], fitted: Callable[[IOData], BlackBoxFit]) -> float:
    """Return the rms error on unseen parts of fits by `fitted`, over outputs relative to their variances (1: as bad as
    the mean): one-step errors, of an output-error model simulation errors; infinite where a model cannot be run.
    """
    total, weight = 0.0, 0
    for fold in parts:
        fit = fitted(fold.fitted)
        residuals = errors_elsewhere(fit, fold.judged)
        e = residuals.one_step if residuals.claims_noise else residuals.simulation
        if e is None or not np.all(np.isfinite(e)):
            return float("inf")
        skip = min(_GAP, e.shape[0] // 10)
        size = np.maximum(np.var(fold.judged.y, axis=0), 1e-300)
        total += float(np.sum(np.mean(e[skip:] ** 2 / size, axis=1)))
        weight += e.shape[0] - skip
    return float(np.sqrt(total / weight))
