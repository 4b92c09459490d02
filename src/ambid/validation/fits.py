"""Fits judged: how well they explain their records, criteria, checks, and their errors on a second record.

With coloured residuals an output-error model's covariance is (J'J)^-1 J' R J (J'J)^-1, R that of the noise (Soederstrom
and Stoica 1989, sec. 7.5; Ljung 1999, sec. 9.4), not white noise's (J'J)^-1 var(v), which may be far too small or
large.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.cancellation import orders_supported
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit, structure
from ambid.blackbox.prediction import Errors, Gradient, errors, errors_elsewhere, gradient
from ambid.errors import EstimationError, counted
from ambid.estimation.estimate import Check
from ambid.estimation.linear import triangle_of
from ambid.estimation.uncertainty import criteria, p_text, skipped
from ambid.nonlinear.fit import NonlinearFit, NonlinearModel, nonlinear_structure
from ambid.record import Channel, Record
from ambid.rig.roles import ROLES
from ambid.settings.caller import setting
from ambid.validation.facts import facts
from ambid.validation.residuals import (
    LEAST,
    MOST,
    Residuals,
    ResidualTests,
    Sizes,
    Subject,
    autoregression,
    describe_feedback,
    error_sizes,
    filter_backwards,
    output_fits,
    power_gain,
    refuse_constant,
    residual_checks,
    residual_tests,
)

AnyFit = TypeVar("AnyFit", BlackBoxFit, NonlinearFit)

_ASSUME_WHITE = ("fir", "oe")  # covariance of white noise; the instrumental structures allow for the colour
_ROUNDING = 1e-9  # of a novelty of 1
_SAME = 1e-9  # one-step prediction against free run, relative to the output's size
_REACH = 10.0  # spans of what was measured that a free run may reach
_SHARE = 0.01  # of a record outside the training data, from which it is worth a warning
_GROWN = 1.5  # times the errors of identification that a second record may show, as for physical estimates
_OF_ANY_MODEL = ("belonging", "position_size", "log_runs")  # facts of a record
_OUTSIDE = 0.1  # part of a second record that may lie outside the training data, as for the nonlinear magnet


def judge(fit: AnyFit, records: IOData | Sequence[IOData], *, second: IOData | None = None) -> AnyFit:
    """Judge a fit on its own `records` and on `second`, unused data of the same channels and rate: `fit`, `criteria`,
    `checks` and `validation`. A failed fit comes back as it is; an output-error model of coloured residuals gets the
    covariance that holds for them, and a warning.
    """
    own = [records] if isinstance(records, IOData) else list(records)
    if not own:
        raise EstimationError("no record was given. Pass those that the fit was estimated from")
    if isinstance(fit, BlackBoxFit):
        return _judge_linear(fit, own[0], second)
    return fit if fit.model is None else _judge_nonlinear(fit, own, second)


def _judge_linear(fit: BlackBoxFit, data: IOData, second: IOData | None) -> BlackBoxFit:
    found = errors(fit, data)
    own = _run_of(found)
    checks = {"stable_predictor": _check_predictor(found)}
    more = list[str]()
    if own.finite and checks["stable_predictor"].passed and data.n_samples >= LEAST:
        part, tail = _last(data, found)
        slopes = gradient(fit, part, tail)
        residuals = linear_residuals(fit, part, tail, slopes)
        tests = residual_tests(residuals, open_loop=data.open_loop)
        colours = [np.ones(1) if c is None else c for c in residuals.colours]
        if any(c.size > 1 for c in colours) and fit.structure in _ASSUME_WHITE:
            again = coloured_covariance(fit, found.one_step, slopes, colours) if part is data else None
            more += _coloured_warning(fit, adjusted=again is not None)
            fit = fit if again is None else replace(fit, covariance=again)
        biased = structure(fit.structure).feedback == "biased"
        subject = Subject(name=fit.structure, coloured=not found.claims_noise, biased=biased, closed=data.closed)
        checks |= residual_checks(tests, subject)
        more += _feedback_warning(subject, tests, open_loop=data.open_loop)
    supported = orders_supported(fit)
    if supported is not None:
        checks["orders_supported"] = supported
    judged = None if second is None else validation(fit, second)
    return _conclude(fit, [data], [own], checks, judged, more)


def _judge_nonlinear(fit: NonlinearFit, records: Sequence[IOData], second: IOData | None) -> NonlinearFit:
    runs = [run(fit, x) for x in records]
    checks = {"finite_prediction": _check_finite(runs)}
    coloured = leaves_colour_open(fit, records, runs)
    kind = nonlinear_structure(fit.structure).feedback
    biased = kind == "biased" or (kind == "with noise model" and coloured)
    closed = any(x.closed for x in records)
    subject = Subject(name=f"this {fit.structure}", coloured=coloured, biased=biased, closed=closed)
    tests = None
    if checks["finite_prediction"].passed:
        residuals = nonlinear_residuals(fit, records, runs, coloured=coloured)
        if residuals is not None:
            tests = residual_tests(residuals, open_loop=all(x.open_loop for x in records))
            checks |= residual_checks(tests, subject)
    stable = _check_simulation(records, runs, tests)
    if stable is not None:
        checks["simulation_stable"] = stable
    more = _unconverged_warnings(fit)
    more += _feedback_warnings(fit, records, tests, subject)
    judged = None if second is None else validation(fit, second)
    if judged is not None:
        more += _extrapolation_warnings(next(iter(judged.values()))["extrapolated"])
    return _conclude(fit, records, runs, checks, judged, more)


def _conclude(
    fit: AnyFit,
    records: Sequence[IOData],
    runs: Sequence[Run],
    checks: dict[str, Check],
    judged: dict[str, dict[str, Any]] | None,
    more: list[str],
) -> AnyFit:
    one, free = (_sizes(records, runs, free=free) for free in (False, True))
    for data in records:
        checks |= _against(data)
    judged_fit = replace(
        fit,
        fit=output_fits(fit.outputs, one, free, fit.noise_covariance),
        criteria={} if one is None else _criteria(fit.n_estimated, records, runs),
        checks=checks,
        validation=judged,
        warnings=(*fit.warnings, *more),
    )
    if judged is None:
        return judged_fit
    return replace(judged_fit, checks={**checks, "second_record": second_check(judged_fit, judged)})


def _against(data: IOData) -> dict[str, Check]:
    """Return the facts of a record, of channels that are named by role, that stand against any model of it."""
    columns = zip((*data.inputs, *data.outputs), np.hstack([data.u, data.y]).T, strict=True)
    channels = tuple(Channel(name=n, unit=ROLES[n], values=x) for n, x in columns if ROLES.get(n) == data.units[n])
    known = facts(Record(rate_hz=1.0 / data.dt, channels=channels, start_s=data.start_s)) if channels else {}
    return {n: c for n, c in known.items() if n in _OF_ANY_MODEL and not c.passed}


def validation(fit: BlackBoxFit | NonlinearFit, second: IOData) -> dict[str, dict[str, Any]]:
    """Judge a fit on data not used in the estimation, by output: ``one_step`` and ``simulation`` (None if unstable, not
    finite or without inputs) with ``fit`` (1 - |e|/|y - mean|) and ``rmse`` (SI). Of a linear model initial state and a
    constant error are fitted, as the operating point is the record's; of a nonlinear one nothing is, from sample `lag`
    on, and ``extrapolated`` is the part outside the training data.
    """
    more = dict[str, float]()
    if isinstance(fit, BlackBoxFit):
        refuse_constant(second)
        found = _run_of(errors_elsewhere(fit, second))
    else:
        model = model_of(fit, second)
        refuse_constant(second)
        found = run(fit, second)
        more["extrapolated"] = float(np.mean(beyond(model.novelty(second.u, second.y)[found.lag :])))
    one, free = (_sizes([second], [found], free=free) for free in (False, True))
    return {
        name: {"one_step": one and one[j], "simulation": free and free[j], **more} for j, name in enumerate(fit.outputs)
    }


def second_check(fit: BlackBoxFit | NonlinearFit, result: Mapping[str, Any]) -> Check:
    """Check that a fit holds on a second record by `result` of `validation`: one-step errors at most 1.5 times those at
    identification, and at most a tenth outside the training data (which a linear fit does not know).
    """
    sentences = []
    for name, sizes in result.items():
        one, usual = sizes["one_step"], fit.fit[name].innovation_sd
        if one is None or not math.isfinite(one["rmse"]):
            sentences.append(f"the one-step prediction of {name} diverges")
        elif one["rmse"] > _GROWN * usual:
            sentences.append(
                f"one-step errors of {name} are {one['rmse'] / usual:.3g} times as large as at identification"
                if usual > 0
                else f"one-step errors of {name} are not zero, as they were at identification"
            )
    share = max((float(sizes.get("extrapolated", 0.0)) for sizes in result.values()), default=0.0)
    if share > _OUTSIDE:
        sentences.append(f"{100 * share:.2g} % of it lies outside the training data, where the model extrapolates")
    detail = "; ".join(sentences) or f"one-step errors are at most {_GROWN:g} times as large as at identification"
    return Check(
        passed=not sentences, detail=f"it does not hold on the second record: {detail}" if sentences else detail
    )


def _sizes(records: Sequence[IOData], runs: Sequence[Run], *, free: bool) -> Sizes | None:
    """Fit and rmse of each output over all records; None where a run is not finite."""
    errors = [r.simulation if free else r.one_step for r in runs]
    cut = [e[r.lag :] for e, r in zip(errors, runs, strict=True) if e is not None]
    if len(cut) < len(runs) or not all(np.all(np.isfinite(e)) for e in cut):
        return None
    return error_sizes(cut, [x.y[r.lag :] for x, r in zip(records, runs, strict=True)])


def _criteria(n_estimated: int, records: Sequence[IOData], runs: Sequence[Run]) -> dict[str, float]:
    """Criteria of the one-step errors, over the samples that a linear fit would be judged on: of a single record not
    the first hundred, so that the lag does not matter.
    """
    e = []
    for k, (x, r) in enumerate(zip(records, runs, strict=True)):
        lead = max(skipped(x.n_samples), r.lag)
        if k == 0:
            e.append(np.nan_to_num(r.one_step) if r.lag <= skipped(x.n_samples) else r.one_step[r.lag :])
        else:
            e.append(r.one_step[lead:])
    return criteria(np.concatenate(e), np.concatenate([x.y for x in records]), n_estimated)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One record run through a model."""

    lag: int  # samples at the start that are not predicted
    one_step: Array  # (n_samples, n_outputs), SI, errors; the first `lag` rows are NaN
    # (n_samples, n_outputs), SI, or None, errors of the free run from the first `lag` measured samples on; NaN from
    # where it diverges on. None without inputs: a free run of a time series says nothing.
    simulation: Array | None

    @property
    def finite(self) -> bool:
        """Whether all one-step errors are finite numbers."""
        return bool(np.all(np.isfinite(self.one_step[self.lag :])))

    @property
    def diverges_at(self) -> int | None:
        """First sample where the free run is no finite number; None where there is none."""
        if self.simulation is None:
            return None
        bad = ~np.all(np.isfinite(self.simulation), axis=1)
        return int(np.argmax(bad)) if np.any(bad) else None


def _run_of(residuals: Errors) -> Run:
    return Run(lag=0, one_step=residuals.one_step, simulation=residuals.simulation)


def run(fit: NonlinearFit, data: IOData) -> Run:
    """Run a record through the model that a fit has."""
    model = model_of(fit, data)
    with np.errstate(over="ignore", invalid="ignore"):
        one_step = data.y - model.predict(data.u, data.y)
        simulation = data.y - model.simulate(data.u, data.y) if data.n_inputs else None
    return Run(lag=model.lag, one_step=one_step, simulation=simulation)


def model_of(fit: NonlinearFit, data: IOData) -> NonlinearModel:
    """Return the model of a fit if it can be run on a record."""
    if fit.model is None:
        raise EstimationError(f"the fit failed and has no model: {fit.reason or 'unknown reason'}. Fit again")
    if (data.inputs, data.outputs) != (fit.inputs, fit.outputs):
        raise EstimationError(
            f"the record has inputs {', '.join(data.inputs) or '(none)'} and outputs {', '.join(data.outputs)}, the "
            f"fit {', '.join(fit.inputs) or '(none)'} and {', '.join(fit.outputs)}. Give the same channels"
        )
    if abs(data.dt / fit.dt - 1) > 1e-6:
        raise EstimationError(
            f"the record is sampled at {1 / data.dt:g} Hz, the fit is for {1 / fit.dt:g} Hz. Resample the record"
        )
    if data.n_samples <= fit.model.lag:
        raise EstimationError(
            f"the record has {counted(data.n_samples, 'sample')}; the model needs more than {fit.model.lag}. Give a "
            "longer record"
        )
    return fit.model


def beyond(novelty: Array) -> NDArray[np.bool_]:
    """Return where a model extrapolates by `novelty` (n_samples,): outside the training data, or where it is NaN."""
    out: NDArray[np.bool_] = ~(novelty <= 1.0 + _ROUNDING)
    return out


def looks_back(data: IOData, run: Run) -> bool:
    """Return whether predictions use measured outputs; not where they are the free run, as of an output-error model,
    which leaves the colour of the noise open.
    """
    if run.simulation is None or run.diverges_at is not None or not run.finite:
        return True
    size = np.max(np.abs(data.y), axis=0)
    apart = np.abs(run.simulation - run.one_step)[run.lag :]
    return bool(np.any(apart > _SAME * np.maximum(size, 1e-300)))


def nonlinear_residuals(
    fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run], *, coloured: bool
) -> Residuals | None:
    """Prepare scaled errors and inputs, and prediction slopes, of finite `runs` for the residual tests, None without
    samples enough; `coloured`: the model leaves the colour of the noise open.
    """
    pairs = [(x, r) for x, r in zip(records, runs, strict=True) if x.n_samples - r.lag >= LEAST]
    if not pairs:
        return None
    n_y, n_u = len(fit.outputs), len(fit.inputs)
    width = n_y * max(model_of(fit, pairs[0][0]).theta.size, 1) + 40 * (n_u + n_y)
    most = max(int(MOST / width / len(pairs)), LEAST)
    e, u, J = list[Array](), list[Array](), list[Array]()
    for x, r in pairs:
        first = max(r.lag, skipped(x.n_samples), x.n_samples - most)
        lead = min(first, r.lag + skipped(x.n_samples))  # for derivatives that are recursions to settle
        J.append(model_of(fit, x).jacobian(x.u[first - lead :], x.y[first - lead :])[lead:])
        e.append(r.one_step[first:])
        u.append(x.u[first:])
    size = np.sqrt(np.mean(np.concatenate(e) ** 2, axis=0))
    e = [x / np.where(size > 0, size, 1.0) for x in e]
    whole = np.concatenate(u)
    level, size = whole.mean(axis=0), whole.std(axis=0)
    u = [(x - level) / np.where(size > 0, size, 1.0) for x in u]
    longest = max(e, key=len)
    return Residuals(
        e=e,
        u=u,
        J=[[x[:, o] for x in J] for o in range(n_y)],
        colours=[autoregression(x) if coloured else None for x in longest.T],
        source=u,
        instrumental=coloured and any(looks_back(x, r) for x, r in pairs),
        nonlinear=True,
    )


def _feedback_warnings(
    fit: NonlinearFit, records: Sequence[IOData], tests: ResidualTests | None, subject: Subject
) -> list[str]:
    """Warn where feedback biases a fit, or the data show one that the user excludes; not twice what the fit says."""
    if not fit.inputs:
        return []
    open_loop = all(x.open_loop for x in records)
    if open_loop and tests is not None and tests.feedback_seen and not tests.explained_by_inputs:
        return [
            f"{setting('open_loop')} was given, but inputs depend on past residuals: there is feedback. Omit "
            f"{setting('open_loop')}"
        ]
    warned = any("biased" in x and "open loop" in x for x in fit.warnings)
    if open_loop or warned or not subject.biased:
        return []
    return [
        f"{subject.name} has no noise model and is biased by feedback. Use narmax with ne > 0, or give "
        f"{setting('open_loop', True)} "
        "if the records are open loop"
    ]


def _check_finite(runs: Sequence[Run]) -> Check:
    """Check that the one-step errors are finite on all records."""
    bad = [k + 1 for k, r in enumerate(runs) if not r.finite]
    where = f"record {bad[0]}" if bad else ""
    detail = f"one-step predictions diverge on {where}" if bad else "one-step predictions are finite on all records"
    return Check(passed=not bad, detail=detail, values={"diverged": float(len(bad))})


def _check_simulation(records: Sequence[IOData], runs: Sequence[Run], tests: ResidualTests | None) -> Check | None:
    """Check that the free run stays finite, and within ten times the span measured; None without inputs. Where the data
    show feedback it is reported, not held against the model: an unstable plant cannot be simulated from its input.
    """
    if any(r.simulation is None for r in runs):
        return None
    gone = [(k, r.diverges_at) for k, r in enumerate(runs) if r.diverges_at is not None]
    reach = max(
        (
            float(np.max(np.ptp(x.y - r.simulation, axis=0) / np.maximum(np.ptp(x.y, axis=0), 1e-300)))
            for x, r in zip(records, runs, strict=True)
            if r.simulation is not None and r.diverges_at is None
        ),
        default=0.0,
    )
    values = {"diverged": float(len(gone)), "reach": reach}
    loop = tests is not None and tests.feedback_seen
    excuse = (
        "; with feedback the plant may be unstable: judge by predictions"
        if loop
        else ": the model is fit for prediction, not for simulation"
    )
    if gone:
        k, at = gone[0]
        assert at is not None
        detail = f"the simulation of record {k + 1} diverges after {at * records[k].dt:.3g} s{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    if reach > _REACH:
        detail = f"the simulated output spans {reach:.3g} times the measured range{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    return Check(passed=True, detail=f"the simulated output spans {reach:.3g} times the measured range", values=values)


def _extrapolation_warnings(share: float) -> list[str]:
    """Warn where the second record leaves what the model was trained on, with a share of its samples."""
    if share <= _SHARE:
        return []
    return [
        f"{100 * share:.2g} % of the second record lies outside the training data: the model extrapolates there, and "
        "its standard deviations do not apply"
    ]


def _unconverged_warnings(fit: NonlinearFit) -> list[str]:
    """Warn that a search did not converge, where the estimator has not."""
    if fit.status != "stalled" or any("converge" in x or "interrupted" in x for x in fit.warnings):
        return []
    return ["training did not converge; the best iterate is kept. Allow more iterations"]


def leaves_colour_open(fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run]) -> bool:
    """Return whether coloured residuals are no fault of a fit: it was fitted to its free run, or predicts without
    measured outputs.
    """
    if fit.settings.get("focus") == "simulation":
        return True
    return not any(looks_back(x, r) for x, r in zip(records, runs, strict=True))


def _last(data: IOData, residuals: Errors) -> tuple[IOData, Errors]:
    """Return the last part of a long record: as much as the derivatives of a large model leave room for."""
    m = residuals.model
    width = (m.order + 1) * (m.order + m.n_inputs + m.n_outputs)
    first = data.n_samples - int(MOST / width)
    if first <= 0:
        return data, residuals
    return data.part(first, data.n_samples), replace(residuals, one_step=residuals.one_step[first:], simulation=None)


def linear_residuals(fit: BlackBoxFit, data: IOData, residuals: Errors, slopes: Gradient) -> Residuals:
    """Prepare a fit's residuals and prediction slopes for the tests; a model without noise is tested in a loop against
    the reference, where there is one, as inputs hold the noise.
    """
    first = skipped(data.n_samples)
    loop = not residuals.claims_noise and structure(fit.structure).feedback == "consistent" and bool(data.references)
    u = data.u - data.u.mean(axis=0)
    return Residuals(
        e=[residuals.one_step - residuals.one_step.mean(axis=0)],
        u=[u],
        J=[[rows] for rows in slopes.rows],
        first=first,
        colours=[None if residuals.claims_noise else autoregression(e[first:]) for e in residuals.one_step.T],
        source=[data.reference - data.reference.mean(axis=0)] if loop else [u],
        instrumental=loop,
        nonlinear=False,
        outputs=data.outputs if data.n_outputs > 1 else (),
        inputs=data.inputs,
    )


def _check_predictor(residuals: Errors) -> Check:
    """Check that the one-step errors do not grow by themselves."""
    m = residuals.model
    radius = float(np.max(np.abs(np.linalg.eigvals(m.A - m.K @ m.C)), initial=0.0)) if m.order else 0.0
    ok = radius < 1.0
    return Check(
        passed=ok,
        values={"radius": radius},
        detail=f"the predictor is {'stable' if ok else 'unstable'} (largest pole magnitude {radius:.4g})"
        + ("" if ok else ". Use a structure with a noise model, or other orders"),
    )


def _feedback_warning(subject: Subject, tests: ResidualTests, *, open_loop: bool) -> list[str]:
    """Warn where the data show feedback that the user or the structure excludes."""
    if tests.feedback is None or tests.feedback.passed:
        return []
    evidence = f"{describe_feedback(tests.feedback)} ({p_text(tests.feedback.p)})"
    if subject.biased:
        if tests.explained_by_inputs:
            return [f"{evidence}: feedback, which biases {subject.name}, or an incomplete model"]
        return [f"there is feedback: {evidence}. It biases {subject.name}; use bj, armax or pbsid"]
    if open_loop and not tests.explained_by_inputs:
        return [f"{setting('open_loop')} was given, but {evidence}: there is feedback. Omit {setting('open_loop')}"]
    return []


def _coloured_warning(fit: BlackBoxFit, *, adjusted: bool) -> list[str]:
    """Say how far the standard deviations of an output-error model hold under coloured noise."""
    if adjusted:
        return [
            f"the noise is coloured, and {fit.structure} has no noise model: standard deviations allow for it; a noise "
            "model (bj) would reduce them"
        ]
    if fit.covariance is None:
        return []
    return [
        f"the noise is coloured, and {fit.structure} has no noise model: standard deviations assume white noise and "
        "may be too small. Use a structure with a noise model"
    ]


def coloured_covariance(fit: BlackBoxFit, e: Array, slopes: Gradient, colours: Sequence[Array]) -> Array | None:
    """Return the covariance (n_theta, n_theta) of an output-error model under coloured noise; `e`: simulation errors,
    `slopes`: their derivatives, `colours`: autoregressions of each output's errors, taken as independent of each other.
    None where directions are not coefficients, or not independent.
    """
    if slopes.theta is None or fit.covariance is None:
        return None
    out = np.zeros_like(fit.covariance)
    for o, (J, place) in enumerate(zip(slopes.rows, slopes.theta, strict=True)):
        if not place.size:
            continue
        size = np.linalg.norm(J, axis=0)
        if not np.all(size > 0):
            return None
        wide = np.hstack([J / size, np.full((J.shape[0], 1), 1 / np.sqrt(J.shape[0]))])  # the constant is estimated too
        Q, R = np.linalg.qr(wide)
        if np.min(np.abs(np.diag(R))) < 1e-10:
            return None
        noise = float(np.mean((e[:, o] - e[:, o].mean()) ** 2)) * J.shape[0] / max(J.shape[0] - wide.shape[1], 1)
        half = triangle_of([filter_backwards(Q, colours[o])]) @ np.linalg.inv(R).T
        inner = half.T @ half * noise / power_gain(colours[o])
        out[np.ix_(place, place)] = inner[:-1, :-1] / np.outer(size, size)
    return out
