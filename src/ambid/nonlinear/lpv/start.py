"""Starts of an LPV fit by least squares: without an error model, and with the innovations of an earlier one.

The second is the pseudo-linear regression of extended least squares (Ljung 1999, sec. 10.1): with v and e of an earlier
fit in place of the true ones, the predictor is linear in all coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.roots import reflect
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.lpv.schedule import basis_values
from ambid.nonlinear.lpv.shape import LpvShape, Part, errors

_BLIND = 1e-10
_LONG, _ROWS = 4, 20  # lags of the long regression, times the order of C; samples for each of its numbers


def least_squares(shape: LpvShape, parts: Sequence[Part], first: int) -> tuple[Array, float]:
    """Fit A y = B u + c + e, all coefficients functions of p.

    `parts`: made for it; `first`: equations count from this sample on. Returns `theta`: (n_theta,), scaled, the error
    model is left at zero; `cost`: sum of squared errors.
    """
    n = shape.n_process_theta
    found, cost = _solved([_process_rows(shape, p, p.y, first) for p in parts], [p.y[first:] for p in parts])
    theta = np.zeros(shape.n_theta)
    theta[:n] = found
    return theta, cost


def from_earlier(
    shape: LpvShape,
    parts: Sequence[Part],
    first: int,
    old: LpvShape,
    theta: Array,
    earlier: Sequence[Part] | None = None,
) -> tuple[Array, float] | None:
    """Fit all coefficients with errors and innovations of an earlier model in place of the true ones.

    `parts`: made for it; `first`: equations count from this sample on; `theta`: (n_theta of old,), scaled; `earlier`:
    records made for the earlier model, where its functions of p are others. Returns `theta`: (n_theta,), scaled;
    `cost`: sum of squared errors of this regression; instead of both, where the earlier model diverges.
    """
    rows, targets = [], []
    for part, before in zip(parts, earlier or parts, strict=True):
        found = errors(old, before, theta)
        if not found.finite:
            return None
        v = part.y - found.x
        n = part.y.size
        by = [_process_rows(shape, part, found.x if shape.form == "output" else part.y, first)]
        for signal, size in ((-v, shape.ar), (found.e, shape.ma)):
            by += [signal[first - k : n - k, None] * part.psi[first:] for k in range(1, size + 1)]
        rows.append(np.hstack(by))
        targets.append(part.y[first:])
    return _solved(rows, targets)


def by_long_regression(shape: LpvShape, parts: Sequence[Part], first: int) -> Array:
    """Fit an equation with moving-average errors: innovations by a long regression, then one with their lags.

    `shape`: of the equation form, with ma alone; `parts`: made for it; `first`: equations count from this sample on.
    Returns (n_theta,), scaled, zeros of C outside the unit circle are reflected where C does not depend on p (Hannan
    and Rissanen 1982).
    """
    n, inputs = sum(p.y.size for p in parts), len(shape.columns)
    spare = min(p.y.size for p in parts) - first - shape.ma
    if spare < 1:
        return np.zeros(shape.n_theta)
    lags = min(_LONG * shape.ma, n // (_ROWS * (1 + inputs) * (shape.degree + 1)), spare // 4)
    rows, targets = [], []
    for p in parts:
        begin, end = first + lags, p.y.size
        by = [-p.y[begin - k : end - k, None] * p.phi[begin:] for k in range(1, shape.order + lags + 1)]
        for i in range(inputs):  # the first lag of each input, put back further
            newest = p.W[:, i * shape.nb, None]
            by += [newest[begin - k : end - k] * p.phi[begin:] for k in range(shape.nb + lags)]
        rows.append(np.hstack([*by, p.phi[begin:, : shape.n_offset]]))
        targets.append(p.y[begin:])
    long = _solved(rows, targets)[0]
    again, goal = [], []
    for p, X, t in zip(parts, rows, targets, strict=True):
        e, begin = t - X @ long, first + lags
        by = [e[shape.ma - k : e.size - k, None] * p.psi[begin + shape.ma :] for k in range(1, shape.ma + 1)]
        again.append(np.hstack([_process_rows(shape, p, p.y, begin + shape.ma), *by]))
        goal.append(t[shape.ma :])
    theta = _solved(again, goal)[0]
    if not shape.error_degree:
        theta[-shape.ma :] = reflect(np.concatenate([[1.0], theta[-shape.ma :]]))[1:]
    return theta


def padded(shape: LpvShape, old: LpvShape, theta: Array) -> Array:
    """Carry a model over to one with other functions of p, or with another error model.

    `old`: of the same basis; `theta`: (n_theta of old,). Returns (n_theta,), coefficients as near as can be over the
    range of p; zeros where the old model has none.
    """
    grid = np.linspace(-1.0, 1.0, 33)

    def carried(values: Array, n: int) -> Array:
        before, after = (basis_values(grid, k, shape.basis) for k in (values.size, n))
        return np.asarray(np.linalg.lstsq(after, before @ values, rcond=None)[0], dtype=np.float64)

    out = np.zeros(shape.n_theta)
    known = {name: k for k, name in enumerate(old.coefficients)}
    for k, name in enumerate(shape.coefficients):
        if name in known:
            source, target = theta[old.place(known[name])], shape.place(k)
            n = target.stop - target.start
            out[target] = source if n == source.size else carried(source, n)
    return out


def without_error_model(shape: LpvShape) -> LpvShape:
    """Return the same equation with white errors."""
    return replace(shape, ar=0, ma=0, form="equation")


def _process_rows(shape: LpvShape, part: Part, z: Array, first: int) -> Array:
    """Regressors of A, B and the constant from sample `first` on."""
    n = part.y.size
    phi = part.phi[first:]
    by = [-z[first - k : n - k, None] * phi for k in range(1, shape.order + 1)]
    by += [part.W[first:, i, None] * phi for i in range(part.W.shape[1] - 1)]
    return np.hstack([*by, phi[:, : shape.n_offset]])


def _solved(rows: Sequence[Array], targets: Sequence[Array]) -> tuple[Array, float]:
    """Least squares on columns of unit length, by QR and singular values."""
    R = triangle_of([np.column_stack([X, t]) for X, t in zip(rows, targets, strict=True)])
    if not np.all(np.isfinite(R)):
        return np.zeros(R.shape[1] - 1), np.inf
    size = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    found = np.linalg.lstsq(R[:, :-1] / size, R[:, -1], rcond=_BLIND)[0]
    rest = R[:, -1] - (R[:, :-1] / size) @ found
    return found / size, float(rest @ rest)
