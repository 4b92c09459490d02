"""Maximum likelihood over one predictor problem (Ljung 1999, sec. 7.4 and 10.2): the determinant of the innovation
covariance is minimised with exact weighted Jacobians, compressed to a triangle block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import column_sizes, directions, periods_near, triangle_of, waves_at, without
from ambid.estimation.predictor import Predictor, PredictorProblem, assemble, busiest, predictor_gain
from ambid.estimation.search import NOT_CONVERGED, PhysicalFit, predictable
from ambid.estimation.search import search as descend
from ambid.estimation.uncertainty import explained_by_past

_BLOCK = 1024  # samples: sensitivities of one block stay in the second-level cache
_QR_ROWS = 256  # rows of one small QR: below the size at which the linear algebra library starts threads
_MOST_BLOCKS = 64  # that are held before they are reduced together
_WELL = 1e-6  # least eigenvalue of a Gram matrix with unit diagonal that a triangle is taken from
_TURNED = 1e-9  # least singular value, over the largest, of the scaled triangle that others are taken along


class Workspace:
    """What evaluations of one problem share: scaled outputs `y` (n_used, n_outputs), room for the states and what
    drives the predictor, `w` (..., n_states + n_lags n_inputs + n_outputs + 1) with its view `z` (inputs at the lags,
    y, 1), and the last triangle T: the next Jacobian is taken along the columns of T^-1, whose Gram matrix loses no
    digits.
    """

    def __init__(self, problem: PredictorProblem) -> None:
        d, n_used = problem.delay, problem.n_used
        self.y = problem.y[problem.skip :: problem.stride] / problem.scales.output
        n, (n_u, n_y) = len(problem.model.states), (problem.u.shape[1], problem.y.shape[1])
        extra = None if problem.extra is None else problem.extra[problem.skip :] / problem.scales.disturbance
        n_d = 0 if extra is None else extra.shape[1] * problem.stride
        self.w = np.empty((n_used, n + len(problem.lags) * n_u + n_d + n_y + 1))
        self.z = self.w[:, n:]
        for j, s in enumerate(problem.lags):
            # inputs after the last sample do not exist; they would act only after the last output
            here, there = self.z[:, j * n_u : (j + 1) * n_u], problem.u[problem.skip - d - s :: problem.stride]
            there = there[:n_used]
            here[: there.shape[0]] = there
            here[there.shape[0] :] = problem.u[-1]
            here /= problem.scales.input
        if extra is not None:  # of each sample of a step; after the last sample there is none
            missing = n_used * problem.stride - len(extra)
            self.z[:, -1 - n_y - n_d : -1 - n_y] = np.pad(extra, ((0, missing), (0, 0))).reshape(n_used, n_d)
        self.z[:, -1 - n_y : -1], self.z[:, -1] = self.y, 1.0
        self.turn: tuple[Array, Array] | None = None
        self._problem = problem
        self._weight, self._weighted = np.zeros((0, 0)), self.y
        self._buffers: tuple[Array, ...] = ()

    def of(self, problem: PredictorProblem) -> Workspace:
        """Return the workspace of a problem: this one, where the scaled data are the same."""
        own, new = self._problem, problem
        same = (
            own.u is new.u and own.y is new.y and (own.delay, own.skip, own.stride) == (new.delay, new.skip, new.stride)
        )
        same = (
            same
            and own.extra is new.extra
            and own.lags == new.lags
            and len(own.model.states) == len(new.model.states)
            and np.array_equal(own.scales.input, new.scales.input)
        )
        if not same or not np.array_equal(own.scales.output, new.scales.output):
            return Workspace(problem)
        if self.turn is not None and self.turn[0].shape[0] != problem.size:
            self.turn = None
        return self

    def near(self, triangle: Array) -> None:
        """Take note of a triangle that is about that of the next Jacobian."""
        self.turn = _turn(triangle)

    def buffers(self, *shapes: tuple[int, ...]) -> tuple[Array, ...]:
        """Return scratch arrays, not initialised, kept while shapes stay the same: fresh pages cost more than sums."""
        if tuple(b.shape for b in self._buffers) != shapes:
            self._buffers = tuple(_aligned(shape) for shape in shapes)
        return self._buffers

    def weighted(self, weight: Array) -> Array:
        """Return outputs (n_used, n_outputs) times a weight (n_outputs, n_outputs), kept while that stays the same."""
        if not np.array_equal(weight, self._weight):
            self._weight, self._weighted = weight.copy(), self.y @ weight.T
        return self._weighted


def _aligned(shape: tuple[int, ...]) -> Array:
    """Return an array that begins where a cache line does: vector instructions want that."""
    size = int(np.prod(shape))
    raw = np.empty(size + 8)
    first = -(raw.ctypes.data // 8) % 8
    return raw[first : first + size].reshape(shape)


def innovations(
    problem: PredictorProblem, vector: Array, work: Workspace | None = None, predictor: Predictor | None = None
) -> Array | None:
    """Return the innovations (n_used, n_outputs) in scaled output units, None without a predictor at `vector` (size,);
    `work` and `predictor` save making them again.
    """
    from ambid.estimation.kernels import state_scan

    work = work or Workspace(problem)
    predictor = predictor or assemble(problem, vector, with_derivatives=False)
    if predictor is None:
        return None
    state_scan(predictor.M, work.w, predictor.x0.copy())
    e = work.y - work.w[:, : predictor.x0.size] @ predictor.C.T
    return e if np.all(np.isfinite(e[-1])) else None


def run(M: Array, z: Array, x0: Array) -> Array:
    """Run x+ = M [x; z] and return the states before each sample and after the last, (n_samples + 1, n)."""
    from ambid.estimation.kernels import state_scan

    n = x0.size
    w, x = np.empty((z.shape[0], n + z.shape[1])), x0.copy()
    w[:, n:] = z
    state_scan(M, w, x)
    return np.vstack([w[:, :n], x])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """Weighted innovations and Jacobian at one vector, compressed by QR."""

    r: Array  # (size + 1,)
    # (size + 1, size), same norm, gradient and singular values as the full residual and Jacobian: they differ by an
    # orthogonal matrix
    J: Array
    covariance: Array  # (n_outputs, n_outputs), mean of e e^T, scaled output units


def linearise(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace | None = None
) -> Linearisation | None:
    """Return the compressed weighted residual at `vector` (size,) and its exact Jacobian. `weight` (n_outputs,
    n_outputs): lower triangular W with W^T W the inverse innovation covariance (scaled).
    """
    work = work or Workspace(problem)
    p, moment = problem.size, np.zeros_like(weight)
    full = _near_triangle(problem, vector, weight, work, moment) if work.turn is not None else None
    if full is None:
        blocks, moment[:] = list[Array](), 0.0
        for rows in residual_blocks(problem, vector, weight, work):
            e = rows[:, :, p]
            moment += e.T @ e
            blocks.append(reduce_rows(rows.reshape(-1, p + 1)))
            if len(blocks) == _MOST_BLOCKS:
                blocks = [reduce_rows(np.vstack(blocks), last=True)]
        if not blocks or not np.all(np.isfinite(moment)):
            return None
        reduced = reduce_rows(np.vstack(blocks), last=True)
        full = np.zeros((p + 1, p + 1))
        full[: reduced.shape[0]] = reduced
    work.turn = _turn(full[:p, :p])
    back = np.linalg.inv(weight)
    return Linearisation(r=full[:, p].copy(), J=full[:, :p].copy(), covariance=back @ moment @ back.T / problem.n_used)


def _near_triangle(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace, moment: Array
) -> Array | None:
    """Triangle of [J | r] from the Gram matrix along the last triangle's directions, None where digits run short."""
    assert work.turn is not None
    (last, turn), p = work.turn, problem.size
    gram = np.zeros((p + 1, p + 1))
    for rows in residual_blocks(problem, vector, weight, work, turn):
        e = rows[:, :, p]
        moment += e.T @ e
        for o in range(rows.shape[1]):
            gram += rows[:, o].T @ rows[:, o]
    if not np.all(np.isfinite(gram)) or not np.all(np.diag(gram) > 0.0):
        return None
    size = np.sqrt(np.diag(gram))
    gram /= np.outer(size, size)
    if np.linalg.eigvalsh(gram)[0] < _WELL:
        return None
    full = np.linalg.cholesky(gram).T * size
    full[:, :p] = full[:, :p] @ last
    return np.asarray(full)


def _turn(triangle: Array) -> tuple[Array, Array] | None:
    """A triangle and its inverse, None where the data do not tell some directions apart."""
    size = column_sizes(triangle)
    scaled = triangle / size
    s = np.linalg.svd(scaled, compute_uv=False)
    if not s[-1] > _TURNED * s[0]:
        return None
    return triangle, np.linalg.inv(scaled) / size[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Products:
    """Scalar products over a whole record of J, e and lagged signals, J along the directions of `turn`."""

    turn: Array  # (size, size)
    rows: Array  # (size + 1, size + 1), of [J turn, e], summed over the outputs
    cross: Array  # (n_outputs, size + 1, n_columns), of [J turn, e] of each output and the lagged signals
    inner: Array  # (n_columns, n_columns), of the lagged signals
    squares: Array  # (n_outputs,), of e
    scores: Array  # (n_stretches, size), J' e of stretches of the record, by each number


def products(
    problem: PredictorProblem,
    vector: Array,
    weight: Array,
    work: Workspace,
    lagged: Sequence[tuple[Array, tuple[int, ...]]] = (),
    stretches: int = 1,
) -> Products | None:
    """Return all scalar products of checks and robust covariances from one pass of sensitivities; None without a
    predictor, or where the data do not tell all numbers apart. `lagged`: signals (n_used, n_signals) with lags, zero
    before the record; `stretches`: into about how many it is cut.
    """
    p, n_used, n_y = problem.size, problem.n_used, work.y.shape[1]
    if work.turn is None and linearise(problem, vector, weight, work) is None:
        return None
    turn = np.eye(p) if work.turn is None else work.turn[1]
    length = max(1, n_used // stretches)
    n_columns = sum(len(lags) * signals.shape[1] for signals, lags in lagged)
    rows, cross, inner = np.zeros((p + 1, p + 1)), np.zeros((n_y, p + 1, n_columns)), np.zeros((n_columns, n_columns))
    squares, scores, first = np.zeros(n_y), np.zeros((-(-n_used // length), p)), 0
    for block in residual_blocks(problem, vector, weight, work, turn):
        m = block.shape[0]
        columns = _lagged_block(lagged, first, m, n_columns)
        inner += columns.T @ columns
        for o in range(n_y):
            own = block[:, o]
            rows += own.T @ own
            cross[o] += own.T @ columns
            squares[o] += own[:, p] @ own[:, p]
            for b in range(first // length, (first + m - 1) // length + 1):
                part = own[max(b * length - first, 0) : (b + 1) * length - first]
                scores[b] += part[:, :p].T @ part[:, p]
        first += m
    if not first or not np.all(np.isfinite(rows)):
        return None
    back = np.eye(p) if work.turn is None else work.turn[0]
    return Products(turn=turn, rows=rows, cross=cross, inner=inner, squares=squares, scores=scores @ back)


def _lagged_block(lagged: Sequence[tuple[Array, tuple[int, ...]]], first: int, m: int, width: int) -> Array:
    """Samples `first` to ``first + m`` of the columns of all signals at all their lags, (m, width)."""
    out, place = np.zeros((m, width)), 0
    for signals, lags in lagged:
        for lag in lags:
            there = signals[max(first - lag, 0) : max(first + m - lag, 0)]
            out[m - there.shape[0] :, place : place + signals.shape[1]] = there
            place += signals.shape[1]
    return out


def reduce_rows(rows: Array, *, last: bool = False) -> Array:
    """Replace rows (n_rows, n_columns) by fewer that differ by an orthogonal matrix (QR of short stacks); `last`: by at
    most n_columns of all instead of each stack.
    """
    if last:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    whole = rows.shape[0] // _QR_ROWS * _QR_ROWS
    if not whole:
        return rows.copy()
    factors = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, _QR_ROWS, rows.shape[1]), mode="r"))
    return np.vstack([factors.reshape(-1, rows.shape[1]), rows[whole:]])


def residual_blocks(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace, turn: Array | None = None
) -> Iterator[Array]:
    """Yield rows [W de/dq, W e] (block, n_outputs, size + 1), views that the next block overwrites, so that memory does
    not grow; none without a predictor at `vector`. `turn` (size, size): directions of the derivatives, along its
    columns.
    """
    from ambid.estimation.kernels import sensitivity_scan, state_scan

    predictor = assemble(problem, vector)
    if predictor is None:
        return
    n, p, n_y, n_used = predictor.x0.size, problem.size, work.y.shape[1], work.y.shape[0]
    # a state basis whose first states are the weighted predicted outputs with their sign turned: weighted innovations
    # are then W y plus a state, and sensitivities of innovations are read off, not multiplied
    whitened = weight @ predictor.C
    basis = -np.vstack([whitened, null_space(whitened)])
    turned = np.linalg.inv(basis)
    M = basis @ predictor.M
    M[:, :n] = M[:, :n] @ turned
    # vector instructions take eight numbers at a time, and pay from sixteen on: columns of zeros fill up to that
    width, length = max(16, -(-(p + 1) // 8) * 8), min(_BLOCK, n_used)
    forcing = np.zeros((n, M.shape[1], width))
    forcing[:, :, :p] = np.tensordot(basis, predictor.dM, axes=1)
    forcing[:, :n] = turned.T @ forcing[:, :n]
    if turn is not None:
        forcing[:, :, :p] = forcing[:, :, :p] @ turn
    through = None  # what numbers that move C do to the innovations at once
    if predictor.dC.shape[2]:
        through = np.zeros((n_y, n, width))
        through[:, :, : predictor.dC.shape[2]] = -np.tensordot(weight, predictor.dC, axes=1)
        through = turned.T @ through
        if turn is not None:
            through[:, :, :p] = through[:, :, :p] @ turn
    rows, s = work.buffers((n, length, width), (n, width))
    s[:], x = 0.0, basis @ predictor.x0
    s[:, problem.slices["initial"]] = basis
    if turn is not None:
        s[:, :p] = s[:, :p] @ turn
    F, outputs = np.ascontiguousarray(M[:, :n]), work.weighted(weight)
    for a in range(0, n_used, _BLOCK):
        part = work.w[a : a + _BLOCK]
        # whole in memory also where the last block is shorter: another layout would be compiled anew
        block = rows.reshape(-1)[: n * part.shape[0] * width].reshape(n, -1, width)
        state_scan(M, part, x)
        np.matmul(part, forcing, out=block)
        sensitivity_scan(F, part, outputs[a : a + _BLOCK], s, block, p)
        if through is not None:
            block[:n_y] += part[:, :n] @ through
        yield block[:n_y, :, : p + 1].swapaxes(0, 1)


def null_space(a: Array) -> Array:
    """Return orthonormal rows (n - r, n) that complete the row space of a full-rank `a` (r, n), r <= n."""
    q, _ = np.linalg.qr(a.T, mode="complete")
    return np.ascontiguousarray(q[:, a.shape[0] :].T)


NOISE_PRIOR_SD = 5.0  # of a log noise level: keeps a level that the data do not see from running to minus infinity
STEPS = 200  # of a search, at most
_SETTLED = 0.01  # Newton step of every physical parameter, in standard deviations, below which a search has converged
_FLAT = 0.001  # fall of the criterion in one step below which a search has converged; a needless number earns one
PAST = 10  # samples of innovations that a regression looks at, which tells whether a fit has failed
_INPUTS = 28  # and of inputs: a delay that was missed shows there
_LOOKED = 2048  # samples that it looks at
_LINES, _STANDS = 6, 100.0  # lines that no model can explain, and from which power over the median one counts as such
_POOR = 0.1  # share of the squares that offsets and initial state would take off, above which they are set first


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit(PhysicalFit):
    """Outcome of one likelihood search."""

    problem: PredictorProblem
    covariance: Array  # (n_outputs, n_outputs), innovation covariance, scaled output units
    # (size + 1, size), compressed Jacobian of the weighted innovations: J^T J is the information matrix of the data
    J: Array
    J_prior: Array  # (n_priors, size)
    r_prior: Array  # (n_priors,), rows and residuals of the priors
    start_s: float = 0.0  # time that finding start values took before this search, s
    work: Workspace | None = None  # scaled data, and the triangle near the optimum, for those who go on from here
    freed: Array | None = None  # Jacobian with the delay freed as well, where that was asked and is not needed
    leveled: Fit | None = None  # the same with the noise as levels, of which the gain was freed
    beside: Array | None = None  # (n_physical, n_physical), what sizes of causes add to the covariance of the numbers


def prior_rows(problem: PredictorProblem, vector: Array) -> tuple[Array, Array]:
    """Return residual (n_priors,) and Jacobian rows of the priors: the rig's, and a weak one on log noise levels."""
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
    """Return n log det(covariance), in scaled output units, plus the squared prior residuals."""
    r, _ = prior_rows(problem, vector)
    return float(problem.n_used * np.linalg.slogdet(covariance)[1] + r @ r)


def evaluate(
    problem: PredictorProblem, vector: Array, work: Workspace | None = None, predictor: Predictor | None = None
) -> tuple[float, Array | None]:
    """Return the criterion at a vector (size,), infinite without a predictor, and the innovation covariance (n_outputs,
    n_outputs) or None, without a Jacobian.
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
    """Return lower triangular W with W^T W = covariance^-1, of a positive definite one."""
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
    """Return compressed Jacobian and residual, priors included, of a larger problem at a fit; None without a predictor.
    `vector` (size,): the fit's numbers written in that problem.
    """
    work = workspace_near(fit, problem) if work is None else work
    at = linearise(problem, vector, weight_of(fit.covariance), work)
    if at is None:
        return None
    r, J = prior_rows(problem, vector)
    return np.vstack([at.J, J]), np.concatenate([at.r, r])


def score_statistic(fit: Fit, problem: PredictorProblem, vector: Array) -> float:
    """Return the fall of the criterion that freeing all numbers of the extended `problem` promises to second order, 0
    where undefined: the score (Lagrange multiplier) test, chi-squared with the numbers added as degrees of freedom if
    they are not needed. `vector` (size,): the fit's numbers written in that problem.
    """
    return promise_of(extend(fit, problem, vector))


def promise_of(rows: tuple[Array, Array] | None) -> float:
    """Return the score statistic of Jacobian and residual, 0 where there are none."""
    return 0.0 if rows is None else directions(rows[0]).explain(rows[1])


Freed = Mapping[str, tuple[float, Array]]
"""What `free_one` says, by fixed parameter."""


def free_one(fit: Fit, name: str) -> tuple[float, Array]:
    """Return what the data say of a fixed parameter, to second order: the fall of the criterion that freeing it
    promises (chi-squared with one degree of freedom if its value is right), and by how much one Newton step moves the
    estimated parameters and, last, the freed one, SI: right in direction, in size only near the fixed value.
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
        return 0.0, np.zeros(n + 1)
    axes, residual = directions(rows[0]), rows[1]
    if not axes.seen.all():  # the data cannot tell it from the others
        return 0.0, np.zeros(n + 1)
    return axes.explain(residual), -axes.solve(residual)[: n + 1] * problem.magnitude


def with_linear_part(problem: PredictorProblem, vector: Array, work: Workspace) -> Array:
    """Return a copy with the offsets and the initial state that fit best, unchanged without a predictor at `vector`."""
    rows, out = _Objective(problem, work, None).triangle(vector), vector.copy()
    if np.all(np.isfinite(rows)):
        linear = problem.slices["offset"].start
        out[linear:] += directions(rows[:, linear:-1]).solve(rows[:, -1])
    return out


def search(
    problem: PredictorProblem,
    start: Array,
    *,
    steps: int = STEPS,
    tick: Callable[[], None] | None = None,
    work: Workspace | None = None,
) -> Fit:
    """Minimise the likelihood criterion from `start` (size,); status ``"failed"`` where there is no predictor. A trial
    step costs one run of the predictor; slopes are taken only where the criterion fell. `tick` is called after each
    evaluation.
    """
    objective = _Objective(problem, Workspace(problem) if work is None else work.of(problem), tick)
    linear = problem.slices["offset"].start
    rows = objective.triangle(start)
    if np.all(np.isfinite(rows)):
        offsets, r = directions(rows[:, linear:-1]), rows[:, -1]
        if offsets.explain(r) > _POOR * float(r @ r):
            start = start.copy()
            start[linear:] += offsets.solve(r)
    end = descend(objective, start, most=steps, enough=_FLAT, settled=_SETTLED**2, bounded=linear,
                  judged=problem.n_physical or problem.size)  # fmt: skip
    rows = objective.triangle(end.theta)
    if not np.all(np.isfinite(rows)):
        return _failed(problem, start)
    n = rows.shape[0] - objective.n_priors
    return Fit(
        problem=problem,
        vector=end.theta,
        covariance=objective.covariance,
        J=rows[:n, :-1],
        J_prior=rows[n:, :-1],
        r_prior=-rows[n:, -1],
        criterion=end.cost,
        status=end.status,
        evaluations=objective.evaluations,
        work=objective.work,
    )


class _Objective:
    """The likelihood as `search.Problem`: rows are weighted by the innovation covariance at the same vector."""

    def __init__(self, problem: PredictorProblem, work: Workspace, tick: Callable[[], None] | None) -> None:
        self.problem, self.work, self.tick = problem, work, tick
        self.evaluations, self.n_priors = 0, 0
        self.at, self.covariance = np.full(problem.size, np.nan), np.eye(problem.y.shape[1])
        self.rows = np.zeros((0, 0))  # [J | r] at `at`, those of the priors last; empty until they are wanted
        self.value = np.inf

    def cost(self, theta: Array) -> float:
        """Return n log det(covariance) plus the squared prior residuals."""
        if np.array_equal(theta, self.at):
            return self.value
        value, covariance = evaluate(self.problem, theta, self.work)
        self.evaluations += 1
        if self.tick is not None:
            self.tick()
        if covariance is None:
            return np.inf
        self.at, self.value, self.covariance, self.rows = theta, value, covariance, np.zeros((0, 0))
        return value

    def triangle(self, theta: Array) -> Array:
        """Return [J | r], compressed, NaN where there is no predictor or its innovations are rounding."""
        if self.rows.size and np.array_equal(theta, self.at):
            return self.rows
        nothing = np.full((1, self.problem.size + 1), np.nan)
        if not np.isfinite(self.cost(theta)):
            return nothing
        try:
            at = linearise(self.problem, theta, weight_of(self.covariance), self.work)
        except np.linalg.LinAlgError:  # a record without noise: what is left is rounding
            return nothing
        if at is None:
            return nothing
        r, J = prior_rows(self.problem, theta)
        self.n_priors = r.size
        self.rows = np.vstack([np.column_stack([at.J, -at.r]), np.column_stack([J, -r])])
        return self.rows


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
    correction = np.linalg.solve(S, cross.T).T
    return np.asarray(predictor_gain(whole - correction @ C, C, Q - correction @ cross.T, S).K + correction)


def simulation_error(fit: Fit) -> Array | None:
    """Return y minus its simulation from input, offsets and initial state alone, SI, (n_used, n_outputs); None where
    the plant is unstable in open loop: its simulation runs away.
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
    """Return y minus its prediction `steps` ahead with known inputs, SI: row k of (n_used - steps + 1, n_outputs) is
    sample t = k + steps - 1 predicted from outputs before k.

    It is e(t) + C K e(t-1) + ... + C A^(steps-2) K e(t-steps+1) for x+ = A x + B u + K e (Ljung 1999, sec. 3.2).
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


def failure(fit: Fit) -> str:
    """Return why a fit counts as failed, empty where it did not: lines in the innovations are of no other model."""
    if fit.status != "converged":
        return NOT_CONVERGED
    why = predictable(unexplained(fit))
    return predictable(unexplained(fit, lines=False)) if why else ""


def _without_lines(e: Array) -> Array:
    """Return innovations without their strongest narrow lines, each of an amplitude and a phase that may drift."""
    n = len(e)
    for _ in range(_LINES):
        spectra = np.fft.rfft(e * np.hanning(n)[:, None], axis=0)
        power = np.sum(np.abs(spectra) ** 2 / np.maximum(np.median(np.abs(spectra) ** 2, axis=0), 1e-300), axis=1)
        j = int(np.argmax(power))
        if power[j] < _STANDS or j < 2:
            break
        e = without(e, waves_at(periods_near(e @ spectra[j].conj(), j), n))
    return e


def unexplained(fit: Fit, *, lines: bool = True) -> float:
    """Return the part of the innovations' variance that a linear regression on past innovations and inputs explains:
    about 0 where a search ended well, as no linear model of high order predicts better; 1 without a predictor. Without
    `lines`: what stands far out of their spectra at few frequencies is taken off first.
    """
    work = None if fit.work is None else fit.work.of(fit.problem)
    e = None if fit.status == "failed" else innovations(fit.problem, fit.vector, work)
    if e is None:
        return 1.0
    u = fit.problem.u[fit.problem.skip :]
    at = busiest(u, _LOOKED)
    e = e if lines else _without_lines(e)
    return explained_by_past([(e[at], ((e[at], PAST), (u[at], _INPUTS)))])[0]
