"""Least squares for every lagged model: one-step or simulation errors over records, priors, and what a fit ends with.

Errors have unit variance, normal priors' rows beside them; triangles of [J | r] come block by block: constant memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import information_inverse, least_squares, triangle_of
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import Found, search
from ambid.estimation.uncertainty import sandwich
from ambid.nonlinear.fit import Attempt, NonlinearFit
from ambid.nonlinear.lagged import LaggedFunction, LaggedModel, Mask, Rows
from ambid.nonlinear.records import Parts, Scaled, cloud_of
from ambid.settings.caller import setting

_BLOCK = 4096
_LEAST = 1e-7  # standard deviation of errors, scaled
_APART = 1e-8  # of correlation: errors of two outputs are never taken as the same
_DRAWN_ON = 1000  # rows by which they are compared
_LAGS = (1, 2, 3, 4, 6)  # that are compared
_CROWDED = 0.8  # part of the errors that numbers may take up


@dataclass(frozen=True, kw_only=True, eq=False)
class LaggedProblem:
    """Weighted errors of a lagged function and the rows of its prior; what is searched is `theta` where `live`."""

    function: LaggedFunction
    parts: Parts
    weight: Array  # (n_outputs, n_outputs), by which errors are multiplied
    base: Array  # (n_theta,), all parameters; those that are not searched stay as they are here
    live: Mask  # (n_theta,), what is searched
    mean: Array  # (n_theta,), of the prior; one over its standard deviation, 0 for none
    precision: Array
    free: bool = False  # errors of the free run instead of the predictions
    joint: bool = False  # whether weights take correlation of the outputs' errors into account
    _rows: list[Rows] = field(default_factory=list)

    def rows(self) -> list[Rows]:
        """Return the measured regressors of each record, made once."""
        if not self._rows:
            self._rows.extend(self.function.rows(y, u) for y, u in self.parts)
        return self._rows

    @property
    def n_errors(self) -> int:
        """Errors in all."""
        return sum(y[self.function.lag :].size for y, _ in self.parts)

    def whole(self, v: Array) -> Array:
        """Return all parameters."""
        if v.size == self.base.size:
            return v
        out = self.base.copy()
        out[self.live] = v
        return out

    def errors(self, v: Array) -> list[Array]:
        """Return the errors of each record, scaled, shape (n_samples - lag, n_outputs); NaN from a divergence on."""
        function, theta = self.function, self.whole(v)
        if self.free:
            return [(y - function.free_run(theta, y, u)[0])[function.lag :] for y, u in self.parts]
        return [function.errors(theta, rows) for rows in self.rows()]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors and of the prior's rows; infinite where the model diverges."""
        whole = self.whole(theta)
        if not self.free and not self.function.is_stable(whole):
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            total = float(np.sum(self._prior(whole)[self.live] ** 2))
            total += sum(float(np.sum((e @ self.weight.T) ** 2)) for e in self.errors(whole))
        return total if np.isfinite(total) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], the prior's rows included."""
        with np.errstate(over="ignore", invalid="ignore"):
            triangles = [triangle_of([b.reshape(-1, b.shape[2])]) for _, b in self.blocks(theta) if b.size]
        if np.any(self.precision):
            triangles.append(self.prior_rows(theta))
        return triangles[0] if len(triangles) == 1 else triangle_of([np.concatenate(triangles)])

    def blocks(self, v: Array) -> Iterator[tuple[int, Array]]:
        """Yield record number and weighted slopes and errors of some of its rows, (n, n_outputs, n_live + 1)."""
        function, theta = self.function, self.whole(v)
        at = function.regressors.own if self.free else function.regressors.noisy
        reach = int(function.regressors.back[at].max(initial=0))
        for k, (y, u) in enumerate(self.parts):
            if self.free:
                run, z = function.free_run(theta, y, u)
                left, rows = (y - run)[function.lag :], function.rows_of(z, y)
            else:
                predicted, rows = function.predict(theta, self.rows()[k])
                left = rows.y - predicted
            before: Array | None = None
            for first in range(0, left.shape[0], _BLOCK):
                part = slice(first, first + _BLOCK)
                some = rows.part(part)
                J = function.slopes(theta, some, free=self.free, live=self.live, before=before)
                if reach:
                    before = J[-reach:].copy() if before is None else np.concatenate([before, J])[-reach:]
                yield k, np.matmul(self.weight, np.concatenate([J, left[part, :, None]], axis=2))

    def sample_rows(self, v: Array) -> list[Array]:
        """Return slopes and errors of every sample, of unit variance, (n_samples - lag, n_outputs, n_live + 1)."""
        rows: list[list[Array]] = [[] for _ in self.parts]
        for k, block in self.blocks(v):
            rows[k].append(block)
        return [np.concatenate(x) for x in rows]

    def prior_rows(self, v: Array) -> Array:
        """Return slopes and rows of the prior, (n_priors, n_live + 1)."""
        informed = self.live & (self.precision > 0)
        out = np.zeros((np.count_nonzero(informed), np.count_nonzero(self.live) + 1))
        out[np.arange(out.shape[0]), np.flatnonzero(informed[self.live])] = self.precision[informed]
        out[:, -1] = self._prior(self.whole(v))[informed]
        return out

    def _prior(self, theta: Array) -> Array:
        return np.asarray(self.precision * (self.mean - theta))

    def across(self, v: Array, noise: Array) -> Array:
        """Return the information (n_live, n_live) of scores beyond the slopes' where outputs' errors are correlated, of
        scaled covariance `noise`.
        """
        extra = self.weight @ noise @ self.weight.T
        np.fill_diagonal(extra, 0.0)
        n = int(np.count_nonzero(self.live))
        out = np.zeros((n, n))
        for _, block in self.blocks(v) if np.any(extra) else ():
            J = block[:, :, :-1]
            out += np.tensordot(J, np.matmul(extra, J), axes=([0, 1], [0, 1]))
        return (out + out.T) / 2.0

    def at(self, theta: Array, live: Mask | None = None) -> Self:
        """Return the problem around other parameters, its errors there of unit variance."""
        live = self.live if live is None else live
        moved = replace(self, base=theta, live=live)
        return replace(moved, weight=moved.weight_for(np.concatenate(moved.errors(theta))))

    def weight_for(self, errors: Array) -> Array:
        """Return what gives errors unit variance; 1 for outputs whose errors are not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            noise = errors.T @ errors / max(errors.shape[0], 1)
        return self.weight_of(np.where(np.isfinite(noise), noise, np.eye(noise.shape[0])))

    def weight_of(self, noise: Array) -> Array:
        """Return what gives errors of some covariance unit variance, and, if `joint`, makes them uncorrelated."""
        return whitening(noise) if self.joint else np.diag(1.0 / np.maximum(np.sqrt(np.diag(noise)), _LEAST))


def problem_at(
    function: LaggedFunction,
    parts: Parts,
    theta: Array,
    precision: Array | None = None,
    *,
    weight: Array | None = None,
    mean: Array | None = None,
    live: Mask | None = None,
    free: bool = False,
    joint: bool = False,
) -> LaggedProblem:
    """Return the problem around parameters, the live ones searched, errors of unit variance there, or a `weight`."""
    none = np.zeros(function.n_theta)
    problem = LaggedProblem(
        function=function, parts=parts, weight=np.eye(function.n_outputs) if weight is None else weight, base=theta,
        live=np.ones(none.size, dtype=np.bool_) if live is None else live, mean=none if mean is None else mean,
        precision=none if precision is None else precision, free=free, joint=joint,
    )  # fmt: skip
    return problem.at(theta) if weight is None else problem


def whitening(noise: Array) -> Array:
    """Return W, lower triangular, with W noise W' = 1; finite also where errors vanish, or are alike in two outputs."""
    size = np.maximum(np.sqrt(np.diag(noise)), _LEAST)
    alike = (1.0 - _APART) * noise / size[:, None] / size
    np.fill_diagonal(alike, 1.0)
    out: Array = np.linalg.inv(np.linalg.cholesky(alike)) / size
    return out


def split(parts: Parts, share: float, lag: int) -> tuple[Parts, Parts]:
    """Cut the end off each record: training, and what is held out, with `lag` samples before it as its past."""
    if not share > 0:
        return parts, ()
    cuts = [max(round(y.shape[0] * (1.0 - share)), lag + 1) for y, _ in parts]
    training = tuple((y[:c], u[:c]) for c, (y, u) in zip(cuts, parts, strict=True))
    validation = tuple((y[c - lag :], u[c - lag :]) for c, (y, u) in zip(cuts, parts, strict=True))
    return training, validation


def rms_error(function: LaggedFunction, theta: Array, parts: Parts, *, free: bool = False) -> float:
    """Return the root mean square error in deviations of the outputs; infinite where the model diverges."""
    problem = problem_at(function, parts, theta, weight=np.eye(function.n_outputs), free=free)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.sqrt(np.mean(np.concatenate(problem.errors(theta)) ** 2)))
    return error if np.isfinite(error) else np.inf


Size = dict[str, Any]
"""What a model may be, by the names of its settings."""


def choose_smallest(
    sizes: Sequence[Size], score: Callable[[Size, Tick | None], float], tried: list[Size], near: float,
    tick: Tick | None,
) -> Size:  # fmt: skip
    """Return the first size, smallest first, within `near` times the best's `score`, its error on held-out data, added
    to `tried`; one size alone is not scored.
    """
    if len(sizes) == 1:
        return sizes[0]
    errors = list[float]()
    for one, share in zip(sizes, portions(tick, (1.0,) * len(sizes)), strict=True):
        if share is not None:
            share(f"choice of {' and '.join(one)}", 0.0)
        errors.append(score(one, share))
        tried.append({**one, "held_out_rms": errors[-1]})
    return sizes[next((k for k, x in enumerate(errors) if x <= near * min(errors)), 0)]


def lag_sizes(ny: int | None, nu: int | None, nk: int, parts: Parts, share: float) -> list[Size]:
    """Return the lags that are compared where they are left open, each once; none too many for what is held out."""
    short, some = min(y.shape[0] for y, _ in parts), bool(parts[0][1].shape[1])
    tries = [k for k in _LAGS if 3 * (k + nk) < short * share] or [1]
    sizes = [{"ny": k if ny is None else ny, "nu": (k if nu is None else nu) * some} for k in tries]
    return [x for i, x in enumerate(sizes) if x not in sizes[:i]]


def solve_linear(problem: LaggedProblem, n: int, v: Array) -> Array:
    """Return what is searched with its first `n` numbers, linear in the errors, at their best, if finite."""
    place = np.flatnonzero(problem.live)[:n]
    part = replace(problem, base=problem.whole(v), live=np.isin(np.arange(problem.base.size), place))
    R, out = part.triangle(v[:n]), v.copy()
    if np.all(np.isfinite(R)):
        out[:n] += least_squares(R[:, :-1], R[:, -1])
    return out


def linear_start(function: LaggedFunction, parts: Parts, n: int) -> Array:
    """Return the first `n` numbers of a function, those of a linear model, by least squares, all others zero."""
    theta = np.zeros(function.n_theta)
    return solve_linear(problem_at(function, parts, theta, weight=np.eye(function.n_outputs)), n, theta)


def draw_start(
    problem: LaggedProblem, n: int, v: Array, neurons: int, width: int, rng: np.random.Generator, draws: int
) -> Array:
    """Return what is searched with the best of some random hidden layers, its last numbers, whose units bend inside the
    data, by errors over the records' beginning after `solve_linear`.
    """
    most = problem.function.lag + _DRAWN_ON // len(problem.parts)
    few = replace(problem, parts=tuple((y[:most], u[:most]) for y, u in problem.parts), _rows=[])
    best, least = v, np.inf
    for _ in range(draws):
        trial = v.copy()
        trial[v.size - neurons * (width + 1) :] = np.concatenate(
            [rng.standard_normal(neurons * width) / np.sqrt(max(width, 1)), rng.standard_normal(neurons)]
        )
        trial = solve_linear(few, n, trial)
        cost = few.cost(trial)
        if cost < least:
            best, least = trial, cost
    return best


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Laplace:
    """Laplace's approximation at the most probable parameters (MacKay 1992)."""

    covariance: Array | None  # (n_live, n_live); None where data and prior leave a direction open
    noise: Array  # (n_outputs, n_outputs), scaled, covariance of the errors
    effective: float  # numbers that the data determine: those searched less what the prior alone does
    condition: float  # of the scaled Jacobian, the prior's rows included
    triangle: Array  # of the slopes, the prior's included


def laplace(problem: LaggedProblem, theta: Array) -> Laplace:
    """Return the inverse of the information, the prior's included; correlation of the outputs' errors counts."""
    v = problem.whole(theta)[problem.live]
    errors = np.concatenate(problem.errors(v))
    n, p = errors.shape
    noise, effective = errors.T @ errors / n, float(v.size)
    for _ in range(2):  # the degrees of freedom are those that the prior leaves
        at = replace(problem, weight=problem.weight_of(noise))
        R = at.triangle(v)[:, :-1]
        P, condition = information_inverse(R)
        if P is None:
            break
        effective = float(v.size - np.sum(np.diag(P) * problem.precision[problem.live] ** 2))
        noise = errors.T @ errors / max(n - effective / p, 1.0)
    if P is not None and p > 1 and not problem.joint:
        P = P + P @ replace(problem, weight=problem.weight_of(noise)).across(v, noise) @ P
    return Laplace(covariance=P, noise=noise, effective=effective, condition=condition, triangle=R)


class SampledProblem(Protocol):
    """A problem of least squares that tells the rows of each sample."""

    def triangle(self, theta: Array) -> Array: ...  # noqa: D102
    def sample_rows(self, v: Array) -> list[Array]: ...  # noqa: D102
    def prior_rows(self, v: Array) -> Array: ...  # noqa: D102


def sandwich_at(problem: SampledProblem, v: Array) -> Array | None:
    """Return the covariance that does not take errors as white; None where data and prior leave a direction open."""
    rows, prior = problem.sample_rows(v), problem.prior_rows(v)[:, :-1]
    scores = [np.einsum("tok,to->tk", r[:, :, :-1], r[:, :, -1]) for r in rows]
    return sandwich(problem.triangle(v)[:, :-1], scores, prior.T @ prior, [r[:, :, :-1] for r in rows])[0]


F = TypeVar("F", bound=LaggedFunction)


@dataclass(slots=True, kw_only=True)
class Draft(Attempt, Generic[F]):
    """What the fit of a lagged function has come to."""

    data: Scaled
    function: F
    theta: Array  # (n_theta,), scaled
    free: bool = False  # whether `theta` is that of simulation errors
    stopped_early: bool = False
    held_out: float = float("nan")  # error on held-out data; NaN without

    def keep(self, theta: Array) -> None:
        """Take over other parameters."""
        self.theta = theta

    def note(self, ended: Found, problem: LaggedProblem, method: str) -> None:
        """Add the learning curve of a search."""
        noise = np.linalg.inv(problem.weight) if np.isfinite(ended.cost) else np.eye(problem.weight.shape[0])
        size = float(np.sqrt(np.sum(noise**2) / noise.shape[0]))
        self.note_curve(ended, method, problem.n_errors, size)

    def settle(self, ended: Found, problem: LaggedProblem, method: str) -> None:
        """Add the learning curve of a search, and whether it converged."""
        self.note(ended, problem, method)
        self.status = "converged" if ended.converged else "stalled"


def train_watched(
    draft: Draft[Any],
    problem_of: Callable[[Parts, Array], LaggedProblem],
    share: float,
    method: str,
    tick: Tick | None,
    *,
    n_linear: int,
    **options: Any,
) -> Found:
    """Train a draft watched on the held-out `share` of each record, on all data where nothing overfits; `problem_of`:
    the problem of records about parameters; `n_linear`: see `solve_linear`.
    """
    training, validation = split(draft.data.parts, share, draft.function.lag)
    first, second = portions(tick, (1.0, 1.0 * bool(validation)))

    def run(some: Parts, **more: Any) -> tuple[LaggedProblem, Found]:
        problem = problem_of(some, draft.theta)
        solved = partial(solve_linear, problem, n_linear)
        return problem, search(
            problem, draft.theta, keep=draft.keep, solved=solved, n_linear=n_linear, **options, **more
        )

    def watch(theta: Array) -> float:
        return rms_error(draft.function, theta, validation)

    problem, ended = run(training, stage="training", held_out=watch if validation else None, tick=first)
    draft.keep(ended.theta)
    draft.note(ended, problem, method)
    draft.stopped_early = ended.stopped_early
    draft.held_out = watch(ended.theta) if validation else float("nan")
    if validation and not ended.stopped_early:
        _, ended = run(draft.data.parts, stage="all data", tick=second)
        draft.keep(ended.theta)
    draft.status = "converged" if ended.converged else "stalled"
    return ended


def refine(
    draft: Draft[Any], problem_of: Callable[[Array], LaggedProblem], most: int, tick: Tick | None, units: str
) -> None:
    """Go on with the errors of the free run; `problem_of` gives its problem around parameters."""
    problem = problem_of(draft.theta)
    if not np.isfinite(problem.cost(draft.theta)):
        draft.status = "stalled"
        draft.warnings.append(
            f"the simulation diverges, so that the weights are those of the one-step errors: use fewer {units} or "
            "other lags"
        )
        return

    def keep(v: Array) -> None:
        draft.theta, draft.free = problem.whole(v), True

    rounds = 1 if draft.function.n_outputs == 1 else 2  # the sizes of several outputs' errors are known only afterwards
    for part in portions(tick, (1.0,) * rounds):
        start = draft.theta[problem.live]
        ended = search(problem, start, stage="simulation errors", most=most, tick=part, keep=keep)
        keep(ended.theta)
        draft.settle(ended, problem, "Levenberg-Marquardt, simulation errors")
        problem = problem_of(draft.theta)


def finish(
    draft: Draft[Any],
    problem: LaggedProblem,
    posterior: Laplace,
    *,
    units: str,
    how: str = "auto",
    why_not: str = "",
    noise: bool = False,
    instead: str = "Use narmax or nn",
) -> NonlinearFit:
    """Return a draft's fit in SI, its covariance, and what a reader must be told. `units`: of which a model has too
    many; `how`: setting ``uncertainty``; `why_not`: no standard deviations; `instead`: without a `noise` model feedback
    does harm.
    """
    records, data, share = draft.records, draft.data, posterior.effective / problem.n_errors
    if share > _CROWDED:
        draft.warnings.append(
            f"the data determine {share:.0%} as many parameters as there are errors: the model overfits, and "
            f"standard deviations are unreliable. Use fewer {units}, or a longer record"
        )
    if draft.stopped_early:
        draft.warnings.append(
            f"training was stopped at the smallest held-out error: more {units.split()[0]} than the data support; "
            "standard deviations are those of a linearisation there"
        )
    if not draft.free and not np.isfinite(rms_error(draft.function, draft.theta, problem.parts, free=True)):
        draft.warnings.append(
            "the simulation diverges on the training records: the model is fit for prediction, not for simulation"
        )
    if not noise and records[0].n_inputs and not all(x.open_loop for x in records):
        draft.warnings.append(
            f"{draft.structure} has no noise model: trained on {'simulation' if draft.free else 'one-step errors'}, it "
            f"is biased by feedback unless its errors are white. {instead}, or give {setting('open_loop', True)} if "
            "the records are "
            "open loop"
        )
    robust = how == "sandwich" or (draft.free and how == "auto")
    origin = "sandwich" if robust else "laplace" if np.any(problem.precision) else "information"
    covariance = posterior.covariance
    if robust and not why_not:
        covariance = sandwich_at(problem, problem.whole(draft.theta)[problem.live])
    if how == "none":
        why_not = "no standard deviations: no covariance was requested"
    elif draft.free and origin == "laplace" and not why_not:
        why_not = (
            "no standard deviations: simulation errors are coloured, and Laplace's approximation assumes white "
            "ones. Give uncertainty = sandwich"
        )
    elif covariance is None and not why_not:
        why_not = (
            "no standard deviations: data and prior do not determine the parameters (condition number "
            f"{posterior.condition:.1e}). Use fewer {units}, or more excitation"
        )
    if why_not:
        draft.warnings.append(why_not)
    began, function, whole = perf_counter(), draft.function, None
    unit = np.broadcast_to(function.unit(data.y_scale, data.u_scale), draft.theta.shape)
    if covariance is not None and not why_not:
        whole = np.zeros((draft.theta.size, draft.theta.size))
        whole[np.ix_(problem.live, problem.live)] = covariance
        whole *= unit[:, None] * unit
    x = np.concatenate([r.x[:, function.in_cloud] for r in problem.rows()])
    model = LaggedModel(
        dt=records[0].dt, function=function, theta=draft.theta * unit, u_level=data.u_level, u_scale=data.u_scale,
        y_level=data.y_level, y_scale=data.y_scale, cloud=cloud_of(x, ellipsoid=function.ellipsoid),
    )  # fmt: skip
    draft.timed("result", began)
    draft.timing_s["all"] = sum(draft.timing_s.values())
    if np.any(problem.precision):
        draft.details = {"effective_parameters": posterior.effective, **draft.details}
    return draft.result(
        model=model, covariance=whole, covariance_from="" if whole is None else origin,
        n_estimated=int(np.count_nonzero(problem.live)),
        noise_covariance=posterior.noise * data.y_scale[:, None] * data.y_scale,
    )  # fmt: skip
