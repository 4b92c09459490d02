"""A nonlinear fit judged: fit, criteria, residual tests, free run, extrapolation, and its errors on a second record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.criteria import criteria, skipped
from ambid.estimation.parts import Check
from ambid.nonlinear.fit import NonlinearFit, NonlinearModel
from ambid.nonlinear.structures import nonlinear_structure
from ambid.validate.residuals import (
    LEAST,
    MOST,
    Residuals,
    ResidualTests,
    Sizes,
    Subject,
    autoregression,
    error_sizes,
    output_fits,
    refuse_constant,
    residual_checks,
    residual_tests,
)

_ROUNDING = 1e-9  # of a novelty of 1
_SAME = 1e-9  # one-step prediction against free run, relative to the output's size
_REACH = 10.0  # spans of what was measured that a free run may reach
_SHARE = 0.01  # of a record outside the training data, from which it is worth a warning


def judge(fit: NonlinearFit, records: Sequence[IOData], *, second: IOData | None = None) -> NonlinearFit:
    """Judge a fit on its own records and, where given, on another.

    `fit`: as an estimator returns it; `records`: what it was estimated from; `second`: data that were not used; same
    channels, same rate. Returns with `fit`, `criteria`, `checks` and, for a second record, `validation` (see
    `validation`). A failed fit comes back as it is.
    """
    if not records:
        raise EstimationError("there is no record to judge on. Pass those that the fit was estimated from")
    if fit.model is None:
        return fit
    runs = [run(fit, x) for x in records]
    checks = {"finite_prediction": _check_finite(runs)}
    coloured = leaves_colour_open(fit, records, runs)
    kind = nonlinear_structure(fit.structure).feedback
    biased = kind == "biased" or (kind == "with noise model" and coloured)
    subject = Subject(name=f"this {fit.structure}", coloured=coloured, biased=biased)
    tests = None
    if checks["finite_prediction"].passed:
        residuals = residuals_of(fit, records, runs, coloured=coloured)
        if residuals is not None:
            tests = residual_tests(residuals, open_loop=all(x.open_loop for x in records))
            checks |= residual_checks(tests, subject)
    stable = _check_simulation(records, runs, tests)
    if stable is not None:
        checks["simulation_stable"] = stable
    more = _unconverged_warnings(fit)
    more += _feedback_warnings(fit, records, tests, subject)
    found = None if second is None else validation(fit, second)
    if found is not None:
        more += _extrapolation_warnings(next(iter(found.values()))["extrapolated"])
    one, free = _sizes(records, runs, free=False), _sizes(records, runs, free=True)
    return replace(
        fit,
        fit=output_fits(fit.outputs, one, free, fit.noise_covariance),
        criteria=_criteria(fit, records, runs) if checks["finite_prediction"].passed else {},
        checks=checks,
        validation=found,
        warnings=(*fit.warnings, *more),
    )


def leaves_colour_open(fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run]) -> bool:
    """Return whether a fit says nothing of the colour of its noise, so that coloured residuals are no fault of it.

    Returns true for a model that was fitted to its free run, and for one that predicts without measured outputs.
    """
    if fit.settings.get("focus") == "simulation":
        return True
    return not any(looks_back(x, r) for x, r in zip(records, runs, strict=True))


def validation(fit: NonlinearFit, second: IOData) -> dict[str, dict[str, Any]]:
    """Judge a fit on data that were not used in the estimation; nothing is fitted.

    Returns by output: ``one_step`` and ``simulation`` (None where it diverges, or without inputs), each with ``fit`` (1
    - |e|/|y - mean|) and ``rmse`` (SI), over all samples but the first `lag`, from which the free run starts;
    ``extrapolated``, the part of the samples that lie outside the training data.
    """
    model = model_of(fit, second)
    refuse_constant(second)
    found = run(fit, second)
    novelty = model.novelty(second.u, second.y)[found.lag :]
    share = float(np.mean(beyond(novelty)))
    one, free = _sizes([second], [found], free=False), _sizes([second], [found], free=True)
    return {
        name: {"one_step": one and one[j], "simulation": free and free[j], "extrapolated": share}
        for j, name in enumerate(fit.outputs)
    }


def _sizes(records: Sequence[IOData], runs: Sequence[Run], *, free: bool) -> Sizes | None:
    """Fit and rmse of each output over all records; None where a run is not finite."""
    errors = [r.simulation if free else r.one_step for r in runs]
    cut = [e[r.lag :] for e, r in zip(errors, runs, strict=True) if e is not None]
    if len(cut) < len(runs) or not all(np.all(np.isfinite(e)) for e in cut):
        return None
    return error_sizes(cut, [x.y[r.lag :] for x, r in zip(records, runs, strict=True)])


def _criteria(fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run]) -> dict[str, float]:
    """Criteria of the one-step errors, over the samples that a linear fit to the same record would be judged on.

    Of a single record the first hundred samples are left out anyway, so that the lag does not matter.
    """
    e = []
    for k, (x, r) in enumerate(zip(records, runs, strict=True)):
        lead = max(skipped(x.n_samples), r.lag)
        if k == 0:
            e.append(np.nan_to_num(r.one_step) if r.lag <= skipped(x.n_samples) else r.one_step[r.lag :])
        else:
            e.append(r.one_step[lead:])
    return criteria(np.concatenate(e), np.concatenate([x.y for x in records]), fit.n_estimated)


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


def run(fit: NonlinearFit, data: IOData) -> Run:
    """Run a record through the model of a fit.

    `fit`: with a model.
    """
    model = model_of(fit, data)
    with np.errstate(over="ignore", invalid="ignore"):
        one_step = data.y - model.predict(data.u, data.y)
        simulation = data.y - model.simulate(data.u, data.y) if data.n_inputs else None
    return Run(lag=model.lag, one_step=one_step, simulation=simulation)


def model_of(fit: NonlinearFit, data: IOData) -> NonlinearModel:
    """Return the model of a fit if it can be run on a record."""
    if fit.model is None:
        raise EstimationError(f"the fit has failed and holds no model: {fit.reason or 'no reason is given'}. Fit again")
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
            f"the record has {data.n_samples} samples; the model looks back over {fit.model.lag}. Give a longer record"
        )
    return fit.model


def beyond(novelty: Array) -> NDArray[np.bool_]:
    """Return where a model extrapolates.

    `novelty`: (n_samples,). Returns (n_samples,), true outside the training data, and where novelty is no number.
    """
    out: NDArray[np.bool_] = ~(novelty <= 1.0 + _ROUNDING)
    return out


def looks_back(data: IOData, found: Run) -> bool:
    """Return whether predictions use measured outputs: if not, the model leaves the colour of the noise open.

    Returns false where the one-step prediction is the free run, as for an output-error model.
    """
    if found.simulation is None or found.diverges_at is not None or not found.finite:
        return True
    size = np.max(np.abs(data.y), axis=0)
    apart = np.abs(found.simulation - found.one_step)[found.lag :]
    return bool(np.any(apart > _SAME * np.maximum(size, 1e-300)))


def residuals_of(
    fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run], *, coloured: bool
) -> Residuals | None:
    """Prepare what the residual tests look at: errors and inputs over their size, derivatives of the predictions.

    `runs`: of these records, all finite; `coloured`: whether the model leaves the colour of the noise open. None where
    no record has samples enough.
    """
    used = [(x, r) for x, r in zip(records, runs, strict=True) if x.n_samples - r.lag >= LEAST]
    if not used:
        return None
    n_y, n_u = len(fit.outputs), len(fit.inputs)
    width = n_y * max(model_of(fit, used[0][0]).theta.size, 1) + 40 * (n_u + n_y)
    most = max(int(MOST / width / len(used)), LEAST)
    e, u, J = list[Array](), list[Array](), list[Array]()
    for x, r in used:
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
        instrumental=coloured and any(looks_back(x, r) for x, r in used),
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
        return ["the records are said to be open loop, but inputs depend on past residuals: leave --open-loop out"]
    said = any("biased" in x and "open loop" in x for x in fit.warnings)
    if open_loop or said or not subject.biased:
        return []
    return [
        f"{subject.name} has no noise model and is biased where a controller was at work, and nothing says that "
        "these records are open loop: use narmax with ne > 0, or say --open-loop if there was no feedback"
    ]


def _check_finite(runs: Sequence[Run]) -> Check:
    """Check that the one-step errors are finite on all records."""
    bad = [k + 1 for k, r in enumerate(runs) if not r.finite]
    where = f"record {bad[0]}" if bad else ""
    detail = (
        f"one-step errors grow beyond all numbers on {where}" if bad else "one-step errors are finite on all records"
    )
    return Check(passed=not bad, detail=detail, values={"diverged": float(len(bad))})


def _check_simulation(records: Sequence[IOData], runs: Sequence[Run], tests: ResidualTests | None) -> Check | None:
    """Check that the free run stays finite, and within ten times the span of what was measured; None without inputs.

    An unstable plant under feedback cannot be simulated from its input: where the data show feedback, a free run that
    runs away is reported and not held against the model.
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
        "; there is feedback, and the plant may be unstable: judge by predictions"
        if loop
        else ": the model predicts, but does not simulate"
    )
    if gone:
        k, at = gone[0]
        assert at is not None
        detail = f"the free run of record {k + 1} diverges {at * records[k].dt:.3g} s after its start{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    if reach > _REACH:
        detail = f"the free run reaches {reach:.3g} times the span of what was measured{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    return Check(
        passed=True, detail=f"the free run stays finite, at {reach:.3g} times the measured span", values=values
    )


def _extrapolation_warnings(share: float) -> list[str]:
    """Warn where the second record leaves what the model was trained on, with a share of its samples."""
    if share <= _SHARE:
        return []
    return [
        f"{100 * share:.2g} % of the second record lies outside what the model was trained on: there it extrapolates, "
        "and its standard deviations say nothing"
    ]


def _unconverged_warnings(fit: NonlinearFit) -> list[str]:
    """Say that a search did not converge, where the estimator has not."""
    if fit.status != "stalled" or any("converge" in x or "interrupted" in x for x in fit.warnings):
        return []
    return ["the training did not converge: the best of its steps is given; more iterations may go on from there"]
