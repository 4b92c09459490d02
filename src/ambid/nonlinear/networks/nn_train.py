"""The stages of training a state-space network: weights and first states by Levenberg-Marquardt, then gain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick, part_of
from ambid.estimation.search import search
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.networks.layout import Layout
from ambid.nonlinear.networks.residual import Orthogonal, Ridge
from ambid.nonlinear.networks.segments import Penalty, StateProblem, largest_pole, shots
from ambid.nonlinear.networks.start import carried_to_continuous, widened
from ambid.nonlinear.networks.thesis_training import trained_one_step
from ambid.nonlinear.records import Scaled

Trained = tuple["State", LearningCurve, bool] | None

_ROUNDS = 3  # of weighting: the errors' covariance is known only afterwards
_SHARES = (0.0, 0.6, 0.85, 1.0)  # of the time that is over before each round
_ENOUGH = 1e-3  # gain that ends a search: a step of 0.03 standard deviations
_LAGS = 20  # of the test for whiteness
_LEAST = 1e-7  # deviation of errors, in that of the outputs: less is rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """A network on its way."""

    layout: Layout
    theta: Array  # (n_theta,), scaled
    x0: Array  # (n_records, n), scaled, first states
    noise: Array  # (n_outputs, n_outputs), scaled, covariance of its errors
    n_rows: int  # samples in all
    penalties: tuple[Penalty, ...] = ()

    @classmethod
    def of(cls, layout: Layout, theta: Array, data: Scaled) -> State:
        """Return a network that starts each record from its first outputs.

        `theta`: (n_theta,).
        """
        x0 = np.zeros((len(data.parts), layout.n))
        for k, (y, _) in enumerate(data.parts):
            x0[k, layout.head_table] = y[0]
        n = sum(y.shape[0] for y, _ in data.parts)
        return cls(layout=layout, theta=theta, x0=x0, noise=np.eye(layout.p), n_rows=n)

    @property
    def K(self) -> Array:
        """Gain, shape (n, n_outputs)."""
        return self.layout.matrices(self.theta).K

    @property
    def score(self) -> float:
        """Logarithm of the determinant of the errors' covariance: what maximum likelihood makes small."""
        return float(np.linalg.slogdet(self.noise + _LEAST**2 * np.eye(self.layout.p))[1])

    @property
    def bic(self) -> float:
        """Bayes' criterion."""
        return self.n_rows * self.score + self.layout.n_theta * float(np.log(self.n_rows))

    def simulates(self, data: Scaled) -> bool:
        """Say whether it runs freely with errors no larger than twice the outputs' deviations."""
        at = self.moved(self.problem(data), self.vector)
        return at is not None and bool(np.all(np.diag(at.noise) < 4.0))

    @property
    def stable(self) -> bool:
        """Whether no pole lies outside the unit circle, integrators allowed."""
        return bool(np.max(np.abs(np.linalg.eigvals(self.layout.matrices(self.theta).A))) < 1.0 + 1e-4)

    def without_gain(self) -> State:
        """Return the same network without gain."""
        layout, theta = widened(self.layout, self.theta, gain=False)
        return replace(self, layout=layout, theta=theta)

    def problem(self, data: Scaled, length: int | None = None, jump: Array | None = None) -> StateProblem:
        """Return the problem whose errors have unit covariance here.

        `length`: samples of a shot; `jump`: (n,), one over the deviation of jumps between shots.
        """
        noise = self.noise + _LEAST**2 * np.eye(self.layout.p)
        return StateProblem(
            layout=self.layout,
            shots=shots(data.parts, length),
            weight=np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(noise)).T),
            jump=np.ones(self.layout.n) if jump is None else jump,
            penalties=self.penalties,
        )

    def moved(self, problem: StateProblem, v: Array) -> State | None:
        """Return the network at another vector, with the covariance of its errors; None where it diverges.

        `problem`: over whole records; `v`: (n_theta + n_records n,).
        """
        theta, x0 = problem.split(v)
        with np.errstate(over="ignore", invalid="ignore"):
            e = np.concatenate(problem.errors(v)[1])
            noise = e.T @ e / e.shape[0]
        return replace(self, theta=theta, x0=x0, noise=noise) if np.all(np.isfinite(noise)) else None

    @property
    def vector(self) -> Array:
        """Weights and first states, shape (n_theta + n_records n,)."""
        return np.concatenate([self.theta, self.x0.ravel()])


class Interrupted(KeyboardInterrupt):
    """An interruption in the middle of a search.

    `state`: the best network of that search.
    """

    def __init__(self, state: State) -> None:
        super().__init__()
        self.state = state


def added_gain(state: State, data: Scaled, K: Array) -> State | None:
    """Return the network with a predictor gain; None if it diverges on the data with every try.

    `K`: (n, n_outputs), scaled.
    """
    layout, theta = widened(state.layout, state.theta, gain=True)
    penalties = tuple(replace(p, layout=layout) for p in state.penalties if isinstance(p, (Ridge, Orthogonal)))
    wide = replace(state, layout=layout, theta=theta, penalties=penalties)
    k = len(layout.entries)
    heads = np.zeros((layout.n, layout.p))
    heads[layout.head_table, range(layout.p)] = 0.5
    best: State | None = None
    for gain in (K, 0.5 * K, heads, 0.0 * K):
        theta = wide.theta.copy()
        theta[k : layout.n_directions] = gain.ravel()
        problem = wide.problem(data)
        tried = wide.moved(problem, np.concatenate([theta, wide.x0.ravel()]))
        if tried is not None and (best is None or tried.score < best.score):
            best = tried
    return best


def trained(state: State, data: Scaled, *, stage: str, iterations: int, tick: Tick | None) -> Trained:
    """Search for weights and first states, over whole records; None where the start diverges."""
    at = state.moved(state.problem(data), state.vector)
    if at is None:
        return None
    seconds, errors, offset, converged = [], [], 0.0, False
    damping = 1e-3 if state.layout.neurons else 1e-9  # physics alone begins near: Gauss-Newton at once
    for k in range(_ROUNDS):
        before, problem, best = at.score, at.problem(data), [at.vector]
        if at.layout.gain:  # a start that is not stable may stay so
            problem = replace(problem, farthest=max(1.0, largest_pole(at.layout, at.theta) * (1.0 + 1e-9)))
        try:
            found = search(
                problem, at.vector, stage=stage, most=iterations, tolerance=0.0, enough=_ENOUGH * 100.0 ** (k == 0),
                damping=damping, tick=part_of(tick, *_SHARES[k : k + 2]), keep=best.append,
            )  # fmt: skip
        except KeyboardInterrupt as stop:
            raise Interrupted(at.moved(problem, best[-1]) or at) from stop
        seconds += [offset + t for t in found.seconds]
        errors += [relative_error(c, at) for c in found.costs]
        offset = seconds[-1]
        after = at.moved(problem, found.theta)
        converged = found.converged
        if after is None:
            break
        at = after
        if abs(before - at.score) < 0.02:
            break
    what = "prediction" if state.layout.gain else "simulation"
    curve = LearningCurve(
        method=f"Levenberg-Marquardt, {what} errors", seconds=np.array(seconds), training=np.array(errors)
    )
    return at, curve, converged


def relative_error(cost: float, at: State) -> float:
    """Return the root mean square error in deviations of the outputs.

    `cost`: sum of squares of errors of unit variance; `at`: whose errors' covariance they were weighted by.
    """
    size = np.exp(at.score / at.layout.p / 2)
    return float(np.sqrt(cost / (at.n_rows * at.layout.p)) * size)


def descended(state: State, data: Scaled, iterations: int) -> tuple[tuple[LearningCurve, ...], dict[str, object]]:
    """Train one-step errors of the network's states as the thesis does, and by Gauss-Newton, from weights of zero.

    `state`: its predicted states are trained on; measured ones in their place where there are. Returns `entries`: a and
    B in SI, by training; continuous in the form ``one-axis``.
    """
    problem = state.problem(data)
    X = [x[:-1] for x in problem.errors(state.vector)[0]]
    if state.layout.p == state.layout.n:
        X = [y[:, np.argsort(state.layout.heads)] for y, _ in data.parts]
    slow, fast, curves = trained_one_step(X, [s.u for s in problem.shots], iterations)
    found: dict[str, object] = {}
    n, size = state.layout.n, np.array(state.layout.scale)
    for name, M in (("steepest descent", slow), ("Gauss-Newton", fast)):
        A, B = M[:, :n], M[:, n:-1]
        if state.layout.form == "one-axis":
            both = carried_to_continuous(state.layout, A, B)
        else:
            both = A * size[:n, None] / size[:n], B * size[:n, None] / size[n:]
        found[name] = None if both is None else {"A": both[0].tolist(), "B": both[1].tolist()}
    return curves, found


def white(state: State, data: Scaled) -> bool:
    """Say whether the errors are white (Ljung and Box 1978, all outputs together)."""
    from scipy.stats import chi2

    problem = state.problem(data)
    total, p = 0.0, state.layout.p
    for e in problem.errors(state.vector)[1]:
        w = (e - e.mean(axis=0)) @ problem.weight
        n = w.shape[0]
        for lag in range(1, _LAGS + 1):
            r = w[lag:].T @ w[:-lag] / n
            total += n * (n + 2) * float(np.sum(r**2)) / (n - lag)
    freedom = _LAGS * p**2 * len(data.parts)
    return total < float(chi2.ppf(0.999, freedom))
