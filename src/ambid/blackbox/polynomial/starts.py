"""First values for the search, without help from the user.

A long ARX model gives innovations; with them as one more input, A, B and C follow by least squares (Hannan & Rissanen
1982), and so do C and D of the noise of any plant model. B and F follow from iterated prefiltering (Steiglitz & McBride
1965) or from the null space of the long model (Galrinho, Rojas & Hjalmarsson 2019). A root that lies outside the unit
circle is reflected: this is a start, and the search decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.polynomial._kernels import filtered
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.scaled import liveliest
from ambid.blackbox.polynomial.search import searched
from ambid.blackbox.polynomial.stability import solved
from ambid.blackbox.roots import reflected

_ROWS = 4096  # of the long model: more would not make a better start
_CHUNK = 1024
_SM_ITERATIONS = 5
_DOUBLE = np.array([1.0, 1.6, 0.64])  # two roots at -0.8: as a numerator low frequencies, as a denominator high ones
_WINDOW = 8192  # samples that a start from the data takes of a long record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LongModel:
    """A long ARX model P y = sum_i Q_i u_i + e, which holds what the data say of plant and noise together."""

    P: Array  # (n + 1,)
    Q: tuple[Array, ...]  # (nk + n,), one for each input
    nk: tuple[int, ...]
    triangle: Array  # (n + n n_inputs, n + n n_inputs), of its regressors, the constant taken out


def arx_coefficients(layout: Layout, y: Array, u: Array) -> Array:
    """Return the least-squares coefficients of an ARX layout with a constant.

    `layout`: nc, nd and nf zero; `y`: (n_samples,); `u`: (n_inputs, n_samples). Returns (n_theta,).
    """
    return _regression(layout, y, u, None)[0]


def _regression(layout: Layout, y: Array, u: Array, most_rows: int | None) -> tuple[Array, Array]:
    """Coefficients and the triangle of their regressors; of at most about so many rows, spread over the record."""
    if most_rows is not None and y.size > most_rows:
        layout = replace(layout, at_rest=False)  # pieces out of the middle are not
    p, theta = predictor(layout), layout.start()
    R: Array = np.zeros((p.columns.shape[0],) * 2)
    for part in _pieces(y.size, layout.first_row, most_rows):
        more = p.triangle(y[part], np.ascontiguousarray(u[:, part]), theta, np.zeros(p.n_nuisance))
        R = more if part.stop - part.start == y.size else np.asarray(np.linalg.qr(np.vstack([R, more]), mode="r"))
    theta[layout.free] -= solved(R[:-1, :-1], R[:-1, -1])[p.n_nuisance :]
    return theta, R[p.n_nuisance : -1, p.n_nuisance : -1]


def starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield first values, the most promising first.

    `y`: (n_samples,), scaled, mean taken off; `u`: (n_inputs, n_samples). Returns (n_theta,).
    """
    if not (layout.nc or layout.nd or any(layout.nf)):
        yield layout.start()  # one step from anywhere
        return
    free = replace(layout, fixed=())
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


def _arx(na: int, nb: tuple[int, ...], nk: tuple[int, ...], *, at_rest: bool) -> Layout:
    return Layout(na=na, nb=nb, nc=0, nd=0, nf=(0,) * len(nb), nk=nk, at_rest=at_rest)


def _set(theta: Array, layout: Layout, letter: str, i: int | None, values: Array) -> None:
    theta[layout.places[letter, i]] = values


def _least_squares(layout: Layout, y: Array, u: Array) -> Array:
    """A and B as if the noise went through 1/A; C = D = 1."""
    na = max([layout.na, *layout.nf])
    arx = _arx(na, layout.nb, layout.nk, at_rest=layout.at_rest)
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


def _long_model(layout: Layout, y: Array, u: Array) -> LongModel:
    n = _long_order(layout, y.size)
    arx = _arx(n, (n,) * layout.n_inputs, layout.nk, at_rest=layout.at_rest)
    found, R = _regression(arx, y, u, _ROWS)
    Q = tuple(found[arx.places["B", i]] for i in range(layout.n_inputs))
    return LongModel(P=found[arx.places["A", None]], Q=Q, nk=layout.nk, triangle=R)


def reduced(long: LongModel, inputs: Sequence[int], nb: Sequence[int], nf: int) -> tuple[list[Array], Array]:
    """Find B_i and the common F with P B_i = Q_i F, weighted by the spread of the long model.

    The null space of the long model is fitted (Galrinho, Rojas & Hjalmarsson 2019): linear, and consistent under
    feedback and for any noise.

    `nb`: for each of `inputs`. Returns B for each of `inputs`, and F, stable or not.
    """
    n = long.P.size - 1
    count = [min(b, n) for b in nb]
    rows, right = np.zeros((n * len(inputs), sum(count) + nf)), np.zeros(n * len(inputs))
    for k, i in enumerate(inputs):
        Q, at = long.Q[i][long.nk[i] :], slice(k * n, (k + 1) * n)
        first = sum(count[:k])
        rows[at, first : first + count[k]] = _shifts(long.P[:n], count[k], 0)
        rows[at, sum(count) :] = -_shifts(Q, nf, 1)
        right[at] = Q
    x = np.linalg.lstsq(rows, right, rcond=1e-12)[0]
    scale = np.maximum(np.linalg.norm(long.triangle, axis=0), 1e-300)
    for _ in range(3):
        F = np.concatenate([[1.0], x[sum(count) :]])
        T = np.zeros((n * len(inputs), long.triangle.shape[0]))
        for k, i in enumerate(inputs):
            at, first = slice(k * n, (k + 1) * n), sum(count[:k])
            T[at, :n] = _shifts(np.concatenate([x[first : first + count[k]], np.zeros(n)])[:n], n, 1)
            T[at, n * (1 + i) : n * (2 + i)] = -_shifts(np.concatenate([F, np.zeros(n)])[:n], n, 0)
        spread = np.linalg.lstsq((long.triangle / scale).T, (T / scale).T, rcond=1e-9)[0]
        whiten = np.asarray(np.linalg.qr(spread, mode="r")).T
        together = np.linalg.lstsq(whiten, np.column_stack([rows, right]), rcond=1e-9)[0]
        x = np.linalg.lstsq(together[:, :-1], together[:, -1], rcond=1e-12)[0]
    found = []
    for k, i in enumerate(inputs):
        first = sum(count[:k])
        b = np.zeros(long.nk[i] + nb[k])
        b[long.nk[i] : long.nk[i] + count[k]] = x[first : first + count[k]]
        found.append(b)
    return found, np.concatenate([[1.0], x[sum(count) :]])


def _shifts(c: Array, n_columns: int, lag: int) -> Array:
    """Columns of c moved down by lag, lag + 1, ..."""
    out = np.zeros((c.size, n_columns))
    for j in range(n_columns):
        if j + lag < c.size:
            out[j + lag :, j] = c[: c.size - j - lag]
    return out


def _long_innovations(layout: Layout, y: Array, u: Array) -> Array:
    long = _long_model(layout, y, u)
    e = filtered(long.P, np.ones(1), y)
    for q, x in zip(long.Q, u, strict=True):
        e -= filtered(q, np.ones(1), x)
    return e


def _hannan_rissanen(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """ARMAX and ARMA: the long model's innovations as one more input."""
    e = _long_innovations(layout, y, u)
    arx = _arx(layout.na, (*layout.nb, layout.nc), (*layout.nk, 1), at_rest=layout.at_rest)
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
    e = filtered(_regression(long, v, u, _ROWS)[0][long.places["A", None]], np.ones(1), v)
    nb = (layout.nc,) if layout.nc else ()
    arx = Layout(na=layout.nd, nb=nb, nc=0, nd=0, nf=(0,) * len(nb), nk=(1,) * len(nb))
    found = arx_coefficients(arx, v, e[None, :] if nb else u)
    D = found[arx.places["A", None]]
    C = np.concatenate([[1.0], found[arx.places["B", 0]][1:]]) if nb else np.ones(1)
    return reflected(C), reflected(D)


def _generalised(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """ARARX and ARARMAX: the plant from the long model, as output error or by least squares, then its residual."""
    theta = layout.start()
    B, A = reduced(_long_model(layout, y, u), range(layout.n_inputs), layout.nb, layout.na)
    _set(theta, layout, "A", None, A)
    for i, b in enumerate(B):
        _set(theta, layout, "B", i, b)
    plants = [theta, _least_squares(layout, y, u)]
    if layout.n_inputs == 1 and layout.na:
        b, f = steiglitz_mcbride(y, u[0], layout.nb[0], layout.na, layout.nk[0], at_rest=layout.at_rest)
        theta = layout.start()
        _set(theta, layout, "A", None, f)
        _set(theta, layout, "B", 0, b)
        plants.insert(1, theta)
    for plant in plants:
        _set_noise(plant, layout, y, u)
        yield plant


def _set_noise(theta: Array, layout: Layout, y: Array, u: Array) -> None:
    if not layout.nc and not layout.nd:
        return
    places = layout.places
    v = filtered(theta[places["A", None]], np.ones(1), y)
    for i, x in enumerate(u):
        v -= filtered(theta[places["B", i]], theta[places["F", i]], x)
    C, D = _noise(layout, v - np.mean(v))
    _set(theta, layout, "C", None, C)
    _set(theta, layout, "D", None, D)


def _output_error(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """OE: the plant from the data, then from the long model. BJ: from the long model, then from the data."""
    coloured = layout.nc + layout.nd > 0
    ways = [_from_long_model] if layout.n_inputs > 1 else [_from_data, _from_long_model]
    for way in ways[::-1] if coloured else ways:
        theta = way(layout, y, u)
        _set_noise(theta, layout, y, u)
        yield theta
    if coloured:  # the plant searched for with white noise, then the noise
        white = Layout(na=0, nb=layout.nb, nc=0, nd=0, nf=layout.nf, nk=layout.nk, at_rest=layout.at_rest)
        found = searched(predictor(white), y, u, ways[0](white, y, u), most=15).theta
        theta = layout.start()
        for i in range(layout.n_inputs):
            _set(theta, layout, "B", i, found[white.places["B", i]])
            _set(theta, layout, "F", i, found[white.places["F", i]])
        _set_noise(theta, layout, y, u)
        yield theta


def weighted_starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield starts for hard cases of OE and BJ: the plant from the data with other frequencies stressed.

    `y`: (n_samples,), scaled, mean taken off; `u`: (n_inputs, n_samples). Returns (n_theta,).
    """
    if layout.n_inputs > 1:
        return
    one = np.ones(1)
    for num, den in ((_DOUBLE, one), (one, _DOUBLE), (one, _DOUBLE * np.array([1.0, -1.0, 1.0]))):
        fy, fu = filtered(num, den, y), filtered(num, den, u[0])[None, :]
        theta = _from_data(replace(layout, fixed=()), fy, fu)
        _set_noise(theta, layout, y, u)
        yield theta


def _from_data(layout: Layout, y: Array, u: Array) -> Array:
    theta = layout.start()
    b, f = steiglitz_mcbride(y, u[0], layout.nb[0], layout.nf[0], layout.nk[0], at_rest=layout.at_rest)
    _set(theta, layout, "B", 0, b)
    _set(theta, layout, "F", 0, f)
    return theta


def _from_long_model(layout: Layout, y: Array, u: Array) -> Array:
    long, theta = _long_model(layout, y, u), layout.start()
    for i in range(layout.n_inputs):
        (b,), f = reduced(long, [i], [layout.nb[i]], layout.nf[i])
        _set(theta, layout, "B", i, b)
        _set(theta, layout, "F", i, reflected(f, 0.999))
    return theta


def steiglitz_mcbride(y: Array, u: Array, nb: int, nf: int, nk: int, *, at_rest: bool = False) -> tuple[Array, Array]:
    """Fit B/F by least squares on data filtered by the last 1/F (Steiglitz & McBride 1965).

    `y`, `u`: (n_samples,). Returns B and a stable F.
    """
    part, F = liveliest(u[None, :], _WINDOW), np.ones(1)
    arx = _arx(nf, (nb,), (nk,), at_rest=at_rest and not part.start)
    y, u = y[part], u[part]
    for _ in range(_SM_ITERATIONS if nf else 1):
        one = np.ones(1)
        found = arx_coefficients(arx, filtered(one, F, y), filtered(one, F, u)[None, :])
        before, F = F, reflected(found[arx.places["A", None]], 0.999)
        if before.size == F.size and np.max(np.abs(before - F)) < 1e-3:
            break
    return found[arx.places["B", 0]], F
