"""Covariance of the weights of a state-space network: information, sandwich, or bootstrap; the first states counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick
from ambid.estimation.uncertainty import bootstrapped, sandwich, score_covariance, widening
from ambid.nonlinear.networks.nn_train import State, white
from ambid.nonlinear.networks.residual import Orthogonal, Ridge, units
from ambid.nonlinear.networks.segments import StateProblem
from ambid.nonlinear.records import Scaled

_AS_GOOD = 0.02  # logarithm of an output's error variance, by which a start may be worse: 1 % of the error
_LONG = 1.0 / 16.0  # of a record, as a block: where it goes hangs together for as long as its slowest motion lasts


_PROJECTED = (
    "A and B are the best linear approximation over this record, and their deviations count that another record would "
    "go elsewhere; those of predictions, in which the network makes up for that, come out too large"
)
_ANCHORED = (
    "A and B are the slope that the network gives at the operating point; what its units cannot follow of the plant is "
    "not in their standard deviations. Compare a fit with more neurons, or with a smaller swing"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spread:
    """Spread of the weights."""

    covariance: Array | None  # (n_theta, n_theta), or None, in the units of the model's weights
    origin: str  # for `NonlinearFit.covariance_from`
    condition: float  # of the scaled information's root
    warnings: tuple[str, ...] = ()


def spread_of(
    state: State, data: Scaled, how: str, seed: int, tick: Tick | None, rivals: Sequence[State] = ()
) -> Spread:
    """Return the spread of trained weights.

    `rivals`: what other starts of a hidden layer came to.
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
    P = P[:k, :k]
    said: tuple[str, ...] = ()
    if any(isinstance(p, Orthogonal) for p in state.penalties):
        P = P + _projection(state, problem)
        said = (_PROJECTED,)
    elif state.layout.neurons:
        said = (_ANCHORED,)
    covariance = P * unit[:, None] * unit
    extra, more = disagreement(state, rivals, covariance)
    return Spread(covariance=covariance + extra, origin=origin, condition=condition, warnings=(*said, *more))


def disagreement(state: State, rivals: Sequence[State], covariance: Array) -> tuple[Array, tuple[str, ...]]:
    """Return what starts that fit about as well disagree by, to be added to the covariance, and what to say of it.

    A hidden layer of few units only comes near to what the plant does: where other starts end with errors as small but
    other A and B, the likelihood alone is too sure of them.

    `state`: the network that was taken; `rivals`: of other starts, with the same weights of physics; `covariance`:
    (n_theta, n_theta), in the units of the model's weights. Returns `extra`: (n_theta, n_theta).
    """
    k = len(state.layout.entries)
    unit, extra = state.layout.unit[:k], np.zeros_like(covariance)
    close = [r for r in rivals if r.score < state.score + _AS_GOOD * state.layout.p and r.layout.neurons]
    if len(close) < 2:
        return extra, ()
    apart = np.array([(r.theta[:k] - state.theta[:k]) * unit for r in close])
    extra[:k, :k] = apart.T @ apart / (len(close) - 1.0)
    ratio = np.sqrt(np.diag(extra)[:k] / np.maximum(np.diag(covariance)[:k], 1e-300))
    if not np.max(ratio) > 1.0:
        return extra, ()
    worst = int(np.argmax(ratio))
    return extra, (
        f"starts of the hidden layer that fit about as well disagree about {state.layout.names[worst]} by "
        f"{ratio[worst]:.1f} of the deviations that the likelihood gives; standard deviations count that. More neurons "
        "or starts, or a smaller swing, settle it",
    )


def _projection(state: State, problem: StateProblem) -> Array:
    """Covariance of what the physical weights take over from the network, because the record is one of many.

    A and B are the best linear approximation over where the record went: (Z'Z)^-1 Z' of the whole right-hand side, of
    which G is what is left over. On another record of the same kind the left-over projects differently.
    """
    layout = state.layout
    rows = {r: [k for k, (row, _) in enumerate(layout.entries) if row == r] for r in layout.rows}
    X, _ = problem.errors(state.vector)
    m = layout.matrices(state.theta)
    scores, slopes, roots = [], [], np.zeros((layout.n_theta, layout.n_theta))
    for x, shot in zip(X, problem.shots, strict=True):
        z = np.hstack([x[:-1], shot.u])
        G = units(z[:, :-1], m.W1, m.b1, layout.anchored)[0] @ m.W2.T
        own = np.zeros((z.shape[0], len(rows), layout.n_theta))
        left = np.empty((z.shape[0], len(rows)))
        for j, at in enumerate(rows.values()):
            own[:, j, at] = z[:, [layout.entries[k][1] for k in at]]
            left[:, j] = layout.rates[j] * G[:, j]
        scores.append(left)
        slopes.append(own)
    for j, at in enumerate(rows.values()):
        Z = np.concatenate([s[:, j, at] for s in slopes])
        roots[np.ix_(at, at)] = np.linalg.pinv(np.linalg.qr(Z, mode="r"))
    slopes = [s @ roots for s in slopes]
    pulls = [np.einsum("tjk,tj->tk", s, e) for s, e in zip(slopes, scores, strict=True)]
    found: Array = roots @ (score_covariance(pulls, _LONG, slopes) * widening(pulls, _LONG)) @ roots.T
    return found


def _sandwich(problem: StateProblem, v: Array) -> Array:
    rows = problem.sample_rows(v)
    scores = [np.einsum("tok,to->tk", r[:, :, :-1], r[:, :, -1]) for r in rows]
    prior = np.zeros((v.size, v.size))
    for p in problem.penalties:
        if isinstance(p, Ridge):  # what keeps the network orthogonal is no knowledge that could be wrong
            J = p.rows(v[: problem.layout.n_theta])[0]
            prior[: J.shape[1], : J.shape[1]] += J.T @ J
    found = sandwich(problem.triangle(v)[:, :-1], scores, prior, [r[:, :, :-1] for r in rows])[0]
    assert found is not None
    return found


def _penalty_rows(problem: StateProblem, v: Array) -> Array:
    """Rows of the penalties at the optimum, where their pull is in balance with the data's."""
    k, out = problem.layout.n_theta, [np.zeros((0, v.size + 1))]
    for p in problem.penalties:
        J, r = p.rows(v[:k])
        out.append(np.hstack([J, np.zeros((r.size, v.size - k)), r[:, None]]))
    return np.concatenate(out)
