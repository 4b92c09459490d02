"""A plain second implementation of the predictor, sample by sample: what the fast one is held against.

Written from the equations alone (theory.md sec. 1; Kalman predictor), with none of the package's code, and in complex
numbers, so that a complex step through it gives derivatives to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from ambid.estimation.predictor import PredictorProblem

STEP = 1e-30


def continuous(name: str, p: Mapping[str, complex]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, E, C of m x'' = k_i i - k_x x - c x' + f and V = R i + L i' + k_i x', state by state."""
    if name == "coil":
        one = np.array([[1.0 + 0j]])
        return one * (-p["R"] / p["L"]), one / p["L"], one / p["L"], one
    if name == "rotor":
        a = np.array([[0, 1], [-p["k_x"], -p["c"]]], dtype=complex)
        b, e = np.array([[0], [p["k_i"]]], dtype=complex), np.array([[0], [1]], dtype=complex)
        for x in (a, b, e):
            x[1] /= p["m"]
        return a, b, e, np.array([[1.0, 0.0]])
    a = np.array([[0, 1, 0], [-p["k_x"], -p["c"], p["k_i"]], [0, -p["k_i"], -p["R"]]], dtype=complex)
    b, e = np.array([[0], [0], [1]], dtype=complex), np.array([[0, 0], [1, 0], [0, 1]], dtype=complex)
    for x in (a, b, e):
        x[1] /= p["m"]
        x[2] /= p["L"]
    return a, b, e, np.array([[1.0, 0, 0], [0, 0, 1.0]])


def sampled(problem: PredictorProblem, p: Mapping[str, complex], part: complex) -> tuple[np.ndarray, ...]:
    """A, B now, B one sample earlier, E, C over one sample, scaled; the input comes `part` of a sample late."""
    sc = problem.scales
    a, b, e, c = continuous(problem.model.name, p)
    a, b, e = (
        a * sc.state / sc.state[:, None],
        b * sc.input / sc.state[:, None],
        e * sc.disturbance / sc.state[:, None],
    )
    n, m = a.shape[0], b.shape[1] + e.shape[1]
    big = np.zeros((n + m, n + m), dtype=complex)
    big[:n, :n], big[:n, n:] = a, np.hstack([b, e])
    whole = expm(big / problem.rate_hz)
    late = expm(big * (1 - part) / problem.rate_hz)
    u = slice(n, n + b.shape[1])
    found = (
        whole[:n, :n],
        late[:n, u],
        whole[:n, u] - late[:n, u],
        whole[:n, u.stop :],
        c * sc.state / sc.output[:, None],
    )
    return found if any(np.iscomplexobj(v) and np.any(np.imag(v)) for v in found) else tuple(np.real(v) for v in found)


def riccati(a: np.ndarray, c: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain, state and innovation covariance; complex arguments are followed by Newton steps from the real solution."""
    p = solve_discrete_are(a.real.T, c.real.T, q.real, r.real).astype(a.dtype)
    for _ in range(4):
        s = c @ p @ c.T + r
        k = a @ p @ c.T @ np.linalg.inv(s)
        f = a - k @ c
        rhs = q + k @ r @ k.T
        p = np.linalg.solve(np.eye(f.size) - np.kron(f, f), rhs.ravel()).reshape(f.shape)
    s = c @ p @ c.T + r
    return a @ p @ c.T @ np.linalg.inv(s), p, s


def innovations(problem: PredictorProblem, vector: np.ndarray) -> np.ndarray:
    """Innovations in scaled output units, (n_used, n_outputs), complex if `vector` is."""
    sl, sc, v = problem.slices, problem.scales, vector
    p = {**problem.known, **dict(zip(problem.estimated, v[sl["physical"]] * problem.magnitude, strict=True))}
    total = problem.delay + (v[sl["fraction"]][0] if problem.fractional else problem.lag)
    whole = int(np.floor(np.real(total)))
    a, now, late, e, c = sampled(problem, p, total - whole)
    noise, n_d, n_y = v[sl["noise"]], e.shape[1], c.shape[0]
    if problem.noise == "levels":
        q = (e * np.exp(2 * noise[:n_d])) @ e.T
        k = riccati(a + 0 * q, c + 0 * q[0, 0], q, np.diag(np.r_[1.0, np.exp(2 * noise[n_d:])]))[0]
    else:
        k = noise.reshape(a.shape[0], n_y) if problem.noise == "gain" else problem.gain
    u, y = problem.u / sc.input, problem.y / sc.output
    last, push = u.shape[0] - 1, e @ v[sl["offset"]]
    x, out = v[sl["initial"]].astype(np.result_type(v, a, k)), []
    for t in range(problem.skip, y.shape[0], problem.stride):
        out.append(y[t] - c @ x)
        for j in range(problem.stride):
            i = t + j - whole
            x = a @ x + now @ u[min(i, last)] + late @ u[min(i - 1, last)] + push
        x = x + k @ out[-1]
    return np.array(out)


def complex_step(f: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Exact derivative of `f` by every entry of `at`, along a new last axis."""
    columns = []
    for j in range(at.size):
        moved = at.astype(complex)
        moved[j] += 1j * STEP
        columns.append(np.imag(f(moved)) / STEP)
    return np.stack(columns, axis=-1)
