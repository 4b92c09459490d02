"""Refined instrumental variables of one output in continuous time: starts, search, what it comes to.

Solves: find F_g, B_i in y = sum of B_i(s)/F_g(s) u_i + constant + free responses + noise from sampled data. Each step
solves Z' (e - Phi step) = 0 with all signals filtered by 1/F: Z from the simulated output, Phi from the measured one
(Young 2011, ch. 8). Where it settles, Z' e = 0: the output error is as small as it can be, whatever the measured
output does between the samples. A step that makes the error larger is shortened, or replaced by one with Z for Phi
(Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.instrumental.continuous import Responses, filtered, free_response, responses
from ambid.blackbox.instrumental.noise import Autoregression, autoregression
from ambid.blackbox.instrumental.solve import Solution, solve, span
from ambid.errors import EstimationError

WHITE = Autoregression(D=np.ones(1), variance=1.0)

_ROUGH, _FINE = 6, 60  # steps spent on a start, and on the best of them
_HALVINGS = 6
_SETTLED = 1e-6  # change of the output by a step, relative to the error
_NUMERIC = 5e-4  # the same, where rounding keeps the error from falling further
_AGREE = 1e-6  # relative difference in loss of two starts that found the same model
_EXACT = 1e-13  # error relative to the output that counts as none
_NOISE_ORDER = 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chain:
    """One denominator and the inputs that go through it, in p = s/w0."""

    inputs: tuple[int, ...]
    nb: tuple[int, ...]  # numerator coefficients, p^0 ... p^(nb - 1), for each of these inputs.
    den: Array  # (n + 1,), highest power first, monic
    num: Array  # (n_inputs, n + 1), highest power first

    @property
    def degree(self) -> int:
        """Degree of the denominator."""
        return self.den.size - 1

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.degree + sum(self.nb)

    def moved(self, change: Array) -> Chain:
        """Return the chain with its coefficients (f_0 ... f_(n-1), then b_0 ... of each input) changed.

        `change`: (size,).
        """
        n, den, num = self.degree, self.den.copy(), self.num.copy()
        den[:0:-1] += change[:n]
        first = n
        for i, nb in enumerate(self.nb):
            num[i, n + 1 - nb :] += change[first : first + nb][::-1]
            first += nb
        return replace(self, den=den, num=num)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setting:
    """One output with the inputs, delays taken off."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)
    step: float  # sampling interval in units of 1/w0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """Error, instruments and regressors about one set of coefficients, offsets and free responses taken off."""

    error: Array  # (n_samples,), filtered by the noise model
    Z: Array  # (n_samples, n_coefficients)
    Phi: Array
    output_error: Array  # (n_samples,), not filtered
    constant: float  # estimated offset of the output

    @property
    def loss(self) -> float:
        """Sum of squares of the error."""
        return float(self.error @ self.error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """Outcome of a search."""

    chains: tuple[Chain, ...]
    at: Linearised  # there
    noise: Autoregression  # by which the error is filtered
    settled: bool
    steps: int

    def solution(self) -> Solution:
        """Return the instrumental variable step at the end, from which the covariance follows."""
        return solve(self.at.Z, self.at.Phi, self.at.error, who="srivc")


def linearise(setting: Setting, chains: Sequence[Chain], noise: Autoregression = WHITE) -> Linearised:
    """Simulate, and set up one step."""
    made = [responses(c.den, c.num, setting.step, setting.u[:, c.inputs]) for c in chains]
    raw = setting.y - sum(m.y for m in made)
    nuisance = _nuisance(setting, chains)
    basis = span(nuisance)
    error = raw - basis @ (basis.T @ raw)
    size = np.linalg.norm(nuisance, axis=0)
    weights = np.linalg.lstsq(nuisance / size, raw, rcond=1e-8)[0] / size
    Z_parts, Phi_parts, first = list[Array](), list[Array](), 1
    for c, m in zip(chains, made, strict=True):
        free = nuisance[:, first : first + c.degree] @ weights[first : first + c.degree]
        first += c.degree
        Z_parts.append(_columns(c, m.of_output + filtered(c.den, setting.step, free), m, setting.u))
        Phi_parts.append(_columns(c, filtered(c.den, setting.step, m.y + free + error), m, setting.u))
    Z, Phi, constant = np.hstack(Z_parts), np.hstack(Phi_parts), float(weights[0])
    all_columns = np.column_stack([error, Z, Phi])
    if noise.order:
        from scipy.signal import lfilter

        p = noise.order
        all_columns = lfilter(noise.D, [1.0], all_columns, axis=0)[p:]
        basis = span(lfilter(noise.D, [1.0], nuisance, axis=0)[p:])
    clean = all_columns - basis @ (basis.T @ all_columns)
    n = Z.shape[1]
    return Linearised(
        error=clean[:, 0], Z=clean[:, 1 : n + 1], Phi=clean[:, n + 1 :], output_error=error, constant=constant
    )


def refine(setting: Setting, chains: Sequence[Chain], steps: int, noise: Autoregression = WHITE) -> Found:
    """Step until settled.

    `chains`: start, stable; `steps`: at most.
    """
    now, at = tuple(chains), linearise(setting, chains, noise)
    floor = (_EXACT * float(np.linalg.norm(setting.y))) ** 2
    for k in range(steps):
        if at.loss <= floor:
            return Found(chains=now, at=at, noise=noise, settled=True, steps=k)
        better = None
        for rows in (at.Phi, at.Z):
            change = solve(at.Z, rows, at.error, who="srivc").theta
            small = float(np.linalg.norm(at.Z @ change)) / np.sqrt(at.loss)
            if small <= _SETTLED:
                return Found(chains=now, at=at, noise=noise, settled=True, steps=k)
            better = _shortened(setting, now, at, change, noise)
            if better is not None:
                break
        if better is None:
            return Found(chains=now, at=at, noise=noise, settled=small <= _NUMERIC, steps=k)
        now, at = better
    return Found(chains=now, at=at, noise=noise, settled=False, steps=steps)


def search(
    y: Array, u: Array, dt: float, degrees: tuple[int, ...], nb: tuple[int, ...], *, common: bool, colour: bool
) -> tuple[Found, float]:
    """Start from several time scales and refine the best.

    `y`: (n_samples,); `u`: (n_samples, n_inputs), delays taken off; `degrees`: of the denominators: one for each input,
    or one where it is common; `nb`: numerator coefficients by input; `common`: whether all inputs share one
    denominator; `colour`: whether the noise is modelled and the data filtered by that model. Returns w0 in rad/s.
    """
    rough = []
    for w0 in _time_scales(y.size, dt):
        setting = Setting(y=y, u=u, step=w0 * dt)
        try:
            start = _start(setting, degrees, nb, common=common)
            rough.append((refine(setting, start, _ROUGH), setting, w0))
        except (EstimationError, np.linalg.LinAlgError):
            continue
        rough.sort(key=lambda r: r[0].at.loss)
        if len(rough) > 1 and rough[1][0].at.loss <= rough[0][0].at.loss * (1 + _AGREE) + 1e-18 * y.size:
            break
    if not rough:
        raise EstimationError(
            "srivc: no stable continuous-time model fits this record. Check the orders and the sampling rate; for an "
            "unstable plant give the reference of its loop and use clsrivc"
        )
    fine = [
        (found if found.settled else refine(setting, found.chains, _FINE), setting, w0)
        for found, setting, w0 in rough[:2]
    ]
    found, setting, w0 = min(fine, key=lambda r: r[0].at.loss)
    if colour:
        for _ in range(5):
            noise = autoregression(found.at.output_error, _NOISE_ORDER)
            if not noise.order:
                break
            before, found = found, refine(setting, found.chains, _FINE, noise)
            if np.allclose(_flat(before.chains), _flat(found.chains), rtol=1e-7, atol=0):
                break
    return found, w0


def _time_scales(n: int, dt: float) -> Array:
    """Corner frequencies of the start filters, from the record's length to half the sampling rate, middle first."""
    grid = np.geomspace(max(20.0 / (n * dt), 1e-4 / dt), 1.5 / dt, 9)
    return grid[[4, 6, 2, 5, 3, 7, 1, 8, 0]]


def _start(setting: Setting, degrees: tuple[int, ...], nb: tuple[int, ...], *, common: bool) -> tuple[Chain, ...]:
    """Least squares on signals through 1/(p + 1)^n (state variable filters), then each input by itself."""
    n, n_u = max(degrees), setting.u.shape[1]
    whole = _state_variable_filter(setting, n, nb if common else tuple(min(n + 1, max(nb)) for _ in nb))
    if common or n_u == 1:
        return (whole,)
    whole = refine(setting, (whole,), _ROUGH).chains[0]
    chains = []
    for i in range(n_u):
        part = responses(whole.den, whole.num[i : i + 1], setting.step, setting.u[:, i : i + 1]).y
        alone = Setting(y=part, u=setting.u[:, i : i + 1], step=setting.step)
        chain = refine(alone, (_state_variable_filter(alone, degrees[i], nb[i : i + 1]),), _ROUGH).chains[0]
        chains.append(replace(chain, inputs=(i,)))
    return tuple(chains)


def _state_variable_filter(setting: Setting, n: int, nb: tuple[int, ...]) -> Chain:
    smooth = np.asarray(np.poly(-np.ones(n)), dtype=np.float64)
    y, n_u = filtered(smooth, setting.step, setting.y), setting.u.shape[1]
    r = responses(smooth, np.zeros((n_u, n + 1)), setting.step, setting.u)
    top = setting.y - y @ smooth[:0:-1]
    blank = Chain(inputs=tuple(range(n_u)), nb=nb, den=smooth, num=np.zeros((n_u, n + 1)))
    rows = _columns(blank, y, r, setting.u)
    nuisance = span(_nuisance(setting, (blank,)))
    rows, top = rows - nuisance @ (nuisance.T @ rows), top - nuisance @ (nuisance.T @ top)
    found = solve(rows, rows, top, who="srivc").theta
    change = found.copy()
    change[:n] -= smooth[:0:-1]
    return _stable(blank.moved(change))


def _columns(chain: Chain, of_y: Array, made: Responses, u: Array) -> Array:
    """Derivatives of the simulated output: -p^k/F y, then p^k/F u of each input."""
    n = chain.degree
    columns = [-of_y]
    for i, nb in enumerate(chain.nb):
        columns.append(made.of_inputs[:, i, : min(nb, n)])
        if nb == n + 1:  # p^n/F u = u - sum of f_k p^k/F u
            columns.append((u[:, chain.inputs[i]] - made.of_inputs[:, i] @ chain.den[:0:-1])[:, None])
    return np.hstack(columns)


def _nuisance(setting: Setting, chains: Sequence[Chain]) -> Array:
    n = setting.y.size
    return np.hstack([np.ones((n, 1)), *[free_response(c.den, setting.step, n) for c in chains]])


def _shortened(
    setting: Setting, now: tuple[Chain, ...], at: Linearised, change: Array, noise: Autoregression
) -> tuple[tuple[Chain, ...], Linearised] | None:
    """The longest of the step, its half, quarter ... that makes the error smaller; None if none does."""
    for k in range(_HALVINGS):
        moved, first = list[Chain](), 0
        for c in now:
            moved.append(_stable(c.moved(0.5**k * change[first : first + c.size])))
            first += c.size
        new = linearise(setting, moved, noise)
        if new.loss < at.loss:
            return tuple(moved), new
    return None


def _stable(chain: Chain) -> Chain:
    """Mirror poles of the right half plane: a simulated output must not run away. The error decides if it stays."""
    roots = np.roots(chain.den)
    if not np.all(np.isfinite(roots)) or np.max(roots.real) < 0:
        return chain
    roots = np.where(roots.real >= 0, -np.maximum(roots.real, 1e-9) + 1j * roots.imag, roots)
    return replace(chain, den=np.asarray(np.poly(roots).real, dtype=np.float64))


def _flat(chains: Sequence[Chain]) -> Array:
    return np.concatenate([np.concatenate([c.den, c.num.ravel()]) for c in chains])
