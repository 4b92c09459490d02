"""Coloured noise beside the white parts of a linear model: low passes and resonances that white noise drives, each one
more source of a disturbance or of a sensor's error (Ljung 1999, sec. 4.2; Anderson and Moore 1979, sec. 11.1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ambid.arrays import Array
from ambid.estimation.likelihood import Fit, Workspace, evaluate, extend, search
from ambid.estimation.linear import directions
from ambid.estimation.predictor import PredictorProblem, Scales
from ambid.physics.linear_model import LinearModel, ParameterSpec, StateSpace

_LEVEL = -2.0  # centre of the weak prior on the log level
_OVER = (-4.0, -2.0, 0.0, 2.0, 4.0)  # logarithm of its level over that of the white part, at the start
_SHAPE = ("colour.omega", "colour.damping")  # names of their logarithms, over those at the start
_RISE = 4.0  # of the criterion, to the end of what a record allows
_FARTHEST, _SOON = 5.0, 3  # logarithm of the last move of a corner, and steps of a search there
_PLACES = 9  # corners of low passes, and widths of resonances, that are looked at
_POWERS = np.geomspace(0.1, 1e6, 12)  # of coloured noise over white, where it stands highest
_REACH = 2.0  # standard deviation of the weak prior on these


@dataclass(frozen=True, slots=True, kw_only=True)
class Colour:
    """A low pass, or a resonance of a damping, of one source: a disturbance, or the sensor of an output."""

    source: str
    omega: float  # rad/s
    damping: float | None = None

    @property
    def order(self) -> int:
        """Number of its states."""
        return 1 if self.damping is None else 2

    @property
    def frequency_hz(self) -> float:
        """Its corner, or its middle."""
        return self.omega / (2.0 * np.pi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Coloured:
    """A linear model whose noise has coloured parts; their states and what drives them come last."""

    plain: LinearModel
    colours: tuple[Colour, ...]

    @property
    def name(self) -> str:
        """Of the model."""
        return self.plain.name

    @property
    def summary(self) -> str:
        """Of the model."""
        return self.plain.summary

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Of the model."""
        return self.plain.parameters

    @property
    def inputs(self) -> tuple[str, ...]:
        """Of the model."""
        return self.plain.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Of the model."""
        return self.plain.outputs

    @property
    def units(self) -> Mapping[str, str]:
        """Of the model."""
        return self.plain.units

    @property
    def states(self) -> tuple[str, ...]:
        """Of the model, and of the colours."""
        return (*self.plain.states, *(f"{c.source}.{k}" for c in self.colours for k in range(c.order)))

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Of the model, and what drives the colours."""
        return (*self.plain.disturbances, *(f"{c.source}.{k}" for k, c in enumerate(self.colours)))

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the matrices with c' = w (d - c) for a low pass, c' = -2 z w c - w s + 2 z w d, s' = w c for a
        resonance, which passes its middle unchanged.
        """
        space, n = self._beside(self.plain.matrices(theta)), len(self.plain.states)
        for j, colour in enumerate(self.colours, len(self.plain.disturbances)):
            w, z = colour.omega, colour.damping
            space.A[n, n], space.E[n, j] = (-w, w) if z is None else (-2.0 * z * w, 2.0 * z * w)
            if z is not None:
                space.A[n, n + 1], space.A[n + 1, n] = -w, w
            if colour.source in self.plain.outputs:
                space.C[self.plain.outputs.index(colour.source), n] = 1.0
            n += colour.order
        return space

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the model's derivative: no parameter moves a colour but by the way of its disturbance."""
        return self._beside(self.plain.derivative(theta, parameter))

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Of the model."""
        return self.plain.references(theta)

    def _beside(self, space: StateSpace) -> StateSpace:
        """Return matrices, or slopes of them, with room for colours and the way of those that disturb."""
        (n, n_d), more = space.E.shape, sum(c.order for c in self.colours)
        own, n_y = n, space.C.shape[0]
        wide = StateSpace(
            A=np.zeros((n + more, n + more)), B=np.zeros((n + more, space.B.shape[1])),
            E=np.zeros((n + more, n_d + len(self.colours))), C=np.zeros((n_y, n + more)),
        )  # fmt: skip
        wide.A[:n, :n], wide.B[:n], wide.E[:n, :n_d], wide.C[:, :n] = space.A, space.B, space.E, space.C
        for colour in self.colours:
            if colour.source in self.plain.disturbances:
                wide.A[:own, n] = space.E[:, self.plain.disturbances.index(colour.source)]
            n += colour.order
        return wide


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shaped(Coloured):
    """The same with frequency and damping, as `_SHAPE`, of some colours together as further numbers."""

    which: tuple[int, ...]

    def at(self, theta: Mapping[str, float]) -> tuple[Coloured, dict[str, float]]:
        """Return the model with the colours there, and its own numbers."""
        by, wider = (float(np.exp(theta.get(name, 0.0))) for name in _SHAPE)
        colours = list(self.colours)
        for k in self.which:
            c = colours[k]
            colours[k] = replace(c, omega=c.omega * by, damping=c.damping and c.damping * wider)
        return Coloured(plain=self.plain, colours=tuple(colours)), {k: x for k, x in theta.items() if k not in _SHAPE}

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the matrices there."""
        model, own = self.at(theta)
        return model.matrices(own)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the derivative: the rows of a colour are proportional to its frequency, its damped ones to both."""
        model, own = self.at(theta)
        if parameter not in _SHAPE:
            return model.derivative(own, parameter)
        space, of = model.matrices(own), np.repeat(np.arange(len(self.colours)), [c.order for c in self.colours])
        A = space.A if parameter == _SHAPE[0] else np.diag(np.diag(space.A))
        rows = np.append(np.zeros(len(self.plain.states), dtype=bool), np.isin(of, self.which))[:, None]
        return StateSpace(A=A * rows, B=0.0 * space.B, E=space.E * rows, C=0.0 * space.C)


def colours_of(problem: PredictorProblem) -> tuple[Colour, ...]:
    """Return the coloured parts of a problem's noise."""
    return problem.model.colours if isinstance(problem.model, Coloured) else ()


def scaled_for(scales: Scales, plain: LinearModel, colours: Sequence[Colour]) -> Scales:
    """Return a predictor's scales with those of colours beside the plain model, as of the white parts of sources."""
    sources = [*plain.disturbances, *plain.outputs]
    size = np.concatenate([scales.disturbance[: len(plain.disturbances)], scales.output])
    own = size[[sources.index(c.source) for c in colours]]
    state = np.append(scales.state, np.repeat(own, [c.order for c in colours]))
    return replace(scales, state=state, disturbance=np.append(scales.disturbance, own))


def plain_of(model: LinearModel) -> LinearModel:
    """Return a model without coloured parts."""
    return model.plain if isinstance(model, Coloured) else model


def with_colours(
    problem: PredictorProblem, vector: Array, colours: Sequence[Colour], over: float = 0.0
) -> tuple[PredictorProblem, Array]:
    """Return a problem with further coloured parts, and its vector with their log levels `over` those of the white
    parts of their sources.
    """
    plain = plain_of(problem.model)
    end, white = len(problem.model.disturbances), len(plain.disturbances)
    at = [(*plain.disturbances, *plain.outputs).index(c.source) for c in colours]
    noise = vector[problem.slices["noise"]]
    levels = np.concatenate([noise[:white], [0.0], noise[end:]])[at] + over
    more = replace(
        problem, model=Coloured(plain=plain, colours=(*colours_of(problem), *colours)),
        unsteady=problem.unsteady + len(at), scales=scaled_for(problem.scales, plain, colours),
        noise_center=np.insert(problem.noise_center, end, np.full(len(at), _LEVEL)),
        extra=None if problem.extra is None else np.pad(problem.extra, ((0, 0), (0, len(at)))),
    )  # fmt: skip
    place = problem.slices["noise"].start + end
    return more, np.append(np.insert(vector, place, levels), np.zeros(sum(c.order for c in colours)))


def coloured(fit: Fit, choices: Sequence[Sequence[Colour]], tick: Callable[[], None] | None = None) -> Fit | None:
    """Fit again with the likeliest of several choices of coloured parts of one frequency and damping, at the likeliest;
    None where that does not settle, or gains less than its numbers cost (BIC).
    """
    before, had = fit if fit.problem.noise == "levels" else _with_levels(fit, tick), len(colours_of(fit.problem))
    least, begun, work = before.criterion, None, None
    for colours, over in product(choices, _OVER):
        problem, vector = with_colours(before.problem, before.vector, colours, over)
        work = Workspace(problem) if work is None else work.of(problem)
        value = evaluate(problem, vector, work)[0]
        least, begun = (value, (problem, vector)) if value < least else (least, begun)
    more = None if begun is None else _shaped(*begun, range(had, len(colours_of(begun[0]))), tick)
    if more is None or more.status != "converged":
        return None
    numbers = more.problem.slices["offset"].start - fit.problem.slices["offset"].start
    price = (numbers + colours_of(more.problem)[-1].order) * np.log(fit.problem.y.size)
    more = replace(more, leveled=fit.leveled if had else before)
    return more if fit.criterion - more.criterion > price else None


def resettled(fit: Fit, which: int) -> Fit:
    """Return a fit with one of its colours where it is likeliest."""
    again = _shaped(fit.problem, fit.vector, [which], None)
    return again if again.status == "converged" and again.criterion < fit.criterion - 1.0 else fit


def _shaped(problem: PredictorProblem, vector: Array, which: Sequence[int], tick: Callable[[], None] | None) -> Fit:
    """Search with frequency and damping of some colours free, which have one, then with them where they are."""
    n, (free, began) = problem.n_physical, _freed(problem, vector, which)
    found = search(free, began, tick=tick)
    assert isinstance(free.model, _Shaped)
    there = replace(problem, model=free.model.at(free.parameters(found.vector))[0])
    rest = np.delete(found.vector, slice(n, free.n_physical))
    return search(there, rest, tick=tick, work=found.work)


def _freed(problem: PredictorProblem, vector: Array, which: Sequence[int]) -> tuple[PredictorProblem, Array]:
    """Return a problem with frequency and damping of some colours, which have one, as further numbers, and its vector
    there.
    """
    n, begun, priors = problem.n_physical, problem.model, problem.joint_priors
    assert isinstance(begun, Coloured)
    names = _SHAPE[: begun.colours[which[0]].order]
    k = len(names)

    def joint(values: Array) -> tuple[Array, Array]:
        assert priors is not None
        slopes, left = priors(values[:n])
        return np.pad(slopes, ((0, 0), (0, k))), left

    free = replace(
        problem, model=_Shaped(plain=begun.plain, colours=begun.colours, which=tuple(which)),
        estimated=(*problem.estimated, *names), joint_priors=priors and joint,
        magnitude=np.append(problem.magnitude, np.ones(k)), prior_mean=np.append(problem.prior_mean, np.zeros(k)),
        prior_sd=np.append(problem.prior_sd, np.full(k, _REACH)),
    )  # fmt: skip
    return free, np.insert(vector, n, np.zeros(k))


def _with_levels(fit: Fit, tick: Callable[[], None] | None) -> Fit:
    """Fit again with the noise as levels, instead of a gain that holds colours of its own, unless that is there."""
    problem, had = replace(fit.problem, noise="levels"), fit.leveled
    if had is not None and had.problem.y is problem.y and had.problem.extra is problem.extra:
        return had
    own, vector = fit.problem.slices, np.empty(problem.size)
    levels = problem.noise_center if had is None else had.vector[had.problem.slices["noise"]]
    for group, there in problem.slices.items():
        vector[there] = levels if group == "noise" else fit.vector[own[group]]
    return search(problem, vector, tick=tick)


def left_open(fit: Fit) -> Array:
    """Return what the corners of low passes of disturbances, known no better than the record shows them, add to the
    covariance of the physical parameters, (n_physical, n_physical), over their magnitudes: a force that walks and a
    stiffness take each other's place, along a curve that a local covariance does not see. Each corner is moved until
    the criterion, all else fitted again, has risen by `_RISE`; a step over the root of its rise is one standard
    deviation.
    """
    problem, n = fit.problem, fit.problem.n_physical
    total = np.zeros((n, n))
    for j, colour in enumerate(colours_of(problem)):
        if colour.damping is not None or colour.source in problem.model.outputs:
            continue
        rows = extend(fit, *_freed(problem, fit.vector, [j]))
        if rows is None:
            continue
        along = directions(rows[0]).inverse()[:, n]  # where all numbers go with the corner
        sd, along = float(np.sqrt(along[n])), np.delete(along, n) / along[n]
        steps, work = [sd * along[:n]], fit.work
        for way, most in ((-1.0, _FARTHEST), (1.0, float(np.log(np.pi * problem.rate_hz / colour.omega)))):
            near, slope, at, by = fit.vector, way * along, 0.0, min(2.0 * sd, most, _FARTHEST)
            while by > at:
                there = _at(problem, j, replace(colour, omega=colour.omega * np.exp(way * by)))
                begun, work = near + (by - at) * slope, None if work is None else work.of(there)
                again = search(there, begun, steps=_SOON, work=work)
                again = search(there, near, steps=_SOON, work=work) if again.status == "failed" else again
                rise = again.criterion - fit.criterion
                if not rise < np.inf:
                    break
                steps.append((again.vector[:n] - fit.vector[:n]) / np.sqrt(max(rise, 1.0)))
                if rise > _RISE:
                    break
                slope, near, at = (again.vector - near) / (by - at), again.vector, by
                by = min(2.0 * by, most, _FARTHEST)
        far = np.array(steps)[np.argmax(np.sum((np.array(steps) @ _whitener(fit)) ** 2, axis=1))]
        total += np.outer(far, far)
    return total


def _whitener(fit: Fit) -> Array:
    """Return what physical steps are multiplied by to be in their standard deviations."""
    n = fit.problem.n_physical
    inverse = directions(np.vstack([fit.J, fit.J_prior])).inverse()[:n, :n]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(inverse)).T)


def _at(problem: PredictorProblem, j: int, colour: Colour) -> PredictorProblem:
    """Return a problem with its j-th colour elsewhere."""
    assert isinstance(problem.model, Coloured)
    colours = problem.model.colours
    return replace(problem, model=replace(problem.model, colours=(*colours[:j], colour, *colours[j + 1 :])))


def without_colours(fit: Fit) -> Fit:
    """Return a fit of white noise alone, at the numbers of a fit with coloured parts: what a reader of the plant's own
    order can use.
    """
    problem, n_c, n = fit.problem, len(colours_of(fit.problem)), fit.problem.n_physical
    if not n_c:
        return fit
    plain = plain_of(problem.model)
    states, white = len(plain.states), len(plain.disturbances)
    scales = replace(
        problem.scales, state=problem.scales.state[:states], disturbance=problem.scales.disturbance[:white]
    )
    alone = replace(
        problem, model=plain, estimated=(), known=problem.parameters(fit.vector), magnitude=np.zeros(0),
        prior_mean=np.zeros(0), prior_sd=np.zeros(0), joint_priors=None, scales=scales,
        unsteady=problem.unsteady - n_c, noise_center=np.delete(problem.noise_center, slice(white, white + n_c)),
        extra=None if problem.extra is None else problem.extra[:, :white],
    )  # fmt: skip
    level = problem.slices["noise"].start + white
    vector = np.delete(fit.vector, slice(level, level + n_c))[n : n + alone.size]
    if fit.leveled is not None:
        vector[alone.slices["noise"]] = fit.leveled.vector[fit.leveled.problem.slices["noise"]]
    return search(alone, vector)


def likely_colours(source: str, power: Array, way: Array, frequency_hz: Array) -> list[tuple[float, Colour]]:
    """Return the low pass and the resonance of a source that explain most of innovations, with the criterion's fall.

    `power` (n_lines,): of white innovations' spectra along the way by which the source shows, whose own power is `way`.
    Noise s φ beside them lowers the criterion by 2 Σ P s φ a/(1 + s φ a) - log(1 + s φ a) (Whittle 1953).
    """
    f = frequency_hz
    low = [(c, None, 1.0 / (1.0 + (f / c) ** 2)) for c in np.geomspace(f[1], f[-1], _PLACES).tolist()]
    high = [(at, z, 1.0 / (1.0 + ((f / at - at / f) / (2.0 * z)) ** 2)) for at, z in _peaks(power, f)]
    found = list[tuple[float, Colour]]()
    for shapes in (low, high):
        gains = [(_explained(power, way * shape / np.max(way * shape)), at, z) for at, z, shape in shapes]
        gain, at, damping = max(gains, key=lambda g: g[0])
        found.append((gain, Colour(source=source, omega=2.0 * np.pi * at, damping=damping)))
    return found


def _peaks(power: Array, f: Array) -> Iterator[tuple[float, float]]:
    """Yield where powers stand highest over bands of several widths, and the damping of a resonance as wide."""
    sums, lines = np.cumsum(np.append(0.0, power)), f.size
    for width in np.unique(np.geomspace(3, max(lines // 5, 4), _PLACES).astype(int)).tolist():
        mean = (sums[width:] - sums[:-width]) / width
        j = int(np.argmax(mean[width:])) + width if mean.size > width else 0
        middle = float(f[j + width // 2])
        yield middle, float(f[width - 1] - f[0]) / (2.0 * middle)


def _explained(power: Array, shape: Array) -> float:
    """Return the fall of the criterion by noise of a shape beside white noise, at its likeliest level."""
    whole = 1.0 + _POWERS[:, None] * shape
    return 2.0 * float(np.max(np.sum(power) - (1.0 / whole) @ power - np.sum(np.log(whole), axis=1)))
