"""Polynomial models A y = (B/F) u + (C/D) e by prediction error (thesis eq. 1.10-1.12, 3.1-3.17, table 3.1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ambid.blackbox.data import IOData, Orders
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.polynomial_predictor import (
    Layout,
    ScaledData,
    coefficient_units,
    fixed_places,
    liveliest_part,
    predictor,
    read_orders,
    scale_data,
)
from ambid.blackbox.polynomial_result import polynomial_fit
from ambid.blackbox.polynomial_search import (
    SMOOTH,
    Minimum,
    long_delays,
    search,
    separable_starts,
    stable_predictor,
    starts,
    weighted_starts,
)
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread

_CONTRACT = """{summary} (Ljung 1999, sec. 4.2), by prediction error, each output by itself.

Parameters
----------
data : IOData
orders : Mapping[str, int or tuple of int]
    {orders}; nb, nf and nk one number, or one for each input; nk left out or "auto" is estimated.
fixed : Mapping[str, float], optional
    Known coefficients, by name (``a1``), SI.
at_rest : bool, optional
    Say that the record begins at rest at zero: no initial states and no constant are estimated, all samples count,
    and a score test warns where the data disagree.
tick : callable, optional
    Called before each look at the data.

Returns
-------
BlackBoxFit
    PolynomialModel with covariance, offsets and innovations.

Raises
------
EstimationError
    If an order breaks a rule, the record is too short, or a channel does not move.
"""

_EXACT = 1e-24  # squared residual, in units of the output's variance
_LONG, _SHORT = 100, 40  # evaluations of a search; those after which a further start has to be ahead
_EQUAL = 0.5  # of squared residual, in units of the noise variance: minima that are equally likely


def _estimator(name: str) -> Callable[..., BlackBoxFit]:
    """Return the public function of one structure, documented from the register."""

    def fit(
        data: IOData,
        orders: Orders,
        *,
        fixed: Mapping[str, float] | None = None,
        at_rest: bool = False,
        tick: Callable[[], None] | None = None,
    ) -> BlackBoxFit:
        return estimate(name, data, orders, fixed, tick, at_rest=at_rest)

    known = structure(name)
    fit.__name__ = fit.__qualname__ = name
    fit.__doc__ = _CONTRACT.format(summary=f"Fit {known.summary}", orders=", ".join(known.orders))
    return fit


fir, arx, armax, arma = (_estimator(name) for name in ("fir", "arx", "armax", "arma"))
ararx, ararmax, oe, bj = (_estimator(name) for name in ("ararx", "ararmax", "oe", "bj"))


def estimate(
    name: str,
    data: IOData,
    orders: Orders,
    fixed: Mapping[str, float] | None,
    tick: Callable[[], None] | None,
    *,
    at_rest: bool = False,
) -> BlackBoxFit:
    """Fit one of the eight structures.

    `fixed`: known coefficients, by the names of `PolynomialModel.names`, in SI; `tick`: called before each look at the
    data; `at_rest`: the record begins at rest at zero.
    """
    given, free_delay = read_orders(name, data, orders, at_rest=at_rest)
    scaled = scale_data(name, data, at_rest=at_rest)
    with one_thread():
        layouts = [given] * data.n_outputs
        if free_delay:
            layouts = _layouts(name, given, scaled, 0 if data.open_loop else 1, tick)
        known = fixed_places(name, tuple(layouts), {} if fixed is None else fixed)
        layouts = [replace(x, fixed=tuple(k)) if k else x for x, k in zip(layouts, known, strict=True)]
        fits = [fit_output(name, x, scaled, o, known[o], tick) for o, x in enumerate(layouts)]
        return polynomial_fit(name, data, scaled, layouts, fits, estimated_delay=free_delay)


def _layouts(name: str, given: Layout, scaled: ScaledData, least: int, tick: Callable[[], None] | None) -> list[Layout]:
    """Layouts of all outputs with delays estimated."""
    piece = liveliest_part(scaled.u)
    part = replace(
        scaled,
        u=np.ascontiguousarray(scaled.u[:, piece]),
        y=np.ascontiguousarray(scaled.y[:, piece]),
        at_rest=scaled.at_rest and not piece.start,
    )
    rows = part.y.shape[1]
    out: list[Layout] = []
    for o in range(scaled.y.shape[0]):
        nk = long_delays(name, scaled.y[o], scaled.u, least, at_rest=scaled.at_rest)
        layout = replace(given, nk=nk, at_rest=part.at_rest)
        loss = _loss(fit_output(name, layout, part, o, {}, tick))
        for i in range(given.n_inputs):  # the structure itself decides between neighbours, where they clearly differ
            for k in (nk[i] - 1, nk[i] + 1):
                near = replace(layout, nk=(*layout.nk[:i], k, *layout.nk[i + 1 :]))
                if k >= least:
                    found = _loss(fit_output(name, near, part, o, {}, tick))
                    if rows * np.log(found / loss) < -np.log(rows):
                        layout, loss = near, found
        out.append(replace(layout, at_rest=scaled.at_rest))
    return out


def _loss(fit: Minimum) -> float:
    return max(fit.cost / fit.n_rows, _EXACT)


def fit_output(
    name: str,
    layout: Layout,
    scaled: ScaledData,
    o: int,
    known: Mapping[int, float],
    tick: Callable[[], None] | None,
) -> Minimum:
    """Fit one output from the best of its starts.

    `known`: fixed coefficients by place, SI.
    """
    p, y = predictor(layout), scaled.y[o]
    need = layout.first_row + 2 * (p.n_nuisance + layout.free.size) + 1
    if y.size < need:
        raise EstimationError(
            f"{name}: {y.size} samples for {layout.free.size} coefficients; at least {need} are needed. "
            "Lower the orders, or take a longer part of the record"
        )
    worth = coefficient_units(layout, scaled, o)
    found: list[Minimum] = []
    shared = bool(layout.na and layout.nd)  # A and D share roots: there always are several minima
    more = weighted_starts(layout, y, scaled.u) if any(layout.nf) else separable_starts(layout, y, scaled.u)
    for ordinary, some in ((True, starts(layout, y, scaled.u)), (False, more)):
        for start in some:
            for place, value in known.items():
                start[place] = value / worth[place]
            if not stable_predictor(layout, start):
                continue
            end = search(p, y, scaled.u, start, most=_LONG if ordinary else _SHORT, tick=tick)
            if not ordinary and not end.converged and found and end.cost < min(x.cost for x in found):
                end = search(p, y, scaled.u, end.theta, tick=tick)
            found.append(end)
            if _agreed(found) if ordinary and shared else _smooth(found):
                break
        if _smooth(found) and not shared:
            break
    best = _best(found)
    if best is None:
        raise EstimationError(f"{name}: no stable predictor to start from. Change the fixed coefficients of C or F")
    return best


def _best(found: list[Minimum]) -> Minimum | None:
    """The lowest minimum; one that converged, where a lower one that did not is not told from it by the data."""
    best = min(found, key=lambda x: x.cost, default=None)
    if best is None or best.converged:
        return best
    near = [x for x in found if x.converged and x.cost <= best.cost * (1 + _EQUAL / best.n_rows)]
    return min(near, key=lambda x: x.cost, default=best)


def _smooth(found: list[Minimum]) -> bool:
    """Whether the last search went straight to the lowest minimum; a long way hints at a second one."""
    last = found[-1] if found else None
    return last is not None and last.converged and last.iterations <= SMOOTH and last.cost <= _lowest(found)


def _agreed(found: list[Minimum]) -> bool:
    """Whether two starts led to the lowest minimum."""
    return sum(x.converged and x.cost <= _lowest(found) for x in found) > 1


def _lowest(found: list[Minimum]) -> float:
    return min(x.cost for x in found) * (1 + 1e-6)
