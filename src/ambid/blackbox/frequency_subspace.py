"""State space from a frequency response by subspace, with the Laguerre operator w = (s - p)/(s + p) (thesis 1.7-1.8).

On s = j omega, |w| = 1: powers as good as a discrete z's, where those of j omega are nearly parallel. Inputs are
projected out of block rows w^k G, weighted by the noise they carry; the column space gives A and C, a linear fit B and
D (McKelvey, Akcay and Ljung 1996; Van Overschee and De Moor 1996). A held input is exact too, as a rational function of
(2/T)(z - 1)/(z + 1). From there the likelihood is searched over all matrices, but for the known number of directions in
which only the state changes (McKelvey, Helmersson and Ribarits 2004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import Orders, check_order_names, left_open, single_order
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.frequency import Lines, build_response_fit, check_lines, search_lines
from ambid.blackbox.model import StateSpaceModel
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.physics.linear_model import StateSpace, discretise
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]


def laguerre_operator(omega: Array, p: float) -> Complex:
    """Return w = (j omega - p)/(j omega + p) on the unit circle: -1 at 0, j at p > 0, towards 1 far above; omega in
    rad/s.
    """
    if not (np.isfinite(p) and p > 0):
        raise EstimationError(f"the Laguerre operator's p is {p} rad/s; it must be positive. Give one inside the band")
    return np.asarray((1j * omega - p) / (1j * omega + p))


def block_rows_condition(omega: Array, order: int, p: float | None = None) -> float:
    """Return the condition number of a subspace method's rows 1, v, v^2 ... v^order: v the Laguerre operator of `p` in
    rad/s, or without `p` j omega over its median, so that the unit of time does not make the number large.
    """
    if not 1 <= order < 2 * omega.size:
        raise EstimationError(f"powers up to {order} on {omega.size} lines; give an order from 1 to twice the lines")
    v = 1j * omega / np.median(omega) if p is None else laguerre_operator(omega, p)
    rows = v[None, :] ** np.arange(order + 1)[:, None]
    s = np.linalg.svd(np.concatenate([rows.real, rows.imag], axis=1), compute_uv=False)
    return float(s[0] / max(s[-1], 1e-300))


def best_conditioned(omega: Array, order: int) -> float:
    """Return the p in rad/s for which the powers of the operator are best conditioned, within 1 %."""
    from scipy.optimize import minimize_scalar

    low, high = np.log(np.min(omega[omega > 0])), np.log(np.max(omega)) + np.log(10.0)
    grid = np.linspace(low, high, 25)
    size = [np.log(block_rows_condition(omega, order, float(np.exp(x)))) for x in grid]
    k, step = int(np.argmin(size)), grid[1] - grid[0]
    minimum = minimize_scalar(
        lambda x: np.log(block_rows_condition(omega, order, float(np.exp(x)))),
        bounds=(grid[k] - step, grid[k] + step),
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(minimum.x if minimum.fun < size[k] else grid[k]))


def refine_matrices(ln: Lines, model: StateSpaceModel, feedthrough: bool) -> tuple[float, StateSpaceModel, bool]:
    """Search the likelihood from a model by Levenberg-Marquardt, D free with `feedthrough`."""
    # states of which inputs and outputs speak alike: rows of B and columns of C of equal size, A balanced.
    from scipy.linalg import matrix_balance

    _, T = matrix_balance(model.A)
    model = model.in_states(np.asarray(T))
    b, c = np.linalg.norm(model.B), np.linalg.norm(model.C)
    here = model.in_states(np.eye(model.order) * np.sqrt(b / c)) if b > 0 and c > 0 else model
    free = _free(here, feedthrough)

    def at(v: Array) -> StateSpaceModel:
        theta = here.theta.copy()
        theta[free] = v
        return here.with_theta(theta)

    def residual(v: Array) -> Array:
        return ln.whitened(at(v).frequency_response(ln.omega) - ln.G)

    def slope(v: Array) -> Array:
        return ln.whitened(at(v).frequency_response_derivative(ln.omega)[..., free])

    cost, v, converged = search_lines(residual, slope, here.theta[free])
    return cost, at(v), converged


def information(ln: Lines, model: StateSpaceModel, feedthrough: bool) -> tuple[Array, float]:
    """Return the covariance (n_theta, n_theta) of all matrices, zero in the directions of the state's choice, and the
    condition of the scaled Jacobian.
    """
    free = _free(model, feedthrough)
    J = ln.whitened(model.frequency_response_derivative(ln.omega)[..., free])
    own, condition = ln.covariance(J, int(np.count_nonzero(free)) - model.order**2)
    full = np.zeros((model.theta.size, model.theta.size))
    full[np.ix_(free, free)] = own
    return full, condition


def to_continuous(model: StateSpaceModel, covariance: Array) -> tuple[StateSpaceModel, Array] | None:
    """Return the continuous model that under a hold gives the discrete one, and its covariance; None where none is
    real.
    """
    from scipy.linalg import logm

    assert model.dt is not None
    n, n_u = model.B.shape
    values = np.linalg.eigvals(model.A)
    if np.any((np.abs(values.imag) < 1e-9 * np.abs(values)) & (values.real <= 0)) or np.any(np.abs(values) < 1e-12):
        return None
    whole = np.zeros((n + n_u, n + n_u))
    whole[:n, :n], whole[:n, n:], whole[n:, n:] = model.A, model.B, np.eye(n_u)
    log = np.real(logm(whole)) / model.dt
    continuous = StateSpaceModel(A=log[:n, :n], B=log[:n, n:], C=model.C, D=model.D, K=model.K / model.dt, dt=None)
    size, none = n * (n + n_u), np.zeros((n, 0))
    one_each = [(x[: n * n].reshape(n, n), x[n * n :].reshape(n, n_u)) for x in np.eye(size)]
    directions = [StateSpace(A=dA, B=dB, E=none, C=model.C) for dA, dB in one_each]
    _, slopes = discretise(
        StateSpace(A=continuous.A, B=continuous.B, E=none, C=model.C), model.dt, derivatives=directions
    )
    forward = np.stack([np.concatenate([d.A.ravel(), d.B.ravel()]) for d in slopes], axis=1)
    M = np.eye(model.theta.size)
    M[:size, :size] = np.linalg.inv(forward)
    return continuous, M @ covariance @ M.T


def _free(model: StateSpaceModel, feedthrough: bool) -> NDArray[np.bool_]:
    """Which of theta is estimated: A, B, C, and D where it is wanted."""
    n, n_y, n_u = model.order, model.n_outputs, model.n_inputs
    free = np.zeros(model.theta.size, dtype=np.bool_)
    free[: n * (n + n_u + n_y) + (n_y * n_u if feedthrough else 0)] = True
    return free


_GRID = 9  # values of p that are tried
_HIGHEST = 8  # order tried where it is to be chosen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    model: StateSpaceModel
    cost: float
    p: float
    singular_values: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    """What `frf_subspace` was asked for beside the order."""

    delay: float
    feedthrough: bool
    domain: Literal["s", "z"]


def frf_subspace(
    frf: FrequencyResponse,
    orders: Orders | Literal["auto"],
    *,
    delay: float = 0.0,
    feedthrough: bool = False,
    domain: Literal["s", "z"] = "s",
) -> BlackBoxFit:
    """Identify a state space from a frequency response. `orders`: ``n``; "auto", or left out: the lowest whose refined
    cost noise explains, else that of least BIC; `delay`: of all inputs in s, known; `feedthrough`: whether D is
    estimated; `domain`: z for held inputs only. The p of the Laguerre operator is that of least mean square error.
    """
    if domain not in ("s", "z") or (domain == "z" and frf.hold != "zoh"):
        raise EstimationError(f"domain {domain!r} with hold {frf.hold!r}; it must be 's', or 'z' for a held input")
    if not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(f"a delay of {delay} s; it must be zero or positive. Correct it")
    samples = delay * frf.rate_hz
    if frf.hold == "zoh" and abs(samples - round(samples)) > 1e-9 * max(samples, 1.0):
        raise EstimationError(
            f"a delay of {delay} s is {samples:.4g} samples; under a hold a part of a sample is no common phase of the "
            "lines. Give whole samples, or estimate it with greybox_frf or frf_ml in domain 's'"
        )
    wanted: Orders = {} if isinstance(orders, str) else orders
    check_order_names("frf-subspace", wanted, ("n",))
    n = None if left_open(wanted, "n") else single_order("frf-subspace", wanted, "n", 1)
    asked = _Asked(delay=delay, feedthrough=feedthrough, domain=domain)
    with one_thread():
        return _choose_order(frf, asked) if n is None else _of_order(frf, n, asked)


def _of_order(frf: FrequencyResponse, n: int, asked: _Asked) -> BlackBoxFit:
    """One order: subspace, refinement, continuous form."""
    ln, rows, best, n_estimated = _start(frf, n, asked)
    cost, model, converged = refine_matrices(ln, best.model, asked.feedthrough)
    covariance, condition = information(ln, model, asked.feedthrough)
    warnings = []
    if model.dt is not None and asked.domain == "s":
        continuous = to_continuous(model, covariance)
        if continuous is None:
            warnings.append(
                "given in z: a pole on the negative real axis of z or at 0 belongs to no continuous model under a hold"
            )
        else:
            model, covariance = continuous
    points = _points(ln).imag
    return build_response_fit(
        "frf-subspace",
        frf,
        ln,
        orders={"n": n},
        model=model,
        covariance=covariance,
        cost=cost,
        n_estimated=n_estimated,
        converged=converged,
        warnings=warnings,
        details={
            "p": best.p,
            "block_rows": rows,
            "singular_values": best.singular_values.tolist(),
            "condition": block_rows_condition(points, rows - 1, best.p),
            "condition_without": block_rows_condition(points, rows - 1),
            "condition_jacobian": condition,
            "delay_s": asked.delay,
            "refined": True,
            "subspace_cost": best.cost,
        },
    )


def _choose_order(frf: FrequencyResponse, asked: _Asked) -> BlackBoxFit:
    """The lowest order that noise explains, else the one of least BIC."""
    m, tried, bic = 2 * frf.G.size, list[tuple[float, int]](), dict[str, float]()
    for n in range(1, _HIGHEST + 1):
        try:
            ln, _, trial, count = _start(frf, n, asked)
        except EstimationError:
            if not tried:
                raise
            break
        cost = refine_matrices(ln, trial.model, asked.feedthrough)[0]
        verdict = ln.verdict(cost, count)
        tried.append((2 * cost + count * float(np.log(m)), n))
        bic[str(n)] = tried[-1][0]
        if verdict.p is not None and verdict.p > 0.01:
            tried = [tried[-1]]
            break
    fit = _of_order(frf, min(tried)[1], asked)
    return replace(fit, details={**fit.details, "bic_by_order": bic})


def _start(frf: FrequencyResponse, n: int, asked: _Asked) -> tuple[Lines, int, _Trial, int]:
    """Lines, block rows, subspace estimate of one order, and how many numbers are estimated."""
    n_y, n_u = frf.n_outputs, frf.n_inputs
    n_estimated = n * (n_y + n_u) + (n_y * n_u if asked.feedthrough else 0)
    ln = check_lines(frf, n_estimated)
    if asked.delay:  # a common phase leaves the covariance as it is
        ln = replace(ln, G=ln.G * np.exp(1j * ln.omega * asked.delay)[:, None, None])
    least, most = n // n_y + 2, int(2 * ln.n_lines * n_u) // (n_y + n_u)
    if least > most:
        raise EstimationError(
            f"order {n} needs {least} block rows, and {ln.n_lines} lines distinguish {most}. Lower the order, or "
            "measure more lines"
        )
    rows = int(max(least, min(2 * n + 2, most // 2)))  # 2 n + 2 where the lines can tell so many apart
    return ln, rows, _best_operator(ln, n, rows, asked.feedthrough), n_estimated


def _points(ln: Lines) -> Complex:
    """Points on the imaginary axis where G is rational: s, or (2/T)(z - 1)/(z + 1) for a held input."""
    return np.asarray(1j * (2 / ln.dt * np.tan(ln.omega * ln.dt / 2) if ln.held else ln.omega), dtype=np.complex128)


def _best_operator(ln: Lines, n: int, rows: int, feedthrough: bool) -> _Trial:
    """The p of least mean square error."""
    omega = _points(ln).imag
    positive = omega[omega > 0]
    grid = [best_conditioned(positive, rows - 1), *np.geomspace(positive[0], positive[-1], _GRID + 2)[1:-1]]
    trials = []
    for value in grid:
        try:
            trials.append(_trial(ln, n, rows, feedthrough, float(value)))
        except np.linalg.LinAlgError:
            continue
    trials = [t for t in trials if np.isfinite(t.cost)]
    if not trials:
        raise EstimationError(f"no state space of order {n} fits these lines; lower the order, or check the response")
    return min(trials, key=lambda t: t.cost)


def _trial(ln: Lines, n: int, rows: int, feedthrough: bool, p: float) -> _Trial:
    """One subspace estimate: A and C from the column space, B and D from a linear fit."""
    points = _points(ln)
    space, s = _column_space(ln, laguerre_operator(points.imag, p), n, rows)
    n_y = ln.G.shape[1]
    up, low = space[:-n_y], space[n_y:]
    A = np.asarray(p * np.linalg.lstsq(up - low, up + low, rcond=None)[0], dtype=np.float64)
    C = _output_matrix(A, space, p, n_y)
    dt = None
    if ln.held:  # s = (2/T)(z - 1)/(z + 1)
        dt, half = ln.dt, np.eye(n) - ln.dt / 2 * A
        A = np.asarray(np.linalg.solve(half, np.eye(n) + ln.dt / 2 * A), dtype=np.float64)
        C = np.asarray(np.linalg.solve(half.T, C.T).T, dtype=np.float64)
    B, D, cost = _input_matrices(ln, A, C, feedthrough, dt)
    model = StateSpaceModel(A=A, B=B, C=C, D=D, K=np.zeros((n, n_y)), dt=dt)
    return _Trial(model=model, cost=cost, p=p, singular_values=s)


def _column_space(ln: Lines, w: Complex, n: int, rows: int) -> tuple[Array, Array]:
    """Extended observability matrix (rows * n_outputs, n), and all singular values."""
    n_f, n_y, n_u = ln.G.shape
    output = np.sqrt(np.mean(ln.sd**2, axis=(0, 2)))  # outputs in units of their noise
    level = np.sqrt(np.mean((ln.sd / output[:, None]) ** 2, axis=(1, 2)))  # lines likewise
    powers = w[:, None] ** np.arange(rows)
    scaled = ln.G / output[:, None] / level[:, None, None]
    Y = np.einsum("fk,fyu->kyfu", powers, scaled).reshape(rows * n_y, n_f * n_u)
    U = np.einsum("fk,vu,f->kvfu", powers, np.eye(n_u), 1.0 / level).reshape(rows * n_u, n_f * n_u)
    both = np.vstack([U, Y])
    r = np.asarray(np.linalg.qr(np.concatenate([both.real, both.imag], axis=1).T, mode="r"))
    tall = r[rows * n_u :, rows * n_u :].T
    inverse = np.linalg.inv(ln.root)
    covariance = (inverse @ np.swapaxes(inverse.conj(), 1, 2)).reshape(n_f, n_y, n_u, n_y, n_u)
    noise = np.einsum("fyuzu->fyz", covariance) / np.outer(output, output) / level[:, None, None] ** 2
    rowwise = np.einsum("fk,fl,fyz->kylz", powers, powers.conj(), noise).reshape(rows * n_y, rows * n_y).real
    factor = np.linalg.cholesky(rowwise + 1e-14 * np.trace(rowwise) * np.eye(rows * n_y))
    left, s, _ = np.linalg.svd(np.linalg.solve(factor, tall))
    space = (factor @ left[:, :n]).reshape(rows, n_y, n) * output[:, None]
    return space.reshape(rows * n_y, n), s


def _output_matrix(A: Array, space: Array, p: float, n_y: int) -> Array:
    """C from all block rows: row k is C (A - p)^k (A + p)^(rows - 1 - k), each mode scaled alike."""
    n, rows = A.shape[0], space.shape[0] // n_y
    values, vectors = np.linalg.eig(A)
    size = np.sqrt(np.abs(values) ** 2 + p**2)
    # this function of A is real: conjugate modes have equal sizes
    unit = np.real(vectors @ np.diag(1 / size) @ np.linalg.inv(vectors))
    less, more = (A - p * np.eye(n)) @ unit, (A + p * np.eye(n)) @ unit
    blocks = [np.linalg.matrix_power(less, k) @ np.linalg.matrix_power(more, rows - 1 - k) for k in range(rows)]
    wide, right = np.hstack(blocks), np.hstack(list(space.reshape(rows, n_y, n)))
    return np.asarray(np.linalg.lstsq(wide.T, right.T, rcond=None)[0].T, dtype=np.float64)


def _input_matrices(ln: Lines, A: Array, C: Array, feedthrough: bool, dt: float | None) -> tuple[Array, Array, float]:
    """B and D by weighted linear least squares, and the cost."""
    n, (n_f, n_y, n_u) = A.shape[0], ln.G.shape
    points = 1j * ln.omega if dt is None else np.exp(1j * ln.omega * dt)
    left = np.linalg.solve(
        np.swapaxes(points[:, None, None] * np.eye(n) - A, 1, 2),
        np.broadcast_to(C.T.astype(np.complex128), (n_f, n, n_y)),
    )
    columns = np.einsum("fjy,uv->fyujv", left, np.eye(n_u)).reshape(n_f, n_y, n_u, n * n_u)
    if feedthrough:
        direct = np.einsum("yz,uv->yuzv", np.eye(n_y), np.eye(n_u)).reshape(n_y, n_u, n_y * n_u)
        columns = np.concatenate([columns, np.broadcast_to(direct, (n_f, *direct.shape))], axis=3)
    a, b = ln.whitened(columns), ln.whitened(ln.G)
    norm = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    x = np.linalg.lstsq(a / norm, b, rcond=None)[0] / norm
    cost = float(np.sum((a @ x - b) ** 2)) / 2
    D = x[n * n_u :].reshape(n_y, n_u) if feedthrough else np.zeros((n_y, n_u))
    return x[: n * n_u].reshape(n, n_u), D, cost
