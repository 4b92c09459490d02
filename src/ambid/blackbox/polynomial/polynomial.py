"""Prediction-error estimate of a polynomial model, each output by itself (Ljung 1999, ch. 7 and 10).

Minimise the squared residual of the predictor (thesis eq. 3.12) over coefficients, initial states and offset, from
starts that need no help; covariance sigma^2 (J'J)^-1 of the coefficients from the triangle of the gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.orders import Orders
from ambid.blackbox.polynomial.delay import long_delays
from ambid.blackbox.polynomial.orders import Layout, fixed_places, layout_of, read_orders
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.result import result
from ambid.blackbox.polynomial.scaled import Scaled, liveliest, scaled_data, unit
from ambid.blackbox.polynomial.search import Fitted, searched
from ambid.blackbox.polynomial.separable import SMOOTH, separable_starts
from ambid.blackbox.polynomial.stability import stable_predictor
from ambid.blackbox.polynomial.starts import starts, weighted_starts
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

_ROUNDING = 1e-24  # squared residual, in units of the output's variance
_WINDOW = 8192  # samples of a long record that decide between neighbouring delays
_LONG, _SHORT = 100, 40  # evaluations of a search; those after which a further start has to be ahead
_EQUAL = 0.5  # of squared residual, in units of the noise variance: minima that are equally likely


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
    read = read_orders(name, data, orders)
    scaled = scaled_data(name, data, at_rest=at_rest)
    with one_thread():
        layouts = _layouts(name, read, scaled, 0 if data.open_loop else 1, tick)
        known = fixed_places(name, tuple(layouts), {} if fixed is None else fixed)
        layouts = [replace(x, fixed=tuple(k)) if k else x for x, k in zip(layouts, known, strict=True)]
        fits = [fit_output(name, x, scaled, o, known[o], tick) for o, x in enumerate(layouts)]
        return result(name, data, scaled, layouts, fits, estimated_delay="nk" in read and read["nk"] is None)


def _layouts(
    name: str,
    read: Mapping[str, int | tuple[int, ...] | None],
    scaled: Scaled,
    least: int,
    tick: Callable[[], None] | None,
) -> list[Layout]:
    """Orders of every output, delays estimated where none were given."""
    n_u, n_y = scaled.u.shape[0], scaled.y.shape[0]
    if "nk" not in read or read["nk"] is not None:
        return [layout_of(read, n_u, at_rest=scaled.at_rest)] * n_y
    piece = liveliest(scaled.u, _WINDOW)
    part = replace(
        scaled,
        u=np.ascontiguousarray(scaled.u[:, piece]),
        y=np.ascontiguousarray(scaled.y[:, piece]),
        at_rest=scaled.at_rest and not piece.start,
    )
    rows = part.y.shape[1]
    out: list[Layout] = []
    for o in range(n_y):
        nk = long_delays(name, scaled.y[o], scaled.u, least, at_rest=scaled.at_rest)
        layout = layout_of({**read, "nk": nk}, n_u, at_rest=part.at_rest)
        loss = _loss(fit_output(name, layout, part, o, {}, tick))
        for i in range(n_u):  # the structure itself decides between neighbours, where they clearly differ
            for k in (nk[i] - 1, nk[i] + 1):
                near = replace(layout, nk=(*layout.nk[:i], k, *layout.nk[i + 1 :]))
                if k >= least:
                    found = _loss(fit_output(name, near, part, o, {}, tick))
                    if rows * np.log(found / loss) < -np.log(rows):
                        layout, loss = near, found
        out.append(replace(layout, at_rest=scaled.at_rest))
    return out


def _loss(fit: Fitted) -> float:
    return max(fit.cost / fit.n_rows, _ROUNDING)


def fit_output(
    name: str,
    layout: Layout,
    scaled: Scaled,
    o: int,
    known: Mapping[int, float],
    tick: Callable[[], None] | None,
) -> Fitted:
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
    worth = unit(layout, scaled, o)
    found: list[Fitted] = []
    shared = bool(layout.na and layout.nd)  # A and D share roots: there always are several minima
    more = weighted_starts(layout, y, scaled.u) if any(layout.nf) else separable_starts(layout, y, scaled.u)
    for ordinary, some in ((True, starts(layout, y, scaled.u)), (False, more)):
        for start in some:
            for place, value in known.items():
                start[place] = value / worth[place]
            if not stable_predictor(layout, start):
                continue
            end = searched(p, y, scaled.u, start, most=_LONG if ordinary else _SHORT, tick=tick)
            if not ordinary and not end.converged and found and end.cost < min(x.cost for x in found):
                end = searched(p, y, scaled.u, end.theta, tick=tick)
            found.append(end)
            if _agreed(found) if ordinary and shared else _smooth(found):
                break
        if _smooth(found) and not shared:
            break
    best = _best(found)
    if best is None:
        raise EstimationError(f"{name}: no stable predictor to start from. Change the fixed coefficients of C or F")
    return best


def _best(found: list[Fitted]) -> Fitted | None:
    """The lowest minimum; one that converged, where a lower one that did not is not told from it by the data."""
    best = min(found, key=lambda x: x.cost, default=None)
    if best is None or best.converged:
        return best
    near = [x for x in found if x.converged and x.cost <= best.cost * (1 + _EQUAL / best.n_rows)]
    return min(near, key=lambda x: x.cost, default=best)


def _smooth(found: list[Fitted]) -> bool:
    """Whether the last search went straight to the lowest minimum; a long way hints at a second one."""
    last = found[-1] if found else None
    return last is not None and last.converged and last.iterations <= SMOOTH and last.cost <= _lowest(found)


def _agreed(found: list[Fitted]) -> bool:
    """Whether two starts led to the lowest minimum."""
    return sum(x.converged and x.cost <= _lowest(found) for x in found) > 1


def _lowest(found: list[Fitted]) -> float:
    return min(x.cost for x in found) * (1 + 1e-6)
