"""Covariance of the weights of a state-space network: information, sandwich, or bootstrap; the first states counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.identify.networks.nn_train import State, white
from ambid.identify.networks.records import Scaled
from ambid.identify.networks.residual import Ridge
from ambid.identify.networks.search import information_inverse
from ambid.identify.networks.segments import StateProblem
from ambid.identify.networks.spread import bootstrapped, sandwich
from ambid.identify.nonlinear.progress import Tick

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spread:
    """Spread of the weights.

    Attributes
    ----------
    covariance : ndarray, shape (n_theta, n_theta), or None
        In the units of the model's weights.
    origin : str
        For `NonlinearFit.covariance_from`.
    condition : float
        Of the scaled information's root.
    warnings : tuple of str
    """

    covariance: Array | None
    origin: str
    condition: float
    warnings: tuple[str, ...] = ()


def spread_of(state: State, data: Scaled, how: str, seed: int, tick: Tick | None) -> Spread:
    """Return the spread of trained weights.

    Parameters
    ----------
    state : State
    data : Scaled
    how : {"auto", "laplace", "sandwich", "bootstrap", "none"}
        ``auto``: information (with a hidden layer: Laplace's approximation, the prior in it) where the errors are
        white, else the sandwich.
    seed : int
    tick : callable or None

    Returns
    -------
    Spread
    """
    problem, v = state.problem(data), state.vector
    P, condition = information_inverse(problem.triangle(v)[:, :-1])
    if how == "none":
        told = ("no covariance was asked for, and so there are no standard deviations",)
        return Spread(covariance=None, origin="", condition=condition, warnings=told)
    if P is None:
        told = (
            f"no standard deviations: the data do not determine all weights (condition number {condition:.1e}). "
            "Fewer states or connections, or more excitation",
        )
        return Spread(covariance=None, origin="", condition=condition, warnings=told)
    origin = "laplace" if state.layout.neurons else "information"
    if how == "auto":
        how = "laplace" if white(state, data) else "sandwich"
    if how == "sandwich":
        P, origin = _sandwich(problem, v), "sandwich"
    elif how == "bootstrap":
        P, origin = bootstrapped(problem.sample_rows(v), _penalty_rows(problem, v), seed, tick), "bootstrap"
    unit, k = state.layout.unit, state.theta.size
    return Spread(covariance=P[:k, :k] * unit[:, None] * unit, origin=origin, condition=condition)


def _sandwich(problem: StateProblem, v: Array) -> Array:
    rows = problem.sample_rows(v)
    scores = [np.einsum("tok,to->tk", r[:, :, :-1], r[:, :, -1]) for r in rows]
    prior = np.zeros((v.size, v.size))
    for p in problem.penalties:
        if isinstance(p, Ridge):  # what keeps the network orthogonal is no knowledge that could be wrong
            J = p.rows(v[: problem.layout.n_theta])[0]
            prior[: J.shape[1], : J.shape[1]] += J.T @ J
    found = sandwich(problem.triangle(v)[:, :-1], scores, prior)[0]
    assert found is not None
    return found


def _penalty_rows(problem: StateProblem, v: Array) -> Array:
    """Rows of the penalties at the optimum, where their pull is in balance with the data's."""
    k, out = problem.layout.n_theta, [np.zeros((0, v.size + 1))]
    for p in problem.penalties:
        J, r = p.rows(v[:k])
        out.append(np.hstack([J, np.zeros((r.size, v.size - k)), r[:, None]]))
    return np.concatenate(out)
