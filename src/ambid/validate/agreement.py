"""Do the parameters stay the same when the data are used differently?

Under the right model the estimate does not depend on how far ahead the predictor has to look. Here the same record is
fitted again with every second, and every fourth, output only (all inputs act; nothing is resampled), with the predictor
gain that follows from the fit, and the parameters are compared: the specification test of Hausman (1978). Where they
move by more than chance allows, the model is wrong in a way that the residuals of one step may hide, and the difference
says how much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.greybox import carry
from ambid.estimation.likelihood import Fit, search, workspace_near
from ambid.estimation.linear import directions
from ambid.estimation.predictor import assemble

STRIDES = (2, 4)
MOST = 4.0  # shift in its standard deviations that chance allows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """Estimates from a record used in other ways."""

    names: tuple[str, ...]  # estimated physical parameters
    shift: Array  # (n_refits, n), SI, refitted value minus estimate
    # (n_refits, n), SI, standard deviation of the shift under the right model: the refit uses less of the data, so
    # that its variance less that of the fit is that of their difference (Hausman 1978)
    sd: Array
    strides: tuple[int, ...]  # of the refits that converged

    @property
    def largest(self) -> float:
        """Largest shift in standard deviations; 0 where no refit converged."""
        return float(np.max(np.abs(self.shift / self.sd), initial=0.0))

    @property
    def passed(self) -> bool:
        """Whether there was a refit, and every shift is within 4 standard deviations."""
        return bool(self.strides) and self.largest < MOST

    def disagreement(self) -> Array:
        """Return how far the parameters move in the refit in which they move most.

        Returns (n,), SI, zeros where no refit converged.
        """
        if not self.strides:
            return np.zeros(len(self.names))
        return np.asarray(self.shift[np.argmax(np.max(np.abs(self.shift / self.sd), axis=1))])


def agreement(fit: Fit) -> Agreement:
    """Refit a record with every second and every fourth output.

    `fit`: not failed. Returns refits that do not converge are left out.
    """
    problem = fit.problem
    size, n = problem.magnitude, problem.n_physical
    shifts, spreads, strides = [], [], []
    own = directions(np.vstack([fit.J, fit.J_prior])).inverse()[:n, :n]
    for stride in STRIDES:
        sparse = replace(problem, stride=stride, noise="given", gain=_sparse_gain(fit, stride))
        start = carry(fit, sparse)
        again = search(sparse, start, most=20, work=workspace_near(fit, sparse))
        if again.status != "converged":
            continue
        spread = directions(np.vstack([again.J, again.J_prior])).inverse()[:n, :n]
        shifts.append((again.vector[:n] - fit.vector[:n]) * size)
        # at least a quarter of its variance: the difference of two nearly equal variances is not known better
        spreads.append(np.sqrt(np.maximum(np.diag(spread - own), 0.25 * np.diag(spread))) * size)
        strides.append(stride)
    return Agreement(
        names=problem.estimated,
        shift=np.array(shifts).reshape(-1, n),
        sd=np.array(spreads).reshape(-1, n),
        strides=tuple(strides),
    )


def _sparse_gain(fit: Fit, stride: int) -> Array:
    """Predictor gain for every stride-th output, from the innovations form of the fit: x+ = A x + K e, y = C x + e."""
    from scipy.linalg import solve_discrete_are

    predictor = assemble(fit.problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    A, C, K, S = predictor.A, predictor.C, predictor.gain, fit.covariance
    if not np.any(K):  # sensor noise alone: no state is ever corrected
        return K
    powers = [np.linalg.matrix_power(A, stride - 1 - j) for j in range(stride)]
    Q = sum((p @ K @ S @ K.T @ p.T for p in powers), np.zeros_like(A))
    cross, whole = powers[0] @ K @ S, A @ powers[0]
    P = solve_discrete_are(whole.T, C.T, Q, S, s=cross)
    return np.asarray(np.linalg.solve(C @ P @ C.T + S, (whole @ P @ C.T + cross).T).T)
