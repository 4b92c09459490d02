"""Transfer functions in continuous time in weak form (thesis eq. 3.8): y^(n) + ... + a_0 y = b_m u^(m) + ... + b_0 u.

Test functions phi(t) = (1 - (t/h)^2)^p, whose derivatives vanish at both ends, spare signals differentiation: int phi
y^(k) dt = (-1)^k int phi^(k) y dt (Messenger and Bortz 2021); the trapezoidal rule leaves the spectrum of phi^(k) at
the sampling rate, ~ (2 / (w h))^(p - k): short supports want a high degree. White output noise enters the rows r(theta)
= V(theta) (signals) as cov r = V Sigma V^T; minimising r^T (V Sigma V^T)^-1 r has no errors-in-variables bias, initial
state or simulation: unstable plants are no harder (Bortz, Messenger and Dukic 2023). Noise of another colour, or a
disturbance inside a loop, leaves a bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import (
    IOData,
    Orders,
    check_length,
    compact_order,
)
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental_continuous import ScaledTransfer, continuous_model, transfer_orders
from ambid.blackbox.model import Offsets
from ambid.errors import EstimationError
from ambid.estimation.linear import directions, one_thread, triangle_of
from ambid.estimation.search import search

_OVERLAP = 7  # rows on half a support: closer ones say the same again, wider ones leave something out
_SMOOTH = 13  # degree beyond the highest derivative: over 20 samples sums are then integrals to 1e-7
_ROUNDS = 40
_SETTLED = 1e-7  # step in standard deviations
_SAME_NOISE = 1.05  # factor on the noise within which the shortest support does not contradict
_CONTRADICTED = 1.3  # ratio of noise from which a support is too long
_SHORTEST, _LONGEST = 10, 2560  # half supports tried, samples


def weakform(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate a continuous-time transfer function for every output, inputs held over a sample and sharing a
    denominator. `orders`: ``nf`` its degree, ``nb`` numerator coefficients, at most nf, and ``nk`` (default 0) samples
    of delay, one or one for each input. `details` tells the supports tried.
    """
    degrees = transfer_orders("weakform", data, {"nk": 0, **orders}, more=0)
    n, nb, nk = degrees.n, degrees.nb, degrees.nk or ()
    check_length("weakform", data, data.n_samples - max(nk) - 4 * _SHORTEST, n + sum(nb) + 1)
    halves = supports(data.n_samples - max(nk))
    u_mean, y_mean = data.u.mean(axis=0), data.y.mean(axis=0)
    u_sd, y_sd = data.u.std(axis=0), data.y.std(axis=0)
    u = (data.u - u_mean) / u_sd
    with one_thread():
        searches = [
            best_support(Equation(y=y, u=u, n=n, nb=nb, nk=nk, dt=data.dt), halves)
            for y in ((data.y - y_mean) / y_sd).T
        ]
    solutions = [f[0] for f in searches]
    size = n + sum(nb)
    scaled = [
        ScaledTransfer(
            theta=s.theta[:size], covariance=s.covariance[:size, :size], orders=degrees, w0=1.0, gain=sd / u_sd
        )
        for s, sd in zip(solutions, y_sd, strict=True)
    ]
    worst = max(s.contradiction for s in solutions)
    model, covariance = continuous_model(scaled, tuple(k * data.dt for k in nk))
    return build_fit(
        "weakform",
        data,
        orders={"nb": compact_order(nb), "nf": n, "nk": compact_order(nk)},
        model=model,
        covariance=covariance,
        n_estimated=data.n_outputs * size,
        offsets=_offsets(solutions, n, u_mean, y_mean, u_sd, y_sd),
        noise_covariance=np.diag([(s.scale * sd) ** 2 for s, sd in zip(solutions, y_sd, strict=True)]),
        status="converged" if all(s.converged for s in solutions) else "stalled",
        warnings=[] if worst < _CONTRADICTED else [_CONTRADICTS.format(worst)],
        details={
            "half_width_s": [s.half * data.dt for s in solutions],
            "rows": [s.rows for s in solutions],
            "condition": [s.condition for s in solutions],
            "supports": {o: tried for o, (_, tried) in zip(data.outputs, searches, strict=True)},
        },
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Equation:
    """y^(n) + sum a_k y^(k) = sum b_ik u_i^(k) + c of one output; theta is a_0 ..., b_i0 ... of every input, c."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs), held over a sample
    n: int
    nb: tuple[int, ...]  # numerator coefficients of every input, at most n
    nk: tuple[int, ...]  # samples by which every input acts late
    dt: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Bump:
    """One test function, set at many centres."""

    half: int  # half of its support in samples
    degree: int  # p
    dt: float

    @property
    def hop(self) -> int:
        """Samples between neighbouring centres."""
        return max(1, self.half // _OVERLAP)

    def centres(self, n_samples: int, lead: int) -> NDArray[np.int64]:
        """Return the samples at which the function is centred, `lead` of them left out at the beginning."""
        return np.arange(self.half + lead, n_samples - self.half, self.hop)

    def kernel(self, order: int) -> Array:
        """Return the weights of samples -half to half in (-1)^k int phi^(k) y dt, k the `order`."""
        tau = np.arange(-self.half, self.half + 1) / self.half
        scale = (-1.0 / (self.half * self.dt)) ** order * self.dt
        return np.asarray(_bump(self.degree).deriv(order)(tau) * scale)

    def held_kernel(self, order: int) -> Array:
        """Return the weights of values that are held over a sample, exact, for offsets -half - 1 to half."""
        whole = _bump(self.degree).integ() if order == 0 else _bump(self.degree).deriv(order - 1)
        edges = np.clip(np.arange(-self.half - 1, self.half + 2) / self.half, -1.0, 1.0)
        scale = (-1.0) ** order * (self.half * self.dt) ** (1 - order)
        return np.asarray(np.diff(whole(edges)) * scale)


def moments_at(x: Array, kernel: Array, last: int, centres: NDArray[np.int64]) -> Array:
    """Return sums of x[c + o] kernel[o] at centres c, (n_rows,), for offsets o up to `last`."""
    from scipy.signal import oaconvolve

    return np.asarray(oaconvolve(x, kernel[::-1])[centres + last])


def adjoint_moments(q: Array, kernel: Array, centres: NDArray[np.int64], n_samples: int) -> Array:
    """Return the adjoint of `moments_at` for offsets -half to half: the sum over centres of q kernel[t - c]."""
    from scipy.signal import oaconvolve

    comb = np.zeros(n_samples)
    comb[centres] = q
    half = kernel.size // 2
    return np.asarray(oaconvolve(comb, kernel)[half : half + n_samples])


def _bump(degree: int) -> Polynomial:
    return Polynomial([1.0, 0.0, -1.0]) ** degree


def kink(u: Array, delay: int, dt: float) -> Array:
    """Return what to add to samples of a signal whose slope jumps by `u`'s steps, so that trapezoidal sums are
    integrals: dt^2 (1/s - 1/x^2) = dt^2 (1/12 + s/240 + 31 s^2/60480 + ...), as sampling folds the spectrum 1/w^2, x =
    w dt and s = 4 sin^2(x/2), minus a second difference.
    """
    out = np.zeros_like(u)
    out[delay:] = np.diff(u, prepend=u[:1])[: u.size - delay]
    second = -np.diff(out, n=2, prepend=out[:1], append=out[-1:])
    fourth = -np.diff(second, n=2, prepend=second[:1], append=second[-1:])
    return np.asarray((out / 12 + second / 240 + fourth * 31 / 60480) * dt)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Whitened rows and regressors at one theta."""

    r: Array
    Z: Array
    cost: float


class Rows:
    """Moments of an equation's signals, and its rows at any parameters."""

    def __init__(self, equation: Equation, bump: Bump) -> None:
        e = self.equation = equation
        self._last: tuple[Array, State] | None = None
        self.bump, self.size = bump, e.n + sum(e.nb) + 1
        self.centres = bump.centres(e.y.size, max(e.nk) + 1)
        if self.centres.size < 2 * self.size + 10:
            raise EstimationError(f"{self.centres.size} rows for {self.size} numbers with this support")
        self.kernels = [bump.kernel(k) for k in range(e.n + 1)]
        self.Y = self._derivatives(e.y)
        kernels_held = [bump.held_kernel(k) for k in range(e.n)]
        inputs = [
            moments_at(e.u[:, i], kernels_held[k], bump.half, self.centres - e.nk[i])
            for i, b in enumerate(e.nb)
            for k in range(b)
        ]
        one = moments_at(np.ones_like(e.y), self.kernels[0], bump.half, self.centres)
        self.U = -np.stack([*inputs, one], axis=1)
        # relative degree one: the slope of y jumps with u, by the leading coefficient of its numerator
        self.kinks = {
            e.n + sum(e.nb[: i + 1]) - 1: self._derivatives(kink(e.u[:, i], e.nk[i], e.dt))
            for i, b in enumerate(e.nb)
            if b == e.n
        }

    def _derivatives(self, y: Array) -> Array:
        """Moments of derivatives 0 to n, (n_rows, n + 1)."""
        return np.stack([moments_at(y, v, self.bump.half, self.centres) for v in self.kernels], axis=1)

    def ordinary(self) -> Array:
        """Return ordinary least squares."""
        X = np.hstack([self.Y[:, :-1], self.U])
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        theta = np.linalg.lstsq(X / size, -self.Y[:, -1], rcond=None)[0]
        return np.asarray(theta / size)

    def at(self, theta: Array) -> State:
        """Return whitened rows and regressors, the output freed from its estimated noise."""
        if self._last is None or not np.array_equal(theta, self._last[0]):
            self._last = (theta.copy(), self._evaluate(theta))
        return self._last[1]

    def _evaluate(self, theta: Array) -> State:
        from scipy.linalg import LinAlgError, cholesky_banded
        from scipy.linalg.lapack import dtbtrs

        a = np.append(theta[: self.equation.n], 1.0)
        v = np.sum([x * kernel for x, kernel in zip(a, self.kernels, strict=True)], axis=0)
        # lower band of V V^T: every row has the same kernel, so each lag is one number.
        hop, length = self.bump.hop, v.size
        lags = [float(v[: length - k] @ v[k:]) for k in range(0, length, hop)]
        band = np.repeat(np.array(lags)[:, None], self.centres.size, axis=1)
        scale = np.sqrt(band[0, 0])
        if not (scale > 0 and np.isfinite(scale)):
            raise EstimationError("the equation holds no noisy signal")
        band /= scale**2
        band[0] *= 1 + 1e-12
        try:
            factor = cholesky_banded(band, lower=True)
        except LinAlgError:
            raise EstimationError("the rows repeat one another") from None

        def down(x: Array, trans: str) -> Array:
            return np.asarray(dtbtrs(factor, x, uplo="L", trans=trans)[0])

        Y = self.Y + sum(theta[j] * moments for j, moments in self.kinks.items())
        r = down(((Y @ a + self.U @ theta[a.size - 1 :]) / scale)[:, None], "N")
        q = down(r, "T")[:, 0] / scale
        clean = Y - self._derivatives(adjoint_moments(q, v, self.centres, self.equation.y.size))
        slope = np.hstack([clean[:, :-1], self.U])
        for j, moments in self.kinks.items():
            slope[:, j] += moments @ a
        return State(r[:, 0], down(np.asfortranarray(slope / scale), "N"), float(r[:, 0] @ r[:, 0]))

    def cost(self, theta: Array) -> float:
        """Return the sum of squares of the whitened rows."""
        return self.at(theta).cost

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of their slope and, its sign turned, the rows."""
        state = self.at(theta)
        return triangle_of([np.column_stack([state.Z, -state.r])])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Parameters of an equation."""

    theta: Array  # (n_theta,)
    covariance: Array  # (n_theta, n_theta)
    scale: float  # standard deviation of the output's noise
    half: int  # half support of the test functions in samples
    rows: int
    condition: float  # of the scaled regressors
    converged: bool
    # noise that the shortest support finds with these parameters, over that of their own; about 1 where all is well
    contradiction: float = 1.0


def solve(equation: Equation, bump: Bump, start: Array | None = None) -> Solution:
    """Estimate the parameters with one test function, from least squares or from `start` where that is better;
    regressors of a step are moments of the output freed from its estimated noise.
    """
    work = Rows(equation, bump)
    first = [work.ordinary(), *([] if start is None else [start])]
    end = search(work, min(first, key=work.cost), most=_ROUNDS, tolerance=_SETTLED / work.centres.size)
    state, theta = work.at(end.theta), end.theta
    scale2, axes = state.cost / max(state.r.size - theta.size, 1), directions(state.Z)
    return Solution(
        theta=theta,
        covariance=scale2 * axes.inverse(),
        scale=float(np.sqrt(scale2)),
        half=bump.half,
        rows=state.r.size,
        condition=axes.condition,
        converged=end.converged,
    )


def supports(n_samples: int) -> list[int]:
    """Return the half supports to try, in samples."""
    halves = [_SHORTEST * 2**k for k in range(12) if _SHORTEST * 2**k <= min(_LONGEST, n_samples // 8)]
    return halves or [_SHORTEST // 2]


def best_support(equation: Equation, halves: Sequence[int]) -> tuple[Solution, list[dict[str, float]]]:
    """Solve from long supports to short and keep the one that predicts least variance, not contradicted by the
    shortest: long ones average most but see low frequencies alone, where a wrong plant may fit as well. Returns the
    best, and each one's half support, noise, log determinant of the covariance and contradiction.
    """
    solution: Solution | None = None
    results, tried, why = list[tuple[float, Solution]](), list[dict[str, float]](), "the record is too short"

    def bump(half: int) -> Bump:
        return Bump(half=half, degree=equation.n + _SMOOTH, dt=equation.dt)

    judge = Rows(equation, bump(min([_SHORTEST, *halves])))
    for half in sorted(halves, reverse=True):
        try:
            solution = solve(equation, bump(half), None if solution is None else solution.theta)
            all_band = judge.at(solution.theta)
        except EstimationError as error:
            why = str(error)
            continue
        sd = np.sqrt(np.diag(solution.covariance))
        sign, size = np.linalg.slogdet(solution.covariance / np.outer(sd, sd))
        size = float(size + 2 * np.sum(np.log(sd))) if sign > 0 else np.inf
        solution = replace(solution, contradiction=float(np.sqrt(all_band.cost / max(all_band.r.size - sd.size, 1))))
        results.append((size, solution))
        tried.append({
            "half_width_samples": float(half), "noise_sd": solution.scale, "log_det_covariance": size,
            "noise_sd_all_band": solution.contradiction,
        })  # fmt: skip
    if not results:
        raise EstimationError(f"weak form: no support of the test functions gives a result ({why}). Record longer")
    settled = [r for r in results if r[1].converged] or results
    noise = min(r[1].contradiction for r in settled)
    chosen = min((r for r in settled if r[1].contradiction <= _SAME_NOISE * noise), key=lambda r: r[0])[1]
    return replace(chosen, contradiction=chosen.contradiction / max(chosen.scale, 1e-300)), tried


_CONTRADICTS = (
    "over the whole band the weak form leaves {:.2g} times the noise of its own test functions: they are too long for "
    "the plant, or the model or the whiteness of the noise is wrong. Use srivc"
)


def _offsets(solutions: list[Solution], n: int, u_mean: Array, y_mean: Array, u_sd: Array, y_sd: Array) -> Offsets:
    """Operating point: a_0 y = b_0 u + c, solved for y, or for the first input where a_0 is lost in its own spread."""
    u, y = u_mean.copy(), y_mean.copy()
    for o, s in enumerate(solutions):
        a0, b0, c = s.theta[0], s.theta[n], s.theta[-1]
        if abs(a0) > 2 * np.sqrt(s.covariance[0, 0]):
            y[o] += y_sd[o] * c / a0
        elif len(solutions) == 1 and b0 != 0:
            u[0] -= u_sd[0] * c / b0
    return Offsets(u=u, y=y)
