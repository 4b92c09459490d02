"""Maximum likelihood of the extended Kalman predictor over all records: least sum of log s + e^2/s over innovations e
with predicted variances s (Ljung 1999, sec. 7.4; Astrom 1980), exact in state and covariance.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_problem import BODY, EDDY_STEPS, NOISE_PRIOR_SD, BearingProblem, BearingRecord
from ambid.estimation.linear import directions, triangle_of
from ambid.estimation.progress import Tick
from ambid.estimation.search import PhysicalFit
from ambid.estimation.search import search as descend
from ambid.physics.sensor_errors import SensorError

_BATCHES = 30  # stretches of all records together for the robust covariance
_ITERATIONS = 60
_SETTLED = 0.05  # fall of the criterion that a full step promises, below which a search has converged
_HUGE = 1e100  # rows of a likelihood that has lost the record
_LEFT = 1.0  # and below which it has converged where rounding leaves no way down
_SEARCHING = "identify"
_ABOUT = 4  # samples before and after a beginning that show where the rotor is and how fast it moves
_BLOCK = 4096  # samples of one block: their rows stay near
_DUST = 1e-9  # part of a weak prior that is left over where the records say nothing
_LONGEST = 1.0  # step of a logarithm at once
_ROLES = ("position", "current")
_ERROR = 1e-4  # step of an error: relative, of an offset in the channel's spread


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linear:
    """The criterion about one vector."""

    J: Array  # (n_rows, size), J'J is the Fisher information, priors included
    r: Array  # (n_rows,), J'r is half the gradient of the criterion
    criterion: float
    # (n_rows, 2 n_settled), columns that J would have for each delay that is whole and settled, longer and shorter
    J_delay: Array
    scores: Array  # (n_stretches, size), half gradients of the stretches of the records
    innovations: tuple[Innovations, ...]  # of each record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingFit(PhysicalFit):
    """Where a search ended."""

    problem: BearingProblem
    at: Linear | None  # the criterion about `vector`; None where the search failed
    beside: Array | None = (
        None  # (n, n), what the covariance of the numbers gains by sizes of nuisances, vector's units
    )
    beaten: float = 0.0  # by how much a law that was not asked for lowers the criterion with its price


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovations:
    """One-step prediction errors of one record."""

    # (n_samples, 2), innovations of position in m and current in A, and their predicted variances; NaN where nothing
    # was measured
    e: Array
    s: Array
    ahead: Array  # (n_samples, 3), position, velocity and current as predicted from all samples before, SI

    @classmethod
    def of(cls, n: int) -> Innovations:
        """Return room for those of `n` samples."""
        return cls(e=np.full((n, 2), np.nan), s=np.full((n, 2), np.nan), ahead=np.full((n, 3), np.nan))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Rows of the likelihood of some samples in a row."""

    first: int
    rows: Array  # (n_samples, 4, n_columns + 1), see `_kernels.predict`; overwritten by the next ones
    columns: NDArray[np.int64]  # (n_columns,), place of each column in the vector


def run(problem: BearingProblem, vector: Array, r: int) -> Innovations | None:
    """Run the predictor over record number `r`; None where there is no predictor."""
    innovations = Innovations.of(problem.records[r].u.size)
    for part in sweep(problem, vector, r, innovations, slopes=False):
        if part is None:
            return None
    return innovations


def sweep(
    problem: BearingProblem, vector: Array, r: int, innovations: Innovations, *, slopes: bool, delays: bool = False
) -> Iterator[Rows | None]:
    """Run the predictor over record `r` block after block, filling `innovations`; yields None, and ends, where there is
    none. `slopes`: whether the likelihood's rows are wanted; `delays`: with columns, behind the vector's, for a settled
    delay, see `Linear`.
    """
    from ambid.bearing.magnet_kernels import EARLY, LATE, LEVEL, ROOM, predict

    record, n_e = problem.records[r], len(problem.estimated)
    theta, whole = problem.theta(vector, record.rate_hz)
    possible = 0 <= whole <= problem.skip - 1 and bool(np.all(np.isfinite(theta)))
    if not possible or abs(theta[problem.law.names.index("k_asym")]) >= 1.0:
        yield None
        return
    noise2, flags, zero = problem.noise2(vector, r), problem.flags(r), problem.zero(r)
    offset = len(problem.law.names) + BODY.index("x_offset")
    if zero is not None:
        theta[offset] += vector[zero] * problem.zero_scale
    lanes, chain, columns = list[int](), np.zeros(0), np.zeros(0, dtype=np.int64)
    if slopes:
        names, place, levels = [n.name for n in problem.numbers], problem.noise_slices[r], problem.levels(r)
        lanes, late = [names.index(n.name) for n in problem.estimated], list[int]()
        columns = np.concatenate([np.arange(n_e), np.arange(place.start, place.stop)])
        lanes += [LEVEL + level for level in levels]
        if record.rate_hz in problem.free_delay:
            late = [n_e + problem.rates.index(record.rate_hz)]
        elif delays:
            first = problem.size + 2 * problem.settled.index(record.rate_hz)
            late = [first, first + 1] if whole > 0 else [first]
        lanes, columns = lanes + [LATE, EARLY][: len(late)], np.append(columns, late).astype(np.int64)
        chain = np.concatenate([problem.chain(vector), 2.0 * noise2[list(levels)], np.ones(len(late))])
        if zero is not None:
            lanes, columns, chain = [*lanes, offset], np.append(columns, zero), np.append(chain, problem.zero_scale)
    p = len(lanes)
    rows = np.zeros((4 * _BLOCK if slopes else 1, p + 1))
    steps, loose, knocks = _steps(problem, r), record.loose**2, _knocks(problem, r)
    push = np.zeros(record.u.size) if record.push is None else record.push
    valid, numbers = record.valid & np.array([not record.held, True]), np.array(lanes, dtype=np.int64)
    for first, last in record.parts:
        begin = max(first + (_ABOUT if first else 0), problem.skip)
        if last - begin < _ABOUT:
            continue
        z, P = _initial(problem, r, begin)
        X, states = np.zeros(ROOM), (0,) * z.size
        for at in range(begin, last, _BLOCK):
            end, rows[:] = min(at + _BLOCK, last), 0.0
            done = predict(
                states, record.u, push, loose, knocks, record.y, valid, at, end, whole, theta, numbers, chain, noise2,
                flags, 1.0 / record.rate_hz, steps, z, P, X, innovations.e, innovations.s, innovations.ahead, rows,
            )  # fmt: skip
            if not done:
                yield None
                return
            if slopes:
                yield Rows(first=at, rows=rows[: 4 * (end - at)].reshape(end - at, 4, -1), columns=columns)


def _knocks(problem: BearingProblem, r: int) -> Array:
    """Variances (n, 2) of force and back-EMF while the rotor is knocked; they do not depend on the vector."""
    record = problem.records[r]
    if record.knock is None or not record.knock.any():
        return np.zeros((record.u.size, 2))
    begun, at = {n.name: n.value for n in problem.numbers}, record.knock > 0.0
    x = np.array([record.y[at, 0].min(), record.y[at, 0].max()]) - begun["x_offset"]
    i = np.full(2, np.sqrt(np.mean(record.y[:, 1] ** 2)))
    k_i = float(np.max(np.abs(problem.law.table(x, i, begun)[0][:, 2])))
    return np.column_stack([begun["m"] * record.knock, k_i * record.knock / record.rate_hz]) ** 2


def _steps(problem: BearingProblem, r: int) -> int:
    """Steps in a sample, a power of two: more where a slow record joins a fast one, for an eddy pole, for a drop."""
    record = problem.records[r]
    slow = 0.25 * max(problem.delays) / record.rate_hz
    wanted = problem.substeps * max(slow, EDDY_STEPS if problem.flags(r)[2] else 1.0, _through(problem, record), 1.0)
    return int(2 ** round(np.log2(wanted)))


def _through(problem: BearingProblem, record: BearingRecord) -> float:
    """Steps in a sample that a stage's drop needs, two while the current runs through its width, and at most eight."""
    drop, width = (next(n for n in problem.numbers if n.name == name) for name in ("v_drop", "i_drop"))
    if not (drop.estimated or drop.value) or not record.kept[:, 1].min() < width.value > -record.kept[:, 1].max():
        return 1.0
    return min(2.0 * float(np.sqrt(np.mean(np.diff(record.kept[:, 1]) ** 2))) / width.value, 8.0)


def _initial(problem: BearingProblem, r: int, begin: int) -> tuple[Array, Array]:
    """State before sample `begin`, and its covariance, which is generous and does not depend on the vector."""
    record, flags = problem.records[r], problem.flags(r)
    rate, n = record.rate_hz, 3 + int(flags[2]) + 2 * int(flags[3])
    noise, begun = np.exp(problem.noise_center[r]), {n.name: n.value for n in problem.numbers}
    first = record.y[max(begin - _ABOUT, 0) : begin + _ABOUT]
    x = record.y[:, 0].mean() if record.held else first[:, 0].mean()
    z, P = np.zeros(n), np.zeros((n, n))
    z[0], z[2] = x - begun["x_offset"], first[:, 1].mean() - begun["i_offset"]
    moved = max(float(np.ptp(first[:, 0])), noise[0])
    if not record.held:
        z[1] = (first[-1, 0] - first[0, 0]) * rate / (len(first) - 1)
        P[0, 0], P[1, 1] = (3.0 * moved) ** 2, (moved * rate) ** 2
    P[2, 2] = (3.0 * max(float(np.ptp(first[:, 1])), noise[1])) ** 2
    # an offset that moves takes the state with it: the start must not hold it where the search began
    free, spread = {n.name for n in problem.estimated}, record.kept.std(axis=0)
    for name, place, c in (("x_offset", 0, 0), ("i_offset", 2, 1)):
        if (name in free or (record.zero is not None and c == 0)) and not (record.held and c == 0):
            P[place, place] += float(spread[c]) ** 2
    if flags[2]:  # the force behind the eddy pole starts at that of the weight
        z[3] = -begun["m"] * begun["g"]
        P[3, 3] = (0.3 * z[3]) ** 2 + (10.0 * noise[2]) ** 2
        if begin > problem.skip:  # after a stretch that was left out, the force need not be about that
            z[3] = problem.law.table(z[:1], z[2:3], begun)[0][0, 0]
            P[3, 3] += z[3] ** 2
    if flags[3]:
        walk = begin > problem.skip or record.later or r != next(k for k, x in enumerate(problem.records) if not x.held)
        P[-2, -2] = max((10.0 * noise[2]) ** 2, 0.5 * noise[4] ** 2 * begun["tau"] * rate)
        P[-1, -1] = float(np.var(record.u)) if walk else noise[5] ** 2  # v_offset is where the voltage begins to walk
    return z, P


def prior_rows(problem: BearingProblem, vector: Array) -> tuple[Array, Array]:
    """Return the priors' `r` (n_priors,) and `J` (n_priors, size): those of numbers, of positive ones log-normal, and
    the weak one on log noise levels.
    """
    values, chain = problem.values(vector), problem.chain(vector)
    r, J = [], []
    for j, n in enumerate(problem.estimated):
        if n.signed and np.isinf(n.prior_sd):
            continue
        row = np.zeros(problem.size)
        if n.signed:
            r.append((values[n.name] - n.value) / n.prior_sd)
            row[j] = chain[j] / n.prior_sd
        else:  # of the logarithm: one in SI would let a positive number run to nothing
            spread = min(n.prior_sd / n.value, NOISE_PRIOR_SD)
            r.append((vector[j] - np.log(n.value)) / spread)
            row[j] = 1.0 / spread
        J.append(row)
    first = problem.noise_slices[0].start
    centre = problem.start()[first:]
    rows = np.zeros((centre.size, problem.size))
    rows[:, first:] = np.eye(centre.size) / NOISE_PRIOR_SD
    return np.concatenate([r, (vector[first:] - centre) / NOISE_PRIOR_SD]), np.vstack([*J, rows])


def criterion(problem: BearingProblem, vector: Array) -> float:
    """Return the criterion at a vector: infinite where there is no predictor."""
    total = 0.0
    for r in range(len(problem.records)):
        innovations = run(problem, vector, r)
        if innovations is None:
            return np.inf
        total += _sum(innovations)
    prior, _ = prior_rows(problem, vector)
    total += float(prior @ prior)
    return total if np.isfinite(total) else np.inf


def linearise(problem: BearingProblem, vector: Array) -> Linear | None:
    """Return the criterion, its gradient and Fisher information as rows; None where there is no predictor."""
    prior, J_prior = prior_rows(problem, vector)
    total, scores, innovations = float(prior @ prior), list[Array](), list[Innovations]()
    parts = [np.column_stack([J_prior, np.zeros((prior.size, 2 * len(problem.settled))), prior])]
    stretch = max(1, sum(r.u.size for r in problem.records) // _BATCHES)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as threads:  # the kernel leaves Python's lock
        for one in threads.map(lambda r: _of_record(problem, vector, r, stretch), range(len(problem.records))):
            if one is None:
                return None
            innovations.append(one[0])
            total += _sum(one[0])
            scores += [*one[1]]
            parts += one[2]
    whole = triangle_of([np.vstack(parts)])
    return Linear(
        J=whole[:, : problem.size], r=whole[:, -1], criterion=total, J_delay=whole[:, problem.size : -1],
        scores=np.array(scores), innovations=tuple(innovations),
    )  # fmt: skip


def _of_record(
    problem: BearingProblem, vector: Array, r: int, stretch: int
) -> tuple[Innovations, Array, list[Array]] | None:
    """Innovations of a record, the scores of its stretches, and the triangle; None without a predictor."""
    n = problem.records[r].u.size
    innovations = Innovations.of(n)
    width = problem.size + 2 * len(problem.settled)
    own, blocks, columns = np.zeros((-(-n // stretch), width)), list[Array](), np.zeros(0, dtype=np.int64)
    for part in sweep(problem, vector, r, innovations, slopes=True, delays=True):
        if part is None or not np.all(np.abs(part.rows) < _HUGE):
            return None
        columns, m = part.columns, part.rows.shape[0]
        for b in range(part.first // stretch, (part.first + m - 1) // stretch + 1):
            rows = part.rows[max(b * stretch - part.first, 0) : (b + 1) * stretch - part.first]
            rows = rows.reshape(-1, rows.shape[2])
            own[b, columns] += rows[:, :-1].T @ rows[:, -1]
        blocks.append(triangle_of([part.rows.reshape(4 * m, -1)]))
    if not blocks:
        return innovations, own[:, : problem.size], []
    short = triangle_of([np.vstack(blocks)])
    triangle = np.zeros((columns.size + 1, width + 1))
    triangle[: short.shape[0], np.append(columns, width)] = short
    return innovations, own[:, : problem.size], [triangle]


def promise(at: Linear, delay: int | None = None) -> float:
    """Return the criterion's fall by a full Fisher step (score test of added numbers); `delay`: column of `J_delay` to
    move too.
    """
    J = at.J if delay is None else np.column_stack([at.J, at.J_delay[:, delay]])
    return directions(J).explain(at.r)


def search(
    problem: BearingProblem,
    start: Array,
    *,
    iterations: int = _ITERATIONS,
    damping: float = 1e-3,
    tick: Tick | None = None,
) -> BearingFit:
    """Minimise the criterion from `start` by at most `iterations` linearisations, `damping` at first (small for a good
    start); status ``"failed"`` where there is no predictor at `start`.
    """
    objective = _Objective(problem)
    end = descend(
        objective, start, stage=_SEARCHING, most=iterations, tolerance=0.0, settled=_SETTLED, left=_LEFT,
        damping=damping, upper=problem.upper(), longest=_LONGEST, tick=tick, keep_best=True,
    )  # fmt: skip
    at = objective.linear(end.theta)
    return BearingFit(
        problem=problem, vector=end.theta, at=at, criterion=end.cost, evaluations=objective.evaluations,
        status="failed" if at is None else end.status,  # a criterion without slopes is no place to end
    )  # fmt: skip


class _Objective:
    """The criterion as `search.Problem`; its slopes come with it where the last step went well."""

    def __init__(self, problem: BearingProblem) -> None:
        self.problem, self.evaluations, self.hopeful = problem, 0, True
        self.vector = np.zeros(0)
        self.at: Linear | None = None

    def cost(self, theta: Array) -> float:
        """Return the criterion."""
        self.evaluations += 1
        # the first step is mostly right, and wants its slopes anyway; after a refusal the criterion alone asks
        if not self.hopeful:
            return criterion(self.problem, theta)
        self.hopeful = False
        at = self.linear(theta)
        return np.inf if at is None else at.criterion

    def triangle(self, theta: Array) -> Array:
        """Return [J | r]."""
        at, self.hopeful = self.linear(theta), True
        return np.full((1, theta.size + 1), np.nan) if at is None else np.column_stack([at.J, -at.r])

    def linear(self, theta: Array) -> Linear | None:
        """Return the criterion about a vector."""
        if not np.array_equal(theta, self.vector):
            self.vector, self.at = theta, linearise(self.problem, theta)
        return self.at


def _sum(innovations: Innovations) -> float:
    with np.errstate(all="ignore"):
        measured = ~np.isnan(innovations.s)
        e, s = innovations.e[measured], innovations.s[measured]
        return float(np.sum(np.log(s) + e * e / s))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingUncertainty:
    """What a fit knows of its numbers."""

    names: tuple[str, ...]  # estimated numbers
    # (n, n), SI, covariance from the Fisher information (priors and noise levels included), and the sandwich over
    # stretches
    information: Array
    robust: Array
    delay_sd: dict[float, float]  # by rate, in samples, where it was estimated
    inflation: float  # largest ratio of robust to information standard deviation
    # (n_moves, n), SI, how far numbers move beyond chance where the records are used otherwise; part of the robust
    # covariance
    disagreement: Array

    def covariance(self, *, robust: bool) -> Array:
        """Return the covariance (n, n), SI; the robust one is nowhere smaller than the information's."""
        if not robust:
            return self.information
        ratio = np.sqrt(np.diag(self.information) / np.maximum(np.diag(self.robust), 1e-300))
        wider = np.maximum(ratio, 1.0)
        # every direction in which they move, each number by no more than it moves at most
        moves = self.disagreement.T @ self.disagreement
        largest = np.max(np.abs(self.disagreement), axis=0, initial=0.0)
        part = largest / np.sqrt(np.maximum(np.diag(moves), 1e-300))
        return np.asarray(self.robust * np.outer(wider, wider) + moves * np.outer(part, part))


def uncertainty(fit: BearingFit) -> BearingUncertainty:
    """Compute the covariances of a fit that has not failed."""
    assert fit.at is not None
    problem, at = fit.problem, fit.at
    n, chain = len(problem.estimated), problem.chain(fit.vector)
    whole = directions(at.J).inverse()
    for j, number in enumerate(problem.estimated):  # a weak prior on a logarithm says nothing of what may be zero
        if not (number.signed or np.isfinite(number.prior_sd)) and whole[j, j] > 1.0:
            left = max(1.0 - whole[j, j] / NOISE_PRIOR_SD**2, _DUST)
            whole = whole + np.outer(whole[:, j], whole[:, j]) / (NOISE_PRIOR_SD**2 * left)
    centred = at.scores - at.scores.mean(axis=0)
    middle = centred * np.sqrt(len(centred) / max(len(centred) - 1, 1))
    half = whole @ middle.T
    sandwich = half @ half.T
    unit, more = np.outer(chain, chain), 0.0 if fit.beside is None else fit.beside
    information, wide = (whole[:n, :n] + more) * unit, (sandwich[:n, :n] + more) * unit
    for j in np.flatnonzero(fit.vector[:n] >= problem.upper()[:n]).tolist():
        # at its bound: the records do not tell it from anything beyond
        information[j, j], wide[j, j] = (max(c[j, j], chain[j] ** 2) for c in (information, wide))
    ratio = np.sqrt(np.diag(wide) / np.maximum(np.diag(information), 1e-300))
    extra = [float(np.sqrt(whole[n + j, n + j])) for j in range(len(problem.rates))]
    return BearingUncertainty(
        names=tuple(number.name for number in problem.estimated),
        information=information,
        robust=wide,
        delay_sd=dict(zip(problem.rates, extra, strict=True)),
        inflation=float(ratio.max()),
        disagreement=np.zeros((0, n)),
    )


def bearing_moves(fit: BearingFit, errors: Sequence[SensorError]) -> Array:
    """Return d theta/d e of the estimated numbers where channels, the time or fixed numbers are too large by e,
    (n_estimated, n_errors), SI: -(J'J)^-1 d(J'r)/de, by which half the gradient stays zero, noise levels and delays
    among what moves. LinAlgError where a record that is hardly changed has no predictor.
    """
    assert fit.at is not None
    problem, vector, free = fit.problem, fit.vector, fit.vector < fit.problem.upper()
    inverse = directions(fit.at.J[:, free]).inverse()

    def half(error: SensorError, by: float) -> Array:
        at = linearise(with_error(problem, error, by), vector)
        if at is None:
            raise np.linalg.LinAlgError("no predictor")
        return np.asarray(at.J.T @ at.r)

    moved, chain = np.zeros((vector.size, len(errors))), problem.chain(vector)
    for k, error in enumerate(errors):
        step = _ERROR * _size(problem, error)
        slope = (half(error, step) - half(error, -step)) / (2.0 * step)
        moved[free, k] = -inverse @ slope[free]
    return chain[:, None] * moved[: chain.size]


def _size(problem: BearingProblem, error: SensorError) -> float:
    """Return what an error is small beside: one, a fixed number, or for an offset the spread of its channel."""
    if error.kind == "fixed":
        return abs(next(n.value for n in problem.numbers if n.name == error.channel))
    if error.kind in ("gain", "zero"):
        return 1.0
    moving = [r for r in problem.records if not r.held]
    return float(
        max(np.std(r.u if error.channel == "voltage" else r.y[:, _ROLES.index(error.channel)]) for r in moving)
    )


def with_error(problem: BearingProblem, error: SensorError, by: float) -> BearingProblem:
    """Return a problem in which a channel of all records, their time or a number that is known is too large."""
    if error.kind == "fixed":
        numbers = (replace(n, value=n.value + by) if n.name == error.channel else n for n in problem.numbers)
        return replace(problem, numbers=tuple(numbers))
    if error.kind == "zero":
        far = [by * r.kept.mean(axis=0) * [not r.held, 0.0] for r in problem.records]
        middle = np.mean([x for x, r in zip(far, problem.records, strict=True) if not r.held], axis=0)
        apart = (x - middle * (not r.held) for x, r in zip(far, problem.records, strict=True))
        return replace(
            problem, records=tuple(replace(r, y=r.y + x) for r, x in zip(problem.records, apart, strict=True))
        )
    gain, offset = (1.0 + by, 0.0) if error.kind == "gain" else (1.0, by)
    if error.channel == "time":
        return replace(
            problem, records=tuple(replace(r, rate_hz=r.rate_hz / gain) for r in problem.records),
            delays={rate / gain: x for rate, x in problem.delays.items()},
            free_delay=frozenset(rate / gain for rate in problem.free_delay),
        )  # fmt: skip
    if error.channel == "voltage":
        return replace(problem, records=tuple(replace(r, u=gain * r.u + offset) for r in problem.records))
    on = np.array([role == error.channel for role in _ROLES])
    return replace(
        problem, records=tuple(replace(r, y=np.where(on, gain * r.y + offset, r.y)) for r in problem.records)
    )
