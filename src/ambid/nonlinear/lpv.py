"""LPV models scheduled by set point: system model and error model by prediction error, coefficients functions of p.

Scale -> set point (its low-pass, where left open) -> degree in p, form and error model, each by a criterion of
the one-step errors -> Levenberg-Marquardt, the time constant of the low-pass included where it was left open. Starts
come from least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, portions
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.fit import NonlinearFit, Settings, failed_fit
from ambid.nonlinear.lagged_problem import guarded
from ambid.nonlinear.lpv_choice import (
    DEGREES,
    Candidate,
    Fitting,
    by_degree,
    by_form,
    carry_over,
    choose_level,
    error_orders,
    wanted_shapes,
)
from ambid.nonlinear.lpv_model import LEVEL, LpvModel, LpvShape, Schedule, looks_back, regressors
from ambid.nonlinear.records import scaled_records
from ambid.nonlinear.settings import choice, number, read_settings, text, whole

DIVERGED = "no one-step predictor that stays finite was found; lower degree, order or error_order, or check the columns"
UNSTABLE = (
    "the output form cannot be fitted: its process part diverges over the records, as that of an unstable plant does. "
    "Say form = equation"
)
_CRITERION = "aicc"  # what chooses the degree
_POINTS = 9  # of the table over the range of p
_CLOSE = 2.0  # difference of Akaike's criterion that says nothing (Burnham and Anderson 2002, sec. 2.6)

# --- settings ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvSettings:
    """What an LPV fit may be given. None: to be chosen."""

    schedule: str = text(
        "scheduling signal: an input, the output, or level (set point: output, low-passed); level", LEVEL
    )
    time_constant: float | None = number(
        "of the low-pass of level, in s; chosen, at least five of the plant's own", 0.0, 1e9
    )
    order: int = whole("of the system model; 2", 1, 10, 2)
    nb: int | None = whole("coefficients of each input; order", 0, 50)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    degree: int | None = whole("of the coefficients in the scheduling signal; chosen, up to 3", 0, 8)
    form: str = choice(
        "output (noise on the output) or equation (noise in it; unstable plants); chosen by bic",
        *("auto", "equation", "output"),
    )
    error_order: int = whole("of the error model, 0 for white noise; 5", 0, 20, 5)
    error_form: str = choice("ar, ma, arma; chosen by bic", "auto", "ar", "ma", "arma")
    iterations: int = whole("of each search, at most; 60", 1, 2000, 60)

    @property
    def orders(self) -> tuple[tuple[int, int], ...]:
        """Orders of D and C to try."""
        return error_orders(self.error_form, self.error_order)


def lpv_settings(given: Settings, first: IOData) -> tuple[LpvSettings, Schedule, tuple[int, ...]]:
    """Check settings beside one of the records, and complete them; with schedule and inputs that excite."""
    s = read_settings(LpvSettings, "lpv", given)
    if first.n_outputs != 1:
        raise EstimationError(
            f"lpv takes one output, not {', '.join(first.outputs)}; fit them one after the other, with the same "
            "schedule. Name one"
        )
    column = _schedule_column(s.schedule, first)
    if s.time_constant and s.schedule != LEVEL:
        raise EstimationError(
            f"lpv: time_constant is that of schedule = level; with schedule = {s.schedule} the column is taken as it "
            "is. Leave it out"
        )
    tau = s.time_constant if s.schedule == LEVEL else 0.0
    s = replace(s, nb=s.order if s.nb is None else s.nb, time_constant=tau)
    columns = tuple(k for k in range(first.n_inputs) if k != column)
    return s, Schedule(name=s.schedule, column=column), columns


def _schedule_column(name: str, first: IOData) -> int:
    """Return which input a schedule names; -1 where the scheduling signal is made of the output."""
    columns = (*first.inputs, *first.outputs)
    if name == LEVEL:
        if LEVEL in columns:
            raise EstimationError(
                "lpv: schedule = level means the low-passed output, but there is a column of that name. Rename "
                "the column"
            )
        return -1
    if name not in columns:
        raise EstimationError(
            f"lpv: schedule is {name!r}; it must be an input, the output or level: {', '.join((*columns, LEVEL))}. "
            f"Name the column as an input too; it does not excite.{nearest(name, list(columns))}"
        )
    return first.inputs.index(name) if name in first.inputs else -1


# --- stages -----------------------------------------------------------------------------------------------------------


def lpv(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a linear model whose coefficients follow a scheduling signal, with an error model (thesis sec. 1.6).

    Consistent under feedback as long as the error model holds the true one. Standard deviations take the form for
    given, and count degree and time constant of the set point where these were chosen: 95 % intervals hold the truth
    about 92 times in 100 on a few hundred samples. Nothing here is random: `seed` is there for the contract's sake.
    """
    if not records:
        raise EstimationError("lpv: no record is given. Pass one at least")
    s, schedule, columns = lpv_settings(settings, records[0])
    fitting, began = _begin(s, records, schedule, columns), perf_counter()

    def fail(why: str) -> NonlinearFit:
        return failed_fit("lpv", records, _used(s, fitting), seed, why, fitting.timing_s)

    def identify() -> None:
        _identify(s, fitting, tick)
        if fitting.status == "stalled":
            fitting.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")

    failed = guarded(identify, fitting, fail)
    fitting.timed("all", began)
    if failed or fitting.reason or not np.isfinite(fitting.problem(fitting.shape).cost(fitting.theta)):
        return failed or fail(fitting.reason or DIVERGED)
    return _finish(records, _used(s, fitting), fitting, seed=seed)


def _begin(s: LpvSettings, records: Sequence[IOData], schedule: Schedule, columns: tuple[int, ...]) -> Fitting:
    """A model by least squares: something to hand over when the very next thing is an interruption."""
    assert s.nb is not None
    tau = 50.0 * records[0].dt if s.time_constant is None else s.time_constant
    last = replace(schedule, time_constant=tau).share(records[0].dt) == 1.0
    shape = LpvShape(
        columns=columns, order=s.order, nb=s.nb, nk=s.nk, ar=0, ma=0, degree=s.degree or 0, form="equation",
        offset="constant" if last else "scheduled",
    )  # fmt: skip
    first = shape.first + s.error_order
    for r, x in enumerate(records):  # before it is said that a scheduling column does not excite
        if (x.inputs, x.outputs) != (records[0].inputs, records[0].outputs):
            scaled_records("lpv", records, lag=first)
        if r == 0 and schedule.column >= 0:
            schedule.over(records, 0.0)
    least = min(looks_back(x) for x in wanted_shapes(shape, s.form, s.orders))
    data = scaled_records("lpv", records, lag=max(first, least))
    n, k = sum(x.n_samples - first for x in records), shape.n_theta + s.error_order * (1 + (s.error_form == "arma"))
    if n <= k + 1:  # these fit anything
        raise EstimationError(
            f"lpv: {n} samples are left after lags for {k} numbers. Give longer records, or lower "
            f"{'order or error_order' if s.degree is None else 'degree, order or error_order'}"
        )
    fitting = Fitting(
        data=data, records=records, schedule=schedule.over(records, tau), shape=shape, theta=np.zeros(shape.n_theta),
        first=first, most=s.iterations,
    )  # fmt: skip
    fitting.theta = fitting.by_equations(shape)
    return fitting


def _used(s: LpvSettings, fitting: Fitting) -> dict[str, object]:
    """Settings with nothing left open."""
    of = fitting.shape
    form = {(False, False): s.error_form, (True, False): "ar", (False, True): "ma", (True, True): "arma"}
    found = {
        "degree": of.degree, "time_constant": fitting.schedule.time_constant, "error_order": max(of.ar, of.ma),
        "form": of.form, "error_form": form[of.ar > 0, of.ma > 0],
    }  # fmt: skip
    return {**asdict(s), **found}


def _identify(s: LpvSettings, fitting: Fitting, tick: Tick | None) -> None:
    """Choose and fit, or say why there is no model."""
    ticks = portions(tick, (1.0, 4.0, 10.0, 0.0 if s.degree is not None else 6.0, 10.0))
    began = perf_counter()
    if ticks[0] is not None:
        ticks[0]("set point", 0.0)
    if s.time_constant is None:
        fitting.schedule = choose_level(fitting, s.error_order, s.degree, ticks[0])
        fitting.theta = fitting.by_equations(fitting.shape)
    began = fitting.timed("set point", began)
    degrees = DEGREES if s.degree is None else (s.degree,)
    best = by_degree(fitting, degrees, replace(fitting.shape, ar=s.error_order), _CRITERION, ticks[1])
    began = fitting.timed("degree", began)
    best = by_form(fitting, wanted_shapes(best.shape, s.form, s.orders), best, ticks[2])
    if s.degree is None and np.isfinite(best.cost):  # a wrong form or error model may have decided on the degree
        others = [d for d in DEGREES if d != best.shape.degree]
        best = by_degree(fitting, others, best, _CRITERION, ticks[3])
    began = fitting.timed("form", began)
    if not np.isfinite(best.cost):
        fitting.reason = UNSTABLE if s.form == "output" else DIVERGED
        return
    fitting.shape, fitting.theta = best.shape, best.theta
    start = fitting.refine_level(best, None) if fitting.limits[1] and best.shape.degree else best.theta
    fitting.search(best.shape, [start], ticks[4], "prediction errors", last=True)
    fitting.timed("search", began)


# --- the fit ----------------------------------------------------------------------------------------------------------


def _finish(records: Sequence[IOData], used: dict[str, object], fitting: Fitting, *, seed: int) -> NonlinearFit:
    """Return the fit of a model that runs; `used` are the settings."""
    problem, theta, of, d = fitting.problem(fitting.shape), fitting.theta, fitting.schedule, fitting.data
    noise = problem.cost(theta) / problem.freedom
    R = fitting.problem(fitting.shape, beside=fitting.level_counts).triangle(theta)
    inverse, condition = information_inverse(R[:, :-1]) if np.all(np.isfinite(R)) else (None, np.inf)
    near = [
        regressors(fitting.shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
        for x, (y, u) in zip(records, d.parts, strict=True)
    ]
    model = LpvModel(
        dt=records[0].dt, n_inputs=records[0].n_inputs, shape=fitting.shape, schedule=of, theta=theta,
        u_level=d.u_level, u_scale=d.u_scale, y_level=d.y_level, y_scale=d.y_scale,
        cloud=cloud_of(np.concatenate(near)),
    )  # fmt: skip
    model = model.with_theta(theta * model.unit)
    warnings = [*fitting.warnings, *_cautions(records, fitting)]
    covariance = None
    if inverse is None:
        warnings.append(
            "no covariance, and so no standard deviations: the data do not determine the coefficients (condition "
            f"number {condition:.1e}). Lower degree or error_order, or give records at more set points"
        )
    else:
        covariance = (
            (noise * inverse[: theta.size, : theta.size] + _disagreement(fitting)) * model.unit[:, None] * model.unit
        )
    column = records[0].outputs[0] if of.column < 0 else of.name
    fitting.warnings = warnings
    fitting.details = {
        "schedule": {
            "signal": of.name, "low": of.low, "high": of.high, "time_constant_s": of.time_constant,
            "unit": records[0].units[column],
        },
        "condition": condition, "frozen": _frozen_table(model, covariance, records[0].inputs),
        "tried": [x.summary() for x in fitting.tried],
    }  # fmt: skip
    return fitting.result(
        "lpv", records, used, seed, model=model, covariance=covariance,
        covariance_from="" if covariance is None else "information", n_estimated=int(theta.size),
        noise_covariance=np.array([[noise * float(d.y_scale[0]) ** 2]]),
    )  # fmt: skip


def _frozen_table(model: LpvModel, covariance: Array | None, inputs: Sequence[str]) -> list[dict[str, object]]:
    """Return poles and gains over the range of the scheduling signal, by value of p.

    ``poles_rad_s`` has real and imaginary part and their standard deviations, ``dc_gain`` value and standard deviation
    by input; None where there is no number.
    """
    out = []
    for p in np.linspace(model.schedule.low, model.schedule.high, _POINTS):
        at = model.at(float(p), covariance)
        poles_sd = np.full(at.poles.size, np.nan + 1j * np.nan) if at.poles_sd is None else at.poles_sd
        gain_sd = np.full(at.dc_gain.size, np.nan) if at.dc_gain_sd is None else at.dc_gain_sd
        poles = [
            [_number(x) for x in (z.real, z.imag, sd.real, sd.imag)] for z, sd in zip(at.poles, poles_sd, strict=True)
        ]
        gains = {
            inputs[column]: [_number(g), _number(sd)]
            for column, g, sd in zip(model.shape.columns, at.dc_gain, gain_sd, strict=True)
        }
        out.append({"p": float(p), "poles_rad_s": poles, "dc_gain": gains})
    return out


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _cautions(records: Sequence[IOData], fitting: Fitting) -> list[str]:
    found = []
    of = fitting.shape
    if of.columns and not (of.ar or of.ma) and not all(x.open_loop for x in records):
        what = "noise is white" if of.form == "output" else "equation errors are white"
        found.append(
            f"without an error model (error_order = 0) lpv is biased under feedback unless its {what}, and nothing "
            "says that these records are open loop: raise error_order, or say --open-loop if there was no feedback"
        )
    if not of.columns and records[0].n_inputs:
        found.append(
            f"no input acts on the output: {fitting.schedule.name!r}, the only one, moves coefficients alone. "
            "Name the input that does"
        )
    if of.degree == 0:
        found.append(
            f"no coefficient depends on the scheduling signal {fitting.schedule.name!r} (degree 0"
            f"{'' if not fitting.tried or len(fitting.tried) < 2 else ', by the criterion'}): this is a linear model"
        )
    close = [str(x.shape.degree) for x, worse in _other_degrees(fitting) if abs(worse) < _CLOSE]
    if close:
        found.append(
            f"degree {of.degree} is a close call: degree {' and '.join(close)} would explain the data about as well. "
            "The standard deviations count what these differ by. Name the degree if you know it"
        )
    return found


def _other_degrees(fitting: Fitting) -> list[tuple[Candidate, float]]:
    """Candidates of other degrees, everything else alike, and by how much Akaike's criterion is worse of each."""
    of = fitting.shape
    alike = {
        x.shape.degree: x for x in fitting.tried if replace(x.shape, degree=of.degree) == of and np.isfinite(x.cost)
    }
    own = alike.pop(of.degree, None)
    return [] if own is None else [(x, x.value("aicc") - own.value("aicc")) for x in alike.values()]


def _disagreement(fitting: Fitting) -> Array:
    """Covariance of the coefficients, scaled, by which degree the model might have had (Burnham and Anderson 2002).

    Each other degree counts by its Akaike weight with the square of what its coefficients differ by over the range of
    p: unconditional variance, sec. 4.3.
    """
    of, theta = fitting.shape, fitting.theta
    found = [
        (np.exp(-max(worse, 0.0) / 2.0), carry_over(of, x.shape, x.theta) - theta)
        for x, worse in _other_degrees(fitting)
    ]
    total = 1.0 + sum(w for w, _ in found)
    out: Array = sum((w / total * np.outer(d, d) for w, d in found), np.zeros((theta.size, theta.size)))
    return out
