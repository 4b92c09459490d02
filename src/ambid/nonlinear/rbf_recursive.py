"""Training sample by sample: recursive Gauss-Newton, and steepest descent as in the thesis, each with a bounded rate.

Gauss-Newton: R <- R + mu (phi phi' - R), w <- w + mu R^-1 phi e, phi the slope of the prediction by all that is
trained, R kept as its triangle S: [S | 0] and [sqrt(mu) phi | sqrt(mu) e] are rotated to [S+ | b], and the step is
S+^-1 b, so that the condition of R, the square of that of S, never enters. With the gain
mu = 1/(t + 1), R_0 the prior's and weights alone trained it is recursive least squares, and ends at the batch solution.
Descent: w <- w + rate phi e, centres and widths likewise (thesis eqs 3.18-3.22; 3.22 is printed as W <- W eta e Phi',
its plus sign lost).

Bounded: one sample's error after a descent step is (1 - rate |phi|^2) e, so that it grows where the rate is over
2/lambda_max, lambda_max = |phi|^2; the rate is kept at 1/|phi|^2 at most, as in NLMS. In Gauss-Newton the new sample
enters R before the step instead of after it, which divides the step by 1 - mu + mu phi' R^-1 phi: the error after it is
(1 - mu phi' R^-1 phi) e with a factor between 0 and 1. Exact for the weights, to first order for centres and widths.
"""

from __future__ import annotations

from itertools import pairwise
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.estimation.progress import Tick
from ambid.nonlinear.blocks import UNITS
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.lagged_problem import LaggedProblem
from ambid.nonlinear.rbf_network import RbfFunction

_CHUNKS = 8  # of a pass, after each of which the error is looked at


GAUSS_NEWTON = "recursive Gauss-Newton"
DESCENT = "steepest descent"


class Recursion:
    """One of the two trainings, `GAUSS_NEWTON` or `DESCENT`, over the rows of a problem, so many passes long.

    `rate` is that of the steps of the descent, or the least gain mu of Gauss-Newton. `theta` (n_theta,) is as far as it
    has come, `seconds` and `errors` are its learning curve.
    """

    def __init__(
        self, problem: LaggedProblem, theta: Array, *, method: str, rate: float, bounded: bool, passes: int
    ) -> None:
        assert isinstance(problem.function, RbfFunction)
        self.problem, self.function, self.theta = problem, problem.function, theta.copy()
        self.method, self.rate, self.bounded, self.passes = method, rate, bounded, passes
        self.n_active = int(np.count_nonzero(problem.live))
        rows = problem.rows()
        self.z = np.ascontiguousarray(np.concatenate([r.x for r in rows]))
        self.y = np.ascontiguousarray(np.concatenate([r.y for r in rows]))
        self.x = np.ascontiguousarray(self.z @ self.function.metric.T)
        self.seconds: list[float] = [0.0]
        self.errors: list[float] = [self._rms()]

    def run(self, tick: Tick | None) -> None:
        """Go through all samples as often as told."""
        S, N = np.diag(self.problem.precision[: self.n_active]), self.z.shape[0]
        self._stretch(slice(0, 0), 0, S)  # loads the compiled loop, which is no part of the training
        began = perf_counter()
        edges = np.unique(np.linspace(0, N, _CHUNKS + 1).astype(np.int64))
        for k in range(self.passes):
            for first, last in pairwise(edges.tolist()):
                if tick is not None:
                    tick(self.method, (k + first / N) / self.passes)
                at = self._stretch(slice(first, last), k * N + first, S)
                if at >= 0 or not np.all(np.isfinite(self.theta)):
                    raise FloatingPointError(
                        f"{self.method} diverged in pass {k + 1} near sample {first + max(at, 0)}: "
                        "say bounded = 1, or a lower rate"
                    )
                self.seconds.append(perf_counter() - began)
                self.errors.append(self._rms())

    def curve(self) -> LearningCurve:
        """Return the learning curve so far."""
        bound = "bounded rate" if self.bounded else "rate not bounded"
        return LearningCurve(
            method=f"{self.method}, {bound}", seconds=np.array(self.seconds), training=np.array(self.errors)
        )

    def _stretch(self, part: slice, done: int, S: Array) -> int:
        from ambid.nonlinear.rbf_kernels import descent_pass, recursive_pass

        p, of, n, N = self.problem, self.function, self.n_active, self.z.shape[0]
        signals = self.z[part], self.x[part], self.y[part]
        kind = UNITS.index(of.unit_name), int(of.linear), of.neurons
        if self.method == DESCENT:
            return int(descent_pass(*signals, self.rate, int(self.bounded), *kind, n, self.theta))
        t = done + np.arange(part.stop - part.start) + 1.0
        if n > of.n_weights:
            # slopes change on the way: for half of the passes the memory is as long as the record, so that old ones
            # are forgotten; then it grows again, and what is left of the noise is averaged out
            t = np.minimum(t, N) + np.maximum(t - N * max(self.passes // 2, 1), 0.0)
        gain = np.maximum(1.0 / (t + 1.0), self.rate)
        prior = slice(0, n if done >= N else 0)  # in the first pass it is in the triangle already
        mean, precision = p.mean[prior], p.precision[prior] * np.sqrt(n / N)
        weight = np.ascontiguousarray(np.diag(p.weight))
        return int(
            recursive_pass(*signals, weight, gain, int(self.bounded), *kind, mean, precision, done, self.theta, S)
        )

    def _rms(self) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            off = [r.y - self.function.values(self.theta, r) for r in self.problem.rows()]
            return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def left_to_gain(problem: LaggedProblem, theta: Array) -> float:
    """Return by how much one batch Gauss-Newton step would still lower the sum of squares.

    In squares of unit variance it is the squared distance from the optimum, in standard deviations of what is trained.
    """
    R = problem.triangle(theta)
    if not np.all(np.isfinite(R)):
        return np.inf
    Q, _ = np.linalg.qr(R[:, :-1])
    return float(np.sum((Q.T @ R[:, -1]) ** 2))
