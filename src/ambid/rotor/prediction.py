"""The innovations-form predictor of a rotor: maximum likelihood from any record, by `ambid.estimation.predictor` (Ljung
1999, sec. 4.3, 7.4). Unstable plants and feedback need no care: innovations do not depend on inputs to come.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.colours import Colour, Coloured, coloured, colours_of, plain_of, with_colours
from ambid.estimation.likelihood import (
    Fit,
    innovations,
    prior_rows,
    residual_blocks,
    score_statistic,
    search,
    weight_of,
    workspace_near,
)
from ambid.estimation.linear import directions, triangle_of
from ambid.estimation.predictor import PredictorProblem, Scales, noise_floor
from ambid.estimation.progress import Tick, silent
from ambid.physics.linear_model import Parameter, ParameterSpec, StateSpace, discretise
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import SensorError
from ambid.record import Record
from ambid.rig.rotor import RigModes
from ambid.rotor.estimator import Ending, Work, unknowns_at
from ambid.rotor.likelihood import Experiment, Point
from ambid.rotor.scores import Cause, Score, beyond_ends, causes_of, scored
from ambid.rotor.spectra import PeriodSpectra, windowed_spectra
from ambid.rotor.unknowns import Unknowns

_FIRST = 12_000  # samples that a first search is made on
_REACH = 20  # samples within which a state shows in the outputs
_REST = 4  # samples beside the longest delay that are left out at the start: fits with other delays see the same data
_WHOLE = 0.01  # samples by which a delay that is estimated may miss a whole number however exact it is
_ROUNDING = 1e-9
_COLOURED = ("_force", "_voltage", "_position", "_current")  # kinds of sources
_SLOWEST, _POLES = 4.0, 7  # pole of coloured noise times the record, that is tried first, and how many up to the rate
_LEVEL = -2.0  # log level of disturbances at the start


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorFit(Ending):
    """Where the search on innovations ended."""

    spectra: PeriodSpectra  # windowed, of the start
    fit: Fit  # of the core's problem, in which noise, offsets and the first state are numbers too


@dataclass(frozen=True, kw_only=True, eq=False)
class Searched:
    """A rotor as a linear model of the numbers that are searched."""

    unknowns: Unknowns
    base: Point
    name: str = "rotor"
    summary: str = "rotor by the numbers that are searched"
    parameters: tuple[ParameterSpec, ...] = field(default=())

    @property
    def rotor(self) -> RotorModel:
        """The rotor at the speed of the record."""
        return self.unknowns.model

    @property
    def inputs(self) -> tuple[str, ...]:
        """Of the rotor."""
        return self.rotor.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Of the rotor."""
        return self.rotor.outputs

    @property
    def states(self) -> tuple[str, ...]:
        """Of the rotor."""
        return self.rotor.states

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Of the rotor."""
        return self.rotor.disturbances

    @property
    def units(self) -> Mapping[str, str]:
        """Of the rotor's signals."""
        return self.rotor.units

    def vector(self, theta: Mapping[str, float]) -> Array:
        """Return the vector of unknowns; delays rest at those of the base."""
        free = self.base.delays[list(self.unknowns.free_delays)]
        return np.array([*theta.values(), *free])

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the rotor's matrices."""
        at = self.unknowns.unpack(self.vector(theta), self.base.theta, self.base.delays)[0]
        return self.rotor.matrices(at)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the rotor's derivative by the chain rule."""
        v = self.vector(theta)
        names, chain = self.unknowns.chain(v)
        at, _ = self.unknowns.unpack(v, self.base.theta, self.base.delays)
        column = chain[: len(names), self.unknowns.names.index(parameter)]
        parts = [(x, self.rotor.derivative(at, name)) for name, x in zip(names, column.tolist(), strict=True) if x]
        A, B, E, C = (sum(x * getattr(d, which) for x, d in parts) for which in "ABEC")
        return StateSpace(A=A, B=B, E=E, C=C)

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return one for what may be zero: it is over its size already."""
        return {name: 1.0 for name in self.unknowns.linear if name in theta}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Erring(Searched):
    """The same with the sizes of causes, all zero, as further numbers."""

    causes: Mapping[str, Cause]

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the rotor's matrices."""
        return super().matrices({k: x for k, x in theta.items() if k not in self.causes})

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the derivative by a number or by the size of a cause: of what is logged, y = C x, for it."""
        own = {k: x for k, x in theta.items() if k not in self.causes}
        if parameter not in self.causes:
            return super().derivative(own, parameter)
        at, _ = self.unknowns.unpack(self.vector(own), self.base.theta, self.base.delays)
        space = self.rotor.matrices(at)
        moved = StateSpace(A=0.0 * space.A, B=0.0 * space.B, E=0.0 * space.E, C=0.0 * space.C)
        for error in self.causes[parameter].errors:
            if error.kind == "fixed":
                d = self.rotor.derivative(at, error.channel)
                moved = StateSpace(A=moved.A + d.A, B=moved.B + d.B, E=moved.E + d.E, C=moved.C + d.C)
            elif error.channel in self.inputs and error.kind == "gain":
                k = self.inputs.index(error.channel)
                moved.B[:, k] -= space.B[:, k]
            elif not error.moves_signal:
                k = self.outputs.index(error.channel)
                row = {"gain": space.C[k], "lag": -space.C[k] @ space.A}
                moved.C[k] += row[error.kind] if error.kind in row else space.C[self.outputs.index(error.other)]
        return moved


def predictor_scores(found: PredictorFit) -> list[Score]:
    """Return the causes that the innovations may have: fixed numbers, gains, cross-talk, lags, amplifiers' limits."""
    fit, searched = found.fit, searched_of(found.fit)
    causes = {c.name: c for c in causes_of(searched.unknowns) if c.errors}
    old, n, more = fit.problem, fit.problem.n_physical, len(causes)
    erring = _Erring(unknowns=searched.unknowns, base=searched.base, causes=causes)
    problem = replace(
        old, model=Coloured(plain=erring, colours=colours_of(old)), estimated=(*old.estimated, *causes),
        magnitude=np.append(old.magnitude, np.ones(more)), joint_priors=None,
        prior_mean=np.append(old.prior_mean, np.zeros(more)), prior_sd=np.append(old.prior_sd, np.full(more, np.inf)),
    )  # fmt: skip
    weight, vector = weight_of(fit.covariance), np.insert(fit.vector, n, np.zeros(more))
    moved, first, parts = _moved_columns(fit, tuple(causes.values())), 0, list[Array]()
    for block in residual_blocks(problem, vector, weight, workspace_near(fit, problem)):
        rows = block.copy()
        rows[:, :, n : n + more] += np.einsum("ij,tjk->tik", weight, moved[first : first + len(rows)])
        parts.append(triangle_of([rows.reshape(-1, problem.size + 1)]))
        first += len(rows)
    if not parts:
        return []
    r, J = prior_rows(problem, vector)
    rows = triangle_of([*parts, np.column_stack([J, r])])
    of_noise = np.zeros(problem.size, dtype=np.bool_)
    of_noise[problem.slices["noise"]] = True  # levels take up a part of what is left out
    of_noise[n : n + more] = True
    C, J, r = rows[:, n : n + more], rows[:, :-1][:, ~of_noise], rows[:, -1]
    return scored(tuple(causes.values()), C, J, -r, old.y.size)


def _moved_columns(fit: Fit, causes: Sequence[Cause]) -> Array:
    """Return what errors that move signals, and no matrix of the plant, do to the innovations, (n_used, n_y, n_causes):
    of a limiter a signal by its part beyond the outer ones, of a lag an input by its own last step, an output by that
    from its last value to what is predicted.
    """
    problem, plant = fit.problem, fit.problem.model
    e = innovations(problem, fit.vector)
    assert e is not None
    used = slice(problem.skip, None)
    predicted, columns = problem.y[used] - e * problem.scales.output, np.zeros((*e.shape, len(causes)))
    of_inputs, of_outputs = beyond_ends(problem.u), beyond_ends(predicted)
    of = dict[SensorError, Array]()
    for k, cause in enumerate(causes):
        for error in (x for x in cause.errors if x.moves_signal):
            if error not in of:
                u, y, limits = problem.u.copy(), problem.y.copy(), error.kind == "limiter"
                if error.channel in plant.inputs:
                    j = plant.inputs.index(error.channel)
                    turned = -1.0 if error.channel.endswith("_current") else 1.0  # measured, where a voltage acts
                    u[1:, j] += turned * (of_inputs[1:, j] if limits else -np.diff(problem.u[:, j]))
                else:
                    j = plant.outputs.index(error.channel)
                    y[used, j] += -of_outputs[:, j] if limits else predicted[:, j] - problem.y[problem.skip - 1 : -1, j]
                moved = innovations(replace(problem, u=u, y=y), fit.vector)
                assert moved is not None
                of[error] = (1.0 if limits else problem.rate_hz) * (moved - e)
            columns[:, :, k] += of[error]
    return columns


def predict_rotor(
    record: Record,
    model: RotorModel,
    parameters: Sequence[Parameter],
    *,
    speed: float,
    delays: Sequence[float | None],
    modes: RigModes = RigModes(),  # noqa: B008 - a frozen value
    tick: Tick = silent,
) -> PredictorFit:
    """Estimate a rotor from one record (channels by role) at a speed in rad/s by its innovations, start values from
    windowed spectra; the rest as `estimate_rotor`.
    """
    tick("start", 0.0)
    spectra = windowed_spectra(record, model, speed)
    experiment = Experiment(spectra=spectra, speed=speed)
    work = Work(model=model, parameters=parameters, delays=delays, modes=modes, tick=tick)
    found, at = work.rough_start([experiment])
    near = np.array([np.round(x) if d is None else d for x, d in zip(at.delays, delays, strict=True)])
    skip = int(near.max()) + _REST

    def problem_at(
        model: RotorModel, point: Point, free: Sequence[int] = (), last: Fit | None = None
    ) -> tuple[PredictorProblem, Array]:
        problem, vector = predictor_problem(record, model, parameters, point, free, skip=skip)
        if last is not None:  # offsets and first state follow by themselves
            scales = last.problem.scales
            rest = scales.disturbance[: len(model.disturbances)]
            problem = replace(problem, scales=replace(scales, state=problem.scales.state, disturbance=rest))
            problem, vector = with_colours(problem, vector, colours_of(last.problem))
            vector[problem.slices["noise"]] = last.vector[last.problem.slices["noise"]]
        return problem, vector

    fit = _search(*problem_at(found.at_speed(speed), replace(at, delays=near)), tick)
    while (more := work.one_more(experiment, _rotor_of(fit), _point_of(fit))) is not None:
        price = float(np.log(fit.problem.y.size)) * (3 + len(model.places))
        trial = search(*problem_at(more[0].at_speed(speed), replace(more[1], delays=near), last=fit))
        if trial.status == "failed" or not fit.criterion - trial.criterion > price:
            break
        fit = trial
    # after the modes, which it would stand in for
    fit = _coloured(fit, lambda x: predictor_scores(_ended(x, spectra, speed)), lambda: tick("fit", 0.7))
    free = tuple(k for k, d in enumerate(delays) if d is None)
    if free:
        fit = _with_delays(fit, free, problem_at, lambda: tick("fit", 0.9))
    return _ended(fit, spectra, speed)


def predictor_problem(
    record: Record,
    model: RotorModel,
    parameters: Sequence[Parameter],
    at: Point,
    free: Sequence[int] = (),
    skip: int = 0,
) -> tuple[PredictorProblem, Array]:
    """Return the core's problem at a point, and its vector there; `free`: inputs whose delay is searched; `skip`:
    samples left out at the start, at least.
    """
    unknowns = unknowns_at(model, parameters, at, free)
    searched = Searched(unknowns=unknowns, base=at)
    u, y = (np.column_stack([record[r].values for r in roles]) for roles in (model.inputs, model.outputs))
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    whole = np.floor(at.delays + _ROUNDING).astype(int)
    least = int(whole.min())
    u = _late(u, whole - least)  # one delay for all inputs is left
    n = len(unknowns.names) - len(free)
    names = unknowns.names[:n]
    n_d, n_y = len(model.disturbances), len(model.outputs)
    problem = PredictorProblem(
        model=searched, rate_hz=record.rate_hz, u=u, y=y, estimated=names, known={}, magnitude=np.ones(n),
        prior_mean=np.zeros(n), prior_sd=np.full(n, np.inf),
        scales=_scales(model, at.theta, u, noise_floor(y), record.rate_hz),
        delay=least, lag=np.maximum(at.delays - whole, 0.0), fractional=bool(free), late=tuple(free),
        skip=max(skip, int(whole.max()) + 2),
        noise_center=np.concatenate([np.full(n_d, _LEVEL), np.zeros(n_y - 1)]), joint_priors=_joint_priors(searched),
    )  # fmt: skip
    vector = np.zeros(problem.size)
    vector[:n] = unknowns.pack(at.theta, at.delays)[:n]
    vector[problem.slices["fraction"]] = (at.delays - whole)[list(free)]
    vector[problem.slices["noise"]] = problem.noise_center
    return problem, vector


def _coloured(fit: Fit, causes_of: Callable[[Fit], list[Score]], tick: Callable[[], None]) -> Fit:
    """Return a fit whose noise has low-pass parts of one pole in all sources of a kind, kind after kind, where the
    likelihood wants them, and more than it wants any cause that the innovations may have.
    """
    rotor, poles = _rotor_of(fit), np.geomspace(_SLOWEST / fit.problem.n_used, 1.0, _POLES) * fit.problem.rate_hz
    kinds = [[s for s in (*rotor.disturbances, *rotor.outputs) if kind in s] for kind in _COLOURED]
    while True:
        had = {c.source for c in colours_of(fit.problem)}
        left = [x for x in kinds if x and had.isdisjoint(x)]
        more = coloured(fit, [[Colour(source=s, omega=p) for s in x] for x, p in product(left, poles.tolist())], tick)
        if more is None or not fit.criterion - more.criterion > max((s.gain for s in causes_of(fit)[:1]), default=0.0):
            return fit
        fit = more


def _joint_priors(searched: Searched) -> Callable[[Array], tuple[Array, Array]]:
    """Priors of the unknowns, by the numbers without the delays, which have none."""

    def rows(values: Array) -> tuple[Array, Array]:
        unknowns = searched.unknowns
        v = np.concatenate([values, searched.base.delays[list(unknowns.free_delays)]])
        slopes, left = unknowns.priors(v)
        return slopes[:, : values.size], left

    return rows


def _scales(model: RotorModel, theta: Mapping[str, float], u: Array, floor: Array, rate_hz: float) -> Scales:
    """Return scales: of a state or disturbance what moves an output by its noise within some samples."""
    space, _ = discretise(model.matrices(theta), 1.0 / rate_hz)
    rows, reach = space.C / floor[:, None], np.zeros(space.A.shape[0])
    for k in range(_REACH):
        reach = np.maximum(reach, np.max(np.abs(rows), axis=0))
        if k == 1:
            push = np.max(np.abs(np.vstack([space.C / floor[:, None], rows]) @ space.E), axis=0)
        rows = rows @ space.A
    return Scales(state=1.0 / reach, input=np.std(u, axis=0), output=floor, disturbance=1.0 / push)


def _search(problem: PredictorProblem, vector: Array, tick: Tick) -> Fit:
    """Search on the first part of a long record, then on all of it."""
    if problem.y.shape[0] > 2 * _FIRST:
        part = replace(problem, u=problem.u[:_FIRST], y=problem.y[:_FIRST])
        first = search(part, vector, tick=lambda: tick("fit", 0.2))
        vector = first.vector if first.status != "failed" else vector
    fit = search(problem, vector, tick=lambda: tick("fit", 0.6))
    if fit.status == "failed":
        raise EstimationError(
            "the search found no stable predictor for this record. Check columns, signs, planes and fixed values"
        )
    return fit


_ProblemAt = Callable[[RotorModel, Point, Sequence[int], Fit], tuple[PredictorProblem, Array]]


def _with_delays(fit: Fit, free: tuple[int, ...], problem_at: _ProblemAt, tick: Callable[[], None]) -> Fit:
    """Estimate delays as real numbers where the score test asks for it. Those that rest at whole samples, where the
    criterion has an edge, are held there, and the others searched once more.
    """
    rotor = _rotor_of(fit)
    loose, vector = problem_at(rotor, _point_of(fit), free, fit)
    price = len(free) * float(np.log(fit.problem.n_used))
    if score_statistic(fit, loose, vector) < price:
        return fit
    freed = search(loose, vector, tick=tick)
    if freed.status == "failed" or not fit.criterion - freed.criterion > price:
        return fit
    at = _point_of(freed)
    delays, whole = at.delays.copy(), np.round(at.delays)
    sd = np.sqrt(np.diag(directions(freed.J).inverse()))[loose.slices["fraction"]]
    near = [k for k, s in zip(free, sd.tolist(), strict=True) if abs(delays[k] - whole[k]) < max(3.0 * s, _WHOLE)]
    if not near:
        return freed
    delays[near] = whole[near]
    rest = [k for k in free if k not in near]
    settled = search(*problem_at(rotor, replace(at, delays=delays), rest, freed), tick=tick)
    return settled if settled.criterion - freed.criterion < price else freed


def _late(u: Array, delays: NDArray[np.intp]) -> Array:
    """Return inputs, each later by whole samples; before the first they stand still."""
    out = u.copy()
    for j, k in enumerate(delays.tolist()):
        if k:
            out[k:, j], out[:k, j] = u[:-k, j], u[0, j]
    return out


def searched_of(fit: Fit) -> Searched:
    """Return the model of a fit."""
    searched = plain_of(fit.problem.model)
    assert isinstance(searched, Searched)
    return searched


def _rotor_of(fit: Fit) -> RotorModel:
    """Return the rotor of a fit, with its modes."""
    return searched_of(fit).rotor


def _point_of(fit: Fit) -> Point:
    """Return the rotor's numbers and delays of a fit."""
    problem, searched = fit.problem, searched_of(fit)
    vector = np.concatenate(
        [fit.vector[: problem.n_physical], searched.base.delays[list(searched.unknowns.free_delays)]]
    )
    theta, delays = searched.unknowns.unpack(vector, searched.base.theta, searched.base.delays)
    if problem.fractional:
        late = list(problem.late)
        delays[late] = np.floor(delays[late] + _ROUNDING) + fit.vector[problem.slices["fraction"]]
    return Point(theta=theta, delays=delays)


def _ended(fit: Fit, spectra: PeriodSpectra, speed: float) -> PredictorFit:
    """Return the end of a search by the unknowns: numbers of noise, offsets and first state are taken out by QR."""
    problem, searched = fit.problem, searched_of(fit)
    n = problem.slices["fraction"].stop
    rows = np.vstack([np.column_stack([fit.J, np.zeros(len(fit.J))]), np.column_stack([fit.J_prior, -fit.r_prior])])
    order = [*range(n, problem.size), *range(n), problem.size]
    triangle = triangle_of([rows[:, order]])[problem.size - n :, problem.size - n :]
    vector = searched.unknowns.pack((at := _point_of(fit)).theta, at.delays)
    return PredictorFit(
        unknowns=searched.unknowns, base=searched.base, vector=vector, status=fit.status, triangle=triangle,
        band_hz=(float(spectra.frequency_hz[0]), float(spectra.frequency_hz[-1])),
        speeds=(speed,), spectra=spectra, fit=fit,
    )  # fmt: skip
