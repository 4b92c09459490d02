"""Multiple shooting for plants whose free run does not stay: errors over short shots, jumps between them penalised.

The penalties' weights are found on the way: each is one over the jumps' deviation, which process noise makes. A
predictor gain is put on at the end, because without one the predictor of an unstable plant runs away.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, part_of
from ambid.estimation.search import search
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.networks.nn_train import State, Trained, added_gain, relative_error
from ambid.nonlinear.networks.segments import StateProblem
from ambid.nonlinear.records import Scaled

_ROUNDS = 4  # of weighting: sizes of errors and jumps are known only afterwards


def shooting(state: State, data: Scaled, length: int, *, iterations: int, tick: Tick | None) -> Trained:
    """Search over shots with continuity penalties, whose weights are found on the way (multiple shooting).

    `length`: samples of a shot. Returns a network with gain again: without one, the predictor of an unstable plant does
    not stay.
    """
    problem = state.problem(data)
    X = np.concatenate([x[:-1] for x in problem.errors(state.vector)[0]])
    plain = state.without_gain()
    short = plain.problem(data, length)
    at = np.cumsum([0, *(s.y.shape[0] for s in short.shots)])[:-1]
    v = np.concatenate([plain.theta, X[at].ravel()])
    seconds, errors, offset, jump, converged = [], [], 0.0, np.full(plain.layout.n, 10.0), False
    for k in range(_ROUNDS):
        short = plain.problem(data, length, jump)
        own = part_of(tick, k / _ROUNDS, (k + 1) / _ROUNDS)
        found = search(short, v, stage="multiple shooting", most=iterations, tolerance=1e-6, tick=own)
        v, converged = found.theta, found.converged
        seconds += [offset + t for t in found.seconds]
        errors += [relative_error(c, plain) for c in found.costs]
        offset = seconds[-1]
        jump, plain = _reweighted(plain, short, v)
    theta, x0 = short.split(v)
    first = x0[[k for k, s in enumerate(short.shots) if not s.goes_on]]
    again = added_gain(replace(plain, theta=theta, x0=first), data, state.K)
    if again is None:
        return None
    curve = LearningCurve(
        method="Levenberg-Marquardt, multiple shooting", seconds=np.array(seconds), training=np.array(errors)
    )
    return again, curve, converged


def _reweighted(state: State, problem: StateProblem, v: Array) -> tuple[Array, State]:
    """Weights of jumps, and the errors' covariance, as they come out."""
    X, E = problem.errors(v)
    _, x0 = problem.split(v)
    gaps = [x0[k] - X[k - 1][-1] for k in range(1, len(X)) if problem.shots[k].goes_on]
    e = np.concatenate(E)
    size = np.sqrt(np.mean(np.square(gaps), axis=0)) if gaps else np.ones(state.layout.n)
    return 1.0 / np.maximum(size, 1e-6), replace(state, noise=e.T @ e / e.shape[0])
