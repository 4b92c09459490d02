"""Polynomial models A y = (B/F) u + (C/D) e by prediction error (thesis eq. 1.10-1.12, 3.1-3.17, table 3.1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import fdtrc

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.model import Offsets, PolynomialModel, roots_at
from ambid.blackbox.polynomial_predictor import (
    Layout,
    ScaledData,
    coefficient_units,
    compact_orders,
    fixed_places,
    liveliest_part,
    predictor,
    read_orders,
    scale_data,
)
from ambid.blackbox.polynomial_search import (
    BLIND,
    LARGEST_DELAY,
    SMOOTH,
    Minimum,
    long_delays,
    search,
    separable_starts,
    stable_predictor,
    starts,
    weighted_starts,
)
from ambid.errors import EstimationError
from ambid.estimation.linear import directions, one_thread
from ambid.estimation.uncertainty import p_text
from ambid.settings.caller import setting

_LEAST_SEEN = 1e-14  # singular value, of scaled columns, that stands for a direction not seen at all
_FAR = 10.0  # standard deviations of y: an offset beyond is put on the input


def polynomial_fit(
    name: str,
    data: IOData,
    scaled: ScaledData,
    layouts: Sequence[Layout],
    fits: Sequence[Minimum],
    *,
    estimated_delay: bool,
) -> BlackBoxFit:
    """Put the outputs' searches together; each output's layout marks its fixed coefficients."""
    units = [coefficient_units(x, scaled, o) for o, x in enumerate(layouts)]
    model = PolynomialModel(
        outputs=tuple(x.polynomials(f.theta * w) for x, f, w in zip(layouts, fits, units, strict=True)), dt=data.dt
    )
    noise, covariance = _covariances(scaled, layouts, fits)
    worth = np.concatenate(units)
    covariance *= worth[:, None] * worth
    warnings = cautions(model, covariance, fits)
    if any(layouts[0].nf) and not data.open_loop:
        warnings += unstable_plant(layouts, scaled)
    warnings += missed_minimum(layouts, fits, scaled)
    if scaled.at_rest:
        warnings += not_at_rest(layouts, fits, scaled)
    if estimated_delay and any(k >= LARGEST_DELAY for x in layouts for k in x.nk):
        warnings.append(f"the delay was searched up to {LARGEST_DELAY} samples and may be longer: give nk")
    details: dict[str, object] = {
        "iterations": [f.iterations for f in fits],
        "condition": [min(f.directions.condition, 1e300) for f in fits],
    }
    if scaled.at_rest:
        details["at_rest"] = True
    if estimated_delay:
        details["nk"] = [list(x.nk) for x in layouts]
    return build_fit(
        name,
        data,
        orders=compact_orders(name, layouts[0]),
        model=model,
        covariance=covariance,
        n_estimated=sum(x.free.size for x in layouts),
        offsets=_offsets(scaled, layouts, fits),
        noise_covariance=noise * np.outer(scaled.y_scale, scaled.y_scale),
        status="converged" if all(f.converged for f in fits) else "stalled",
        warnings=warnings,
        details=details,
    )


def _inverse(R: Array) -> Array:
    """R^-1, zero along directions that the data do not see."""
    return directions(R).solve(np.eye(R.shape[0]))


def _covariances(scaled: ScaledData, layouts: Sequence[Layout], fits: Sequence[Minimum]) -> tuple[Array, Array]:
    """Covariance of the innovations and of all coefficients, both in scaled units."""
    n = sum(x.n_theta for x in layouts)
    freedom = np.array([max(f.n_rows - f.nuisance.size - x.free.size, 1) for x, f in zip(layouts, fits, strict=True)])
    noise = np.diag([f.cost for f in fits] / freedom)
    firsts = np.cumsum([0, *(x.n_theta for x in layouts)])
    places = [int(first) + x.free for first, x in zip(firsts, layouts, strict=False)]
    covariance = np.zeros((n, n))
    for o, fit in enumerate(fits):
        # as large as the coefficients themselves along directions that the data do not see.
        s, sides = fit.directions.s, fit.directions.root(_LEAST_SEEN) * np.sqrt(noise[o, o])
        blind = s * BLIND < (s[0] if s.size else 0.0)
        if blind.any():
            whole = max(1.0, float(np.linalg.norm(fit.theta[fit.free])))
            sides[:, blind] *= np.maximum(whole / np.linalg.norm(sides[:, blind], axis=0), 1.0)
        covariance[places[o][:, None], places[o]] = sides @ sides.T
    for o in range(len(fits)):
        for k in range(o):
            products, errors = _shared(scaled, layouts, fits, o, k)
            noise[o, k] = noise[k, o] = errors / np.sqrt(freedom[o] * freedom[k])
            block = noise[o, k] * (_inverse(fits[o].triangle) @ products @ _inverse(fits[k].triangle).T)
            covariance[np.ix_(places[o], places[k])] = block
            covariance[np.ix_(places[k], places[o])] = block.T
    return noise, covariance


def _shared(
    scaled: ScaledData, layouts: Sequence[Layout], fits: Sequence[Minimum], o: int, k: int
) -> tuple[Array, float]:
    """Q_o' Q_k of the orthonormal gradients J = Q R of two outputs, nuisance taken out, and the sum of e_o e_k."""
    sides = []
    for x in (o, k):
        p, f = predictor(layouts[x]), fits[x]
        R = p.triangle(scaled.y[x], scaled.u, f.theta, f.nuisance)[:-1, :-1]
        sides.append((p, f, _inverse(R)))
    (p, f, left), (q, g, right) = sides
    products, errors = np.zeros((left.shape[0], right.shape[0])), 0.0
    blocks = zip(
        p.blocks(scaled.y[o], scaled.u, f.theta, f.nuisance),
        q.blocks(scaled.y[k], scaled.u, g.theta, g.nuisance),
        strict=True,
    )
    for (first, a), (second, b) in blocks:
        begin = max(first, second)
        a, b = a[:, begin - first :], b[:, begin - second :]
        products += a[:-1] @ b[:-1].T
        errors += float(a[-1] @ b[-1])
    return (left.T @ products @ right)[p.n_nuisance :, q.n_nuisance :], errors


def _offsets(scaled: ScaledData, layouts: Sequence[Layout], fits: Sequence[Minimum]) -> Offsets:
    """Turn the constant of A y - (B/F) u = constant into the output's operating point, or the input's where A sums to
    (nearly) zero: an integrating plant has any level.
    """
    n_u = scaled.u.shape[0]
    y, levels, gains, rows, right = np.zeros(len(fits)), [], [], [], []
    for o, (x, f) in enumerate(zip(layouts, fits, strict=True)):
        constant = float(f.nuisance[-1]) if f.nuisance.size else 0.0
        level = float(f.theta[x.places["A", None]].sum())
        sums = [(f.theta[x.places["B", i]].sum(), f.theta[x.places["F", i]].sum()) for i in range(n_u)]
        gain = np.array([b / a if a else np.inf for b, a in sums])
        finite = np.isfinite(gain)
        levels.append(level)
        gains.append(np.where(finite, gain, 0.0))
        if abs(constant) <= _FAR * abs(level) or (level and not finite.all()):
            y[o] = constant / level  # an F that integrates has no static gain to shift an input by
        elif n_u and finite.all():
            rows.append(-gain)
            right.append(constant)
    u = np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-10)[0] if rows else np.zeros(n_u)
    for o in range(len(fits) if rows else 0):  # the shifted input moves the other outputs too
        if y[o]:
            y[o] += float(gains[o] @ u) / levels[o]
    return Offsets(u=scaled.u_mean + scaled.u_scale * u, y=scaled.y_mean + scaled.y_scale * y)


_SDS = 2.0  # standard deviations by which a root is surely inside the unit circle, or outside
_OUTER = 0.9  # roots inside are not at the border, however vague


def cautions(model: PolynomialModel, covariance: Array, fits: Sequence[Minimum]) -> list[str]:
    """Return warnings of directions that the data do not see, and of roots of C and F not surely inside the circle."""
    warnings = list[str]()
    for o, fit in enumerate(fits):
        where, s, weights = f"output {o}: " if len(fits) > 1 else "", fit.directions.s, np.abs(fit.directions.Vt[-1:])
        blocks = [(letter, i, place) for output, letter, i, place in model.blocks() if output == o]
        if s.size and s[-1] * BLIND < s[0]:
            places = [k for _, _, place in blocks for k in range(place.start, place.stop)]
            large = weights[0] > 0.3 * np.max(weights)
            which = ", ".join(model.names[places[int(k)]] for k, big in zip(fit.free, large, strict=True) if big)
            warnings.append(
                f"{where}the data do not distinguish {which} (condition number {s[0] / max(s[-1], 1e-300):.1e}): their "
                "values are arbitrary along one direction. Lower the orders, or excite more"
            )
        for letter, i, place in blocks:
            if letter not in "CF" or place.stop - place.start < 2:
                continue
            size, sd = _outermost(model.theta, place, covariance)
            if (size > _OUTER and size + _SDS * sd >= 1.0) or (fit.at_border and size > 0.999):
                name = f"F.{i}" if letter == "F" and model.n_inputs > 1 else letter
                warnings.append(
                    f"{where}a root of {name} of magnitude {size:.6g} (sd {sd:.1g}) is at the stability limit: its "
                    "standard deviation is unreliable. "
                    + ("Lower nc" if letter == "C" else "If the plant integrates or is unstable, use armax or arx")
                )
    return warnings


def unstable_plant(layouts: Sequence[Layout], scaled: ScaledData) -> list[str]:
    """Return a warning where the plant looks unstable, which a predictor with F cannot be."""
    warnings = []
    for o, x in enumerate(layouts):
        n = max(x.nf)
        armax = Layout(na=n, nb=x.nb, nc=n, nd=0, nf=(0,) * x.n_inputs, nk=x.nk, at_rest=x.at_rest)
        fit = search(predictor(armax), scaled.y[o], scaled.u, next(starts(armax, scaled.y[o], scaled.u)), most=20)
        theta = fit.theta[armax.places["A", None]]
        if not n or not np.all(np.isfinite(theta)):
            continue
        variance = fit.cost / max(fit.n_rows - fit.nuisance.size - armax.free.size, 1)
        covariance = np.zeros((armax.n_theta,) * 2)
        covariance[np.ix_(armax.free, armax.free)] = variance * fit.directions.inverse()
        size, sd = _outermost(fit.theta, armax.places["A", None], covariance)
        if size > 1.0 + _SDS * sd:
            warnings.append(
                f"output {o}: the plant looks unstable (armax finds a pole of magnitude {size:.4g}, sd {sd:.1g}), "
                "and this structure would give an unstable predictor. Use armax, arx or ararmax"
            )
    return warnings


def _outermost(theta: Array, place: slice, covariance: Array) -> tuple[float, float]:
    """Magnitude of the root that is farthest out, and its standard deviation, 0 at a multiple root."""
    values, rows = roots_at(theta, place)
    k = int(np.argmax(np.abs(values)))
    slope = np.real(rows[k] * np.conj(values[k])) / max(abs(values[k]), 1e-300)
    variance = float(slope @ covariance @ slope) if np.all(np.isfinite(slope)) else 0.0
    return float(abs(values[k])), float(np.sqrt(max(variance, 0.0)))


_LEVEL = 1e-3  # of records at rest, and of fits that found their minimum, so many are flagged
_MORE = 6  # coefficients that a look for a better minimum adds to A and to each B
_ROUNDING = 1e-22  # squared residual over squared output that is nothing but rounding


def not_at_rest(layouts: Sequence[Layout], fits: Sequence[Minimum], scaled: ScaledData) -> list[str]:
    """Return a warning for each output, its layout at rest, whose record does not begin at rest at zero."""
    warnings = []
    for o, (layout, fit) in enumerate(zip(layouts, fits, strict=True)):
        p = rest_probability(layout, fit, scaled.y[o], scaled.u)
        if p < _LEVEL:
            warnings.append(
                f"{f'output {o}: ' if len(fits) > 1 else ''}the record does not start at rest at zero (initial "
                f"state and constant, estimated freely, are significant: {p_text(p)}): coefficients are biased. "
                f"Omit {setting('at_rest')}"
            )
    return warnings


def rest_probability(layout: Layout, fit: Minimum, y: Array, u: Array) -> float:
    """Return how probable it is that a record at rest, scaled `y` (n_samples,) and `u` (n_inputs, n_samples), asks so
    much for an initial state and a constant; 1 where the fit leaves nothing but rounding.
    """
    free = replace(layout, at_rest=False)
    p = predictor(free)
    rows = y.size - free.first_row
    freedom = rows - p.n_nuisance - free.free.size
    if freedom < 1 or fit.cost <= _ROUNDING * float(y @ y):
        return 1.0
    left = float(p.triangle(y, u, fit.theta, np.zeros(p.n_nuisance))[-1, -1] ** 2)
    numbers = p.n_nuisance + free.first_row
    ratio = (fit.cost - left) / numbers / max(left / freedom, 1e-300)
    return float(fdtrc(numbers, freedom, max(ratio, 0.0)))


def missed_minimum(layouts: Sequence[Layout], fits: Sequence[Minimum], scaled: ScaledData) -> list[str]:
    """Return a warning for each output whose search went a long way and left what a longer model explains: with more of
    A and B, what the next Gauss-Newton step takes off the squared residual is F distributed in the minimum of the right
    model (score test; Söderström & Stoica 1989, sec. 11.5).
    """
    warnings = []
    for o, (layout, fit) in enumerate(zip(layouts, fits, strict=True)):
        if any(layout.nf) or not (layout.nc or layout.nd) or (fit.converged and fit.iterations <= SMOOTH):
            continue
        p, less = _longer_model(layout, fit, scaled.y[o], scaled.u)
        if p < _LEVEL:
            warnings.append(
                f"{f'output {o}: ' if len(fits) > 1 else ''}a longer model fits significantly better ({less:.1%} "
                f"of the squared residual, {p_text(p)}) and the search was hard: it may have missed a better "
                "minimum, or the orders are too low. Try pbsid, or raise the orders"
            )
    return warnings


def _longer_model(layout: Layout, fit: Minimum, y: Array, u: Array) -> tuple[float, float]:
    """Probability of so large a fall by chance, and the fall as a part of the squared residual (score test)."""
    part = liveliest_part(u)
    y, u = y[part], np.ascontiguousarray(u[:, part])
    bare = replace(layout, fixed=(), at_rest=False)
    longer = replace(bare, na=layout.na + _MORE, nb=tuple(n + _MORE for n in layout.nb))
    theta = longer.start()
    for key, place in bare.places.items():
        first = longer.places[key].start
        theta[first : first + place.stop - place.start] = fit.theta[place]
    skip = longer.first_row - bare.first_row  # both on the same rows
    few, many = predictor(bare), predictor(longer)
    freedom = y.size - longer.first_row - many.columns.shape[0] + 1
    if freedom < 1:
        return 1.0, 0.0
    late = np.ascontiguousarray(u[:, skip:])
    before = float(few.triangle(y[skip:], late, fit.theta, np.zeros(few.n_nuisance))[-1, -1] ** 2)
    after = float(many.triangle(y, u, theta, np.zeros(many.n_nuisance))[-1, -1] ** 2)
    if before <= 1e-20 * y.size:
        return 1.0, 0.0
    ratio = max(before - after, 0.0) / (longer.free.size - bare.free.size) / max(after / freedom, 1e-300)
    return float(fdtrc(longer.free.size - bare.free.size, freedom, ratio)), 1.0 - after / before


_EXACT = 1e-24  # squared residual, in units of the output's variance
_LONG, _SHORT = 100, 40  # evaluations of a search; those after which a further start has to be ahead
_EQUAL = 0.5  # of squared residual, in units of the noise variance: minima that are equally likely


def estimate(
    name: str,
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """Fit one of the eight structures, each output by itself (Ljung 1999, sec. 4.2); an nk left out is estimated.
    `fixed`: known coefficients, by the names of `PolynomialModel.names`, in SI; `at_rest`: the record begins at rest at
    zero.
    """
    layout, free_delay = read_orders(name, data, orders, at_rest=at_rest)
    scaled = scale_data(name, data, at_rest=at_rest)
    with one_thread():
        layouts = [layout] * data.n_outputs
        if free_delay:
            layouts = _layouts(name, layout, scaled, 0 if data.open_loop else 1, tick)
        places = fixed_places(name, tuple(layouts), {} if fixed is None else fixed)
        layouts = [replace(x, fixed=tuple(k)) if k else x for x, k in zip(layouts, places, strict=True)]
        fits = [fit_output(name, x, scaled, o, places[o], tick) for o, x in enumerate(layouts)]
        return polynomial_fit(name, data, scaled, layouts, fits, estimated_delay=free_delay)


fir, arx, armax, arma = (partial(estimate, name) for name in ("fir", "arx", "armax", "arma"))
ararx, ararmax, oe, bj = (partial(estimate, name) for name in ("ararx", "ararmax", "oe", "bj"))


def _layouts(
    name: str, orders: Layout, scaled: ScaledData, least: int, tick: Callable[[], None] | None
) -> list[Layout]:
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
        layout = replace(orders, nk=nk, at_rest=part.at_rest)
        loss = _loss(fit_output(name, layout, part, o, {}, tick))
        for i in range(orders.n_inputs):  # the structure itself decides between neighbours, where they clearly differ
            for k in (nk[i] - 1, nk[i] + 1):
                near = replace(layout, nk=(*layout.nk[:i], k, *layout.nk[i + 1 :]))
                if k >= least:
                    near_loss = _loss(fit_output(name, near, part, o, {}, tick))
                    if rows * np.log(near_loss / loss) < -np.log(rows):
                        layout, loss = near, near_loss
        out.append(replace(layout, at_rest=scaled.at_rest))
    return out


def _loss(fit: Minimum) -> float:
    return max(fit.cost / fit.n_rows, _EXACT)


def fit_output(
    name: str,
    layout: Layout,
    scaled: ScaledData,
    o: int,
    fixed: Mapping[int, float],
    tick: Callable[[], None] | None,
) -> Minimum:
    """Fit one output from the best of its starts; `fixed`: fixed coefficients by place, SI."""
    p, y = predictor(layout), scaled.y[o]
    need = layout.first_row + 2 * (p.n_nuisance + layout.free.size) + 1
    if y.size < need:
        raise EstimationError(
            f"{name}: {y.size} samples for {layout.free.size} coefficients; at least {need} are needed. Lower the "
            "orders, or use a longer part of the record"
        )
    worth = coefficient_units(layout, scaled, o)
    minima: list[Minimum] = []
    shared = bool(layout.na and layout.nd)  # A and D share roots: there always are several minima
    more = weighted_starts(layout, y, scaled.u) if any(layout.nf) else separable_starts(layout, y, scaled.u)
    for ordinary, some in ((True, starts(layout, y, scaled.u)), (False, more)):
        for start in some:
            for place, value in fixed.items():
                start[place] = value / worth[place]
            if not stable_predictor(layout, start):
                continue
            end = search(p, y, scaled.u, start, most=_LONG if ordinary else _SHORT, tick=tick)
            if not ordinary and not end.converged and minima and end.cost < min(x.cost for x in minima):
                end = search(p, y, scaled.u, end.theta, tick=tick)
            minima.append(end)
            agreed = sum(x.converged and x.cost <= _lowest(minima) for x in minima) > 1
            if agreed if ordinary and shared else _smooth(minima):
                break
        if _smooth(minima) and not shared:
            break
    if not minima:
        raise EstimationError(f"{name}: no stable predictor to start from. Change the fixed coefficients of C or F")
    best = min(minima, key=lambda x: x.cost)
    # one that converged, where a lower one that did not is not told from it by the data
    near = [x for x in minima if x.converged and x.cost <= best.cost * (1 + _EQUAL / best.n_rows)]
    return best if best.converged else min(near, key=lambda x: x.cost, default=best)


def _smooth(minima: list[Minimum]) -> bool:
    """Whether the last search went straight to the lowest minimum; a long way hints at a second one."""
    last = minima[-1] if minima else None
    return last is not None and last.converged and last.iterations <= SMOOTH and last.cost <= _lowest(minima)


def _lowest(minima: list[Minimum]) -> float:
    return min(x.cost for x in minima) * (1 + 1e-6)
