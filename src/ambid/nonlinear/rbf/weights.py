"""Output weights of a network whose units stand: linear least squares with a prior whose size the data choose.

min |y - F l - Phi w|^2 / sigma^2 + |w|^2 / alpha^2, the linear part l without a prior. One QR of [F | Phi | y], then
singular values of what F leaves of Phi: every prior costs a line. Left open, sigma and alpha are those of the
restricted likelihood (Patterson and Thompson 1971; MacKay's evidence 1992), so that Laplace's covariance is honest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.rbf.shape import RbfShape

_BLOCK = 4096
_GRID = 10.0 ** np.arange(-15.0, 4.0, 0.25)  # of sigma^2 / alpha^2, in squared singular values
_BLIND = 1e-12  # part of the largest singular value of the linear part below which a direction is not there
_FLOOR = 1e-14  # least variance of errors, scaled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weights:
    """Weights with what they came from."""

    theta: Array  # (n_theta,), with the centres and widths that were given
    noise: Array  # (n_outputs,), variance of the errors, scaled
    prior: Array  # (n_outputs,), standard deviation of the units' weights before the data, alpha
    effective: Array  # (n_outputs,), numbers that the data determine


def fitted_weights(shape: RbfShape, theta: Array, z: Array, y: Array, prior: float | None) -> Weights:
    """Solve for the output weights.

    `theta`: (n_theta,), its centres and widths are taken; its weights are not looked at; `z`: (n, n_regressors); `y`:
    (n, n_outputs); `prior`: alpha; None for that of the restricted likelihood, output by output.
    """
    n, p, h = y.shape[0], shape.n_outputs, shape.neurons
    d = 1 + (z.shape[1] if shape.linear else 0)
    R = np.zeros((d + h + p, d + h + p))
    with np.errstate(over="ignore", invalid="ignore"):
        small = triangle_of([_columns(shape, theta, z[k : k + _BLOCK], y[k : k + _BLOCK]) for k in range(0, n, _BLOCK)])
    if not np.all(np.isfinite(small)):
        raise np.linalg.LinAlgError("regressors are not finite")
    R[: small.shape[0]] = small
    left, rank = _beyond(R[:, :d], R[:, d:])
    U, s, Vt = np.linalg.svd(left[:, :h], full_matrices=False)
    g = U.T @ left[:, h:]
    rest = np.sum((left[:, h:] - U @ g) ** 2, axis=0)
    w, noise, alpha, effective = np.zeros((h, p)), np.empty(p), np.empty(p), np.empty(p)
    for o in range(p):
        ratio, noise[o] = _ratio(s**2, g[:, o] ** 2, float(rest[o]), n - rank, prior)
        w[:, o] = Vt.T @ (s / (s**2 + ratio) * g[:, o])
        alpha[o] = np.sqrt(noise[o] / ratio)
        effective[o] = rank + np.sum(s**2 / (s**2 + ratio))
    line = np.linalg.lstsq(R[:, :d], R[:, d + h :] - R[:, d : d + h] @ w, rcond=_BLIND)[0]
    found = np.concatenate([line[:-1].T.ravel(), line[-1], w.T.ravel(), theta[shape.n_weights :]])
    return Weights(theta=found, noise=noise, prior=alpha, effective=effective)


def _columns(shape: RbfShape, theta: Array, z: Array, y: Array) -> Array:
    known = [z] if shape.linear else []
    return np.hstack([*known, np.ones((z.shape[0], 1)), shape.activations(theta, z), y])


def _beyond(known: Array, others: Array) -> tuple[Array, int]:
    """Return what known columns, some of which may be the same, leave of others, and the rank of the known ones."""
    U, s, _ = np.linalg.svd(known, full_matrices=False)
    U = U[:, s > _BLIND * max(float(s[0]), 1e-300)]
    for _ in range(2):  # twice is enough
        others = others - U @ (U.T @ others)
    return others, U.shape[1]


def _ratio(squares: Array, products: Array, rest: float, free: int, prior: float | None) -> tuple[float, float]:
    """Return sigma^2 / alpha^2 and sigma^2."""
    top, free = max(float(squares.max(initial=0.0)), 1e-300), max(free, 1)

    def noise(ratio: Array) -> Array:
        left = rest + np.sum(products[:, None] * ratio / (squares[:, None] + ratio), axis=0)
        found: Array = np.maximum(left / free, _FLOOR)
        return found

    if squares.size == 0:
        sigma2 = float(noise(np.ones(1))[0])
        return sigma2 if prior is None else sigma2 / prior**2, sigma2
    if prior is not None:
        ratio = np.array([_FLOOR])
        for _ in range(30):
            ratio = noise(ratio) / prior**2
        return float(ratio[0]), float(noise(ratio)[0])
    grid = _GRID * top
    for _ in range(3):
        minus_log = free * np.log(noise(grid)) + np.sum(np.log1p(squares[:, None] / grid), axis=0)
        at = int(np.argmin(minus_log))
        low, high = grid[max(at - 1, 0)], grid[min(at + 1, grid.size - 1)]
        best = grid[at]
        grid = np.geomspace(low, high, 21)
    return float(best), float(noise(np.array([best]))[0])
