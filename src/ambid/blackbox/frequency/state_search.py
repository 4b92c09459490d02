"""State-space matrices under the likelihood of a frequency response: search, information, resampling, continuous form.

All matrices are free, also the choice of the state; the directions in which only the state changes carry no information
and are left out by their known number, so that poles, zeros and responses get the spread of the invariant model
(McKelvey, Helmersson and Ribarits 2004).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.frequency.lines import Lines
from ambid.blackbox.state_space import StateSpaceModel
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import StateSpace

Complex = NDArray[np.complex128]


def refined(ln: Lines, model: StateSpaceModel, feedthrough: bool) -> tuple[float, StateSpaceModel, bool]:
    """Search the likelihood from a model by Levenberg-Marquardt.

    `feedthrough`: whether D is free.
    """
    from scipy.optimize import least_squares

    here = _balanced(model)
    free = _free(here, feedthrough)

    def at(v: Array) -> StateSpaceModel:
        theta = here.theta.copy()
        theta[free] = v
        return here.with_theta(theta)

    def residual(v: Array) -> Array:
        return ln.whitened(at(v).frequency_response(ln.omega) - ln.G)

    def slope(v: Array) -> Array:
        return ln.whitened(at(v).frequency_response_derivative(ln.omega)[..., free])

    found = least_squares(
        residual, here.theta[free], jac=slope, method="lm", x_scale="jac", xtol=1e-11, ftol=1e-12, gtol=1e-11,
        max_nfev=200,
    )  # fmt: skip
    return float(found.cost), at(found.x), bool(found.status > 0)


def information(ln: Lines, model: StateSpaceModel, feedthrough: bool) -> tuple[Array, float]:
    """Return the covariance of all matrices from the information matrix, and the condition of the scaled Jacobian.

    Returns `covariance`: (n_theta, n_theta), minimal in the directions of the state's choice: zero there.
    """
    free = _free(model, feedthrough)
    J = ln.whitened(model.frequency_response_derivative(ln.omega)[..., free])
    norm = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(J / norm, full_matrices=False)
    used = int(np.count_nonzero(free)) - model.order**2
    half = (vt[:used].T / np.maximum(s[:used], 1e-15 * s[0])) / norm[:, None]
    full = np.zeros((model.theta.size, model.theta.size))
    full[np.ix_(free, free)] = half @ half.T * ln.widening
    return full, float(s[0] / s[used - 1])


def resampled(ln: Lines, model: StateSpaceModel, again: Callable[[Complex], StateSpaceModel], count: int) -> Array:
    """Return the scatter of an estimator's matrices over draws from the covariance of the response.

    Draws are about the model's own response, with a fixed seed; each result is turned into the state of `model`.

    `again`: estimates from a response, shape (n_frequencies, n_outputs, n_inputs). Returns (n_theta, n_theta).
    """
    rng = np.random.default_rng(1)
    centre, factor = model.frequency_response(ln.omega), np.linalg.inv(ln.root)
    draws = []
    for _ in range(count):
        z = rng.standard_normal((ln.n_lines, ln.entries, 2)) @ np.array([1.0, 1j]) / np.sqrt(2)
        drawn = again(centre + (factor @ z[..., None])[..., 0].reshape(centre.shape))
        draws.append(_aligned(drawn, model).theta)
    scatter = np.stack(draws) - model.theta
    return np.asarray(scatter.T @ scatter / count)


def continuous(model: StateSpaceModel, covariance: Array) -> tuple[StateSpaceModel, Array] | None:
    """Return the continuous model that gives the discrete one under a hold, and its covariance.

    `model`: discrete; `covariance`: (n_theta, n_theta). Returns none where no real continuous model exists.
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
    found = StateSpaceModel(A=log[:n, :n], B=log[:n, n:], C=model.C, D=model.D, K=model.K / model.dt, dt=None)
    used, none = n * (n + n_u), np.zeros((n, 0))
    one_each = [(x[: n * n].reshape(n, n), x[n * n :].reshape(n, n_u)) for x in np.eye(used)]
    directions = [StateSpace(A=dA, B=dB, E=none, C=model.C) for dA, dB in one_each]
    _, slopes = discretise(StateSpace(A=found.A, B=found.B, E=none, C=model.C), model.dt, derivatives=directions)
    forward = np.stack([np.concatenate([d.A.ravel(), d.B.ravel()]) for d in slopes], axis=1)
    M = np.eye(model.theta.size)
    M[:used, :used] = np.linalg.inv(forward)
    return found, M @ covariance @ M.T


def _free(model: StateSpaceModel, feedthrough: bool) -> NDArray[np.bool_]:
    """Which of theta is estimated: A, B, C, and D where it is wanted."""
    n, n_y, n_u = model.order, model.n_outputs, model.n_inputs
    free = np.zeros(model.theta.size, dtype=np.bool_)
    free[: n * (n + n_u + n_y) + (n_y * n_u if feedthrough else 0)] = True
    return free


def _turned(model: StateSpaceModel, T: Array) -> StateSpaceModel:
    """The same model in the state T^-1 x."""
    back = np.linalg.inv(T)
    return StateSpaceModel(
        A=back @ model.A @ T, B=back @ model.B, C=model.C @ T, D=model.D, K=back @ model.K, dt=model.dt
    )


def _balanced(model: StateSpaceModel) -> StateSpaceModel:
    """States of which inputs and outputs speak alike: rows of B and columns of C of equal size, A balanced."""
    from scipy.linalg import matrix_balance

    _, T = matrix_balance(model.A)
    model = _turned(model, np.asarray(T))
    b, c = np.linalg.norm(model.B), np.linalg.norm(model.C)
    return _turned(model, np.eye(model.order) * np.sqrt(b / c)) if b > 0 and c > 0 else model


def _aligned(model: StateSpaceModel, like: StateSpaceModel) -> StateSpaceModel:
    """A model in the state in which its observability matrix is nearest to another's."""
    scale = max(float(np.max(np.abs(np.linalg.eigvals(like.A)))), 1e-300)

    def observability(of: StateSpaceModel) -> Array:
        rows = [of.C / np.maximum(np.linalg.norm(like.C, axis=1, keepdims=True), 1e-300)]
        for _ in range(of.order):
            rows.append(rows[-1] @ of.A / scale)
        return np.vstack(rows)

    T = np.linalg.lstsq(observability(model), observability(like), rcond=None)[0]
    return _turned(model, np.asarray(T, dtype=np.float64))
