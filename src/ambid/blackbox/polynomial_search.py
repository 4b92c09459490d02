"""Search for the coefficients of one output, and where it starts.

The squared residual is minimised with initial states and constant taken out exactly (linear; Golub & Pereyra 1973), by
steps on the triangle of the rows, shortened where the predictor would be unstable. Starts: a long ARX model gives
innovations, which as an input give A, B, C (Hannan & Rissanen 1982), and C and D of the noise of any plant; B and F
come from iterated prefiltering (Steiglitz & McBride 1965) or the long model's null space (Galrinho, Rojas & Hjalmarsson
2019). For hard cases C and D come from a grid, e = A (D/C) y - B (D/C) u being linear in A and B, with repeated roots
near 1, which fast sampling asks for and no moderate ARX model sees (Laguerre models; Wahlberg 1991).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from ambid.arrays import Array
from ambid.blackbox.model import reflect, stable
from ambid.blackbox.polynomial_predictor import Layout, Predictor, arx_layout, filter_signal, liveliest_part, predictor
from ambid.errors import EstimationError
from ambid.estimation.linear import Directions, directions

_ENOUGH = 1e-6  # squared length of the last step in standard deviations
_NOTHING_LEFT = 1e-24  # squared residual over squared output where the data are matched to rounding
_MOST = 100
BLIND = 1e8  # condition number, columns of unit length, beyond which a direction counts as not seen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Minimum:
    """Where a search ended."""

    theta: Array  # (n_theta,), all coefficients of the output, in scaled units
    free: NDArray[np.int64]  # (n_free,), places of the estimated ones
    nuisance: Array  # (n_nuisance,), initial states and constant
    triangle: Array  # (n_free, n_free), R of the free coefficients, nuisance taken out
    directions: Directions  # of `triangle`
    cost: float  # squared residual
    n_rows: int
    converged: bool
    at_border: bool  # whether steps had to be shortened to the end to keep the predictor stable
    iterations: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Point:
    theta: Array
    nuisance: Array
    R: Array
    n: int  # nuisance numbers

    @property
    def rest(self) -> float:
        return float(self.R[-1, -1] ** 2)

    @property
    def gradient(self) -> Array:
        return np.asarray(self.R[self.n : -1, -1])

    @property
    def cost(self) -> float:
        e = self.R[self.n :, -1]
        return float(e @ e)


def search(
    predictor: Predictor,
    y: Array,
    u: Array,
    start: Array,
    *,
    most: int = _MOST,
    tick: Callable[[], None] | None = None,
) -> Minimum:
    """Minimise the squared residual from `start` (n_theta,), its C and F stable; `y`: (n_samples,), scaled, mean taken
    off; `u`: (n_inputs, n_samples); `most`: evaluations, before each of which `tick` is called.
    """
    n, free = predictor.n_nuisance, predictor.layout.free

    def evaluated(theta: Array, nuisance: Array) -> _Point:
        if tick is not None:
            tick()
        return _Point(theta=theta, nuisance=nuisance, R=predictor.triangle(y, u, theta, nuisance), n=n)

    n_rows = y.size - predictor.first_row
    floor = _NOTHING_LEFT * float(y @ y)
    at = evaluated(start, np.zeros(n))
    explained = float(np.sum(at.R[:n, -1] ** 2))
    if predictor.n_initial and explained > 1e-3 * at.cost:  # gradients by F and C need the initial states
        at = evaluated(start, at.nuisance + _nuisance_step(at, np.zeros(free.size)))
    damping, converged, shortened, exact, count = 0.0, False, False, False, 1
    while True:
        axes = directions(at.R[n:-1, n:-1])
        spread = max(at.rest / max(n_rows - n - free.size, 1), 1e-300)
        left = axes.explain(at.gradient)
        step = axes.solve(-at.gradient)
        if left <= _ENOUGH * spread or at.cost <= floor or _linear(predictor):
            theta = _moved(at.theta, free, step)
            if _linear(predictor) or stable_predictor(predictor.layout, theta):
                # take the last step, too small (or the problem too linear) to need another look at the data.
                R = at.R
                if _linear(predictor):
                    R = R.copy()
                    R[at.n : -1, -1] += R[at.n : -1, at.n : -1] @ step
                at = _Point(theta=theta, nuisance=at.nuisance + _nuisance_step(at, step), R=R, n=at.n)
            converged = True
            break
        if count >= most or damping > 1e12:
            # where rounding allows no further descent and less than a hundredth of a standard deviation is left
            converged = damping > 1e12 and left <= 1e-4 * spread
            break
        step, cut = _kept_stable(predictor, at.theta, free, axes.solve(-at.gradient, damping))
        trial = evaluated(_moved(at.theta, free, step), at.nuisance + _nuisance_step(at, step))
        count += 1
        if trial.cost < at.cost:  # not where it is no number
            expected = at.cost - float(np.sum((at.R[n:-1, n:-1] @ step + at.gradient) ** 2)) - at.rest
            good = at.cost - trial.cost > 0.5 * expected
            damping = (0.0 if damping < 1e-6 else damping * 0.1) if good else max(damping, 1e-6)
            at, shortened, exact = trial, cut, False
        elif not exact:  # gradients at initial states that belong to these coefficients
            at, exact = evaluated(at.theta, at.nuisance + _nuisance_step(at, np.zeros(free.size))), True
            count += 1
        else:
            damping = max(damping * 10.0, 1e-3)
    return Minimum(
        theta=at.theta,
        free=free,
        nuisance=at.nuisance,
        triangle=at.R[n:-1, n:-1],
        directions=axes,
        cost=at.cost,
        n_rows=n_rows,
        converged=converged,
        at_border=shortened,
        iterations=count,
    )


def _linear(predictor: Predictor) -> bool:
    x = predictor.layout
    return not (x.nc or x.nd or any(x.nf))


def _nuisance_step(at: _Point, step: Array) -> Array:
    """Nuisance numbers that go with a step; the smallest where the data do not tell them apart."""
    if not at.n:
        return np.zeros(0)
    return -solve_triangle(at.R[: at.n, : at.n], at.R[: at.n, at.n : -1] @ step + at.R[: at.n, -1])


def _moved(theta: Array, free: NDArray[np.int64], step: Array) -> Array:
    out = theta.copy()
    out[free] += step
    return out


def _kept_stable(predictor: Predictor, theta: Array, free: NDArray[np.int64], step: Array) -> tuple[Array, bool]:
    """Halve a step until the predictor stays stable."""
    cut = False
    for _ in range(60):
        if stable_predictor(predictor.layout, _moved(theta, free, step)):
            return step, cut
        step, cut = 0.5 * step, True
    return 0.0 * step, True


def stable_predictor(layout: Layout, theta: Array) -> bool:
    """Return whether C and every F of `theta` (n_theta,) are stable."""
    places = layout.places
    return all(stable(theta[p]) for (letter, _), p in places.items() if letter in "CF")


def solve_triangle(R: Array, right: Array) -> Array:
    """Solve R x = right for an upper triangle R (n, n); the shortest x where R leaves some of it open."""
    if not R.size:
        return np.zeros(right.shape)
    scale = np.sqrt(np.einsum("ij,ij->j", R, R))
    scale[scale == 0.0] = 1.0
    S = R / scale
    # back substitution by LAPACK itself: numpy's solve would factorise the triangle again
    x = dtrtrs(S, right)[0] if np.abs(S.diagonal()).min() > 1e-8 else np.linalg.lstsq(S, right, rcond=1e-10)[0]
    return np.asarray((x.T / scale).T)


_ROWS = 4096  # of the long model: more would not make a better start
_CHUNK = 1024
_SM_ITERATIONS = 5
_DOUBLE = np.array([1.0, 1.6, 0.64])  # two roots at -0.8: as a numerator low frequencies, as a denominator high ones


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LongModel:
    """A long ARX model P y = sum_i Q_i u_i + e, which holds what the data say of plant and noise together."""

    P: Array  # (n + 1,)
    Q: tuple[Array, ...]  # (nk + n,), one for each input
    nk: tuple[int, ...]
    triangle: Array  # (n + n n_inputs, n + n n_inputs), of its regressors, the constant taken out


def arx_coefficients(layout: Layout, y: Array, u: Array) -> Array:
    """Return the least-squares coefficients (n_theta,) of an ARX layout (nc, nd, nf zero) with a constant."""
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
    theta[layout.free] -= solve_triangle(R[:-1, :-1], R[:-1, -1])[p.n_nuisance :]
    return theta, R[p.n_nuisance : -1, p.n_nuisance : -1]


def starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield first values (n_theta,), the most promising first; `y`: (n_samples,), scaled, mean taken off."""
    if not (layout.nc or layout.nd or any(layout.nf)):
        yield layout.start()  # one step from anywhere
        return
    free = replace(layout, fixed=())
    if any(layout.nf):
        yield from _output_error(free, y, u)
    elif layout.nd:
        yield from _generalised(free, y, u)
    elif layout.nc:
        # ARMAX and ARMA: the long model's innovations as one more input
        long = _long_model(free, y, u)
        e = filter_signal(long.P, np.ones(1), y)
        for q, x in zip(long.Q, u, strict=True):
            e -= filter_signal(q, np.ones(1), x)
        arx = arx_layout(free.na, (*free.nb, free.nc), (*free.nk, 1), at_rest=free.at_rest)
        plant = arx.polynomials(arx_coefficients(arx, y, np.vstack([u, e])))
        C = reflect(np.concatenate([[1.0], plant.B[-1][1:]]))
        yield free.coefficients(A=plant.A, B=plant.B[:-1], C=C)
    yield _least_squares(free, y, u)


def _pieces(n: int, history: int, most_rows: int | None) -> Iterator[slice]:
    if most_rows is None or n <= most_rows:
        yield slice(0, n)
        return
    count = max(most_rows // _CHUNK, 1)
    for first in np.linspace(0, n - _CHUNK - history, count).astype(int):
        yield slice(int(first), int(first) + _CHUNK + history)


def _least_squares(layout: Layout, y: Array, u: Array) -> Array:
    """A and B as if the noise went through 1/A; C = D = 1."""
    arx = arx_layout(max([layout.na, *layout.nf]), layout.nb, layout.nk, at_rest=layout.at_rest)
    plant = arx.polynomials(arx_coefficients(arx, y, u))
    F = [reflect(plant.A[: n + 1]) for n in layout.nf]
    return layout.coefficients(A=plant.A[: layout.na + 1], B=plant.B, F=F)


def _long_model(layout: Layout, y: Array, u: Array) -> LongModel:
    most = max([layout.na + layout.nd, layout.nc + layout.nd, *layout.nf, *layout.nb])
    n = max(1, min(8 + 2 * most, y.size // (6 * (1 + layout.n_inputs))))
    arx = arx_layout(n, (n,) * layout.n_inputs, layout.nk, at_rest=layout.at_rest)
    theta, R = _regression(arx, y, u, _ROWS)
    polynomials = arx.polynomials(theta)
    return LongModel(P=polynomials.A, Q=polynomials.B, nk=layout.nk, triangle=R)


def reduce_long_model(long: LongModel, inputs: Sequence[int], nb: Sequence[int], nf: int) -> tuple[list[Array], Array]:
    """Find B_i (`nb` coefficients for each of `inputs`) and the common F, stable or not, with P B_i = Q_i F weighted by
    the long model's spread: its null space (Galrinho, Rojas & Hjalmarsson 2019), linear, and consistent under feedback
    and for any noise.
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
    numerators = []
    for k, i in enumerate(inputs):
        first = sum(count[:k])
        b = np.zeros(long.nk[i] + nb[k])
        b[long.nk[i] : long.nk[i] + count[k]] = x[first : first + count[k]]
        numerators.append(b)
    return numerators, np.concatenate([[1.0], x[sum(count) :]])


def _shifts(c: Array, n_columns: int, lag: int) -> Array:
    """Columns of c moved down by lag, lag + 1, ..."""
    out = np.zeros((c.size, n_columns))
    for j in range(n_columns):
        if j + lag < c.size:
            out[j + lag :, j] = c[: c.size - j - lag]
    return out


def _noise(layout: Layout, v: Array) -> tuple[Array, Array]:
    """C and D of the series v = (C/D) e."""
    n = max(1, min(10 + 2 * (layout.nc + layout.nd), v.size // 8))
    u = np.empty((0, v.size))
    long = arx_layout(n, (), ())
    e = filter_signal(long.polynomials(_regression(long, v, u, _ROWS)[0]).A, np.ones(1), v)
    nb = (layout.nc,) if layout.nc else ()
    arx = arx_layout(layout.nd, nb, (1,) * len(nb))
    polynomials = arx.polynomials(arx_coefficients(arx, v, e[None, :] if nb else u))
    return reflect(np.concatenate([[1.0], *(b[1:] for b in polynomials.B)])), reflect(polynomials.A)


def _generalised(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """ARARX and ARARMAX: the plant from the long model, as output error or by least squares, then its residual."""
    B, A = reduce_long_model(_long_model(layout, y, u), range(layout.n_inputs), layout.nb, layout.na)
    plants = [layout.coefficients(A=A, B=B), _least_squares(layout, y, u)]
    if layout.n_inputs == 1 and layout.na:
        b, f = steiglitz_mcbride(y, u[0], layout.nb[0], layout.na, layout.nk[0], at_rest=layout.at_rest)
        plants.insert(1, layout.coefficients(A=f, B=[b]))
    for plant in plants:
        _set_noise(plant, layout, y, u)
        yield plant


def _set_noise(theta: Array, layout: Layout, y: Array, u: Array) -> None:
    if not layout.nc and not layout.nd:
        return
    plant, places = layout.polynomials(theta), layout.places
    v = filter_signal(plant.A, np.ones(1), y)
    for b, f, x in zip(plant.B, plant.F, u, strict=True):
        v -= filter_signal(b, f, x)
    theta[places["C", None]], theta[places["D", None]] = _noise(layout, v - np.mean(v))


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
        polynomials = white.polynomials(search(predictor(white), y, u, ways[0](white, y, u), most=15).theta)
        theta = layout.coefficients(B=polynomials.B, F=polynomials.F)
        _set_noise(theta, layout, y, u)
        yield theta


def weighted_starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield starts (n_theta,) for hard cases of OE and BJ: the plant from the data with other frequencies stressed;
    `y`: (n_samples,), scaled, mean taken off.
    """
    if layout.n_inputs > 1:
        return
    one = np.ones(1)
    for num, den in ((_DOUBLE, one), (one, _DOUBLE), (one, _DOUBLE * np.array([1.0, -1.0, 1.0]))):
        fy, fu = filter_signal(num, den, y), filter_signal(num, den, u[0])[None, :]
        theta = _from_data(replace(layout, fixed=()), fy, fu)
        _set_noise(theta, layout, y, u)
        yield theta


def _from_data(layout: Layout, y: Array, u: Array) -> Array:
    b, f = steiglitz_mcbride(y, u[0], layout.nb[0], layout.nf[0], layout.nk[0], at_rest=layout.at_rest)
    return layout.coefficients(B=[b], F=[f])


def _from_long_model(layout: Layout, y: Array, u: Array) -> Array:
    long = _long_model(layout, y, u)
    reduced = [reduce_long_model(long, [i], [layout.nb[i]], layout.nf[i]) for i in range(layout.n_inputs)]
    return layout.coefficients(B=[b for (b,), _ in reduced], F=[reflect(f, 0.999) for _, f in reduced])


def steiglitz_mcbride(y: Array, u: Array, nb: int, nf: int, nk: int, *, at_rest: bool = False) -> tuple[Array, Array]:
    """Fit B and a stable F by least squares on data filtered by the last 1/F (Steiglitz & McBride 1965)."""
    part, F = liveliest_part(u[None, :]), np.ones(1)
    arx = arx_layout(nf, (nb,), (nk,), at_rest=at_rest and not part.start)
    y, u = y[part], u[part]
    for _ in range(_SM_ITERATIONS if nf else 1):
        one = np.ones(1)
        theta = arx_coefficients(arx, filter_signal(one, F, y), filter_signal(one, F, u)[None, :])
        before, F = F, reflect(theta[arx.places["A", None]], 0.999)
        if before.size == F.size and np.max(np.abs(before - F)) < 1e-3:
            break
    return theta[arx.places["B", 0]], F


SMOOTH = 12  # evaluations; a longer way hints at a second minimum
_GRID = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)  # roots of C: how long the predictor remembers
_D_GRID = (-0.6, 0.0, 0.6, 0.9)
_CANDIDATES = 3  # candidates to search from


def separable_starts(layout: Layout, y: Array, u: Array) -> Iterator[Array]:
    """Yield starts (n_theta,) with C and D from a grid, those first that leave least; none for structures with F."""
    if any(layout.nf) or not (layout.nc or layout.nd):
        return
    part = liveliest_part(u)
    free = replace(layout, fixed=(), at_rest=layout.at_rest and not part.start)
    starts: list[tuple[float, int, Array]] = []
    for C in _candidates(layout.nc, _GRID, mixed=not layout.nd):
        for D in _candidates(layout.nd, _D_GRID, mixed=False):
            loss, theta = _given(free, C, D, y[part], u[:, part])
            starts.append((loss, len(starts), theta))
    yield from (theta for _, _, theta in sorted(starts)[:_CANDIDATES])


def _candidates(n: int, grid: Sequence[float], *, mixed: bool) -> Iterator[Array]:
    """Polynomials with one root of multiplicity n, or two, one of them single."""
    if not n:
        yield np.ones(1)
        return
    for r in grid:
        yield _with_roots([r] * n)
    for r, s in combinations(grid, 2) if mixed else ():
        for k in {1, n - 1} - {0, n}:
            yield _with_roots([r] * (n - k) + [s] * k)


def _with_roots(roots: list[float]) -> Array:
    return np.asarray(np.poly(roots), dtype=np.float64)


def _given(layout: Layout, C: Array, D: Array, y: Array, u: Array) -> tuple[float, Array]:
    """Best loss for C and D, and the coefficients that have it."""
    arx = replace(layout, nc=0, nd=0)
    p, theta = predictor(arx), arx.start()
    fu = np.array([filter_signal(D, C, x) for x in u]).reshape(u.shape)
    R = p.triangle(filter_signal(D, C, y), fu, theta, np.zeros(p.n_nuisance))
    theta[arx.free] -= solve_triangle(R[:-1, :-1], R[:-1, -1])[p.n_nuisance :]
    plant = arx.polynomials(theta)
    return float(R[-1, -1] ** 2), layout.coefficients(A=plant.A, B=plant.B, C=C, D=D, F=plant.F)


LARGEST_DELAY = 20  # samples
_HISTORY = 10  # past outputs, and inputs after the delay, of the long model


def long_delays(name: str, y: Array, u: Array, least: int, *, at_rest: bool = False) -> tuple[int, ...]:
    """Return the delay of every input with the smallest BIC of a long ARX model; `y`: (n_samples,), scaled, mean taken
    off; `name`: structure, for messages.
    """
    n_u, n = u.shape[0], y.size
    history = min(_HISTORY, n // (10 * (1 + n_u)))
    largest = min(LARGEST_DELAY, n // (5 * n_u) - history)
    if history < 3 or largest < 5:
        raise EstimationError(f"{name}: {n} samples are too few to find the delay. Give nk")
    taps = largest + history
    long = arx_layout(history, (taps,) * n_u, (least,) * n_u, at_rest=at_rest)
    p = predictor(long)
    R: Array = p.triangle(y, u, long.start(), np.zeros(p.n_nuisance))[p.n_nuisance :, p.n_nuisance :]
    rows = n - long.first_row

    def bic(delays: tuple[int, ...]) -> float:
        keep = [*range(history)]
        for i, k in enumerate(delays):
            first = history + i * taps
            keep += range(first + k - least, first + taps)
        reduced: Array = np.asarray(np.linalg.qr(R[:, np.array([*keep, -1])], mode="r"))
        cost = max(float(reduced[-1, -1] ** 2), 1e-24 * n)
        return rows * float(np.log(cost)) + len(keep) * float(np.log(rows))

    delays: tuple[int, ...] = (least,) * n_u
    for _ in range(3):
        before = delays
        for i in range(n_u):
            tried = [(*delays[:i], k, *delays[i + 1 :]) for k in range(least, largest + 1)]
            delays = min(tried, key=bic)
        if delays == before:
            break
    return delays
