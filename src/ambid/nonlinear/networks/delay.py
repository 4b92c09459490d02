"""Whole samples by which inputs act late: a first guess from long linear fits, then the errors of short trainings.

Linear fits on past outputs and on a few inputs behind each delay; where inputs act weakly within a sample (fast
sampling, much noise) they cannot tell neighbours apart, and the network itself is trained a little way beside them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick, guessed
from ambid.estimation.search import search
from ambid.nonlinear.networks.nn_train import State
from ambid.nonlinear.networks.segments import largest_pole
from ambid.nonlinear.records import Scaled

LARGEST = 20  # samples that are looked for
_HISTORY = 12  # past outputs
_TAPS = 3  # inputs behind a delay
_MOST = 5000  # samples that the first guess looks at
_SHORT = 5  # iterations of a short training
_WORTH = 2.0  # gain of the log likelihood, times two, for which a neighbour is taken
_TRAINED = 3000  # samples that they look at


def late(data: Scaled, delay: int) -> Scaled:
    """Put each output beside the input that acts at its time.

    `delay`: samples.
    """
    if not delay:
        return data
    return replace(data, parts=tuple((y[delay:], u[:-delay]) for y, u in data.parts))


def guessed_delay(data: Scaled) -> int:
    """Return a first guess: what two readings of a long linear fit on past outputs and inputs agree on at least.

    The delay behind which a few inputs explain most, and the number of leading inputs that Bayes' criterion does
    without.

    Returns 0 where inputs explain nothing.
    """
    m, p = data.u_level.size, data.y_level.size
    share = _MOST // len(data.parts)
    parts = [(y[-share:], u[-share:]) for y, u in data.parts]
    n, shortest = sum(y.shape[0] for y, _ in parts), min(y.shape[0] for y, _ in parts)
    history = min(_HISTORY, n // (8 * (m + p)))
    largest = min(LARGEST, n // (5 * max(m, 1)) - 2 * history, shortest - history - 10)
    if not m or history < _TAPS or largest < 1:
        return 0
    lag, blocks = history + largest, []
    for y, u in parts:
        k = y.shape[0]
        past = [y[lag - j : k - j] for j in range(1, history + 1)]
        inputs = [u[lag - j : k - j] for j in range(1, lag + 1)]
        blocks.append(np.hstack([np.ones((k - lag, 1)), *past, *inputs, y[lag:]]))
    R, n = triangle_of(blocks), sum(b.shape[0] for b in blocks)
    R = R[1 + history * p :, 1 + history * p :]

    n_all = float(n)

    def error(first: int, last: int) -> float:
        """Log determinant of what inputs of these lags leave, times the samples."""
        columns = np.r_[(first - 1) * m : (last - 1) * m, R.shape[1] - p : R.shape[1]]
        left = np.asarray(np.linalg.qr(R[:, columns], mode="r"))[(last - first) * m :, -p:]
        found = np.linalg.slogdet(left.T @ left / n + 1e-14 * np.eye(p))[1]
        return n_all * float(found)

    price = m * p * float(np.log(n))
    if error(1, 1) - error(1, lag + 1) < lag * price:
        return 0
    few = int(np.argmin([error(k + 1, k + 1 + _TAPS) for k in range(largest + 1)]))
    leading = int(np.argmin([error(k + 1, lag + 1) - k * price for k in range(largest + 1)]))
    return min(few, leading)


def found_delay(
    state: State, whole: Scaled, delay: int, tick: Tick | None, *, rather_late: bool = False
) -> tuple[int, dict[int, float]]:
    """Go from a guess to a neighbour as long as a short training ends with smaller errors there.

    `state`: a first network; `whole`: not yet put off; `delay`: of `state`. Returns `errors`: logarithm of the
    determinant of the errors' covariance after a short training, by delay.
    """
    share = _TRAINED // len(whole.parts)
    cut = replace(whole, parts=tuple((y[:share], u[:share]) for y, u in whole.parts))
    n = sum(y.shape[0] for y, _ in cut.parts)
    largest = min(LARGEST, min(y.shape[0] for y, _ in cut.parts) // 4) if whole.u_level.size else 0
    errors = dict[int, float]()

    def error(trial: int) -> float:
        nonlocal state
        if trial not in errors:
            after = _after_short(state, late(cut, trial))
            errors[trial] = np.inf if after is None else after.score
            if after is not None and errors[trial] <= min(errors.values()):
                state = after
            if tick is not None:
                tick("delay", guessed(len(errors), 3.0))
        return errors[trial]

    for step in (1, -1):
        worth = -step * float(np.log(n)) if rather_late else _WORTH
        while 0 <= delay + step <= largest and n * (error(delay) - error(delay + step)) > worth:
            delay += step
    return delay, {k: v for k, v in sorted(errors.items()) if np.isfinite(v)}


def _after_short(state: State, data: Scaled) -> State | None:
    at = State.of(state.layout, state.theta, data)
    moved = at.moved(at.problem(data), at.vector)
    if moved is None:
        return None
    problem = replace(moved.problem(data), farthest=max(1.0, 1.001 * largest_pole(moved.layout, moved.theta)))
    found = search(problem, moved.vector, stage="", most=_SHORT, tolerance=0.0, damping=1e-6)
    return moved.moved(problem, found.theta)
