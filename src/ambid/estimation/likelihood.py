"""Maximum likelihood over one predictor problem (Ljung 1999, sec. 7.4 and 10.2).

The determinant of the innovation covariance is minimised by damped Gauss-Newton steps with exact Jacobians; each is
that of the least-squares problem weighted by the innovation covariance at the vector where it begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import directions, least_squares, triangle_of
from ambid.estimation.problem import PredictorProblem
from ambid.estimation.search import Status
from ambid.estimation.search import search as damped_search
from ambid.estimation.sensitivity import Linearisation, Workspace, innovations, linearise

NOISE_PRIOR_SD = 5.0  # of a log noise level: keeps a level that the data do not see from running to minus infinity
_MOST = 60  # steps of a search
_SETTLED = 1e-5  # squared length of a step in standard deviations below which a search has converged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Outcome of one likelihood search."""

    problem: PredictorProblem
    vector: Array  # (size,)
    covariance: Array  # (n_outputs, n_outputs), innovation covariance, scaled output units
    # (size + 1, size), compressed Jacobian of the weighted innovations: J^T J is the information matrix of the data
    J: Array
    J_prior: Array  # (n_priors, size)
    r_prior: Array  # (n_priors,), rows and residuals of the priors
    # twice the negative log-likelihood but for constants: n log det(covariance) plus squared prior residuals
    criterion: float
    status: Status
    evaluations: int
    start_s: float = 0.0  # time that finding start values took before this search, s
    work: Workspace | None = None  # scaled data, and the triangle near the optimum, for those who go on from here
    # what a global search did where the ordinary starts failed, see `ambid.bearing.rescue.rescued`
    global_search: Mapping[str, object] | None = None


def prior_rows(problem: PredictorProblem, vector: Array) -> tuple[Array, Array]:
    """Return residual and Jacobian rows of the priors: those of the rig, and a weak one on log noise levels.

    `vector`: (size,). Returns `r`: (n_priors,); `J`: (n_priors, size).
    """
    n = problem.n_physical
    mean, inverse_sd = np.zeros(problem.size), np.zeros(problem.size)
    mean[:n] = problem.prior_mean / problem.magnitude
    inverse_sd[:n] = problem.magnitude / problem.prior_sd
    if problem.noise == "levels":
        mean[problem.slices["noise"]] = problem.noise_center
        inverse_sd[problem.slices["noise"]] = 1 / NOISE_PRIOR_SD
    active = inverse_sd > 0
    return ((vector - mean) * inverse_sd)[active], np.diag(inverse_sd)[active]


def criterion(problem: PredictorProblem, vector: Array, covariance: Array) -> float:
    """Return n log det(covariance) plus the squared prior residuals.

    `vector`: (size,); `covariance`: (n_outputs, n_outputs), scaled output units.
    """
    r, _ = prior_rows(problem, vector)
    return float(problem.n_used * np.linalg.slogdet(covariance)[1] + r @ r)


def evaluate(problem: PredictorProblem, vector: Array, work: Workspace | None = None) -> tuple[float, Array | None]:
    """Return the criterion and the innovation covariance at a vector, without a Jacobian.

    `vector`: (size,). Returns `criterion`: infinite where there is no predictor; `covariance`: (n_outputs, n_outputs),
    or None.
    """
    e = innovations(problem, vector, work)
    if e is None:
        return np.inf, None
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = e.T @ e / e.shape[0]
    if not np.all(np.isfinite(covariance)) or np.linalg.slogdet(covariance)[0] <= 0:
        return np.inf, None
    return criterion(problem, vector, covariance), covariance


def weight_of(covariance: Array) -> Array:
    """Return lower triangular W with W^T W = covariance^-1.

    `covariance`: (n, n), positive definite. Returns (n, n).
    """
    return np.linalg.solve(np.linalg.cholesky(covariance), np.eye(covariance.shape[0]))


def workspace_near(fit: Fit, problem: PredictorProblem) -> Workspace:
    """Return the workspace of a problem that shares most numbers with a fit, begun with its triangle."""
    work = fit.work.of(problem) if fit.work is not None else Workspace(problem)
    if work.turn is None:
        old, columns, places = fit.problem, list[int](), list[int]()
        for group, own in old.slices.items():
            there = problem.slices[group]
            shared = min(own.stop - own.start, there.stop - there.start)
            if group != "noise" or old.noise == problem.noise:
                columns += range(own.start, own.start + shared)
                places += range(there.start, there.start + shared)
        triangle = np.eye(problem.size)
        triangle[np.ix_(places, places)] = triangle_of([fit.J[:, columns]])
        work.near(triangle)
    return work


def score_statistic(fit: Fit, problem: PredictorProblem, vector: Array) -> float:
    """Return the fall of the criterion that freeing all numbers of `problem` promises to second order.

    The score (Lagrange multiplier) test: one evaluation decides whether an extension is worth a search.

    `fit`: of the smaller problem; `problem`: the extended one; `vector`: (size,), the fit's numbers written in it.
    Returns chi-squared with as many degrees of freedom as numbers were added, if they are not needed; 0 where
    undefined.
    """
    at = linearise(problem, vector, weight_of(fit.covariance), workspace_near(fit, problem))
    if at is None:
        return 0.0
    r, J = prior_rows(problem, vector)
    return directions(np.vstack([at.J, J])).explain(np.concatenate([at.r, r]))


def freed(fit: Fit, name: str) -> tuple[float, float]:
    """Return what the data say of a parameter that was fixed, to second order.

    `name`: one of the problem's known parameters. Returns `statistic`: fall of the criterion that freeing it promises:
    chi-squared with one degree of freedom if the fixed value is right; `value`: where one Newton step puts it, SI:
    right in direction, in size only near the fixed value.
    """
    old = fit.problem
    value = old.known[name]
    reference = old.model.references(old.parameters(fit.vector)).get(name, 0.0)
    size = max(abs(value), reference) or 1.0
    problem = replace(
        old,
        estimated=(*old.estimated, name),
        known={k: v for k, v in old.known.items() if k != name},
        magnitude=np.append(old.magnitude, size),
        prior_mean=np.append(old.prior_mean, 0.0),
        prior_sd=np.append(old.prior_sd, np.inf),
    )
    n = old.n_physical
    vector = np.insert(fit.vector, n, value / size)
    at = linearise(problem, vector, weight_of(fit.covariance), workspace_near(fit, problem))
    if at is None:
        return 0.0, value
    r, rows = prior_rows(problem, vector)
    found, residual = directions(np.vstack([at.J, rows])), np.concatenate([at.r, r])
    if not found.seen.all():  # the data cannot tell it from the others
        return 0.0, value
    return found.explain(residual), value - float(found.solve(residual)[n]) * size


def with_linear_part(problem: PredictorProblem, vector: Array, work: Workspace) -> Array:
    """Return a copy with the offsets and the initial state that fit best; they enter linearly, so one solve finds
    them.

    `vector`: (size,). Returns (size,), unchanged where there is no predictor at `vector`.
    """
    _, covariance = evaluate(problem, vector, work)
    at = None if covariance is None else linearise(problem, vector, weight_of(covariance), work)
    if at is None:
        return vector.copy()
    out, linear = vector.copy(), slice(problem.slices["offset"].start, problem.size)
    out[linear] -= least_squares(at.J[:, linear], at.r)
    return out


def search(
    problem: PredictorProblem,
    start: Array,
    *,
    most: int = _MOST,
    settled: float = _SETTLED,
    tick: Callable[[], None] | None = None,
    work: Workspace | None = None,
) -> Fit:
    """Minimise the likelihood criterion from `start`.

    `start`: (size,); `most`: steps, at most; `settled`: squared length of a step in standard deviations
    below which it has converged; `tick`: called after each evaluation (progress, interruption); `work`: of
    this problem, or of one with the same data. Returns with status ``"failed"`` where there is no predictor at `start`.
    """
    work = Workspace(problem) if work is None else work.of(problem)
    vector = with_linear_part(problem, start, work)
    target = _Likelihood(problem, work, tick)
    found = damped_search(
        target,
        vector,
        most=most,
        tolerance=0.0,
        settled=settled,
        wanted=slice(0, problem.n_physical or None),
        damping=1e-4,
    )
    at = target.linearisation(found.theta) if np.isfinite(found.cost) else None
    if at is None:
        return _failed(problem, start)
    r_prior, J_prior = prior_rows(problem, found.theta)
    return Fit(
        problem=problem,
        vector=found.theta,
        covariance=at.covariance,
        J=at.J,
        J_prior=J_prior,
        r_prior=r_prior,
        criterion=found.cost,
        status=found.status,
        evaluations=target.evaluations,
        work=work,
    )


def _failed(problem: PredictorProblem, start: Array) -> Fit:
    n_y = problem.y.shape[1]
    return Fit(
        problem=problem, vector=start, covariance=np.eye(n_y), J=np.zeros((problem.size + 1, problem.size)),
        J_prior=np.zeros((0, problem.size)), r_prior=np.zeros(0), criterion=np.inf, status="failed", evaluations=1,
    )  # fmt: skip


class _Likelihood:
    """The criterion n log det S + priors and its triangle: J'J is the information matrix, -J'r half the gradient."""

    def __init__(self, problem: PredictorProblem, work: Workspace, tick: Callable[[], None] | None) -> None:
        self.problem, self.work, self.tick = problem, work, tick
        self.evaluations = 0
        self._at = np.full(problem.size, np.nan)  # where `_covariance` belongs to
        self._covariance: Array | None = None
        self._linear: tuple[Array, Linearisation | None] = (self._at, None)

    def cost(self, vector: Array) -> float:
        self.evaluations += 1
        if self.tick is not None:
            self.tick()
        value, covariance = evaluate(self.problem, vector, self.work)
        self._at, self._covariance = vector.copy(), covariance
        return value

    def triangle(self, vector: Array) -> Array:
        at = self.linearisation(vector)
        if at is None:
            return np.full((1, vector.size + 1), np.inf)
        r, J = prior_rows(self.problem, vector)
        return np.vstack([np.column_stack([at.J, -at.r]), np.column_stack([J, -r])])

    def linearisation(self, vector: Array) -> Linearisation | None:
        """Innovations and Jacobian, weighted by the innovation covariance at the same vector; made once for each."""
        if not np.array_equal(self._linear[0], vector):
            if not np.array_equal(self._at, vector):
                self.cost(vector)
            at = None
            if self._covariance is not None:
                at = linearise(self.problem, vector, weight_of(self._covariance), self.work)
            self._linear = (vector.copy(), at)
        return self._linear[1]
