"""What a finished search says: coefficients with covariance, offsets, noise, and what to be warned of.

Covariance sigma^2 (J'J)^-1 from the triangle of J with initial states and constant taken out (Ljung 1999, sec. 9.4), so
their uncertainty is in it. Outputs are fitted one by one; what their common noise makes their coefficients share is
added from J_o' J_p.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.made import made
from ambid.blackbox.polynomial.caution import cautions, unstable_plant
from ambid.blackbox.polynomial.delay import LARGEST_DELAY
from ambid.blackbox.polynomial.orders import Layout, shown_orders
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.rest import not_at_rest
from ambid.blackbox.polynomial.scaled import Scaled, unit
from ambid.blackbox.polynomial.search import BLIND, Fitted
from ambid.blackbox.polynomial.separable import missed_minimum
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.response import Offsets

_LEAST_SEEN = 1e-14  # singular value, of scaled columns, that stands for a direction not seen at all
_FAR = 10.0  # standard deviations of y: an offset beyond is put on the input


def result(
    name: str,
    data: IOData,
    scaled: Scaled,
    layouts: Sequence[Layout],
    fits: Sequence[Fitted],
    *,
    estimated_delay: bool,
) -> BlackBoxFit:
    """Put the outputs' searches together.

    `layouts`: one for each output, fixed coefficients marked.
    """
    units = [unit(x, scaled, o) for o, x in enumerate(layouts)]
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
        warnings.append(f"the delay was looked for up to {LARGEST_DELAY} samples and may be longer: give nk")
    details: dict[str, object] = {
        "iterations": [f.iterations for f in fits],
        "condition": [_condition(f) for f in fits],
    }
    if scaled.at_rest:
        details["at_rest"] = True
    if estimated_delay:
        details["nk"] = [list(x.nk) for x in layouts]
    return made(
        name,
        data,
        orders=shown_orders(name, layouts[0]),
        model=model,
        covariance=covariance,
        n_estimated=sum(x.free.size for x in layouts),
        offsets=_offsets(scaled, layouts, fits),
        noise_covariance=noise * np.outer(scaled.y_scale, scaled.y_scale),
        status="converged" if all(f.converged for f in fits) else "stalled",
        warnings=warnings,
        details=details,
    )


def _condition(fit: Fitted) -> float:
    """Condition number of the gradients with columns of unit length."""
    s = fit.directions[1]
    if not s.size:
        return 1.0
    return float(min(s[0] / max(s[-1], 1e-300), 1e300))


def _inverse(R: Array) -> Array:
    """R^-1, with a huge but finite inverse along directions that the data do not see."""
    scale, U, s, Vt = _singular(R)
    return np.asarray((Vt.T / s) @ U.T / scale[:, None])


def _spread(fit: Fitted, variance: float) -> Array:
    """Covariance; as large as the coefficients themselves along directions that the data do not see."""
    _, s, Vt, scale = fit.directions
    s = np.maximum(s, _LEAST_SEEN * max(float(s[0]) if s.size else 1.0, 1e-150))
    directions = Vt.T / scale[:, None]
    length = np.sqrt(variance) / s
    blind = s * BLIND < (s[0] if s.size else 0.0)
    if blind.any():
        whole = max(1.0, float(np.linalg.norm(fit.theta[fit.free])))
        length[blind] = np.maximum(length[blind], whole / np.linalg.norm(directions[:, blind], axis=0))
    sides = directions * length
    return np.asarray(sides @ sides.T)


def _singular(R: Array) -> tuple[Array, Array, Array, Array]:
    """Column lengths of R, and singular values and directions of R with unit columns."""
    scale = np.maximum(np.linalg.norm(R, axis=0), 1e-150)
    U, s, Vt = np.linalg.svd(R / scale)
    s = np.maximum(s, _LEAST_SEEN * max(float(s[0]) if s.size else 1.0, 1e-150))
    return scale, U, s, Vt


def _covariances(scaled: Scaled, layouts: Sequence[Layout], fits: Sequence[Fitted]) -> tuple[Array, Array]:
    """Covariance of the innovations and of all coefficients, both in scaled units."""
    n = sum(x.n_theta for x in layouts)
    freedom = np.array([max(f.n_rows - f.nuisance.size - x.free.size, 1) for x, f in zip(layouts, fits, strict=True)])
    noise = np.diag([f.cost for f in fits] / freedom)
    firsts = np.cumsum([0, *(x.n_theta for x in layouts)])
    places = [int(first) + x.free for first, x in zip(firsts, layouts, strict=False)]
    covariance = np.zeros((n, n))
    for o, fit in enumerate(fits):
        covariance[places[o][:, None], places[o]] = _spread(fit, noise[o, o])
    for o in range(len(fits)):
        for k in range(o):
            products, errors = _shared(scaled, layouts, fits, o, k)
            noise[o, k] = noise[k, o] = errors / np.sqrt(freedom[o] * freedom[k])
            block = noise[o, k] * (_inverse(fits[o].triangle) @ products @ _inverse(fits[k].triangle).T)
            covariance[np.ix_(places[o], places[k])] = block
            covariance[np.ix_(places[k], places[o])] = block.T
    return noise, covariance


def _shared(scaled: Scaled, layouts: Sequence[Layout], fits: Sequence[Fitted], o: int, k: int) -> tuple[Array, float]:
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


def _offsets(scaled: Scaled, layouts: Sequence[Layout], fits: Sequence[Fitted]) -> Offsets:
    """Turn the constant of A y - (B/F) u = constant into an operating point.

    It is the output's, unless A sums to (nearly) zero: an integrating plant has any level, and the constant stands for
    an offset of its input.
    """
    n_u = scaled.u.shape[0]
    y, rows, right = np.zeros(len(fits)), [], []
    for o, (x, f) in enumerate(zip(layouts, fits, strict=True)):
        constant = float(f.nuisance[-1]) if f.nuisance.size else 0.0
        level = float(f.theta[x.places["A", None]].sum())
        p = x.polynomials(f.theta)
        gain = [np.sum(b) / np.sum(a) if np.sum(a) else np.inf for b, a in zip(p.B, p.F, strict=True)]
        if abs(constant) <= _FAR * abs(level) or (level and not np.all(np.isfinite(gain))):
            y[o] = constant / level  # an F that integrates has no static gain to shift an input by
        elif n_u and np.all(np.isfinite(gain)):
            rows.append([-g for g in gain])
            right.append(constant)
    u = np.linalg.lstsq(np.array(rows), np.array(right), rcond=1e-10)[0] if rows else np.zeros(n_u)
    for o, (x, f) in enumerate(zip(layouts, fits, strict=True)):
        if rows and y[o]:  # the shifted input moves the other outputs too
            p = x.polynomials(f.theta)
            static = np.array([np.sum(b) / np.sum(a) if np.sum(a) else 0.0 for b, a in zip(p.B, p.F, strict=True)])
            y[o] += float(static @ u) / float(p.A.sum())
    return Offsets(u=scaled.u_mean + scaled.u_scale * u, y=scaled.y_mean + scaled.y_scale * y)
