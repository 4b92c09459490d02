"""Linear differential equations between noisy signals, solved in weak form by maximum likelihood.

Rows r(theta) = V(theta) (signals) are what the equations leave over, V the moments of each signal. Noise enters through
the same V: cov r = V Sigma V^T, so the noise of a signal stands in regressors and left side alike. Minimising
r^T (V Sigma V^T)^-1 r is least squares on the signals themselves under the equations as constraints; it has no
errors-in-variables bias, needs no initial state, and runs through unstable plants (Bortz, Messenger and Dukic 2023).
Gauss-Newton: the regressors of a step are moments of the signals freed from their estimated noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.uncertainty import inverse_information
from ambid.identify.weakform.bumps import Bump, moments_at, spread_out

Array = NDArray[np.float64]

_ROUNDS = 40
_SETTLED = 1e-7  # step in standard deviations
_SAME_NOISE = 1.05  # factor on the noise within which the shortest support does not contradict


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signal:
    """One signal of the equations.

    Attributes
    ----------
    values : ndarray, shape (n_samples,)
    sd : float
        White noise of its samples, relative to the other signals'; 0: exact.
    held : bool
        Held over a sample (an input), else smooth between samples.
    delay : float
        Samples by which it acts late; only for a held one.
    """

    values: Array
    sd: float = 0.0
    held: bool = False
    delay: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """factor * parameter * (d/dt)^order signal, in one equation.

    Attributes
    ----------
    equation : int
    signal : str
    order : int
    parameter : str or None
        None: just the factor.
    factor : float
    """

    equation: int
    signal: str
    order: int
    parameter: str | None = None
    factor: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kink:
    """What sampling leaves out of a signal: parameter^power * pattern is added to its samples.

    Attributes
    ----------
    signal : str
    pattern : ndarray, shape (n_samples,)
    parameter : str or None
        None: just the pattern.
    power : int
    """

    signal: str
    pattern: Array
    parameter: str | None
    power: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class System:
    """Equations sum of terms = 0.

    Attributes
    ----------
    terms : tuple of Term
    signals : Mapping[str, Signal]
    names : tuple of str
        Parameters.
    dt : float, s
    prior_mean, prior_sd : ndarray, shape (n_names,)
        Infinite sd: no prior.
    kinks : tuple of Kink
        Of outputs whose slope jumps with a held input.
    """

    terms: tuple[Term, ...]
    signals: Mapping[str, Signal]
    names: tuple[str, ...]
    dt: float
    prior_mean: Array
    prior_sd: Array
    kinks: tuple[Kink, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Parameters of a system.

    Attributes
    ----------
    theta : Mapping[str, float]
    covariance : ndarray, shape (n, n)
        In the order of the system's names.
    scale : float
        Noise standard deviation, by which the relative ones of the signals are multiplied.
    half : int
        Half support of the test functions in samples.
    rows : int
    condition : float
        Of the scaled regressors.
    converged : bool
    contradiction : float
        Noise that the shortest support finds with these parameters, over that of their own; about 1 where all is well.
    """

    theta: Mapping[str, float]
    covariance: Array
    scale: float
    half: int
    rows: int
    condition: float
    converged: bool
    contradiction: float = 1.0


def solve(system: System, bump: Bump, start: Mapping[str, float] | None = None) -> Solution:
    """Estimate the parameters with one test function.

    Parameters
    ----------
    system : System
    bump : Bump
    start : Mapping[str, float], optional
        By default from ordinary least squares.

    Returns
    -------
    Solution

    Raises
    ------
    EstimationError
        If the rows do not determine the parameters.
    """
    work = _Rows(system, bump)
    theta = work.ordinary()
    converged, state = False, work.at(theta)
    if start is not None:
        other = np.array([start[k] for k in system.names])
        there = work.at(other)
        if not state.cost <= there.cost:
            theta, state = other, there
    for _ in range(_ROUNDS):
        step = work.step(state)
        expected = float(np.sum((state.Z @ step) ** 2))
        if expected <= _SETTLED * max(state.cost, 1e-300) / state.r.size:
            converged = True
            break
        length, moved = 1.0, work.at(theta + step)
        while moved.cost > state.cost and length > 1e-3:
            length *= 0.5
            moved = work.at(theta + length * step)
        if moved.cost > state.cost:
            converged = expected <= 1e-3 * state.cost / state.r.size
            break
        theta, state = theta + length * step, moved
    rows = state.r.size - int(np.sum(np.isfinite(system.prior_sd)))
    scale2 = state.cost / max(rows - theta.size, 1)
    size = np.maximum(np.linalg.norm(state.Z, axis=0), 1e-300)
    s = np.linalg.svd(state.Z / size, compute_uv=False)
    return Solution(
        theta=dict(zip(system.names, theta.tolist(), strict=True)),
        covariance=scale2 * inverse_information(state.Z),
        scale=float(np.sqrt(scale2)),
        half=bump.half,
        rows=rows,
        condition=float(s[0] / max(s[-1], 1e-300)),
        converged=converged,
    )


def best_support(
    system: System, halves: Sequence[int], degree: int, shortest: int
) -> tuple[Solution, list[dict[str, float]]]:
    """Solve from long supports to short, from the one before or anew; keep the one that predicts least variance.

    Long supports average most but see low frequencies alone, where a wrong plant may fit as well; short ones see all.
    So every solution is also held against the shortest support, and those that it contradicts do not count.

    Parameters
    ----------
    system : System
    halves : sequence of int
        Half supports in samples.
    degree : int
        Of the bumps.
    shortest : int
        Half support against which solutions are held.

    Returns
    -------
    best : Solution
        Its `contradiction` tells what the shortest support makes of it.
    tried : list of dict
        Half support, noise scale, log determinant of the covariance and contradiction of every one with a result.

    Raises
    ------
    EstimationError
        If no support determines the parameters.
    """
    found: Solution | None = None
    results, tried, why = list[tuple[float, Solution]](), list[dict[str, float]](), "the record is too short"
    judge = _Rows(system, Bump(half=shortest, degree=degree, dt=system.dt))
    for half in sorted(halves, reverse=True):
        try:
            found = solve(system, Bump(half=half, degree=degree, dt=system.dt), None if found is None else found.theta)
            all_band = judge.at(np.array([found.theta[k] for k in system.names]))
        except EstimationError as error:
            why = str(error)
            continue
        sd = np.sqrt(np.diag(found.covariance))
        sign, size = np.linalg.slogdet(found.covariance / np.outer(sd, sd))
        size = float(size + 2 * np.sum(np.log(sd))) if sign > 0 else np.inf
        found = replace(found, contradiction=float(np.sqrt(all_band.cost / max(all_band.r.size - sd.size, 1))))
        results.append((size, found))
        tried.append({
            "half_width_samples": float(half), "noise_sd": found.scale, "log_det_covariance": size,
            "noise_sd_all_band": found.contradiction,
        })  # fmt: skip
    if not results:
        raise EstimationError(f"weak form: no support of the test functions gives a result ({why}). Record longer")
    settled = [r for r in results if r[1].converged] or results
    noise = min(r[1].contradiction for r in settled)
    chosen = min((r for r in settled if r[1].contradiction <= _SAME_NOISE * noise), key=lambda r: r[0])[1]
    return replace(chosen, contradiction=chosen.contradiction / max(chosen.scale, 1e-300)), tried


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Whitened rows and regressors at one theta."""

    r: Array
    Z: Array
    cost: float


class _Rows:
    """Moments of a system's signals, and its rows at any parameters."""

    def __init__(self, system: System, bump: Bump) -> None:
        self.system, self.bump = system, bump
        self.n = next(iter(system.signals.values())).values.size
        self.n_equations = 1 + max(t.equation for t in system.terms)
        lead = max((int(s.delay) + 1 for s in system.signals.values() if s.held), default=0)
        self.centres = bump.centres(self.n, lead)
        self.index = {k: j for j, k in enumerate(system.names)}
        if self.centres.size * self.n_equations < 2 * len(system.names) + 10:
            raise EstimationError(f"{self.centres.size} rows for {len(system.names)} numbers with this support")
        self.kernels = {o: bump.kernel(o) for o in {t.order for t in system.terms}}
        used = sorted({(t.signal, t.order) for t in system.terms})
        self.moments = {(name, o): self._moment(name, o, system.signals[name].values) for name, o in used}
        self.kinks = [
            {(name, o): self._moment(name, o, k.pattern) for name, o in used if name == k.signal} for k in system.kinks
        ]

    def _moment(self, name: str, order: int, values: Array) -> Array:
        s = self.system.signals[name]
        if not s.held:
            return moments_at(values, self.kernels[order], self.bump.half, self.centres)
        whole = int(np.floor(s.delay))
        kernel = self.bump.held_kernel(order, s.delay - whole)
        return moments_at(values, kernel, self.bump.half, self.centres - whole)

    def _columns(self, moments: Mapping[tuple[str, int], Array]) -> tuple[Array, Array]:
        """Fixed part (rows,) and regressors (rows, p), equations interleaved."""
        e = self.n_equations
        fixed, X = np.zeros((self.centres.size, e)), np.zeros((self.centres.size, e, len(self.index)))
        for t in self.system.terms:
            m = moments.get((t.signal, t.order))
            if m is None:
                continue
            if t.parameter is None:
                fixed[:, t.equation] += t.factor * m
            else:
                X[:, t.equation, self.index[t.parameter]] += t.factor * m
        return fixed.reshape(-1), X.reshape(-1, len(self.index))

    def ordinary(self) -> Array:
        """Ordinary least squares, equations weighted alike."""
        fixed, X = self._columns(self.moments)
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        found = np.linalg.lstsq(X / size, -fixed, rcond=None)[0]
        return np.asarray(found / size)

    def at(self, theta: Array) -> _State:
        from scipy.linalg import LinAlgError, cholesky_banded
        from scipy.linalg.lapack import dtbtrs

        kernels = self._noise_kernels(theta)
        band = self._band(kernels)
        scale = np.sqrt(band[0])
        if not np.all(scale > 0) or not np.all(np.isfinite(scale)):
            raise EstimationError("an equation holds no noisy signal")
        for j in range(band.shape[0]):
            band[j, : band.shape[1] - j] /= scale[j:] * scale[: scale.size - j]
        band[0] *= 1 + 1e-12
        try:
            factor = cholesky_banded(band, lower=True)
        except LinAlgError:
            raise EstimationError("the rows repeat one another") from None

        def down(x: Array, trans: str) -> Array:
            return np.asarray(dtbtrs(factor, x, uplo="L", trans=trans)[0])

        moments = self._corrected(theta)
        fixed, X = self._columns(moments)
        r = fixed + X @ theta
        z = down((r / scale)[:, None], "N")
        q = (down(z, "T")[:, 0] / scale).reshape(-1, self.n_equations)
        noise = {}
        for name, s in self.system.signals.items():
            if s.sd > 0:
                parts = [spread_out(q[:, e], v, self.centres, self.n) for (e, k), v in kernels.items() if k == name]
                noise[name] = s.sd**2 * np.sum(parts, axis=0)
        estimated = {
            (name, order): m - moments_at(noise[name], self.kernels[order], self.bump.half, self.centres)
            if name in noise
            else m
            for (name, order), m in moments.items()
        }
        slope = self._columns(estimated)[1]
        for k, m in zip(self.system.kinks, self.kinks, strict=True):
            if k.parameter is not None:
                j = self.index[k.parameter]
                through, by = self._columns(m)
                slope[:, j] += k.power * theta[j] ** (k.power - 1) * (through + by @ theta)
        Z = down(np.asfortranarray(slope / scale[:, None]), "N")
        has = np.isfinite(self.system.prior_sd)
        rows = np.eye(theta.size)[has] / self.system.prior_sd[has, None]
        prior = (theta - self.system.prior_mean)[has] / self.system.prior_sd[has]
        r_all = np.concatenate([z[:, 0], prior])
        return _State(r_all, np.vstack([Z, rows]), float(r_all @ r_all))

    def step(self, state: _State) -> Array:
        size = np.maximum(np.linalg.norm(state.Z, axis=0), 1e-300)
        return np.asarray(np.linalg.lstsq(state.Z / size, -state.r, rcond=1e-13)[0] / size)

    def _corrected(self, theta: Array) -> dict[tuple[str, int], Array]:
        """Moments with what sampling left out of them."""
        out = dict(self.moments)
        for k, moments in zip(self.system.kinks, self.kinks, strict=True):
            size = 1.0 if k.parameter is None else theta[self.index[k.parameter]] ** k.power
            for key, m in moments.items():
                out[key] = out[key] + size * m
        return out

    def _noise_kernels(self, theta: Array) -> dict[tuple[int, str], Array]:
        """What carries the noise of each signal into each equation, offsets -half to half."""
        out: dict[tuple[int, str], Array] = {}
        for t in self.system.terms:
            if self.system.signals[t.signal].sd > 0:
                weight = t.factor * (1.0 if t.parameter is None else theta[self.index[t.parameter]])
                key = (t.equation, t.signal)
                out[key] = out.get(key, 0.0) + weight * self.kernels[t.order]
        return out

    def _band(self, kernels: Mapping[tuple[int, str], Array]) -> Array:
        """Lower band of V Sigma V^T: every row has the same kernel, so each lag is one number per pair of equations."""
        e, hop, length = self.n_equations, self.bump.hop, 2 * self.bump.half + 1
        lags = (length - 1) // hop + 1
        band = np.zeros((lags * e + e, self.centres.size * e))
        for (a, name), v in kernels.items():
            for b in range(e):
                w = kernels.get((b, name))
                if w is None:
                    continue
                variance = self.system.signals[name].sd ** 2
                for lag in range(lags):
                    place = lag * e + a - b
                    if place >= 0:
                        band[place, b::e] += variance * float(v[: length - lag * hop] @ w[lag * hop :])
        return band
