"""From the end of a search to the estimate of a rotor: covariance, modes, checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.calibration import lines_of
from ambid.estimation.estimate import Check, Continuous, Delay, EstimatedParameter, OutputFit
from ambid.estimation.modes import EstimatedNumber, Mode
from ambid.physics.linear_model import Parameter
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import Lines
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.estimator import Ending, RotorFit
from ambid.rotor.likelihood import Experiment, sampled
from ambid.rotor.prediction import PredictorFit
from ambid.rotor.scores import (
    Bent,
    Score,
    agreement_checks,
    beside,
    curvature,
    curvature_check,
    refined,
    scores,
    suspects,
)

_BANDS = 24  # parts of the excited band whose residuals are judged
_FAR = 4.5  # standard deviations from which residuals are above the noise
_LIMIT_SHARE = 0.05  # of the mean square, above which they matter
_LENGTH_SEEN = 0.25
FOLD = 3.0  # logarithm of a number by which a cause may move it: beyond, it is not identifiable in any case


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Numbers:
    """All numbers of a fit with their covariance: `names` are those that were estimated, then delays."""

    theta: Mapping[str, float]
    names: tuple[str, ...]
    covariance: Array
    weakest: Mapping[str, float]
    condition: float

    def sd(self, name: str) -> float:
        """Return the standard deviation of a number, 0 where it was not estimated."""
        return float(np.sqrt(self.covariance[k, k])) if (k := self._at(name)) is not None else 0.0

    def wider(self, names: Sequence[str], more: Array) -> Numbers:
        """Return them with covariance beside that of the record."""
        covariance, at = self.covariance.copy(), [self.names.index(name) for name in names]
        covariance[np.ix_(at, at)] += more
        return replace(self, covariance=covariance)

    def _at(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None


def numbers_of(fit: Ending) -> Numbers:
    """Return numbers and covariance by the names of the model."""
    unknowns, data = fit.unknowns, fit.seen
    names, chain = unknowns.estimated(fit.vector)
    half = chain @ data.root()
    last = data.Vt[-1] if data.Vt.size else np.zeros(0)
    heavy = np.argsort(-np.abs(last))[:4]
    return Numbers(
        theta=fit.point.theta,
        names=names,
        covariance=half @ half.T,
        weakest={unknowns.names[k]: float(last[k]) for k in heavy},
        condition=data.condition,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What a method shows beside numbers: its noise, how much it explains, whether its residuals are noise."""

    method: Literal["periods", "predictor"]
    noise: Mapping[str, float]  # rms of each source, SI
    fit: Mapping[str, OutputFit]
    checks: Mapping[str, Check]
    bent: Bent | None = None  # what curvature has done to the numbers
    # beside what the record itself leaves open, in order of `Numbers.names`, each (n,) or (n_ways, n): what causes that
    # are named have done to the numbers, and what residuals that are no noise say
    shifts: Sequence[Array] = ()


def of_periods(fit: RotorFit) -> Evidence:
    """Return the evidence of period spectra."""
    found, numbers = refined(fit.problem, fit.vector, scores(fit.problem, fit.vector)), numbers_of(fit)
    sd, bent = {name: numbers.sd(name) for name in numbers.names}, curvature(fit.problem, fit.vector)
    if bent and bent.shift and curvature_check(bent, sd, told=False).passed:  # magnets that bend do so at the ends too
        found = [s for s in found if s.cause.kind != "limiter" or s.gain > bent.gain]
    more, second = beside(fit.problem, fit.vector, found)
    agree = agreement_checks(found, fit.model, second)
    named = next((c.cause for c in agree.values() if not c.passed), "")
    if bent and bent.shift and named and bent.gain < found[0].gain:  # no more than what is named does
        bent = bent.instead(named)
    residual, shifts = _residual_checks(fit), [*shifts_of(fit, found), *shifts_of(fit, more)]
    told = not all(c.passed for c in (*residual.values(), *agree.values()))
    if not all(c.passed for c in residual.values()):  # what no cause explains
        left = fit.problem.cost(fit.vector) - (found[0].gain if suspects(found) else 0.0)
        _, chain = fit.unknowns.estimated(fit.vector)
        shifts.append(np.sqrt(max(left / fit.problem.n_real - 1.0, 0.0)) * (chain @ fit.seen.root()).T)
    return Evidence(
        method="periods",
        noise=_noise(fit),
        fit=_fits(fit),
        bent=bent,
        shifts=shifts,
        checks={
            **residual,
            **({"curvature": curvature_check(bent, sd, told=told)} if bent else {}),
            **agree,
        },
    )


def shifts_of(fit: Ending, found: Sequence[Score]) -> list[Array]:
    """Return by how much each cause that is named has moved the numbers, and how far that is known."""
    names, chain = fit.unknowns.estimated(fit.vector)
    free, n, shifts = list(fit.unknowns.free_delays), fit.vector.size, list[Array]()
    names = names[: len(names) - len(free)]
    logs = [k for k, x in enumerate(fit.unknowns.names) if k < len(fit.unknowns.logs) or x.endswith(".l")]
    for s in suspects(found):
        shift = s.shift[:n].copy()
        shift[logs] = np.clip(shift[logs], -FOLD, FOLD)
        points = (fit.point, replace(fit, vector=fit.vector - shift).point)
        is_now, would_be = (np.array([*(p.theta[x] for x in names), *p.delays[free]]) for p in points)
        shifts += [is_now - would_be, chain @ s.spread[:n]]
    return shifts


def lines_seen(fit: RotorFit | PredictorFit) -> list[Lines]:
    """Return what the records of a fit show, and how they count: to say how errors of calibration move it."""
    if isinstance(fit, PredictorFit):
        return [replace(lines_of(fit.fit), plant=fit.model)]
    return [
        Lines(
            plant=fit.model.at_speed(e.speed), omega=e.spectra.omega, excitation=e.spectra.mean_u[:, :, None],
            whiten=w.whiten,
        )
        for e, w in zip(fit.problem.experiments, fit.problem.weights, strict=True)
    ]  # fmt: skip


def conclude(
    fit: Ending,
    evidence: Evidence,
    parameters: Sequence[Parameter],
    records: Sequence[Mapping[str, object]],
    *,
    delay_how: Sequence[str],
    more_checks: Mapping[str, Check],
    rig: Mapping[str, object],
    warnings: Sequence[str] = (),
) -> RotorEstimate:
    """Return the estimate of a search; `delay_how`: by input, "given" or "estimated"."""
    numbers, model = (of_record := numbers_of(fit)), fit.model
    if evidence.bent is not None:
        numbers = numbers.wider(tuple(evidence.bent.shift), evidence.bent.more)
    for x in map(np.atleast_2d, evidence.shifts):
        numbers = numbers.wider(numbers.names, x.T @ x)
    estimated = _parameters(model, parameters, numbers, of_record)
    checks = {**evidence.checks, "identifiable": _identifiable(estimated, numbers), **more_checks}
    speed = max(fit.speeds, key=abs)
    turned = model.at_speed(speed)
    modes, above = _modes(model, numbers, fit.band_hz)
    checks |= _mode_checks(modes, above)
    return RotorEstimate(
        status=fit.status,
        method=evidence.method,
        record=records[0],
        records=tuple(records),
        parameters=estimated,
        modes=modes,
        plant=turned,
        numbers={p.name: numbers.theta[p.name] for p in turned.parameters},
        covariance_names=numbers.names,
        covariance=numbers.covariance,
        delay=_delays(model, fit.point.delays, numbers, delay_how),
        continuous=Continuous.of(turned, numbers.theta),
        noise=evidence.noise,
        fit=evidence.fit,
        checks=checks,
        warnings=tuple(warnings),
        information={"condition": numbers.condition, "weakest": numbers.weakest, "band_hz": fit.band_hz},
        rig=rig,
    )  # fmt: skip


def _parameters(
    model: RotorModel, parameters: Sequence[Parameter], numbers: Numbers, of_record: Numbers
) -> tuple[EstimatedParameter, ...]:
    """Return the parameters as estimated; what the record itself shows of a prior is by `of_record`."""
    sizes = model.references(numbers.theta)
    estimated = []
    for p in parameters:
        sd = numbers.sd(p.name)
        value = numbers.theta[p.name]
        size = sizes.get(p.name, abs(value))
        shows = {p.name: p.role == "fixed" or bool(sd <= _LENGTH_SEEN * size)}
        # of independent information 1/sd² = 1/alone² + 1/prior²
        own = of_record.sd(p.name)
        left = max(1.0 - (own / p.sd) ** 2, 1e-12) if p.role == "prior" and p.sd else 1.0
        estimated.append(
            EstimatedParameter.of(p, numbers.theta, {p.name: sd}, shows, {p.name: own / float(np.sqrt(left))})
        )
    return tuple(estimated)


def _delays(model: RotorModel, delays: Array, numbers: Numbers, how: Sequence[str]) -> dict[str, Delay]:
    return {
        role: Delay.of(
            float(delays[k]), numbers.sd(f"{role}.delay") or None, "given" if how[k] == "given" else "estimated"
        )
        for k, role in enumerate(model.inputs)
    }


def _modes(model: RotorModel, numbers: Numbers, band: tuple[float, float]) -> tuple[tuple[Mode, ...], tuple[int, ...]]:
    """Return the modes within the band, and which stand above it."""
    modes, above = [], []
    for r in range(1, model.n_modes + 1):
        f = numbers.theta[f"mode{r}.omega"] / (2.0 * np.pi)
        if not f <= band[1]:
            above.append(r)
            continue
        shape = {
            place: EstimatedNumber.of(numbers.theta[f"mode{r}.{place}"], numbers.sd(f"mode{r}.{place}"))
            for place in model.places
        }
        modes.append(
            Mode(
                frequency_hz=EstimatedNumber.of(f, numbers.sd(f"mode{r}.omega") / (2.0 * np.pi)),
                damping=EstimatedNumber.of(numbers.theta[f"mode{r}.zeta"], numbers.sd(f"mode{r}.zeta")),
                shape=shape,
            )
        )
    return tuple(modes), tuple(above)


def _noise(fit: RotorFit) -> dict[str, float]:
    """Return the rms of every source in the first experiment."""
    weight, experiment = fit.problem.weights[0], fit.problem.experiments[0]
    assert weight.noise is not None
    sd = weight.noise.sd(experiment.spectra.period, experiment.spectra.rate_hz)
    return dict(zip((*fit.model.outputs, *fit.model.disturbances), sd.tolist(), strict=True))


def _fits(fit: RotorFit) -> dict[str, OutputFit]:
    """Return by output how much of the excited lines the model explains, over all experiments."""
    left, whole = np.zeros(len(fit.model.outputs)), np.zeros(len(fit.model.outputs))
    for e in fit.problem.experiments:
        response = sampled(e, fit.model, fit.point)
        difference = e.spectra.mean_y - np.einsum("kyu,ku->ky", response.transfer(), e.spectra.mean_u)
        left += np.sum(np.abs(difference) ** 2, axis=0)
        whole += np.sum(np.abs(e.spectra.mean_y) ** 2, axis=0)
    rms = np.sqrt(2.0 * left / len(fit.problem.experiments))
    share = 1.0 - np.sqrt(left / np.maximum(whole, 1e-300))
    return {
        role: OutputFit(one_step=float(share[k]), simulation=None, innovation_sd=float(rms[k]))
        for k, role in enumerate(fit.model.outputs)
    }


# --- checks ---------------------------------------------------------------------------------------------------------


def _residual_checks(fit: RotorFit) -> dict[str, Check]:
    """Judge the mean residuals against the noise between periods."""
    left = zip(fit.problem.experiments, fit.problem.residuals(fit.vector), strict=True)
    return line_checks(fit.model.outputs, [(e, r, np.zeros(r.shape)) for e, r in left], n_free=fit.vector.size)


def line_checks(
    outputs: Sequence[str], parts: Sequence[tuple[Experiment, Complex, Array]], *, n_free: int = 0
) -> dict[str, Check]:
    """Judge what a model leaves at the lines of records, of all and band by band for each output. `parts`: whitened
    mean residuals, and the squares that errors of its numbers add, (n_lines, n_y); `n_free`: numbers fitted to these
    lines. 2|r|² has two degrees of freedom; the noise's own levels come from P - 1 periods.
    """
    worst: dict[str, Any] = {"z": 0.0, "where": ""}
    total, count, spread = 0.0, 0, 0.0
    for e, r, added in parts:
        power, periods = 2.0 * (np.abs(r) ** 2 - added), e.spectra.n_periods
        more = 4.0 * float(added.sum()) * (2.0 + float(added.sum()))  # errors of numbers move many lines together
        total, count = total + float(power.sum()), count + 2 * power.size
        spread += 2.0 * 2 * power.size * (1.0 + 1.0 / (periods - 1)) + more
        bands = np.array_split(np.arange(power.shape[0]), min(_BANDS, max(1, power.shape[0] // 10)))
        for part in bands:
            freedom = 2.0 * part.size
            more_here = 4.0 * added[part].sum(axis=0) * (2.0 + added[part].sum(axis=0))
            own = 2.0 * freedom * (1.0 + 1.0 / (periods - 1))
            z = (power[part].sum(axis=0) - freedom) / np.sqrt(own + more_here)
            k = int(np.argmax(z))
            if z[k] > worst["z"]:
                f = e.spectra.frequency_hz[part]
                worst = {"z": float(z[k]), "where": f"{outputs[k]}, {f[0]:.4g} to {f[-1]:.4g} Hz"}
    freedom = max(count - n_free, 1)
    ratio, z_all = total / freedom, (total - freedom) / np.sqrt(spread)
    whole = bool(ratio < 1.0 + _LIMIT_SHARE or z_all < _FAR)
    white = bool(worst["z"] < _FAR + 1.0)
    detail = "the model leaves no more at the excited lines than the scatter between periods"
    return {
        "residuals_white": Check(
            passed=white, values={"z": worst["z"]},
            detail=detail + ", in every band" if white else f"the model misses part of {worst['where']} "
            f"(z = {worst['z']:.3g}"
            "). A mode, a delay or a sensor's pole may be missing, or the magnets be nonlinear: excite less",
        ),
        "residuals_uncorrelated": Check(
            passed=whole, values={"mean_square": ratio, "z": float(z_all)},
            detail=detail if whole else f"residuals at the excited lines are {ratio:.3g} times the noise: the model is "
            "incomplete. Check planes, modes, saturation of the voltage; excite less (the magnets are nonlinear)",
        ),
    }  # fmt: skip


def _identifiable(estimated: Sequence[EstimatedParameter], numbers: Numbers) -> Check:
    """Name what the data do not show, and the experiment that would."""
    unseen = [p.name for p in estimated if not p.identifiable]
    if not unseen:
        return Check(passed=True, detail="the data show all parameters", values={"condition": numbers.condition})
    return Check(
        passed=False, detail=f"the data do not show {', '.join(unseen)}. {_hint(unseen)}",
        values={"condition": numbers.condition},
    )  # fmt: skip


def _hint(unseen: Sequence[str]) -> str:
    kinds = {name.split(".")[-1] for name in unseen}
    if {"m", "k_i"} <= kinds and "R" not in kinds:
        return "Without voltages only ratios to m show: log the coil voltages, or give m as fixed"
    if {"k_i", "amplifier_gain"} <= kinds:
        return "Commands show k_i and the gain of the amplifier as a product only: give one of them as fixed"
    if kinds & {"z_sensor", "z"}:
        return "Give one length between planes"
    if kinds == {"Ip"}:
        return "Ip shows at speed only: record while the rotor turns, or give it as fixed"
    if kinds <= {"a", "sensor_pole"}:
        return "Excite higher frequencies"
    return "Excite every axis, with more lines or a larger amplitude"


def _mode_checks(modes: Sequence[Mode], above: Sequence[int]) -> dict[str, Check]:
    """Judge the modes within the band."""
    checks: dict[str, Check] = {}
    weak = [m for m in modes if not m.identifiable]
    if modes:
        names = ", ".join(f"{m.frequency_hz.value:.5g} Hz" for m in weak)
        checks["modes"] = Check(
            passed=not weak,
            detail=f"bending modes at {', '.join(f'{m.frequency_hz.value:.5g}' for m in modes)} Hz" if not weak else
            f"the data hardly show the bending mode at {names}. Excite around it, or set modes.count",
            values={"above_band": float(len(above))},
        )  # fmt: skip
    return checks


def experiments_hint(experiments: Sequence[Experiment], model: RotorModel) -> str | None:
    """Return a warning where some axes are not excited in any record."""
    moved = np.zeros(len(model.axes), dtype=bool)
    for e in experiments:
        if e.spectra.R is None:
            return None
        moved |= np.max(np.abs(e.spectra.R), axis=0) > 0.0
    idle = [axis for axis, on in zip(model.axes, moved, strict=True) if not on]
    if not idle:
        return None
    return f"no excitation of {', '.join(idle)}: their coils and the rotor's modes show through the coupling only"
