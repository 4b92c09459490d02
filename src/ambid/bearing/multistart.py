"""Many start values, one search: the weak-form candidates of all bands and delays are scored by the likelihood.

Scores come from the busiest stretch, the best's from a longer one and several noise levels; those that differ in more
than chance are searched a little, the winner on. Weak form: equations of motion are integrated against Fourier
modulating functions phi_k(t) = w(t) exp(-j w_k t) (theory.md sec. 2.7, thesis eq. 3.8; Shinbrot 1957; Pearson and Lee
1985). The window w vanishes with three derivatives at the record's ends: no boundary terms, no signal differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, compress
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.likelihood import Workspace, evaluate, search, with_linear_part
from ambid.estimation.linear import column_sizes, triangle_of
from ambid.estimation.predictor import PredictorProblem, Scales, all_scales, assemble_all, busiest, noise_floor
from ambid.physics.linear_model import LinearModel, Parameter

Spectrum = NDArray[np.complexfloating]
Term = tuple[str, Spectrum, Spectrum]  # role whose noise it holds, what that noise passes through, moments

# upper band edges as fractions of the Nyquist frequency: wide bands want the errors-in-variables regression (sensor
# noise dominates up there), narrow ones plain least squares (disturbances dominate, and few lines are left)
_BANDS = (
    (0.6, True),
    (0.3, True),
    (0.15, True),
    (0.06, True),
    (0.15, False),
    (0.06, False),
    (0.025, False),
    (0.01, False),
)
_LOWEST_LINE = 3  # the window's main lobe: lines below see the constant


def weak_form_values(
    model_name: str,
    m: Moments,
    noise: Mapping[str, float],
    delays: Sequence[float],
    rate_hz: float,
    fixed: Mapping[str, float],
) -> Iterator[tuple[float, dict[str, float]]]:
    """Yield the delay with all parameters (SI) of the model ``"one-axis"``, ``"coil"`` or ``"rotor"``, one set for each
    band and delay; `delays`: of the input, in samples; `fixed`: fixed values, SI, used and returned unchanged.
    """
    damping = fixed.get("c", 0.0)
    steps = np.diff(delays, prepend=0.0).tolist()  # mostly one sample: products cost less than exponentials
    turns = {d: np.exp(-1j * m.omega * d / rate_hz) for d in set(steps)}
    delayed = np.stack(list(accumulate((turns[d] for d in steps), np.multiply)), axis=1)
    rate = damping / fixed.get("m", np.inf) if damping else 0.0
    for part, errors_in_variables in _BANDS:
        lines = slice(_LOWEST_LINE, int(part * m.omega.size))
        omega = m.omega[lines]
        if omega.size < 8:
            continue
        jw, corner, level = 1j * omega, omega[-1] / 3, noise if errors_in_variables else {}
        s = {role: tuple(v[lines] for v in values) for role, values in m.signals.items()}
        electric = np.zeros((len(delays), 0))
        if model_name in ("one-axis", "coil"):
            i0, i1, _ = s["current"]
            terms: list[Term] = [("current", 1 + 0 * jw, i0), ("current", jw, i1)]
            if model_name == "one-axis":
                terms.append(("position", jw, s["position"][1]))
            coil = Regressors(terms, 1.0 / np.abs(jw + corner), level)
            electric = coil.regress(("", 0 * jw, s["voltage"][0][:, None] * delayed[lines]))
        if model_name in ("one-axis", "rotor"):
            x0, x1, x2 = s["position"]
            motion = []
            for lag in delayed[lines].T if model_name == "rotor" else [1.0]:
                terms = [("position", -1 + 0 * jw, -x0), ("current", 1 + 0 * jw, s["current"][0] * lag)]
                rotor = Regressors(terms, 1.0 / np.abs(jw + corner) ** 2, level)
                motion.append(rotor.regress(("position", jw**2 + rate * jw, x2 + rate * x1))[0])
            motion *= len(delays) // len(motion)
        for j, d in enumerate(delays):
            start = {**dict(zip(("R", "L", "k_i"), electric[j], strict=False)), **fixed}
            if model_name != "coil":
                stiffness, current = motion[j]
                if "m" not in fixed:  # its sign may come out wrong where the motional voltage is lost in the noise
                    start["m"] = abs(start["k_i"] / current) if "k_i" in start and current != 0 else 1.0
                start = {**start, "k_x": stiffness * start["m"], "k_i": current * start["m"], "c": damping, **fixed}
            yield d, {name: float(value) for name, value in start.items()}


class Regressors:
    """Terms that others are regressed on, over complex lines with real coefficients, reduced once by QR."""

    def __init__(self, terms: Sequence[Term], weight: Array, noise: Mapping[str, float]) -> None:
        """Reduce terms by `weight` (n_lines,); `noise`: role -> noise standard deviation; empty: ordinary least
        squares.
        """
        a = np.stack([_real(t[2] * weight) for t in terms], axis=1)
        self.size = column_sizes(a)  # (n_terms,), what the columns are divided by
        self.Q, self.R = np.linalg.qr(a / self.size)
        self.weight, self.noise = weight, noise
        # role -> what its noise leaves in each term, (n_lines, n_terms)
        self.filters = {
            role: np.stack([t[1] * (t[0] == role) for t in terms], axis=1) * (weight * sd)[:, None] / self.size
            for role, sd in noise.items()
        }
        self.spread = sum(((f.conj().T @ f).real for f in self.filters.values()), np.zeros((len(terms),) * 2))

    def regress(self, first: Term) -> Array:
        """Regress more terms, moments (n_lines,) or (n_lines, n_first), to (n_first, n_terms), NaN where the noise
        description cannot be used: with noise levels by generalised total least squares, the combination smallest
        against what noise alone would leave (Van Huffel and Vandewalle 1991); without, by ordinary least squares.
        """
        b, n = _real(first[2].reshape(self.weight.size, -1) * self.weight[:, None]), self.size.size
        length = np.linalg.norm(b, axis=0)
        length[length == 0.0] = 1.0
        b /= length
        along = self.Q.T @ b
        if not self.noise:
            return np.asarray((np.linalg.lstsq(self.R, along, rcond=None)[0] / self.size[:, None] * length).T)
        short, spread = np.zeros((2, length.size, n + 1, n + 1))
        short[:, :n, :n], short[:, :n, n] = self.R, along.T
        short[:, n, n] = np.linalg.norm(b - self.Q @ along, axis=0)
        spread[:, :n, :n] = self.spread
        if first[0] in self.noise:
            own = first[1] * self.weight * self.noise[first[0]]
            cross = (self.filters[first[0]].conj().T @ own).real / length[:, None]
            spread[:, n, :n] = spread[:, :n, n] = cross
            spread[:, n, n] = np.vdot(own, own).real / length**2
        spread += 1e-12 * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(n + 1)
        if not np.all(spread[:, n, n] > 0):
            return np.full((length.size, n), np.nan)
        # smallest generalised singular vector against the noise: exact columns get a tiny one
        factor = np.linalg.cholesky(spread)
        last = np.linalg.svd(np.swapaxes(np.linalg.solve(factor, np.swapaxes(short, 1, 2)), 1, 2))[2][:, -1]
        v = np.linalg.solve(np.swapaxes(factor, 1, 2), last[:, :, None])[:, :, 0]
        v /= np.column_stack([np.tile(self.size, (length.size, 1)), length])
        v[v[:, n] == 0.0] = np.nan
        return np.asarray(-v[:, :n] / v[:, n:])


def _real(x: Spectrum) -> Array:
    return np.concatenate([x.real, x.imag])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Spectra of the signals and of their first and second derivatives, by modulating functions."""

    omega: Array  # (n_lines,), rad/s
    # role -> (value, first derivative, second derivative), each (n_lines,), complex
    signals: Mapping[str, tuple[Spectrum, Spectrum, Spectrum]]


def take_moments(signals: Mapping[str, Array], held: tuple[str, ...], rate_hz: float) -> Moments:
    """Take modulating-function moments of all signals (role -> samples, SI, deviations from the operating point)."""
    n = len(next(iter(signals.values())))
    period, turn = 1.0 / rate_hz, 2 * np.pi * rate_hz / n
    omega = turn * np.arange(n // 2 + 1)
    jw, result = 1j * omega, {}
    hold = np.sinc(omega * period / (2 * np.pi)) * np.exp(-0.5j * omega * period)
    for role, x in signals.items():
        # times cos(2 pi t) and sin(2 pi t), t over the record, a spectrum moves by one line, times twice that by two
        lines = np.fft.rfft(x)
        whole = np.concatenate([lines[2:0:-1].conj(), lines, lines[(n - 1) // 2 : (n - 1) // 2 - 2 : -1].conj()])
        below, above, below2, above2 = whole[1:-3], whole[3:-1], whole[:-4], whole[4:]
        m0 = (3 * lines - 2 * (below + above) + (below2 + above2) / 2) / 8
        m1 = -0.25j * turn * ((below - above) - (below2 - above2) / 2)
        m2 = 0.25 * turn**2 * ((below + above) - (below2 + above2))
        value = m0 * hold if role in held else m0
        # integration by parts: int phi x' = -int phi' x with phi' = (w' - jw w) e, and again for x''
        result[role] = (value, jw * m0 - m1, m2 - 2 * jw * m1 - omega**2 * m0)
    return Moments(omega=np.asarray(omega, dtype=np.float64), signals=result)


Delay = float | Literal["auto"]

MAX_DELAY = 6  # samples, searched when the delay is "auto"; farther where the last one is the best
FARTHEST = 24  # samples: the search goes no farther
_LEVELS = (-4.0, -8.0, -1.5)  # log disturbance levels tried, relative to what the sensor noise of one sample hides
_STEPS = 25  # of a search on the stretch that a candidate of a long record is for; usually it takes ten
_REGRESSED = 1 << 17  # samples that start values are regressed from, and that a search begins on
_STRETCH = 4096  # samples on which candidates are first compared
_SHORT = 4096  # samples on which racers are searched
_KEPT = 6  # candidates scored on all that start values are regressed from
_RACE = 3  # candidates searched a little way
_CLOSE = 0.5  # difference of the criterion per sample within which candidates race
_ALIKE = 0.3  # relative difference of all parameters within which candidates are taken for the same


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """What the estimator sees of a record."""

    u: Array  # (n_samples, n_inputs), SI, inputs in the order of the model's, held over a sample
    y: Array  # (n_samples, n_outputs), SI
    rate_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A place to search from."""

    criterion: float  # at `vector`, see `ambid.estimation.likelihood.criterion`; where it was compared with others
    problem: PredictorProblem
    vector: Array  # (size,)
    work: Workspace | None = None  # of the problem

    def like(self, other: Candidate) -> bool:
        """Return whether a search from here would end where one from `other` does."""
        a, b = self.problem.parameters(self.vector), other.problem.parameters(other.vector)
        same = all(abs(a[k] - b[k]) <= _ALIKE * max(abs(a[k]), abs(b[k])) for k in self.problem.estimated)
        return same and self.problem.delay == other.problem.delay


def starts(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    *,
    tick: Callable[[], None] | None = None,
) -> list[Candidate]:
    """Score all start values and race the best that differ, best first; noise by levels, searched delays whole; `tick`:
    called after each evaluation of a search.
    """
    delays = [float(d) for d in range(MAX_DELAY + 1)] if delay == "auto" else [float(delay)]
    scored = sorted(_scored(model, signals, parameters, delays), key=lambda c: c.criterion)
    while delay == "auto" and scored and scored[0].problem.delay == delays[-1] < FARTHEST:
        delays = [float(d) for d in range(int(delays[-1]) - 1, int(delays[-1]) + MAX_DELAY + 1)]
        scored = sorted(_scored(model, signals, parameters, delays), key=lambda c: c.criterion)
    if not scored:
        raise EstimationError(
            "no start values make a physical plant (positive m and L) with this record: it holds too little "
            "excitation, or voltage, current and position are not what the rig says. Check columns and signs, or give "
            "start values"
        )
    racers = _unlike(scored)[:_RACE]
    if len(racers) > 1:
        racers = sorted((race(c, tick) for c in racers), key=lambda c: c.criterion)
    return [_widen(c, signals, tick) for c in racers]


def _unlike(scored: Sequence[Candidate]) -> list[Candidate]:
    """Those of the best, which come first, that differ in more than their criterion says is chance."""
    unlike: list[Candidate] = []
    for candidate in scored:
        close = candidate.criterion <= scored[0].criterion + _CLOSE * candidate.problem.n_used
        if close and not any(candidate.like(r) for r in unlike):
            unlike.append(candidate)
    return unlike


def _widen(candidate: Candidate, signals: Signals, tick: Callable[[], None] | None) -> Candidate:
    """Search on the stretch that a candidate is for, then on all of a long record, whose costly passes are the last
    steps.
    """
    part = candidate.problem
    if part.y.shape[0] == signals.y.shape[0]:
        return candidate
    whole = _centre(signals)
    problem = replace(part, u=whole.u, y=whole.y)
    fit = search(part, candidate.vector, steps=_STEPS, tick=tick, work=candidate.work)
    work, share = Workspace(problem), problem.n_used / part.n_used
    candidate = replace(candidate, criterion=candidate.criterion * share)  # of a record that goes on like the stretch
    if fit.status != "converged":
        return replace(candidate, problem=problem, vector=at_first_sample(problem, candidate.vector), work=work)
    work.near(triangle_of([fit.J]))
    return replace(candidate, problem=problem, vector=at_first_sample(problem, fit.vector), work=work)


def _centre(signals: Signals) -> Signals:
    return replace(signals, u=signals.u - signals.u.mean(axis=0), y=signals.y - signals.y.mean(axis=0))


def race(candidate: Candidate, tick: Callable[[], None] | None) -> Candidate:
    """Search a little on a short stretch, calling `tick` after each evaluation; keep what does best on the whole
    record.
    """
    problem, vector = candidate.problem, candidate.vector
    stretch = busiest(problem.u, _SHORT)
    part = replace(problem, u=problem.u[stretch], y=problem.y[stretch])
    fit = search(part, at_first_sample(part, vector), steps=20, tick=tick)
    moved = at_first_sample(problem, fit.vector)
    # noise levels move slowly on a logarithmic scale: look again where they stand best
    work = candidate.work.of(problem) if candidate.work else Workspace(problem)
    both = (moved, with_linear_part(problem, moved, work), vector)
    vectors = [w for v in both for w in (v, *(_with_level(problem, v, level) for level in _LEVELS))]
    scored = [(evaluate(problem, v, work)[0], j) for j, v in enumerate(vectors)]
    value, best = min(scored)
    return Candidate(criterion=value, problem=problem, vector=vectors[best], work=work)


def _scored(
    model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delays: Sequence[float]
) -> list[Candidate]:
    """Return the best candidates of all bands and delays, each at several noise levels, for the busiest stretch."""
    centred = _centre(signals)
    stretch = busiest(centred.u, _REGRESSED)
    part = replace(centred, u=centred.u[stretch], y=centred.y[stretch])
    columns = dict(zip((*model.inputs, *model.outputs), np.hstack([part.u, part.y]).T, strict=True))
    moments = take_moments(columns, model.inputs, signals.rate_hz)
    candidates, work = [], None
    coarse = _unlike(_coarse(model, centred, parameters, moments, delays))[:_KEPT]
    for candidate in sorted(coarse, key=lambda c: c.problem.delay):
        problem = replace(candidate.problem, u=part.u, y=part.y)
        work = Workspace(problem) if work is None else work.of(problem)
        for level in _LEVELS:
            vector = at_first_sample(problem, _with_level(problem, candidate.vector, level))
            value, _ = evaluate(problem, vector, work)
            if np.isfinite(value):
                candidates.append(Candidate(criterion=value, problem=problem, vector=vector, work=work))
    return candidates


def _coarse(
    model: LinearModel,
    centred: Signals,
    parameters: Sequence[Parameter],
    moments: Moments,
    delays: Sequence[float],
) -> list[Candidate]:
    """Each band and delay on the busiest stretch, best first."""
    floor, spread = noise_floor(centred.y), np.std(centred.u, axis=0)
    stretch = busiest(centred.u, _STRETCH)
    part = replace(centred, u=centred.u[stretch], y=centred.y[stretch])
    noise = dict(zip(model.outputs, floor.tolist(), strict=True))
    from_data = list(weak_form_values(model.name, moments, noise, delays, centred.rate_hz, fixed_values(parameters)))
    possible = [
        (d, values, sizes)
        for d in delays
        for values, sizes in _possible(model, [v for own, v in from_data if own == d], parameters)
    ]
    if not possible:
        return []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # of a plant that explodes within a sample
        scales = all_scales(model, [values for _, values, _ in possible], spread, floor, centred.rate_hz)
    finite = [bool(np.all(np.isfinite(own.disturbance))) for own in scales]
    possible, scales = list(compress(possible, finite)), list(compress(scales, finite))
    skip = int(max(delays)) + 2
    problems = [
        candidate_problem(model, part, parameters, sizes, own, d, skip)
        for (d, _, sizes), own in zip(possible, scales, strict=True)
    ]
    if not problems:
        return []
    vectors = [_vector(problem, values) for problem, (_, values, _) in zip(problems, possible, strict=True)]
    candidates, work = list[Candidate](), Workspace(problems[0])
    for problem, vector, predictor in zip(problems, vectors, assemble_all(problems, vectors), strict=True):
        work = work.of(problem)  # the scaled data are the same for all candidates of a delay
        value = np.inf if predictor is None else evaluate(problem, vector, work, predictor)[0]
        candidates.append(Candidate(criterion=value, problem=problem, vector=vector))
    return sorted(candidates, key=lambda c: c.criterion)


def fixed_values(parameters: Sequence[Parameter]) -> dict[str, float]:
    """Return the values of those that are fixed."""
    return {p.name: p.value for p in parameters if p.value is not None and p.role == "fixed"}


def _possible(
    model: LinearModel, from_data: list[dict[str, float]], parameters: Sequence[Parameter]
) -> Iterator[tuple[dict[str, float], dict[str, float]]]:
    """Yield start values that make a plant, and sizes: from the data, and with the values given (which may be zero)."""
    values_of_rig = {p.name: p.value for p in parameters if p.value is not None}
    bases = (from_data or [values_of_rig])[:3] if values_of_rig != fixed_values(parameters) else []
    for values, sizes in [*((v, v) for v in from_data), *(({**v, **values_of_rig}, v) for v in bases)]:
        finite = all(np.isfinite(v) for v in values.values())
        if finite and len(values) == len(model.parameters) and values.get("m", 1.0) > 0 and values.get("L", 1.0) > 0:
            yield values, {k: max(abs(v), abs(sizes.get(k, 0.0))) for k, v in values.items()}


def candidate_problem(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    sizes: Mapping[str, float],
    scales: Scales,
    delay: float,
    skip: int,
) -> PredictorProblem:
    """Set up the problem of one candidate; `signals`: means taken off; `sizes`: of parameters, not negative, SI;
    `delay`, and `skip` left out at the start, in samples.
    """
    estimated = [p for p in parameters if p.role != "fixed"]
    reference = model.references(sizes)
    return PredictorProblem(
        model=model,
        rate_hz=signals.rate_hz,
        u=signals.u,
        y=signals.y,
        estimated=tuple(p.name for p in estimated),
        known={p.name: float(p.value) for p in parameters if p.role == "fixed" and p.value is not None},
        magnitude=np.array([max(sizes[p.name], 1e-3 * reference.get(p.name, 0.0)) or 1.0 for p in estimated]),
        prior_mean=np.array([p.value if p.role == "prior" and p.value is not None else 0.0 for p in estimated]),
        prior_sd=np.array([p.sd if p.sd is not None else np.inf for p in estimated]),
        scales=scales,
        delay=int(delay),
        lag=delay - int(delay),
        skip=skip,
        noise_center=np.concatenate([np.full(len(model.disturbances), _LEVELS[0]), np.zeros(len(model.outputs) - 1)]),
    )


def _vector(problem: PredictorProblem, values: Mapping[str, float]) -> Array:
    """Write start values as a vector; nothing is known of offsets."""
    vector = np.zeros(problem.size)
    vector[problem.slices["physical"]] = np.array([values[k] for k in problem.estimated]) / problem.magnitude
    return at_first_sample(problem, _with_level(problem, vector, _LEVELS[0]))


def at_first_sample(problem: PredictorProblem, vector: Array) -> Array:
    """Return a copy of `vector` whose initial state is that of the data: the outputs at the first sample."""
    out, model = vector.copy(), problem.model
    first, initial = problem.y[problem.skip], problem.slices["initial"].start
    for j, state in enumerate(model.states):
        measured = state in model.outputs
        out[initial + j] = first[model.outputs.index(state)] / problem.scales.state[j] if measured else 0.0
    return out


def _with_level(problem: PredictorProblem, vector: Array, level: float) -> Array:
    """Return a copy with all log disturbance levels at `level`."""
    out, first = vector.copy(), problem.slices["noise"].start
    out[first : first + len(problem.model.disturbances)] = level
    return out
