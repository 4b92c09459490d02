"""What the model of one axis leaves out: score tests of the innovations, by cause.

Each cause is a known signal times an unknown size: a force or a voltage beyond the model, or an error of a sensor. It
moves the innovations by a column c, the signal's way through the predictor; with J the slopes of all estimated numbers
and c⊥ the part of c outside J's space,

    size = -c⊥ᵀ e / |c⊥|²,   gain = (c⊥ᵀ e)² / |c⊥|²,   shift of the estimate = (JᵀJ)⁻¹ Jᵀ c · c⊥ᵀ e / |c⊥|²

are what the cause would have to be, the fall of the criterion, chi-squared if the model is right (Rao 1948), and what
leaving it out has done to the parameters. Causes of several columns are tested together. Lines stand out of the
periodogram of the whitened innovations; the channel is told by the direction in which they point.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.bearing.uncertainty import farthest
from ambid.estimation.calibration import explaining, lines_of
from ambid.estimation.colours import Colour, coloured, colours_of, likely_colours, resettled
from ambid.estimation.estimate import Check
from ambid.estimation.kernels import state_scan
from ambid.estimation.likelihood import (
    Fit,
    Freed,
    free_one,
    innovations,
    residual_blocks,
    search,
    weight_of,
    workspace_near,
)
from ambid.estimation.linear import column_sizes, directions, periods_near, waves_at, without
from ambid.estimation.predictor import Predictor, PredictorProblem, assemble, busiest
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.record import Record
from ambid.rig import Rig
from ambid.validation.cause_signals import SAME_AS, TEXT, WAVES, Column, Course, groups_of
from ambid.validation.facts import between_samples

_LONGEST = 100_000  # samples that are looked at, the busiest
_CHANCE = 1e-4  # probability below which a cause counts as seen
_ALIKE = 0.7  # part of the strongest cause's gain from which another explains the record about as well
_BLIND = 1e-12  # eigenvalue, over the largest, of directions that are not seen
_SAME = 1e-5  # part of a column outside the Jacobian's space, squared, below which the data do not tell it from J
_SMOOTH = 9  # lines that are averaged to see a mode or a band
_NARROW = 0.6  # part of the power around a line that its own three frequencies hold
_LINES, _SKIRT = 6, 4  # lines that are taken together, and how far each reaches
_CLEAR = 10.0  # power, of noise one, that no other channel of a line may leave less than, nor its own more
_PENALTY = 2.0  # gain that each column costs a cause when causes are compared
_LINE = 1e-6  # probability of a line by chance, over all frequencies
_CHANNELS = ("force", "voltage", "position", "current")
_NOISE = {f"{how}_{where}" for how in ("slow", "coloured") for where in _CHANNELS}
"""Noise that is not white."""
_IN_TIME = {*_NOISE, "line", "r_drift"}
"""Causes that change in time, which no constant of the plant can imitate."""
_GROWING = {
    *_IN_TIME, "eddy_pole", "sensor_lag", "current_sensor_pole", "cross_talk", "curvature", "dead_time",
    "friction", "amplifier_lag",
}  # fmt: skip
"""Causes whose signals are known but for their sizes."""
_KNOWN = {"fixed_value", "sensor_gain", "rate"}
"""Causes in what the rig says."""
_OPPOSING = {"dead_time", "friction", "amplifier_lag", "current_sensor_pole"}
"""Causes that physics gives a sign."""
OF_THE_MODEL = {
    "causes", "residuals_white", "residuals_uncorrelated", "uncertainty_consistent", "estimates_agree",
}  # fmt: skip
"""Checks that an extension has to pass: those that asked for it."""
_LAGS = {"eddy_pole", "sensor_lag"}
"""Causes that another is named for where they lead: the current is late then, and the delay has followed it."""
_LATEST = 0.5  # samples of a lag that its first order explains
_HARMLESS = 1.5  # standard deviations by which a cause may move a number
_BENT = 5.0  # standard deviations that curvature may move a number by, to be taken in by two degrees
_STEPS, _TURNS = 8, 12  # of a search that begins at a fit, and turns in which sizes and parameters are found
_NEAR = 1.5  # ratio of frequencies within which colours are of one shape
SETTLED = 0.1  # gain below which they are
_SOUND = Check(passed=True, detail="")  # of what was not looked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cause:
    """A cause that the innovations may have."""

    name: str = ""  # as `Check.cause`
    channel: str = ""  # force, voltage, position or current
    gain: float  # fall of the criterion
    p: float  # probability of that by chance
    size: float  # of its first column, SI; of a line its frequency, Hz
    shift: Array  # (n_physical,), SI, what the estimate lacks for leaving it out, as far as it is more than chance
    sizes: Array  # (n_columns,), SI, of all its columns
    columns: tuple[Column, ...] = ()
    colour: Colour | None = None  # noise that it is
    far: bool = False  # a fixed value that would have to change by more than itself: what is missing lies elsewhere


class Look(Protocol):
    """A fit with its innovations over the samples that are looked at."""

    @property
    def course(self) -> Course:
        """Return the signals."""

    @property
    def white(self) -> Array:
        """Return the innovations, (n, n_outputs), of unit variance."""

    def ways(self, which: slice) -> dict[str, Complex]:
        """Return how a force, a voltage or an error of a sensor shows at some frequencies, (n_lines, n_outputs)."""

    def tested(self, groups: Sequence[tuple[str, tuple[Column, ...]]]) -> list[Cause]:
        """Test groups of signals, each together."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Look:
    """That of a linear fit."""

    fit: Fit
    predictor: Predictor
    weight: Array
    e: Array  # (n, n_outputs), scaled
    at: slice
    course: Course

    @property
    def white(self) -> Array:
        return self.e @ self.weight.T

    def ways(self, which: slice) -> dict[str, Complex]:
        predictor, model, n = self.predictor, self.fit.problem.model, self.e.shape[0]
        values, vectors = np.linalg.eig(predictor.M[:, : predictor.A.shape[0]])
        z = np.exp(2j * np.pi * np.arange(2, (n + 1) // 2)[which] / n)
        enter = np.linalg.solve(vectors, np.hstack([predictor.E, -predictor.gain]).astype(complex))
        through = -np.einsum("oj,kj,jb->kob", predictor.C @ vectors, 1.0 / (z[:, None] - values), enter)
        through[:, :, len(model.disturbances) :] -= np.eye(len(model.outputs))
        names = (*model.disturbances, *model.outputs)
        return {name: through[:, :, j] @ self.weight.T for j, name in enumerate(names) if name in _CHANNELS}

    def tested(self, groups: Sequence[tuple[str, tuple[Column, ...]]]) -> list[Cause]:
        problem = self.fit.problem
        sums = _sums(self, _through(self, [column for _, columns in groups for column in columns]))
        kept = np.ones(problem.size, dtype=bool)
        kept[problem.slices["noise"]] = False
        return tested(sums, groups, kept, problem.magnitude)


def _look(fit: Fit, means: Mapping[str, float]) -> _Look | None:
    problem, work = fit.problem, workspace_near(fit, fit.problem)
    predictor = assemble(problem, fit.vector, with_derivatives=False)
    e = innovations(problem, fit.vector, work, predictor)
    if predictor is None or e is None:
        return None
    at = busiest(problem.u[problem.skip :], min(_LONGEST, len(e)))
    course = _course(fit, work.w[at], at, means)
    return _Look(fit=fit, predictor=predictor, weight=weight_of(fit.covariance), e=e[at], at=at, course=course)


def causes(
    fit: Fit, means: Mapping[str, float], rig: Rig, *, thorough: bool, delay_given: bool = False,
    freed: Freed | None = None,
) -> list[Cause]:  # fmt: skip
    """Return the causes that the innovations of a model of one axis may have, the strongest first.

    `means`: operating point by role, SI; `thorough`: look for those too that take long, because a check failed;
    `delay_given`: the delay of the voltage was not estimated; `freed`: what `free_one` says of each fixed value, where
    that is known.
    """
    look = _look(fit, means)
    if look is None:
        return []
    freed = {name: free_one(fit, name) for name in fit.problem.known} if freed is None else freed
    return ranked([*seen(look, thorough=thorough, delay_given=delay_given), *_fixed(look, rig, freed)])


def seen(look: Look, *, thorough: bool, delay_given: bool = False) -> list[Cause]:
    """Return the causes beyond model and rig that innovations may have."""
    course, rate_hz = look.course, look.course.rate_hz
    spectra = _spectra(look.white)
    lines = _lines(look)
    top_hz = _top(spectra, lines) * rate_hz / course.t.size if thorough else 0.0
    groups = list(groups_of(course, top_hz, thorough=thorough))
    if delay_given and "voltage" in course.channels:
        later = -(course.u - course.u_before) * rate_hz
        groups.append(("input_delay", ((("voltage", later),),)))
    groups += [("line", _waving(lines, course.t.size))] if lines else []
    found = look.tested(groups)
    if lines:
        line = found.pop()
        at, p = lines[0].k * rate_hz / course.t.size, min(line.p, lines[0].p)
        found.append(replace(line, channel=lines[0].channel, size=at, p=p))
    if thorough:
        found += _colours(spectra, look.ways(slice(None)), rate_hz, found[0].shift.size)
    return found


def ranked(found: Sequence[Cause]) -> list[Cause]:
    """Return causes, the strongest first, without those of the wrong sign: where one leads, the current is late."""
    found = [
        replace(c, name="current_lag", channel="current", size=-c.size) if c.name in _LAGS and c.size < 0.0 else c
        for c in sorted(found, key=_net)
    ]
    late = next((c for c in found if c.name == "current_lag"), None)
    return [  # a current that drifts acts as force and voltage together, and explains much of either
        c
        for c in found
        if (c.name != "slow_current" or c is found[0])
        and not (c.name in _OPPOSING and c.size < 0.0)
        and (c.name != "current_lag" or c is late)
    ]


def _fixed(look: _Look, rig: Rig, freed: Freed) -> Iterator[Cause]:
    """Yield each fixed value as a cause: what freeing it would gain, in the part of the record that is looked at, and
    move; and, where that is seen, each gain and the rate: an error that puts the fixed value as far from the data
    explains them as well, and moves the others too.
    """
    fit, problem, share = look.fit, look.fit.problem, len(look.e) / look.fit.problem.n_used
    theta = problem.parameters(fit.vector)
    n, unit = problem.n_physical, np.outer(problem.magnitude, problem.magnitude)
    for name, (gain, step) in freed.items():
        if not gain > 0.0:
            continue
        p, sure = chi_squared_tail(1, gain), np.sqrt(max(1.0 - 1.0 / gain, 0.0))
        far = abs(float(step[-1])) > abs(theta[name]) > 0.0
        moves = {("fixed_value", name): (float(step[-1]), step[:-1])}
        if p < _CHANCE and theta[name]:
            covariance = directions(np.vstack([fit.J, fit.J_prior])).inverse()[:n, :n] * unit
            slope, names = np.append(np.zeros(n), 1.0 / theta[name]), (*problem.estimated, name)
            scales = explaining(
                rig, problem.model, theta, names, covariance, [lines_of(fit)], slope, float(slope @ step)
            )
            kinds = {"rate": "rate"}
            moves |= {(kinds.get(k, "sensor_gain"), k): (e, (step - moved)[:-1]) for k, (e, moved) in scales.items()}
        for (cause, channel), (size, shift) in moves.items():
            sizes = np.array([size])
            yield Cause(
                name=cause, channel=channel, gain=gain * share, p=p, size=size, shift=shift * sure, sizes=sizes, far=far
            )


def _sure(found: Sequence[Cause]) -> list[Cause]:
    """Return the causes that are seen, the one to name first; fixed values far from where they are come last."""
    return sorted((c for c in found if c.p < _CHANCE), key=lambda c: c.far)


def _net(cause: Cause) -> float:
    """What a cause costs, less what it explains."""
    return _PENALTY * cause.sizes.size - cause.gain


def _waving(lines: Sequence[_Line], n: int) -> tuple[Column, ...]:
    """Return columns of lines, each in its channels."""
    return tuple(((channel, w),) for line in lines for channel in line.channels for w in waves_at(line.k, n).T)


def extended(
    fit: Fit,
    means: Mapping[str, float],
    found: Sequence[Cause],
    plain: PredictorProblem,
    taken: Sequence[Cause],
    *,
    doubtful: bool,
) -> tuple[Fit, PredictorProblem, tuple[Cause, ...]] | None:
    """Fit again with the strongest cause of those `found`, and those about as strong or else alone, their sizes
    estimated beside the parameters; with noise that is not white where that is the strongest.

    `plain`, `taken`: the problem before any cause but coloured noise, and those that `fit` holds already; they come
    back with the new ones. None where one of them cannot be taken in, or the search does not settle; where a fixed
    value is `doubtful`, only what it cannot stand for is. The record is corrected by an error of a sensor; a force or a
    voltage is known to the predictor. Sizes and parameters are found in turn, and the information of the parameters is
    what is left beside the sizes.
    """
    strong = _strong(found, doubtful=doubtful)
    late = max((c.size * fit.problem.rate_hz for c in strong if c.name in _LAGS), default=0.0)
    if not strong or late > _LATEST or fit.problem.n_used > _LONGEST:
        return None
    cause, alike = strong[0], to_take(found, doubtful=doubtful)[1:]
    more, had = None, colours_of(fit.problem)
    if cause.name not in _NOISE:
        n, size = fit.problem.n_physical, fit.problem.magnitude
        sd = np.sqrt(np.diag(directions(np.vstack([fit.J, fit.J_prior])).inverse())[:n]) * size
        if cause.name == "curvature" and np.any(np.abs(cause.shift) > _BENT * sd):
            return None  # what is of higher degree would move them too
        more = _with_causes(fit, means, plain, taken, (cause, *alike))
        more = _with_causes(fit, means, plain, taken, (cause,)) if more is None and alike else more
    if more is not None:
        return _resettled(more[0], means, plain, more[1], len(had))
    noises = [[c.colour] for c in found if c.colour and (c in strong or c.channel == cause.channel)]
    noises = [c for c in noises if not any(_same(c[0], h) for h in had)]
    louder = coloured(fit, noises) if noises else None
    return None if louder is None else _resettled(louder, means, plain, taken, len(had))


def worse(first: Mapping[str, Check], after: Mapping[str, Check]) -> bool:
    """Whether a model that was extended is no better than before: it does not fit, more checks fail, or one that did
    not, but that a fixed value shows as wrong.
    """
    had, has = ({name for name, c in checks.items() if not c.passed} for checks in (first, after))
    return bool(has & OF_THE_MODEL or has - had - {"fixed_agree"} or len(has) >= len(had))


def _strong(found: Sequence[Cause], *, doubtful: bool = False) -> list[Cause]:
    """Return the strongest cause, and those about as strong; none where a model cannot take one of them in."""
    sure = [c for c in _sure(found) if c.name not in _KNOWN]
    strong = [c for c in sure if c.gain > _ALIKE * sure[0].gain and (c.name in _IN_TIME or not doubtful)]
    return [] if any(c.name not in _GROWING for c in strong) else strong


def to_take(found: Sequence[Cause], *, doubtful: bool = False) -> list[Cause]:
    """Return the strongest cause and those about as strong whose signals are known, each once; none where the
    strongest is noise, or a model cannot take it in.
    """
    strong = _strong(found, doubtful=doubtful)
    if not strong or strong[0].name in _NOISE:
        return []
    each = {(c.name, c.channel): c for c in reversed(strong) if c.name not in _NOISE}
    return [strong[0], *(c for k, c in each.items() if k != (strong[0].name, strong[0].channel))]


def _same(a: Colour, b: Colour) -> bool:
    """Whether colours are of one source and about one frequency: what still stands there is no noise of that shape."""
    return a.source == b.source and a.order == b.order and abs(np.log(a.omega / b.omega)) < np.log(_NEAR)


def _resettled(
    fit: Fit, means: Mapping[str, float], plain: PredictorProblem, taken: Sequence[Cause], had: int
) -> tuple[Fit, PredictorProblem, tuple[Cause, ...]] | None:
    """Return a fit with the colours that it `had` before where they are likeliest beside what it holds now."""
    leveled = fit.leveled
    for k in range(had):
        fit = resettled(fit, k)
    if fit.problem.model is not plain.model:
        plain = replace(fit.problem, y=plain.y, extra=plain.extra)
        again = _with_causes(fit, means, plain, taken, ()) if taken else (fit, ())
        if again is None:
            return None
        fit, taken = again
    return replace(fit, leveled=leveled), plain, tuple(taken)


def _with_causes(
    fit: Fit, means: Mapping[str, float], plain: PredictorProblem, taken: Sequence[Cause], new: Sequence[Cause]
) -> tuple[Fit, tuple[Cause, ...]] | None:
    """Fit again with causes beside those `taken`; None where the search does not settle."""
    parts = [*taken, *(replace(c, sizes=np.zeros(c.sizes.size)) for c in new)]
    step = [new[0].sizes if new and k == len(taken) else np.zeros(c.sizes.size) for k, c in enumerate(parts)]
    leveled = fit.leveled
    for _ in range(_TURNS):
        parts = [replace(c, sizes=c.sizes + more) for c, more in zip(parts, step, strict=True)]
        problem = _corrected(plain, [z for c in parts for z in c.columns], np.concatenate([c.sizes for c in parts]))
        fit = search(problem, fit.vector, steps=_STEPS, work=workspace_near(fit, problem))
        look = None if fit.status == "failed" else _look(fit, means)
        if look is None:
            return None
        parts = [replace(c, columns=again(c, look.course)) for c in parts]
        columns = [z for c in parts for z in c.columns]
        left = look.tested([("", tuple(columns))])[0]
        step = np.split(left.sizes, np.cumsum([c.sizes.size for c in parts])[:-1])
        if left.gain < SETTLED and fit.status == "converged":
            sums = _sums(look, _through(look, columns))
            return replace(fit, beside=beside(sums, fit.problem.n_physical), leveled=leveled), tuple(parts)
    return None


def told(fit: Fit, taken: Sequence[Cause]) -> tuple[str, ...]:
    """Return what a fit is extended by: causes `taken`, with their sizes, and coloured noise."""
    noise = [
        f"{'slow' if c.damping is None else 'coloured'}_{c.source} ({c.frequency_hz:.3g} Hz)"
        for c in colours_of(fit.problem)
    ]
    return tuple(dict.fromkeys([*map(told_of, taken), *noise]))


def told_of(cause: Cause) -> str:
    """Return a cause and its size."""
    unit = {"line": " Hz"}
    unit |= dict.fromkeys(("sensor_lag", "eddy_pole", "current_sensor_pole"), " s")
    unit |= {"r_drift": " ohm", "dead_time": " V", "friction": " N"}
    return f"{cause.name} ({cause.size:.3g}{unit[cause.name]})" if cause.name in unit else cause.name


def again(cause: Cause, course: Course) -> tuple[Column, ...]:
    """Return a cause's signals at another fit: those of lines are the same."""
    if cause.name == "line":
        return cause.columns
    own = (cause.name, cause.channel, len(cause.columns))
    groups = groups_of(course, 0.0, thorough=False)
    return next(columns for name, columns in groups if (name, columns[0][0][0], len(columns)) == own)


def _corrected(problem: PredictorProblem, columns: Sequence[Column], sizes: Array) -> PredictorProblem:
    """Return a problem that holds signals of some sizes."""
    model, skip = problem.model, problem.skip
    y, extra = problem.y.copy(), np.zeros((problem.y.shape[0], len(model.disturbances)))
    parts = [(*part, size) for column, size in zip(columns, sizes.tolist(), strict=True) for part in column]
    for where, signal, size in parts:
        if where in model.outputs:
            y[skip:, model.outputs.index(where)] -= size * signal
        else:
            extra[skip:, model.disturbances.index(where)] += size * signal
    return replace(problem, y=y, extra=extra)


def _course(fit: Fit, states: Array, at: slice, means: Mapping[str, float]) -> Course:
    problem, model = fit.problem, fit.problem.model
    columns = [model.states.index(n) if n in model.states else -1 for n in ("position", "velocity", "current")]
    x, v, i = (states[:, k] * problem.scales.state[k] if k >= 0 else np.zeros(len(states)) for k in columns)
    theta = {"k_i": 0.0, "R": 0.0, "L": 1.0, **problem.parameters(fit.vector)}
    delay = problem.delay_samples(fit.vector)
    whole = int(np.floor(delay))
    first = problem.skip + at.start - whole - 3
    raw = problem.u[np.maximum(np.arange(first, first + x.size + 3), 0), 0]
    held = raw[1:] + (delay - whole) * (raw[:-1] - raw[1:])  # mean from each sample to the next, from two before on
    rest, u, last = theta["R"] * i + theta["k_i"] * v, held[2:], held[1:-1]
    if model.inputs == ("current",):  # at each sample, by the means before it
        i = 1.5 * last - 0.5 * held[:-2]
    return Course(
        t=np.linspace(-1.0, 1.0, x.size), x=x, v=v, i=i, u=u, u_before=last,
        before=(last - rest) / theta["L"],
        theta=theta, i0=means.get("current", 0.0), rate_hz=problem.rate_hz,
        channels=(*model.disturbances, *model.outputs),
    )  # fmt: skip


def _through(look: _Look, columns: Sequence[Column]) -> Array:
    """Return what signals of size one do to the whitened innovations, (n_outputs, n_columns, n)."""
    predictor, sc, model = look.predictor, look.fit.problem.scales, look.fit.problem.model
    n, (length, n_y) = predictor.A.shape[0], look.e.shape
    out, away = np.empty((n_y, len(columns), length)), -(look.weight @ predictor.C)
    for j, column in enumerate(columns):
        enter, own = [predictor.M[:, :n]], np.zeros((n_y, 1))
        w = np.empty((length, n + len(column)))
        for k, (where, signal) in enumerate(column):
            if where in model.outputs:
                o = model.outputs.index(where)
                w[:, n + k] = signal / sc.output[o]
                enter.append(-predictor.gain[:, [o]])
                own = -look.weight[:, [o]] * w[:, n + k]
            else:
                o = model.disturbances.index(where)
                w[:, n + k] = signal / sc.disturbance[o]
                enter.append(predictor.E[:, [o]])
        state_scan(np.hstack(enter), w, np.zeros(n))
        out[:, j] = own + away @ w[:, :n].T
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sums:
    """Scalar products of slopes J, residuals r and columns C, whitened; priors are part of J and r."""

    own: Array  # J'J, (size, size)
    cross: Array  # J'C, (size, n_columns), zero for the levels of noise
    pull: Array  # J'r
    along: Array  # C'r
    inner: Array  # C'C
    square: float  # mean of r^2


def _sums(look: _Look, C: Array) -> Sums:
    """Sum over the samples that are looked at.

    Levels of noise are left out of what is projected: under the right model they are not correlated with what moves
    the mean, and under a wrong one they have taken up a part of it.
    """
    fit, at = look.fit, look.at
    problem, work, p, first = fit.problem, workspace_near(fit, fit.problem), fit.problem.size, 0
    turn, back = (np.eye(p), np.eye(p)) if work.turn is None else (work.turn[1], work.turn[0])
    own, cross, pull = np.zeros((p, p)), np.zeros((p, C.shape[1])), np.zeros(p)
    along, square = np.zeros(C.shape[1]), 0.0
    for block in residual_blocks(problem, fit.vector, look.weight, work, turn):
        a, b = max(at.start - first, 0), min(at.stop - first, block.shape[0])
        if a < b:
            rows, columns = block[a:b], C[:, :, first + a - at.start : first + b - at.start]
            for o in range(rows.shape[1]):
                J, r = rows[:, o, :p], rows[:, o, p]
                own += J.T @ J
                cross += (columns[o] @ J).T
                pull += J.T @ r
                along += columns[o] @ r
                square += float(r @ r)
        first += block.shape[0]
    cross = back.T @ cross
    cross[problem.slices["noise"]] = 0.0
    return Sums(
        own=back.T @ own @ back + fit.J_prior.T @ fit.J_prior, cross=cross,
        pull=back.T @ pull + fit.J_prior.T @ fit.r_prior, along=along,
        inner=sum((c @ c.T for c in C[1:]), C[0] @ C[0].T), square=square / max(look.e.size, 1),
    )  # fmt: skip


def _scales(own: Array) -> Array:
    """Return the sizes of columns from their products, which rounding makes negative where the stretch sees none."""
    return column_sizes(np.sqrt(np.maximum(np.diag(own), 0.0))[None, :])


def tested(
    sums: Sums, groups: Sequence[tuple[str, tuple[Column, ...]]], kept: NDArray[np.bool_], magnitude: Array
) -> list[Cause]:
    """Test groups of signals, each together, from the sums of all; `kept`: what is projected out of them, the numbers
    of a `magnitude` first.
    """
    own = sums.own[np.ix_(kept, kept)]
    scale = _scales(own)
    values, vectors = np.linalg.eigh(own / np.outer(scale, scale))
    visible = values > _BLIND * values[-1]
    root = (vectors[:, visible] / np.sqrt(values[visible])).T / scale
    inside_J = root @ sums.cross[kept]
    rest, left = sums.inner - inside_J.T @ inside_J, sums.along - inside_J.T @ (root @ sums.pull[kept])
    out, start = list[Cause](), 0
    for name, columns in groups:
        g = slice(start, start + len(columns))
        start = g.stop
        unit = np.sqrt(np.maximum(np.diag(sums.inner)[g], 1e-300))
        values, vectors = np.linalg.eigh(rest[g, g] / np.outer(unit, unit))
        distinct = values > _SAME
        inside = (vectors[:, distinct].T @ (left[g] / unit)) / values[distinct]
        sizes = -(vectors[:, distinct] @ inside) / unit
        gain = float(-sizes @ left[g]) / max(1.0, sums.square)
        along = (root.T @ inside_J[:, g])[: magnitude.size]
        shift = -(along @ sizes)
        spread = np.sum((along @ (vectors[:, distinct] / unit[:, None])) ** 2 / values[distinct], axis=1)
        shift = np.sign(shift) * np.sqrt(np.maximum(shift**2 - spread, 0.0)) * magnitude
        out.append(Cause(
            name=name, channel=columns[0][0][0], gain=gain, p=chi_squared_tail(max(int(distinct.sum()), 1), gain),
            size=float(sizes[0]), shift=shift, sizes=sizes, columns=columns,
        ))  # fmt: skip
    return out


def beside(sums: Sums, n: int) -> Array:
    """Return what the covariance of the first `n` parameters gains by the sizes of signals, over the magnitudes."""
    unit = np.sqrt(np.maximum(np.diag(sums.inner), 1e-300))
    taken = sums.cross / unit @ np.linalg.pinv(sums.inner / np.outer(unit, unit), rcond=_SAME, hermitian=True)
    scale = _scales(sums.own)
    both = [sums.own - taken @ (sums.cross / unit).T, sums.own]
    left, plain = (np.linalg.pinv(x / np.outer(scale, scale), rcond=_BLIND, hermitian=True)[:n, :n] for x in both)
    values, vectors = np.linalg.eigh(0.5 * (left - plain + (left - plain).T))
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T  # sizes never tell of the numbers
    return np.asarray(more / np.outer(scale[:n], scale[:n]))


def _spectra(e: Array) -> Complex:
    """Return the spectra of whitened innovations at k = 2, 3, ... over the length, of variance 1 each."""
    n = e.shape[0]
    window = np.hanning(n)[:, None] * np.sqrt(8.0 / 3.0 / n)
    return np.asarray(np.fft.rfft(e * window, axis=0)[2 : (n + 1) // 2], dtype=np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    k: float  # periods over the samples that are looked at
    channel: str  # that its direction tells best
    channels: tuple[str, ...]  # that alone where it is clear, else force and voltage, which hold any
    p: float


def _lines(look: Look) -> list[_Line]:
    """Return narrow lines that stand out, the strongest first, each after those before it are taken off."""
    e, lines = look.white, list[_Line]()
    while len(lines) < _LINES:
        spectra = _spectra(e)
        power, n_y = np.sum(np.abs(spectra) ** 2, axis=1), spectra.shape[1]
        median = float(np.median(power))
        usual = _mean(median, n_y)
        power[: WAVES // 2] = median  # what walks as slowly is no line
        j = int(np.argmax(power))
        ratio = float(power[j] / max(usual, 1e-300))
        p = float(power.size * (1.0 + ratio * (n_y > 1)) * np.exp(-min(ratio, 700.0)))
        around = power[max(j - 12, 0) : j + 13]
        if p > _LINE or float(power[max(j - 1, 0) : j + 2].sum()) < _NARROW * float(around.sum()):
            break
        ways = {name: way[0] for name, way in look.ways(slice(j, j + 1)).items()}
        shares = {name: abs(np.vdot(way, spectra[j])) ** 2 / np.vdot(way, way).real for name, way in ways.items()}
        first, second = sorted(shares, key=lambda name: -float(shares[name]))[:2]
        left = float(np.vdot(spectra[j], spectra[j]).real) - float(shares[first])
        clear = left < _CLEAR and float(shares[first] - shares[second]) > _CLEAR
        k = periods_near(e @ ways[first].conj(), j + 2)
        lines.append(
            _Line(k=k, channel=first, channels=(first,) if clear else tuple(n for n in _CHANNELS[:2] if n in ways), p=p)
        )
        e = without(e, waves_at(k, len(e)))
    return lines


def _top(spectra: Complex, lines: Sequence[_Line]) -> int:
    """Return where the innovations stand highest over some lines that are none of `lines`, in periods."""
    power = np.sum(np.abs(spectra) ** 2, axis=1)
    for at in (round(line.k) - 2 for line in lines):
        power[max(at - _SKIRT, 0) : at + _SKIRT + 1] = float(np.median(power))
    smooth = np.convolve(power, np.ones(_SMOOTH) / _SMOOTH, mode="same")
    smooth[: 2 * _SMOOTH] = 0.0
    return int(np.argmax(smooth)) + 2


def _mean(median: float, n_y: int) -> float:
    """Return the size of each of `n_y` exponentials whose sum has a median."""
    return median / (1.678 if n_y == 2 else np.log(2.0))


def _colours(spectra: Complex, ways: Mapping[str, Complex], rate_hz: float, n_physical: int) -> Iterator[Cause]:
    """Yield for each disturbance and sensor the low pass and the resonance that explain most of the innovations."""
    n = spectra.shape[0]
    f = np.arange(2, n + 2) * rate_hz / (2 * (n + 2))
    for source, way in ways.items():
        a = np.maximum(np.sum(np.abs(way) ** 2, axis=1), 1e-300)
        along = np.abs(np.sum(way.conj() * spectra, axis=1)) ** 2 / a
        for name, (gain, colour) in zip(("slow", "coloured"), likely_colours(source, along, a, f), strict=True):
            gain /= 1.5  # of a Hann window
            yield Cause(
                name=f"{name}_{source}", channel=source, gain=gain, p=min(1.0, n * chi_squared_tail(3, gain)),
                size=colour.frequency_hz, shift=np.zeros(n_physical), sizes=np.zeros(1 + colour.order), colour=colour,
            )  # fmt: skip


def named_bias(found: Sequence[Cause], known: Array) -> Array:
    """Return the largest shift of each parameter by the strongest cause and those about as strong, or as is `known`."""
    sure = _sure(found)
    return farthest([known, *(c.shift for c in sure if c.gain > _ALIKE * sure[0].gain)])


def causes_check(
    found: Sequence[Cause], checks: Mapping[str, Check], sd: Array, *, robust: bool, record: Record
) -> dict[str, Check]:
    """Judge the causes of `causes`: what explains the innovations best, and what explains them about as well.

    `checks`: made before; a fixed value that the record contradicts less than it shows the cause is not blamed. `sd`:
    (n_physical,), SI; a cause that moves no number by more than 1.5 of them is told and does no harm, unless other
    tests of the innovations failed (`robust`).
    """
    sure = _sure(found)
    if not sure:
        return {"causes": Check(passed=True, detail="no cause that was looked for shows in the innovations")}
    if not robust and all(np.all(np.abs(c.shift) <= _HARMLESS * sd) for c in sure):
        detail = f"{sure[0].name} shows in the innovations, and moves no number by more than {_HARMLESS:g} sd"
        return {"causes": Check(passed=True, p=sure[0].p, values={"gain": sure[0].gain}, detail=detail)}
    first = sure[0]
    alike = [c.name for c in sure[1:] if c.gain > _ALIKE * first.gain and c.name != first.name]
    same = [n for n in SAME_AS.get(first.name, ()) if n != "sensor_lag" or record is None or "position" in record]
    if first.name == "eddy_pole" and record is not None and "voltage" not in record:
        same = ["sensor_lag", "sensor_pole"]  # a force that lags and a position that does are the same to an input
    others = tuple(dict.fromkeys([*alike, *same]))
    refits = checks.get("estimates_agree", _SOUND)
    if not refits.passed and between_samples(record):
        others = (*others, "sampling")
    late = checks.get("in_time")
    if late is not None and not late.passed:
        others = tuple(c for c in dict.fromkeys([*others, late.cause, *late.alternatives]) if c != first.name)
    where = "far from" if first.far else f"{first.size:+.3g} (SI) from"
    name = first.name
    if name == "fixed_value" and "sampling" in others:  # a number of the bench is wrong less often than a log is thin
        name, others = "sampling", ("fixed_value", *(c for c in others if c != "sampling"))
    text = TEXT[name].format(size=first.size, channel=first.channel, where=where)
    if first.name == "line" and first.sizes.size > 8:
        text += "; more beside it"
    if others:
        text += f"; about as well explained by {' or '.join(others)}"
    grave = refits.grave or (late is not None and not late.passed)
    net = first.gain - _PENALTY * first.sizes.size
    named = Check(
        passed=False, p=first.p, values={"gain": first.gain}, detail=f"{text} (chi-squared {first.gain:.3g})",
        grave=grave, cause=name, size=first.size if name == first.name else None, alternatives=others,
    )  # fmt: skip
    fixed = checks.get("fixed_agree", _SOUND)
    if fixed.passed or max((c.gain for c in found if c.name == "fixed_value"), default=np.inf) - _PENALTY >= net:
        return {"causes": named}
    text = f"a fixed value would fit better elsewhere, by less than {first.name} explains"
    return {"causes": named, "fixed_agree": replace(fixed, passed=True, detail=text)}
