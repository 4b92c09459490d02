"""Maximum likelihood over one predictor problem (Ljung 1999, sec. 7.4 and 10.2).

The determinant of the innovation covariance is minimised by Gauss-Newton steps in a trust region, with exact Jacobians
weighted by the innovation covariance at the same vector. A trial step costs one run of the predictor; slopes are taken
only where the criterion fell.

Predictions further ahead than one sample: from x+ = A x + B u + K e, y = C x + D u + e the error k steps ahead, inputs
known, is the sum of the innovations since, e(t) + C K e(t-1) + ... + C A^(k-2) K e(t-k+1) (Ljung 1999, sec. 3.2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import BLIND, directions, triangle_of
from ambid.estimation.predictor import Predictor, PredictorProblem, assemble, predictor_gain
from ambid.estimation.search import Status
from ambid.estimation.sensitivity import Workspace, innovations, linearise, run

NOISE_PRIOR_SD = 5.0  # of a log noise level: keeps a level that the data do not see from running to minus infinity
_STEPS = 200
_NOTHING = 1e-12  # radius of the trust region below which no step is left
_ROUNDING = 1e-15  # singular value, over the largest, below which there is nothing but rounding
_SECULAR = 30  # Newton steps towards the damping that gives a step its length
_SETTLED = 0.01  # Newton step of every physical parameter, in standard deviations, below which a search has converged
_POOR = 0.1  # share of the squares that offsets and initial state would take off, above which they are set first
_FLAT = 0.001  # fall of the criterion in one step below which a search has converged; a needless number earns one


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
    freed: Array | None = None  # Jacobian with the delay freed as well, where that was asked and is not needed
    # what a global search did where the ordinary starts failed, see `ambid.bearing.rescue`
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
    r, J = ((vector - mean) * inverse_sd)[active], np.diag(inverse_sd)[active]
    if problem.joint_priors is not None:
        slopes, left = problem.joint_priors(vector[:n])
        r, J = np.concatenate([r, -left]), np.vstack([J, np.pad(slopes, ((0, 0), (0, problem.size - n)))])
    return r, J


def criterion(problem: PredictorProblem, vector: Array, covariance: Array) -> float:
    """Return n log det(covariance) plus the squared prior residuals.

    `vector`: (size,); `covariance`: (n_outputs, n_outputs), scaled output units.
    """
    r, _ = prior_rows(problem, vector)
    return float(problem.n_used * np.linalg.slogdet(covariance)[1] + r @ r)


def evaluate(
    problem: PredictorProblem, vector: Array, work: Workspace | None = None, predictor: Predictor | None = None
) -> tuple[float, Array | None]:
    """Return the criterion and the innovation covariance at a vector, without a Jacobian.

    `vector`: (size,); `work`, `predictor`: of this problem, to save making them again. Returns `criterion`:
    infinite where there is no predictor; `covariance`: (n_outputs, n_outputs), or None.
    """
    e = innovations(problem, vector, work, predictor)
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


def extend(
    fit: Fit, problem: PredictorProblem, vector: Array, work: Workspace | None = None
) -> tuple[Array, Array] | None:
    """Return Jacobian and residual of a larger problem at a fit, compressed, priors included; None without predictor.

    `vector`: (size,), the fit's numbers written in that problem; `work`: of that problem.
    """
    work = workspace_near(fit, problem) if work is None else work
    at = linearise(problem, vector, weight_of(fit.covariance), work)
    if at is None:
        return None
    r, J = prior_rows(problem, vector)
    return np.vstack([at.J, J]), np.concatenate([at.r, r])


def score_statistic(fit: Fit, problem: PredictorProblem, vector: Array) -> float:
    """Return the fall of the criterion that freeing all numbers of `problem` promises to second order.

    The score (Lagrange multiplier) test: one evaluation decides whether an extension is worth a search.

    `fit`: of the smaller problem; `problem`: the extended one; `vector`: (size,), the fit's numbers written in it.
    Returns chi-squared with as many degrees of freedom as numbers were added, if they are not needed; 0 where
    undefined.
    """
    return promise_of(extend(fit, problem, vector))


def promise_of(rows: tuple[Array, Array] | None) -> float:
    """Return the score statistic of Jacobian and residual, 0 where there are none."""
    return 0.0 if rows is None else directions(rows[0]).explain(rows[1])


def free_one(fit: Fit, name: str) -> tuple[float, float]:
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
    rows = extend(fit, problem, vector)
    if rows is None:
        return 0.0, value
    found, residual = directions(rows[0]), rows[1]
    if not found.seen.all():  # the data cannot tell it from the others
        return 0.0, value
    return found.explain(residual), value - float(found.solve(residual)[n]) * size


def with_linear_part(problem: PredictorProblem, vector: Array, work: Workspace) -> Array:
    """Return a copy with the offsets and the initial state that fit best.

    `vector`: (size,). Returns (size,), unchanged where there is no predictor at `vector`.
    """
    at = _point(problem, vector, work)
    return vector.copy() if at is None else at.with_linear_part()


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
    steps: int = _STEPS,
    tick: Callable[[], None] | None = None,
    work: Workspace | None = None,
) -> Fit:
    """Minimise the likelihood criterion from `start`.

    `start`: (size,); `steps`: steps tried at most; `tick`: called after each (progress, interruption); `work`: of this
    problem, or of one with the same data. Returns with status ``"failed"`` where there is no predictor at `start`.
    """
    work = Workspace(problem) if work is None else work.of(problem)
    at = _point(problem, start, work)
    if at is not None and at.linear_fall() > _POOR * float(at.r @ at.r):
        at = _point(problem, at.with_linear_part(), work)
    if at is None:
        return _failed(problem, start)
    status: Status = "stalled"
    region, fall = _Region(), np.inf
    count = 1
    for _ in range(steps):
        step, promise = region.step(at)
        value, covariance = evaluate(problem, at.vector + step, work)
        count += 1
        if tick is not None:
            tick()
        # the weighted sum of squares falls by less than the criterion, which is concave in the covariance
        gain = at.fall(problem, at.vector + step, covariance)
        better = _point(problem, at.vector + step, work, value, covariance) if gain > 0.0 else None
        region.judge(gain / promise if better is not None else -1.0)
        if better is not None:
            at, fall = better, at.criterion - value
        if (fall < _FLAT or promise < _FLAT) and _step_left(at.J, at.r, problem.n_physical) < _SETTLED:
            status = "converged"
            break
        if region.radius < _NOTHING:
            break
    n = at.J.shape[0] - at.n_priors
    return Fit(
        problem=problem,
        vector=at.vector,
        covariance=at.covariance,
        J=at.J[:n],
        J_prior=at.J[n:],
        r_prior=at.r[n:],
        criterion=at.criterion,
        status=status,
        evaluations=count,
        work=work,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Point:
    """Criterion and its slope at one vector, rows of the priors last."""

    vector: Array  # (size,)
    covariance: Array  # (n_outputs, n_outputs), innovation covariance, scaled
    criterion: float
    r: Array  # (n_rows,), weighted by the covariance here: the gradient of the criterion is 2 J^T r
    J: Array  # (n_rows, size)
    n_priors: int
    linear: int  # from here on numbers enter linearly: offsets and initial state

    def linear_fall(self) -> float:
        """Return by how much the sum of squares falls where the numbers that enter linearly are set to their best."""
        return directions(self.J[:, self.linear :]).explain(self.r)

    def with_linear_part(self) -> Array:
        """Return the vector with those set to their best; one solve finds them."""
        out = self.vector.copy()
        out[self.linear :] -= directions(self.J[:, self.linear :]).solve(self.r)
        return out

    def fall(self, problem: PredictorProblem, vector: Array, covariance: Array | None) -> float:
        """Return by how much the sum of squares, weighted as here, falls to a vector with that covariance."""
        if covariance is None:
            return -np.inf
        r, _ = prior_rows(problem, vector)
        return float(self.r @ self.r - problem.n_used * np.trace(np.linalg.solve(self.covariance, covariance)) - r @ r)


def _point(
    problem: PredictorProblem,
    vector: Array,
    work: Workspace,
    value: float = np.nan,
    covariance: Array | None = None,
) -> _Point | None:
    """The point at a vector, None without a predictor or its slope; `value`, `covariance`: where they are known."""
    if covariance is None:
        value, covariance = evaluate(problem, vector, work)
    if covariance is None:
        return None
    try:
        weight = weight_of(covariance)
    except np.linalg.LinAlgError:  # a record without noise: what is left is rounding
        return None
    at = linearise(problem, vector, weight, work)
    if at is None:
        return None
    r, J = prior_rows(problem, vector)
    return _Point(
        vector=vector,
        covariance=covariance,
        criterion=value,
        r=np.concatenate([at.r, r]),
        J=np.vstack([at.J, J]),
        n_priors=r.size,
        linear=problem.slices["offset"].start,
    )


class _Region:
    """Trust region of Gauss-Newton steps (Nocedal and Wright 2006, sec. 10.3).

    Lengths are those of what acts nonlinearly, in its own unit: parts of a parameter, and logarithms of levels bend at
    about the same length, whatever the data say of them. Offsets and initial state, which enter linearly, follow.
    """

    def __init__(self) -> None:
        self.radius = 1.0
        self.length, self.bound = 0.0, False  # of the last step, and whether it was cut

    def step(self, at: _Point) -> tuple[Array, float]:
        """Return the best step inside the region, and the fall of the sum of squares that it promises."""
        n = at.linear
        easy = directions(at.J[:, n:])
        rows = np.column_stack([at.J[:, :n], at.r])
        rows = rows - easy.U @ (easy.U.T @ rows)
        U, s, Vt = np.linalg.svd(rows[:, :n], full_matrices=False)
        seen = s > _ROUNDING * np.max(s, initial=0.0)
        s, pull = s[seen], -(U.T @ rows[:, n])[seen]
        damping, along = 0.0, pull / s
        for _ in range(_SECULAR):  # Newton's method on 1 / length, which is nearly linear in the damping
            self.length = float(np.linalg.norm(along))
            if self.length <= 1.1 * self.radius:
                break
            slope = float(along**2 @ (1.0 / (s**2 + damping)))
            damping += self.length**2 / slope * (self.length / self.radius - 1.0)
            along = s * pull / (s**2 + damping)
        self.bound = damping > 0.0
        step = Vt[seen].T @ along
        rest = easy.solve(-at.r - at.J[:, :n] @ step)
        promise = float(2.0 * pull @ (s * along) - np.sum((s * along) ** 2)) + easy.explain(at.r)
        return np.concatenate([step, rest]), promise

    def judge(self, ratio: float) -> None:
        """Move the bound by the ratio of the fall that came to the one that was promised."""
        if ratio < 0.25:
            self.radius = 0.25 * self.length
        elif ratio > 0.75 and self.bound:
            self.radius = 2.0 * self.length


def _failed(problem: PredictorProblem, start: Array) -> Fit:
    n_y = problem.y.shape[1]
    return Fit(
        problem=problem, vector=start, covariance=np.eye(n_y), J=np.zeros((problem.size + 1, problem.size)),
        J_prior=np.zeros((0, problem.size)), r_prior=np.zeros(0), criterion=np.inf, status="failed", evaluations=1,
    )  # fmt: skip


def sparse_gain(fit: Fit, stride: int) -> Array:
    """Return the predictor gain for every stride-th output, from the innovations form of the fit."""
    predictor = _predictor(fit)
    A, C, K, S = predictor.A, predictor.C, predictor.gain, fit.covariance
    if not np.any(K):  # sensor noise alone: no state is ever corrected
        return K
    powers = [np.linalg.matrix_power(A, stride - 1 - j) for j in range(stride)]
    Q = sum((p @ K @ S @ K.T @ p.T for p in powers), np.zeros_like(A))
    cross, whole = powers[0] @ K @ S, A @ powers[0]
    # what the innovation says of the noise that comes after it is known, and leaves noises that do not correlate
    shown = np.linalg.solve(S, cross.T).T
    return np.asarray(predictor_gain(whole - shown @ C, C, Q - shown @ cross.T, S).K + shown)


def simulation_error(fit: Fit) -> Array | None:
    """Return y minus its simulation from the input, offsets and initial state alone, SI.

    Returns (n_used, n_outputs); None where the plant is unstable in open loop: its simulation runs away and says
    nothing.
    """
    predictor = _predictor(fit)
    A = predictor.A
    if np.max(np.abs(np.linalg.eigvals(A))) >= 1.0:
        return None
    n, work = A.shape[0], Workspace(fit.problem) if fit.work is None else fit.work.of(fit.problem)
    M = predictor.M.copy()
    M[:, :n] = A
    M[:, -1 - work.y.shape[1] : -1] = 0.0  # the gain is off: measurements do not correct the state
    e = work.y - run(M, work.z, predictor.x0)[:-1] @ predictor.C.T
    return np.asarray(e * fit.problem.scales.output)


def prediction_error(fit: Fit, steps: int) -> Array:
    """Return y minus its prediction `steps` samples ahead, SI, with the inputs known up to then.

    Returns (n_used - steps + 1, n_outputs), row k is the error at sample k + steps - 1, predicted from outputs before
    sample k.
    """
    predictor, e = _predictor(fit), innovations(fit.problem, fit.vector)
    if e is None:
        raise ValueError("the fit has no predictor; it has failed")
    n, out, power = e.shape[0], e[steps - 1 :].copy(), predictor.gain
    for j in range(1, steps):
        out += e[steps - 1 - j : n - j] @ (predictor.C @ power).T
        power = predictor.A @ power
    return np.asarray(out * fit.problem.scales.output)


def expected_prediction_sd(fit: Fit, steps: int) -> Array:
    """Return the standard deviation (n_outputs,) that the model gives its predictions `steps` samples ahead, SI."""
    predictor = _predictor(fit)
    total, power = fit.covariance.copy(), predictor.gain
    for _ in range(1, steps):
        h = predictor.C @ power
        total += h @ fit.covariance @ h.T
        power = predictor.A @ power
    return np.asarray(np.sqrt(np.diag(total)) * fit.problem.scales.output)


def _predictor(fit: Fit) -> Predictor:
    predictor = assemble(fit.problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    return predictor
