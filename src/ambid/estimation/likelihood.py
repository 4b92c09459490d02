"""Maximum likelihood over one predictor problem (Ljung 1999, sec. 7.4 and 10.2).

The determinant of the innovation covariance is minimised as a sequence of weighted least-squares problems, each given
to SciPy's trust-region optimiser with exact Jacobians; the weights are the innovation covariance of the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import BLIND, directions, least_squares, triangle_of
from ambid.estimation.problem import PredictorProblem
from ambid.estimation.search import Status
from ambid.estimation.sensitivity import Workspace, innovations, linearise

NOISE_PRIOR_SD = 5.0  # of a log noise level: keeps a level that the data do not see from running to minus infinity
_ROUNDS = 20  # of reweighting by the innovation covariance
_EVALUATIONS = 10  # of the residual in one round
_SETTLED = 0.03  # Newton step of every physical parameter, in standard deviations, below which a search has converged
_FLAT = 0.1  # fall of the criterion in one round below which a search has converged; a needless number earns one


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


def _step_left(J: Array, r: Array, n_physical: int) -> float:
    """Largest Newton step of a physical parameter (of any number, where there are none), in standard deviations."""
    found = directions(J)
    half = found.root(BLIND)
    ratio = np.abs(half @ (found.U.T @ r)) / np.linalg.norm(half, axis=1)
    return float(np.max(ratio[: n_physical or None]))


def search(
    problem: PredictorProblem,
    start: Array,
    *,
    rounds: int = _ROUNDS,
    evaluations: int = _EVALUATIONS,
    tick: Callable[[], None] | None = None,
    work: Workspace | None = None,
) -> Fit:
    """Minimise the likelihood criterion from `start`.

    `start`: (size,); `rounds`, `evaluations`: bounds on reweightings, and on residual evaluations in each; `tick`:
    called after each evaluation (progress, interruption); `work`: of this problem, or of one with the same data.
    Returns with status ``"failed"`` where there is no predictor at `start`.
    """
    from scipy.optimize import least_squares

    work = Workspace(problem) if work is None else work.of(problem)
    vector = with_linear_part(problem, start, work)
    value, covariance = evaluate(problem, vector, work)
    if covariance is None:
        return _failed(problem, start)
    target = _Weighted(problem, work, tick)
    status: Status = "stalled"
    count = 1
    for _ in range(rounds):
        target.reweigh(weight_of(covariance))
        if not np.all(np.isfinite(target.residual(vector))):  # innovations exist, their sensitivities overflow
            return _failed(problem, start)
        # the cost is about n_used * n_outputs / 2, and a change of 1/2 is one standard deviation
        small = 4e-3 / (problem.n_used * problem.y.shape[1])
        found = least_squares(
            target.residual, vector, jac=target.jacobian, method="trf", x_scale="jac",
            ftol=small, xtol=1e-12, gtol=1e-14, max_nfev=evaluations,
        )  # fmt: skip
        count += found.nfev
        before, vector = value, found.x
        J = target.jacobian(vector)
        r, covariance = target.r, target.covariance
        value = criterion(problem, vector, covariance)
        # the covariance moved since r was weighted: that changes the step only to second order
        if before - value < _FLAT and _step_left(J, r, problem.n_physical) < _SETTLED:
            status = "converged"
            break
    at = linearise(problem, vector, weight_of(covariance), work)
    if at is None:
        return _failed(problem, start)
    r_prior, J_prior = prior_rows(problem, vector)
    return Fit(
        problem=problem,
        vector=vector,
        covariance=covariance,
        J=at.J,
        J_prior=J_prior,
        r_prior=r_prior,
        criterion=value,
        status=status,
        evaluations=count,
        work=work,
    )


def _failed(problem: PredictorProblem, start: Array) -> Fit:
    n_y = problem.y.shape[1]
    return Fit(
        problem=problem, vector=start, covariance=np.eye(n_y), J=np.zeros((problem.size + 1, problem.size)),
        J_prior=np.zeros((0, problem.size)), r_prior=np.zeros(0), criterion=np.inf, status="failed", evaluations=1,
    )  # fmt: skip


class _Weighted:
    """Residual and Jacobian as SciPy's optimiser asks for them: one evaluation serves both."""

    def __init__(self, problem: PredictorProblem, work: Workspace, tick: Callable[[], None] | None) -> None:
        self.problem, self.work, self.tick = problem, work, tick
        self.weight = np.eye(problem.y.shape[1])
        self.at = np.full(self.problem.size, np.nan)
        self.r, self.J, self.covariance = np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0))

    def reweigh(self, weight: Array) -> None:
        self.weight = weight
        self.at = np.full(self.problem.size, np.nan)

    def residual(self, vector: Array) -> Array:
        if np.array_equal(self.at, vector):  # once more would begin from another gain, and may find no predictor
            return self.r
        prior, J_prior = prior_rows(self.problem, vector)
        result = linearise(self.problem, vector, self.weight, self.work)
        if self.tick is not None:
            self.tick()
        if result is None:  # infinite: the trust region shrinks
            return np.full(self.problem.size + 1 + prior.size, np.inf)
        self.at = vector.copy()
        self.r, self.J = np.concatenate([result.r, prior]), np.vstack([result.J, J_prior])
        self.covariance = result.covariance
        return self.r

    def jacobian(self, vector: Array) -> Array:
        if not np.array_equal(self.at, vector):
            self.residual(vector)
        return self.J
