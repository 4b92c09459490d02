"""First values for the search, without help from the user.

A long ARX model gives innovations; with them as one more input, A, B and C follow by least squares (Hannan & Rissanen
1982), and so do C and D of the noise of any plant model. B and F follow from iterated prefiltering (Steiglitz & McBride
1965), of the data or, with several inputs, of the long model's impulse responses. A root that lies outside the unit
circle is reflected: this is a start, and the search decides.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ambid.identify.polynomial._kernels import filtered
from ambid.identify.polynomial.orders import Layout
from ambid.identify.polynomial.predictor import predictor
from ambid.identify.polynomial.stability import reflected, stable

Array = NDArray[np.float64]

_ROWS = 4096  # of the long model: more would not make a better start
_CHUNK = 512
_SM_ITERATIONS = 5


def arx_coefficients(layout: Layout, y: Array, u: Array, *, most_rows: int | None = None) -> Array:
    """Return the least-squares coefficients of an ARX layout with a constant.

    Parameters
    ----------
    layout : Layout
        nc, nd and nf zero.
    y : ndarray, shape (n_samples,)
    u : ndarray, shape (n_inputs, n_samples)
    most_rows : int, optional
        Use at most about so many rows, in pieces spread over the record.

    Returns
    -------
    ndarray, shape (n_theta,)
    """
    p, theta = predictor(layout), layout.start()
    R: Array = np.zeros((p.columns.shape[0],) * 2)
    for part in _pieces(y.size, layout.first_row, most_rows):
        more = p.triangle(y[part], np.ascontiguousarray(u[:, part]), theta, np.zeros(p.n_nuisance))
        R = more if part.stop - part.start == y.size else np.asarray(np.linalg.qr(np.vstack([R, more]), mode="r"))
    scale = np.maximum(np.linalg.norm(R[:-1, :-1], axis=0), 1e-300)
    step = -np.linalg.lstsq(R[:-1, :-1] / scale, R[:-1, -1], rcond=1e-10)[0] / scale
    theta[layout.free] += step[p.n_nuisance :]
    return theta


def starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield first values, the most promising first.

    Parameters
    ----------
    layout : Layout
    y : ndarray, shape (n_samples,)
        Scaled, mean taken off.
    u : ndarray, shape (n_inputs, n_samples)

    Yields
    ------
    ndarray, shape (n_theta,)
    """
    free = Layout(na=layout.na, nb=layout.nb, nc=layout.nc, nd=layout.nd, nf=layout.nf, nk=layout.nk)
    if any(layout.nf):
        yield from _output_error(free, y, u)
    elif layout.nd:
        yield from _generalised(free, y, u)
    elif layout.nc:
        yield from _hannan_rissanen(free, y, u)
    yield _least_squares(free, y, u)


def _pieces(n: int, history: int, most_rows: int | None) -> Iterator[slice]:
    if most_rows is None or n <= most_rows:
        yield slice(0, n)
        return
    count = max(most_rows // _CHUNK, 1)
    for first in np.linspace(0, n - _CHUNK - history, count).astype(int):
        yield slice(int(first), int(first) + _CHUNK + history)


def _arx(na: int, nb: tuple[int, ...], nk: tuple[int, ...]) -> Layout:
    return Layout(na=na, nb=nb, nc=0, nd=0, nf=(0,) * len(nb), nk=nk)


def _set(theta: Array, layout: Layout, letter: str, i: int | None, values: Array) -> None:
    theta[layout.places[letter, i]] = values


def _least_squares(layout: Layout, y: Array, u: Array) -> Array:
    """A and B as if the noise went through 1/A; C = D = 1."""
    na = max([layout.na, *layout.nf])
    arx = _arx(na, layout.nb, layout.nk)
    found = arx_coefficients(arx, y, u)
    theta = layout.start()
    for i in range(layout.n_inputs):
        _set(theta, layout, "B", i, found[arx.places["B", i]])
        if layout.nf[i]:
            _set(theta, layout, "F", i, reflected(found[arx.places["A", None]][: layout.nf[i] + 1]))
    if layout.na:
        _set(theta, layout, "A", None, found[arx.places["A", None]])
    return theta


def _long_order(layout: Layout, n_samples: int) -> int:
    most = max([layout.na + layout.nd, layout.nc + layout.nd, *layout.nf, *layout.nb])
    return max(1, min(8 + 2 * most, n_samples // (6 * (1 + layout.n_inputs))))


def _long_model(layout: Layout, y: Array, u: Array) -> tuple[Array, list[Array]]:
    """A and B_i of a long ARX model."""
    n = _long_order(layout, y.size)
    arx = _arx(n, (n,) * layout.n_inputs, layout.nk)
    found = arx_coefficients(arx, y, u, most_rows=_ROWS)
    return found[arx.places["A", None]], [found[arx.places["B", i]] for i in range(layout.n_inputs)]


def _long_innovations(layout: Layout, y: Array, u: Array) -> Array:
    A, B = _long_model(layout, y, u)
    e = filtered(A, np.ones(1), y)
    for b, x in zip(B, u, strict=True):
        e -= filtered(b, np.ones(1), x)
    return e


def _hannan_rissanen(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """ARMAX and ARMA: the long model's innovations as one more input."""
    e = _long_innovations(layout, y, u)
    arx = _arx(layout.na, (*layout.nb, layout.nc), (*layout.nk, 1))
    found = arx_coefficients(arx, y, np.vstack([u, e]))
    theta = layout.start()
    if layout.na:
        _set(theta, layout, "A", None, found[arx.places["A", None]])
    for i in range(layout.n_inputs):
        _set(theta, layout, "B", i, found[arx.places["B", i]])
    c = found[arx.places["B", layout.n_inputs]]
    _set(theta, layout, "C", None, reflected(np.concatenate([[1.0], c[1:]])))
    yield theta


def _noise(layout: Layout, v: Array) -> tuple[Array, Array]:
    """C and D of the series v = (C/D) e."""
    n = max(1, min(10 + 2 * (layout.nc + layout.nd), v.size // 8))
    u = np.empty((0, v.size))
    long = Layout(na=n, nb=(), nc=0, nd=0, nf=(), nk=())
    e = filtered(arx_coefficients(long, v, u, most_rows=_ROWS)[long.places["A", None]], np.ones(1), v)
    nb = (layout.nc,) if layout.nc else ()
    arx = Layout(na=layout.nd, nb=nb, nc=0, nd=0, nf=(0,) * len(nb), nk=(1,) * len(nb))
    if not layout.nc and not layout.nd:
        return np.ones(1), np.ones(1)
    found = arx_coefficients(arx, v, e[None, :] if nb else u)
    D = found[arx.places["A", None]]
    C = np.concatenate([[1.0], found[arx.places["B", 0]][1:]]) if nb else np.ones(1)
    return reflected(C), reflected(D)


def _generalised(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """ARARX and ARARMAX: the plant by instruments that the noise does not reach, then its residual's model."""
    for theta in (_instrumental(layout, y, u), _least_squares(layout, y, u)):
        if theta is None:
            continue
        _set_noise(theta, layout, y, u)
        yield theta


def _set_noise(theta: Array, layout: Layout, y: Array, u: Array) -> None:
    places = layout.places
    v = filtered(theta[places["A", None]], np.ones(1), y)
    for i, x in enumerate(u):
        v -= filtered(theta[places["B", i]], theta[places["F", i]], x)
    C, D = _noise(layout, v - np.mean(v))
    _set(theta, layout, "C", None, C)
    _set(theta, layout, "D", None, D)


def _instrumental(layout: Layout, y: Array, u: Array) -> Array | None:
    """A and B with the simulated output as instrument; None where the model at hand is unstable."""
    arx = _arx(layout.na, layout.nb, layout.nk)
    theta, p = arx_coefficients(arx, y, u), predictor(arx)
    for _ in range(3):
        A = theta[arx.places["A", None]]
        if not stable(A):
            return None
        simulated = np.zeros_like(y)
        for i, x in enumerate(u):
            simulated += filtered(theta[arx.places["B", i]], A, x)
        if not np.all(np.isfinite(simulated)) or not np.any(simulated):
            return None
        zero = np.zeros(p.n_nuisance)
        rows, instruments = p.rows(y, u, arx.start(), zero), p.rows(simulated, u, arx.start(), zero)
        Q = np.linalg.qr(instruments[:-1].T)[0]
        step = -np.linalg.lstsq(Q.T @ rows[:-1].T, Q.T @ rows[-1], rcond=1e-12)[0]
        theta = arx.start()
        theta[arx.free] += step[p.n_nuisance :]
    out = layout.start()
    _set(out, layout, "A", None, theta[arx.places["A", None]])
    for i in range(layout.n_inputs):
        _set(out, layout, "B", i, theta[arx.places["B", i]])
    return out


def _output_error(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """OE and BJ."""
    if layout.n_inputs == 1:
        theta = layout.start()
        b, f = steiglitz_mcbride(y, u[0], layout.nb[0], layout.nf[0], layout.nk[0])
        _set(theta, layout, "B", 0, b)
        _set(theta, layout, "F", 0, f)
        _set_noise(theta, layout, y, u)
        yield theta
    A, B = _long_model(layout, y, u)
    A = reflected(A, 0.995)
    theta = layout.start()
    for i in range(layout.n_inputs):
        impulse = np.zeros(min(y.size, 1000))
        impulse[0] = 1.0
        g = filtered(B[i], A, impulse)
        b, f = steiglitz_mcbride(g, impulse, layout.nb[i], layout.nf[i], layout.nk[i])
        _set(theta, layout, "B", i, b)
        _set(theta, layout, "F", i, f)
    _set_noise(theta, layout, y, u)
    yield theta


def steiglitz_mcbride(y: Array, u: Array, nb: int, nf: int, nk: int) -> tuple[Array, Array]:
    """Fit B/F by least squares on data filtered by the last 1/F (Steiglitz & McBride 1965).

    Parameters
    ----------
    y, u : ndarray, shape (n_samples,)
    nb, nf, nk : int

    Returns
    -------
    tuple of ndarray, shape (nk + nb,) and (nf + 1,)
        B and a stable F.
    """
    arx = Layout(na=nf, nb=(nb,), nc=0, nd=0, nf=(0,), nk=(nk,))
    F = np.ones(1)
    for _ in range(_SM_ITERATIONS if nf else 1):
        one = np.ones(1)
        found = arx_coefficients(arx, filtered(one, F, y), filtered(one, F, u)[None, :])
        before, F = F, reflected(found[arx.places["A", None]], 0.999)
        if before.size == F.size and np.max(np.abs(before - F)) < 1e-3:
            break
    return found[arx.places["B", 0]], F
