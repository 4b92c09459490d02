"""Local coordinates of an innovations form: every way in which the model, not only its choice of states, can move.

Solves: theta = theta_0 + P beta, with the columns of P orthonormal and orthogonal to all that a change of states does,
(T A - A T, T B, -C T, 0, T K) for every T (McKelvey, Helmersson and Ribarits 2004, Automatica 40, 1629). No canonical
form, so no structure at which it breaks down; states are balanced first, so that sizes are alike.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.state_space import StateSpaceModel

_DOUBLINGS = 24  # samples as a power of two
_FAINT = 1e-10  # Hankel singular value beside the largest below which a state is not scaled further


def tangent(model: StateSpaceModel, *, feedthrough: bool) -> Array:
    """Return directions along which the model moves, those of a mere change of states left out.

    `feedthrough`: whether D moves. Returns orthonormal columns.
    """
    m, n, n_u, n_y = model, model.order, model.n_inputs, model.n_outputs
    eye = np.eye(n)
    exchange = np.vstack(
        [
            np.kron(eye, m.A.T) - np.kron(m.A, eye),
            np.kron(eye, m.B.T),
            -np.kron(m.C, eye),
            np.kron(eye, m.K.T),
        ]
    )
    basis = np.linalg.qr(exchange, mode="complete")[0][:, n * n :]
    before, size = n * n + n * n_u + n_y * n, n_y * n_u
    out = np.zeros((m.theta.size, basis.shape[1] + (size if feedthrough else 0)))
    out[:before, : basis.shape[1]] = basis[:before]
    out[before + size :, : basis.shape[1]] = basis[before:]
    if feedthrough:
        out[before : before + size, basis.shape[1] :] = np.eye(size)
    return out


def linear(model: StateSpaceModel, *, feedthrough: bool) -> Array:
    """Return directions along which the predictions are linear: inputs and outputs enter a predictor that stays.

    With F = A - K C and C held, they are linear in K and in B - K D; in D beside K up to the product of their changes.

    `feedthrough`: whether D moves.
    """
    m, n, n_u, n_y = model, model.order, model.n_inputs, model.n_outputs
    ends = np.cumsum([0, n * n, n * n_u, n_y * n, n_y * n_u, n * n_y])
    by_b, by_k = n * n_u, n * n_y
    out = np.zeros((m.theta.size, by_b + by_k + (n_y * n_u if feedthrough else 0)))
    out[ends[1] : ends[2], :by_b] = np.eye(by_b)
    out[ends[4] : ends[5], by_b : by_b + by_k] = np.eye(by_k)
    out[: ends[1], by_b : by_b + by_k] = np.kron(np.eye(n), m.C.T)  # dA = dK C
    out[ends[1] : ends[2], by_b : by_b + by_k] = np.kron(np.eye(n), m.D.T)  # dB = dK D
    if feedthrough:
        out[ends[3] : ends[4], by_b + by_k :] = np.eye(n_y * n_u)
        out[ends[1] : ends[2], by_b + by_k :] = np.kron(m.K, np.eye(n_u))  # dB = K dD
    return out


def moved(model: StateSpaceModel, change: Array) -> StateSpaceModel:
    """Return the model with its coefficients changed.

    `change`: (n_theta,).
    """
    theta, parts, at = model.theta + change, {}, 0
    for name in "ABCDK":
        shape = getattr(model, name).shape
        parts[name] = theta[at : at + shape[0] * shape[1]].reshape(shape)
        at += shape[0] * shape[1]
    return StateSpaceModel(**parts, dt=model.dt)


def balanced(model: StateSpaceModel, x0: Array, noise: Array) -> tuple[StateSpaceModel, Array]:
    """Return the model in states that white inputs and outputs drive, and the predictions show, by equal amounts.

    `model`: with a stable predictor; `x0`: (n,), first states; `noise`: (n_outputs, n_outputs), of the innovations:
    errors are counted in it. Returns `model`: as it was where its predictor is too near the edge of stability to be
    balanced; `x0`: (n,).
    """
    m = model
    F, G = m.A - m.K @ m.C, np.hstack([m.B - m.K @ m.D, m.K])
    seen = np.linalg.solve(np.linalg.cholesky(noise), m.C)
    try:
        left, right = _factor(_gramian(F, G)), _factor(_gramian(F.T, seen.T))
        U, s, _ = np.linalg.svd(right.T @ left)
        s = np.sqrt(np.maximum(s, _FAINT * s[0]))
        T = (U / s).T @ right.T  # new states = T old states
        back = np.linalg.inv(T)
    except (np.linalg.LinAlgError, ValueError):
        return model, x0
    if not (np.all(np.isfinite(T)) and np.linalg.cond(T) < 1e12):
        return model, x0
    return StateSpaceModel(A=T @ m.A @ back, B=T @ m.B, C=m.C @ back, D=m.D, K=T @ m.K, dt=m.dt), T @ x0


def _gramian(F: Array, G: Array) -> Array:
    """Sum of F^k G G' F'^k, its length doubled until nothing is added: no equation to be ill-conditioned."""
    total, power = G @ G.T, F
    for _ in range(_DOUBLINGS):
        total = total + power @ total @ power.T
        power = power @ power
        if not np.any(np.abs(power) > 1e-18):
            break
    if not np.all(np.isfinite(total)):
        raise np.linalg.LinAlgError("the predictor forgets nothing")
    return np.asarray(total)


def _factor(gramian: Array) -> Array:
    """Return L with L L' = gramian, rounding below zero taken as rounding."""
    values, ways = np.linalg.eigh(0.5 * (gramian + gramian.T))
    if not values[-1] > 0:
        raise np.linalg.LinAlgError("nothing drives the states")
    return np.asarray(ways * np.sqrt(np.maximum(values, 1e-14 * values[-1])))
