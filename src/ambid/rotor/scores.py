"""What the model of a rotor leaves out, or holds at a wrong value: score tests of the residuals, by cause: z = c⊥ᵀ
r/|c⊥|, size = c⊥ᵀ r/|c⊥|², c⊥ a cause's column outside the Jacobian's space (Rao 1948; Breusch and Pagan 1980).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.estimation.estimate import Check
from ambid.estimation.linear import directions, triangle_of
from ambid.estimation.search import search
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import Kind, SensorError, electrical_errors, logged_error, position_errors
from ambid.rotor.likelihood import Experiment, Likelihood, Point, Weight, sampled
from ambid.rotor.response import Sampled
from ambid.rotor.spectra import PeriodSpectra
from ambid.rotor.unknowns import Unknowns

_FAR = 4.5
_OWN = 1e-5  # part of a column outside the Jacobian's space, squared, below which the data do not tell it from J
_ALIKE = 0.7  # part of the strongest cause's gain from which another explains the record about as well
_CLOSE = 9.0  # and the difference of gains within which it does in any case
_LARGE = 1.5  # mean square of the residuals from which an error is not of first order
_MAIN = 0.5  # part of what the model leaves, that curvature or a second cause has to explain
_WORTH, _MOST, _STEPS = 0.1, 8, 30  # part of the best gain from which a cause is searched, how many, steps
_ENDS = 0.95  # quantile of a signal beyond which an amplifier or a sensor may limit
_TOGETHER = {"position": "positions", "current": "currents", "voltage": "voltages"}


_TWINS = (
    ("_current.lag", "_voltage.lag"), ("_voltage.lag", "_current.lag"),
    ("currents.lag", "voltages.lag"), ("voltages.lag", "currents.lag"),
    ("positions.lag", "eddy_pole"), ("eddy_pole", "positions.lag"), ("solid_iron", "eddy_pole"),
)  # fmt: skip
"""Lags that look alike in most records."""
_LATE = ("lag", "eddy", "iron")


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """Errors of one size that have one cause."""

    name: str  # as `Check.cause`: "ax_current.gain", "A.z", "A.z+A.z_sensor", "positions.lag", "solid_iron"
    # "fixed", "gain", "lag", "cross-talk", "limiter", "eddy" (f = k_i i/(1 + s/a)), "iron" (k_i i/(1 + (s/a)^0.5))
    kind: str
    errors: tuple[SensorError, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Score:
    """A cause, how sure it is in standard deviations, and what it would have to be."""

    cause: Cause
    z: float
    size: float  # change of the number, relative gain, lag in s, share, time constant in s, its root
    gain: float  # by how much it would lower the sum of squares
    shift: Array = field(default_factory=lambda: np.zeros(0))  # by how much it has moved the vector
    spread: Array = field(default_factory=lambda: np.zeros(0))  # standard deviations of that


def causes_of(unknowns: Unknowns) -> tuple[Cause, ...]:
    """Return what may be wrong: fixed numbers, both planes of a bearing, channels alone and together, eddy currents."""
    model, known = unknowns.model, [p.name for p in unknowns.known if p.role == "fixed"]
    causes = [Cause(name=x, kind="fixed", errors=(SensorError(kind="fixed", channel=x),)) for x in known]
    for b in model.bearings:
        planes = (f"{b.name}.z", *(b.sensor_parameter(k) for k in range(len(b.z_sensors))))
        if set(known).issuperset(planes):
            both = tuple(SensorError(kind="fixed", channel=x) for x in planes)
            causes.append(Cause(name="+".join(planes), kind="fixed", errors=both))
    errors = (*position_errors(model), *electrical_errors(model))
    causes += [Cause(name=f"{e.channel}.{e.kind}", kind=e.kind, errors=(e,)) for e in errors]
    shared = [e for e in errors if e.kind in ("lag", "limiter")]
    for (kind, of), group in groupby(shared, lambda e: (e.kind, e.channel.split("_")[1].rstrip("0123456789"))):
        if len(all_of := tuple(group)) > 1 and of in _TOGETHER:
            causes.append(Cause(name=f"{_TOGETHER[of]}.{kind}", kind=kind, errors=all_of))
    eddy = () if "a" in model.extras else (Cause(name="eddy_pole", kind="eddy"),)
    return (*causes, *eddy, Cause(name="solid_iron", kind="iron"))


def scores(problem: Likelihood, v: Array) -> list[Score]:
    """Return the causes that the residuals may have, the surest first."""
    causes = causes_of(problem.unknowns)
    C, J, r = _columns_of(problem, v, causes)
    return scored(causes, C, J, r, r.size)


def _columns_of(problem: Likelihood, v: Array, causes: Sequence[Cause]) -> tuple[Array, Array, Array]:
    """Return what causes add to the residuals, their slopes and themselves."""
    rows = np.concatenate(problem.rows(v, corrected=True))
    return np.concatenate(_by_cause(problem, v, causes, corrected=True)), rows[:, :-1], rows[:, -1]


def scored(causes: Sequence[Cause], C: Array, J: Array, r: Array, n: int) -> list[Score]:
    """Return scores by what each cause adds, C (n_rows, n_causes), slopes J and residuals r; `n`: real residuals."""
    rows = triangle_of([np.column_stack([J, C, r])])
    J, C, r = rows[:, : J.shape[1]], rows[:, J.shape[1] : -1], rows[:, -1]
    outside, moved = _outside(J, C)
    own, whole = np.sum(outside**2, axis=0), np.sum(C**2, axis=0)
    along = outside.T @ r
    spread = np.sqrt(max(1.0, float(r @ r) / n))
    found = [
        Score(cause=c, z=float(a / np.sqrt(o) / spread), size=float(a / o), gain=float(a * a / o), shift=a / o * m,
              spread=spread / np.sqrt(o) * m)
        for c, a, o, w, m in zip(causes, along, own, whole, moved.T, strict=True)
        if o > _OWN * w and o > 0.0
    ]  # fmt: skip
    return sorted(found, key=lambda s: -abs(s.z))


def _by_cause(problem: Likelihood, v: Array, causes: Sequence[Cause], *, corrected: bool) -> list[Array]:
    """Return what each cause adds to the whitened outputs of each experiment, (n_real, n_causes)."""
    at, model = problem.point(v), problem.unknowns.model
    errors = tuple(dict.fromkeys(e for c in causes for e in c.errors))
    blocks = []
    for e, w in zip(problem.experiments, problem.weights, strict=True):
        moved = _columns(e, w if corrected else replace(w, back=None), model, at, errors)
        single = dict(zip([*errors, "eddy", "iron"], moved, strict=True))
        columns = [np.sum([single[x] for x in c.errors or (c.kind,)], axis=0) for c in causes]
        block = (w.whiten @ np.stack(columns, axis=2)).reshape(-1, len(causes))
        blocks.append(np.sqrt(2.0) * np.concatenate([block.real, block.imag]))
    return blocks


def refined(problem: Likelihood, v: Array, found: Sequence[Score]) -> list[Score]:
    """Return scores of large errors: where residuals are far above the noise, the likeliest causes are searched with
    the parameters, by what they do exactly, and lags that are none are left out.
    """
    before = problem.cost(v)
    if before < _LARGE * problem.n_real or not found or abs(found[0].z) < _FAR:
        return list(found)
    v, best = _risen(problem, v), found[0]
    twins = [b for a, b in _TWINS if best.cause.name.endswith(a)]
    top = [s for s in found if s.gain > _WORTH * best.gain or s.cause.name.endswith(tuple(twins))][:_MOST]
    searched = [_searched(problem, v, s, before) for s in top]
    possible = [s for s in searched if s.cause.kind not in _LATE or s.size > 0.0]
    return sorted(possible, key=lambda s: -s.gain) or list(found)


def _risen(problem: Likelihood, v: Array) -> Array:
    """Return the vector with resistances that ran to zero, where nothing moves them, at the lowest line's reactance."""
    at, v, names = problem.point(v).theta, v.copy(), problem.unknowns.logs
    low = min(float(e.spectra.omega[0]) for e in problem.experiments)
    for k, name in enumerate(names):
        if name.endswith(".R"):
            v[k] = max(v[k], np.log(low * at[f"{name[:-1]}L"]))
    return v


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Beside:
    """The criterion with the size of a cause as one more number, over that of its score."""

    problem: Likelihood
    cause: Cause
    unit: float

    def freed(self, theta: Array) -> Likelihood:
        """Return the problem without the cause."""
        return _without(self.problem, theta[:-1], self.cause, self.unit * float(theta[-1]))

    def cost(self, theta: Array) -> float:
        """Return the criterion."""
        return self.freed(theta).cost(theta[:-1])

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of slopes and residuals."""
        there, v = self.freed(theta), theta[:-1]
        rows = np.concatenate(there.rows(v, corrected=False))
        c = self.unit * np.concatenate(_by_cause(there, v, [self.cause], corrected=False))
        slopes, left = there.unknowns.priors(v)
        prior = np.column_stack([slopes, np.zeros(len(left)), left])
        return triangle_of([np.column_stack([rows[:, :-1], c, rows[:, -1]]), prior])


def _searched(problem: Likelihood, v: Array, s: Score, before: float) -> Score:
    """Return a score whose size is searched together with the parameters, from zero, and a lag from what turns the
    highest line: a fit that lacks it stands far away.
    """
    lag, last = s.cause.kind in _LATE, max(float(e.spectra.omega[-1]) for e in problem.experiments)
    unit = abs(s.size) if not lag else last**-0.5 if s.cause.kind == "iron" else 1.0 / last
    beside = _Beside(problem=problem, cause=s.cause, unit=unit)
    starts = [np.append(v, x) for x in ((0.0, 1.0) if lag else (0.0,))]
    ends = [search(beside, x, most=_STEPS, tolerance=1e-4, longest=1.0) for x in starts]
    best = min(ends, key=lambda x: x.cost)
    size, gain = unit * float(best.theta[-1]), max(before - best.cost, 0.0)
    z = float(np.sign(size) * np.sqrt(gain * s.z**2 / s.gain))
    return replace(s, z=z, size=size, gain=gain, shift=v - best.theta[:-1])


def other_gain(problem: Likelihood, v: Array) -> float:
    """Return by how much what a mode may stand in for would lower the sum of squares: a channel's gain, lag or
    cross-talk, an eddy pole, or the fixed numbers all together, as two planes at wrong places are.
    """
    causes = [c for c in causes_of(problem.unknowns) if "+" not in c.name]
    C, J, r = _columns_of(problem, v, causes)
    alone = (s.gain for s in scored(causes, C, J, r, r.size) if s.cause.kind != "fixed")
    return max(_together(J, C[:, [c.kind == "fixed" for c in causes]], r).gain, *alone, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Joint:
    """Several columns in the residuals at once."""

    sizes: Array  # what the columns would have to be, by axes that the residuals tell apart, (n_axes,)
    information: Array  # of these, (n_axes,)
    shift: Array  # by how much one of each has moved the vector, (n_vector, n_axes)

    @property
    def gain(self) -> float:
        """By how much they would lower the sum of squares."""
        return float(np.sum(self.sizes**2 * self.information))


def _together(J: Array, C: Array, r: Array) -> _Joint:
    """Return what columns C (n_rows, n) explain of residuals r outside the space of the slopes J."""
    C = C / np.maximum(np.linalg.norm(C, axis=0), 1e-300)
    outside, moved = _outside(J, C)
    values, axes = np.linalg.eigh(outside.T @ outside)
    axes, values = axes[:, values > _OWN], values[values > _OWN]
    return _Joint(sizes=axes.T @ (outside.T @ r) / values, information=values, shift=moved @ axes)


def _outside(J: Array, C: Array) -> tuple[Array, Array]:
    """Return columns outside the space of the slopes, and by how much one of each has moved the vector."""
    moved = directions(J).solve(C)
    return C - J @ moved, moved


def _columns(
    e: Experiment, w: Weight, model: RotorModel, at: Point, errors: Sequence[SensorError]
) -> Iterator[Complex]:
    """Yield what each error adds to the outputs, (n_lines, n_y), last an eddy pole and solid iron. The inputs are those
    of the slopes: freed of what feedback put in.
    """
    of, turned = sampled(e, model, at), model.at_speed(e.speed)
    H, mean = of.transfer(), e.spectra.mean_u
    if w.back is not None:
        left = e.spectra.mean_y - (H @ mean[:, :, None])[:, :, 0]
        mean = mean - (w.back @ left[:, :, None])[:, :, 0]
    y, omega, outputs, inputs = of.states(mean) @ of.space.C.T, e.spectra.omega, model.outputs, model.inputs
    for error in errors:
        if error.kind == "fixed":
            yield of.slopes(mean, [turned.derivative(at.theta, error.channel)])[:, :, 0]
            continue
        if error.channel in inputs:  # a gain is of what is logged, a lag of what acts, but for a measured current
            k = inputs.index(error.channel)
            sign = -1.0 if error.kind == "gain" or error.channel.endswith("_current") else 1.0
            yield sign * H[:, :, k] * _at_lines(e.spectra, error.kind, mean[:, k])[:, None]
            continue
        added, k = np.zeros_like(y), outputs.index(error.channel)
        other = y[:, outputs.index(error.other)] if error.other else None
        added[:, k] = _at_lines(e.spectra, error.kind, y[:, k], other)
        yield added
    forced = _forced(of, model, at, mean, y)
    yield -1j * omega[:, None] * forced
    yield -np.sqrt(1j * omega)[:, None] * forced


def beyond_ends(x: Array) -> Array:
    """Return the parts of signals, time first, beyond the outer twentieth of each."""
    ends = np.quantile(np.abs(x), _ENDS, axis=0)
    return np.asarray(x - np.clip(x, -ends, ends))


def _at_lines(spectra: PeriodSpectra, kind: Kind, signal: Complex, other: Complex | None = None) -> Complex:
    """Return what an error of one unit adds to a channel's lines (n_lines,); a limiter's part beyond the outer
    twentieth is zero where the lines are not those of one period.
    """
    if kind != "limiter":
        return logged_error(kind, signal, spectra.omega, other)
    bins = _bins(spectra)
    if spectra.known_scatter is not None or np.any(np.diff(bins) <= 0):
        return np.zeros_like(signal)
    return np.asarray(np.fft.rfft(beyond_ends(_course(signal, bins, spectra.period)))[bins] / spectra.period)


def _bins(spectra: PeriodSpectra) -> NDArray[np.intp]:
    """Return the place of each line in the spectrum of a period."""
    return np.round(spectra.frequency_hz * spectra.period / spectra.rate_hz).astype(np.intp)


def _forced(of: Sampled, model: RotorModel, at: Point, U: Complex, Y: Complex) -> Complex:
    """Return what the forces of the currents do to the outputs, (..., n_lines, n_y), by inputs and outputs."""
    omega, theta = of.omega, at.theta
    course = np.exp(0.5j * omega / of.rate_hz) / np.sinc(omega / of.rate_hz / (2.0 * np.pi))  # of what is not held
    if "a" in model.extras:
        course = course / (1.0 + 1j * omega / theta["a"])
    signals = dict(zip((*model.inputs, *model.outputs), (*np.moveaxis(U, -1, 0), *np.moveaxis(Y, -1, 0)), strict=True))
    forced, D = np.zeros(Y.shape, dtype=complex), of.disturbed()
    for k, axis in enumerate(model.axes):
        if k in model.amplified:
            amplifier = theta[f"{axis}.amplifier_gain"] / (1.0 + 1j * omega / theta[f"{axis}.amplifier_pole"])
            current = signals[f"{axis}_command"] * amplifier
        else:
            current = signals[f"{axis}_current"]
        forced += (theta[f"{axis}.k_i"] * course * current)[..., None] * D[:, :, k]
    return forced


def _without(problem: Likelihood, v: Array, cause: Cause, size: float) -> Likelihood:
    """Return the problem freed of a cause of a size, at a vector."""
    base, experiments, model, at = problem.base, problem.experiments, problem.unknowns.model, problem.point(v)
    if not cause.errors:
        power = 1.0 if cause.kind == "eddy" else 0.5
        lost = [1.0 / (1.0 + size * (1j * e.spectra.omega) ** power) - 1.0 for e in experiments]
        of = [(e.spectra, sampled(e, model, at)) for e in experiments]
        Y = [q.Y - x[:, None] * _forced(there, model, at, q.U, q.Y) for (q, there), x in zip(of, lost, strict=True)]
        experiments = [replace(e, spectra=replace(e.spectra, Y=y)) for e, y in zip(experiments, Y, strict=True)]
    for error in cause.errors:
        if error.kind == "fixed":
            base = replace(base, theta={**base.theta, error.channel: base.theta[error.channel] + size})
        else:
            experiments = [replace(e, spectra=_freed(e.spectra, model, error, size))
                           for e in experiments]  # fmt: skip
    return replace(problem, base=base, experiments=experiments)


def _freed(spectra: PeriodSpectra, model: RotorModel, error: SensorError, size: float) -> PeriodSpectra:
    U, Y, late = spectra.U.copy(), spectra.Y.copy(), 1.0 + 1j * spectra.omega * size
    if error.kind == "limiter" and error.channel in model.outputs:
        k = model.outputs.index(error.channel)
        Y[:, :, k] -= size * _at_lines(spectra, error.kind, spectra.mean_y[:, k])
    elif error.kind == "limiter":
        k = model.inputs.index(error.channel)
        U[:, :, k] += (-size if error.channel.endswith("_current") else size) * _at_lines(
            spectra, error.kind, spectra.mean_u[:, k]
        )
    elif error.channel in model.inputs:
        acts = 1.0 / late if not error.channel.endswith("_current") else late
        U[:, :, model.inputs.index(error.channel)] *= acts if error.kind == "lag" else 1.0 / (1.0 + size)
    elif error.kind == "cross-talk":
        k, other = (model.outputs.index(x) for x in (error.channel, error.other))
        Y[:, :, k] -= size * Y[:, :, other]
    else:
        Y[:, :, model.outputs.index(error.channel)] *= late if error.kind == "lag" else 1.0 / (1.0 + size)
    return replace(spectra, U=U, Y=Y)


def agreement_checks(found: Sequence[Score], model: RotorModel, more: Sequence[Score] = ()) -> dict[str, Check]:
    """Judge what is fixed, and the channels, by their scores. What explains the residuals best is named, with what
    explains them about as well, and what shows besides (`more`); the other check does not fail for what that explains.
    """
    if not found:
        return {}
    best, units = found[0], {p.name: p.unit for p in model.parameters}
    alike = _alike(found)
    others = [s.cause.name for s in alike] + ["planes"] * ("+" in best.cause.name)
    others += ["curvature"] * (best.cause.kind == "limiter")
    twin = next((best.cause.name.replace(a, b) for a, b in _TWINS if best.cause.name.endswith(a)), "")
    twins = _late_instead(best.cause.name) if _leads(best) else (twin,)
    others += [x for x in twins if x not in (best.cause.name, *others) and _logged(x, model)]
    checks: dict[str, Check] = {}
    for name, fixed, fine in (
        ("fixed_agree", True, "the record agrees with the planes and the other fixed numbers"),
        ("sensors_agree", False, "no gain, lag or cross-talk of a channel and no eddy pole shows in the residuals"),
    ):
        group = [s for s in found if (s.cause.kind == "fixed") == fixed]
        if not group:
            continue
        worst = group[0]
        passed = abs(worst.z) < _FAR or worst is not best
        detail = fine if abs(worst.z) < _FAR else f"{best.cause.name} explains more than what this check asks for"
        if not passed:
            detail = _words(worst, units.get(worst.cause.name.split("+")[0], "1"))
            words = {"planes": "two planes, each by its own", "curvature": "curvature of the magnets"}
            shown = [_shown(s, units) for s in alike] + [words.get(x, x) for x in others[len(alike) :]]
            if shown:
                detail += f"; about as well explained by {' or '.join(shown)}"
            if more:
                detail += f". With that taken out, {' or '.join(_shown(s, units) for s in more)} shows too"
        checks[name] = Check(
            passed=passed, values={"z": worst.z, "size": worst.size}, detail=detail,
            cause="" if passed else worst.cause.name, size=None if passed else worst.size,
            alternatives=() if passed else tuple(dict.fromkeys(others)),
        )  # fmt: skip
    return checks


def _alike(found: Sequence[Score]) -> list[Score]:
    """Return the scores that explain the residuals about as well as the first."""
    best = found[0].gain
    return [s for s in found[1:] if s.gain > min(_ALIKE * best, best - _CLOSE)]


def suspects(found: Sequence[Score]) -> list[Score]:
    """Return the score that a check fails for, and those about as good; none where the checks pass."""
    return [found[0], *_alike(found)] if found and abs(found[0].z) >= _FAR else []


def beside(problem: Likelihood, v: Array, found: Sequence[Score]) -> tuple[list[Score], list[Score]]:
    """Return the causes that show once the one that a check fails for is taken out: all, and those to be named, which
    explain most of what is left.
    """
    if not suspects(found) or not np.isfinite(problem.cost(v - found[0].shift[: v.size])):
        return [], []
    first = found[0]
    v = v - first.shift[: v.size]
    freed, n = _without(problem, v, first.cause, first.size), problem.n_real
    found = suspects([s for s in scores(freed, v) if s.cause != first.cause])
    left = freed.cost(v) - n - 2.0 * np.sqrt(2.0 * n)  # beyond chance: what is taken out in part leaves a rest
    return found, found if found and found[0].gain > _MAIN * left else []


def _leads(s: Score) -> bool:
    """Whether a score would have a channel lead, as none does: others lag."""
    return s.cause.kind in _LATE and s.size < 0.0


def _late_instead(name: str) -> tuple[str, ...]:
    """Return the lags of current and voltage that a lead of another channel stands for."""
    axis, _, channel = name.partition("_")
    if not channel or name in ("eddy_pole", "solid_iron"):
        return ("currents.lag", "voltages.lag")
    return (f"{axis}_current.lag", f"{axis}_voltage.lag")


def _logged(name: str, model: RotorModel) -> bool:
    """Whether a model has the channels that a lag is of, or lacks the eddy pole."""
    if name == "eddy_pole":
        return "a" not in model.extras
    channel, roles = name.rpartition(".")[0], (*model.inputs, *model.outputs)
    return channel in roles or any(role.endswith(f"_{channel.removesuffix('s')}") for role in roles)


def _shown(s: Score, units: dict[str, str]) -> str:
    """Return a cause with its size, in a few words."""
    kind, unit = s.cause.kind, units.get(s.cause.name.split("+")[0], "1")
    if kind == "fixed":
        size = f"{1e3 * s.size:+.3g} mm" if unit == "m" else f"{s.size:+.3g} {unit}"
    else:
        late = f"{s.size**-2 / (2.0 * np.pi):.3g} Hz" if kind == "iron" else f"{1e6 * s.size:.3g} us"
        size = late if kind in _LATE else f"{100 * s.size:+.3g} %"
    return f"{s.cause.name} ({size})"


def _words(s: Score, unit: str) -> str:
    sure, name, kind = f"z = {abs(s.z):.3g}", s.cause.name, s.cause.kind
    channel, axis = name.rpartition(".")[0], name.split("_")[0]
    if kind == "fixed":
        shown = f"{1e3 * s.size:+.3g} mm" if unit == "m" else f"{s.size:+.3g} {unit}"
        both = " and ".join(name.split("+"))
        return f"the record contradicts {both}: {shown} would fit better ({sure}). Measure it, or let it be free"
    if _leads(s):
        lead = "" if kind == "iron" else f" of {1e6 * abs(s.size):.3g} us"
        return (
            f"{name} would have to be a lead{lead} ({sure}), as no sensor has: currents or "
            "voltages lag behind what is logged, or are logged late. Log them without filters"
        )
    if kind == "eddy":
        return (
            f"the positions lag behind the currents by {1e6 * s.size:.3g} us ({sure}). Add to [parameters] an eddy "
            "pole, a, or the poles of the sensors"
        )
    if kind == "iron":
        return (
            f"the forces follow the currents as 1/(1 + (s/a)^0.5), a of about {s.size**-2 / (2.0 * np.pi):.3g} Hz "
            f"({sure}), as eddy currents in solid iron do: the intervals hold that. Excite more slowly, or let the "
            "iron be laminated"
        )
    if kind == "limiter":
        voltage = channel.rpartition("_")[2].startswith("voltage")
        whose, remedy = (
            ("the coils get", "Log the coils' voltages, or") if voltage else (f"{channel} read", "Calibrate, or")
        )
        return f"{whose} {100 * s.size:+.3g} % ({sure}) beyond the outer twentieth of {channel}. {remedy} excite less"
    if kind == "cross-talk":
        return (
            f"{channel} holds {100 * s.size:+.3g} % of the other plane ({sure}): cross-talk, or turned. Check its "
            "mounting"
        )
    position = "_position" in name
    if kind == "gain":
        remedy = f"Calibrate it, or free {axis}.gain" if position else "Calibrate it"
        return f"{channel} reads {100 * s.size:+.3g} % beside the others ({sure}). {remedy}"
    late = f"{channel} {'lags' if '_' in channel else 'lag'} by {1e6 * s.size:.3g} us ({sure})"
    if channel.rpartition("_")[2].startswith("voltage"):
        return f"{late}: the coils get less than what is logged. Log behind the amplifier, or excite more slowly"
    remedy = f"Add {axis}.sensor_pole to [parameters]" if position else "Log without its filter"
    return f"{late}. {remedy}"


# --- curvature: force and flux of a co-energy of fourth degree in position and current, as a pair of magnets has beside
# its linear terms, tested in the residuals with their sizes unknown

_DEGREE = 4
_CHANCE = 1e-4  # probability below which curvature counts as seen
_HARMLESS, _BENT = 1.5, 8.0  # standard deviations that it may move a number by, to be silent, and to be held


@dataclass(frozen=True, slots=True, kw_only=True)
class Bent:
    """Curvature as the residuals show it."""

    gain: float  # by how much it would lower the sum of squares
    p: float  # probability of that by chance
    shift: Mapping[str, float]  # of each number, SI
    # covariance that numbers by the names of `shift` have beside that of the record: what the shift is, not taken out,
    # and how far it is known
    more: Array
    share: float = 1.0  # of what the residuals hold beyond noise, that it would explain
    other: str = ""  # what explains the residuals better, so that the shift is none of curvature

    def instead(self, other: str) -> Bent:
        """Return that something else explains the residuals better."""
        return replace(self, shift={}, more=np.zeros((0, 0)), other=other)


def curvature(problem: Likelihood, v: Array) -> Bent | None:
    """Return what curvature has done to the numbers; no shift where it does not show, None without coils."""
    model = problem.unknowns.model
    if len(model.coils) < len(model.axes):
        return None
    rows, at = np.concatenate(problem.rows(v, corrected=True)), problem.point(v)
    pairs = zip(problem.experiments, problem.weights, strict=True)
    C, J, r = np.concatenate([_bent(problem, e, w, at) for e, w in pairs]), rows[:, :-1], rows[:, -1]
    joint = _together(J, C, r)
    p = chi_squared_tail(max(joint.sizes.size, 1), joint.gain / max(1.0, float(r @ r) / r.size))
    if p > _CHANCE:
        return Bent(gain=joint.gain, p=p, shift={}, more=np.zeros((0, 0)))
    names, chain = problem.unknowns.estimated(v)
    of_sizes = chain @ joint.shift
    shift = of_sizes @ joint.sizes
    more = np.outer(shift, shift) + (of_sizes / joint.information) @ of_sizes.T
    return Bent(
        gain=joint.gain, p=p, shift=dict(zip(names, shift.tolist(), strict=True)), more=np.asarray(more),
        share=joint.gain / max(float(r @ r) - r.size, joint.gain),
    )  # fmt: skip


def _bent(problem: Likelihood, e: Experiment, w: Weight, at: Point) -> Array:
    """Return what each term of each axis adds to the whitened outputs, (n_real, n_axes (degree + 1))."""
    model, spectra = problem.unknowns.model, e.spectra
    of, turned = sampled(e, model, at), model.at_speed(e.speed)
    x, n = of.states(spectra.mean_u), len(turned.coordinates)
    bins = _bins(spectra)
    places, states, D = x[:, :n] @ turned.rows(at.theta)[0].T, list(turned.states), of.disturbed()
    columns = []
    for j, axis in enumerate(model.axes):
        courses = (_course(q, bins, spectra.period) for q in (places[:, j], x[:, states.index(f"{axis}_current")]))
        (px, sx), (pi, si) = (_powers(s) for s in courses)
        for a in range(_DEGREE + 1):
            b = _DEGREE - a
            force = a / sx * px[max(a - 1, 0)] * pi[b]
            flux = b / si * px[a] * pi[max(b - 1, 0)]
            F, L = (np.fft.rfft(q)[bins] / spectra.period for q in (force, flux))
            rate = -1j * spectra.omega * L
            added = D[:, :, j] * F[:, None] + D[:, :, len(model.axes) + model.coils.index(j)] * rate[:, None]
            columns.append((w.whiten @ added[:, :, None])[:, :, 0].ravel())
    block = np.sqrt(2.0) * np.array(columns).T
    return np.concatenate([block.real, block.imag])


def _course(spectrum: Complex, bins: NDArray[np.intp], period: int) -> Array:
    """Return a signal over one period by its lines."""
    whole = np.zeros(period // 2 + 1, dtype=complex)
    whole[bins] = spectrum * period
    return np.fft.irfft(whole, period)


def _powers(s: Array) -> tuple[list[Array], float]:
    """Return powers of a signal over its rms, and that."""
    size = max(float(s.std()), 1e-300)
    return [(s / size) ** k for k in range(_DEGREE + 1)], size


def curvature_check(bent: Bent, sd: Mapping[str, float], *, told: bool) -> Check:
    """Judge what curvature has done against the standard deviations of the record; `told`: another check fails."""
    worst = max(bent.shift, key=lambda x: abs(bent.shift[x]) / (sd.get(x) or np.inf), default="")
    z = abs(bent.shift[worst]) / (sd.get(worst) or np.inf) if worst else 0.0
    if bent.other:
        text = f"curvature of the magnets would explain less than {bent.other}: it is not held in the intervals"
        return Check(passed=True, p=bent.p, detail=text)
    if bent.share < _MAIN and z > _BENT:
        text = (
            f"curvature of the magnets would explain {bent.share:.0%} of what the model leaves, and move {worst} by "
            f"{z:.2g} sd of the record: something else is wrong"
        )
        return Check(passed=told, p=bent.p, values={"z": z}, detail=text)
    if z <= _HARMLESS:
        return Check(passed=True, p=bent.p, detail="no curvature of the magnets shows that moves a number")
    held = z <= _BENT
    text = f"curvature of the magnets shows, and moves {worst} by {z:.2g} sd of the record: the intervals hold it"
    if held:
        return Check(passed=True, p=bent.p, values={"z": z}, detail=text)
    return Check(
        passed=False, p=bent.p, values={"z": z}, detail=f"{text} to first order. Excite less", cause="curvature"
    )
