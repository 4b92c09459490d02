"""The search behind `select`: a line of sizes, then orders moved by one while the criterion falls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ambid.blackbox.data import IOData, UsedOrders, compact_order
from ambid.blackbox.structures import Structure
from ambid.validate.arx_orders import ArxCandidate, arx_candidates

Point = tuple[int, ...]

_SIZES, _DELAYS, _TAPS = 10, 20, 60  # most states, delay in samples, coefficients of an impulse response
_PATIENCE = 3  # sizes without an improvement after which a line ends
_BUDGET = 40  # fits
_SLOW = 6  # most states, and half the fits, for the instrumental structures, whose fits take longer
_FINALISTS = 12  # ARX candidates that are fitted


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Where a search begins."""

    bounds: Mapping[str, tuple[int, int]]  # least and largest value of each order
    nk: tuple[int, ...]  # its delays
    arx: tuple[ArxCandidate, ...]  # all ARX models that were compared


def first_size(of: Structure, data: IOData, ranges: Mapping[str, tuple[int, int]]) -> Start:
    """Compare ARX models of all sizes and delays, as far as the record is long enough for them.

    `ranges`: the user's.
    """
    n_u = max(data.n_inputs, 1)
    room = max(data.n_samples // 10, 4)  # coefficients that a record of this length can tell
    slow = of.instrumental
    most = max(1, min(_SLOW if slow else _SIZES, room // (n_u + 1)))
    taps = max(1, min(_TAPS, room) // n_u) if of.name == "fir" else most
    lag = max(1, min(_DELAYS, room // n_u))
    bounds = {
        **dict.fromkeys(("na", "nf", "n"), (1, most)),
        **dict.fromkeys(("nc", "nd"), (0, min(most, 6))),
        "nb": (1, taps),
        "nk": (0 if data.open_loop else 1, lag),
        **ranges,
    }
    arx_bounds = {**bounds, "na": (0, 0)} if of.name == "fir" else bounds
    found = arx_candidates(data, arx_bounds)
    best = min(found, key=lambda c: c.bic)
    return Start(bounds=bounds, nk=best.nk, arx=found)


def searched_orders(of: Structure, start: Start, n_inputs: int, score: Callable[[UsedOrders], float]) -> None:
    """Fit candidates, each once, until none of those around the best is better or the budget is spent."""
    if of.name in ("arx", "fir"):
        for orders in _finalists(of, start):
            score(orders)
        return
    keys = _coordinates(of, n_inputs)
    known = dict[Point, float]()

    def at(point: Point) -> float:
        if point not in known:
            known[point] = score(_orders(keys, point))
        return known[point]

    best = _line(keys, start, at)
    budget = _BUDGET // 2 if of.instrumental else _BUDGET
    while len(known) < budget:
        around = [p for p in _moves(keys, best, start.bounds) if p not in known][: budget - len(known)]
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
        chosen += [c for c in ranked[: _FINALISTS // 2] if c not in chosen]
    for c in chosen:
        full: UsedOrders = {"na": c.na, "nb": c.nb, "nk": compact_order(c.nk)}
        yield {k: full[k] for k in of.orders}


Coordinate = tuple[str, int | None]


def _coordinates(of: Structure, n_inputs: int) -> tuple[Coordinate, ...]:
    """One coordinate for each order; for nb, nf and nk one for each input."""
    return tuple((key, i) for key in of.orders for i in (range(n_inputs) if key in ("nb", "nf", "nk") else (None,)))


def _orders(keys: tuple[Coordinate, ...], point: Point) -> UsedOrders:
    out = dict[str, int | tuple[int, ...]]()
    for key in dict.fromkeys(k for k, _ in keys):
        out[key] = compact_order(tuple(v for (k, _), v in zip(keys, point, strict=True) if k == key))
    return out


def _line(keys: tuple[Coordinate, ...], start: Start, at: Callable[[Point], float]) -> Point:
    """All orders grow together, noise orders up to 2; the best size, and no further than it helps."""
    best, least, since = tuple[int, ...](), float("inf"), 0
    top = max(start.bounds[k][1] for k, _ in keys if k != "nk")
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
    seen = set[Point]()
    for step in steps:
        moved = tuple(v + step.get(j, 0) for j, v in enumerate(point))
        inside = all(bounds[key][0] <= v <= bounds[key][1] for (key, _), v in zip(keys, moved, strict=True))
        if inside and moved not in seen:
            seen.add(moved)
            yield moved


def _within(value: int, bounds: tuple[int, int]) -> int:
    return min(max(value, bounds[0]), bounds[1])
