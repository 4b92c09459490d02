"""A nonlinear fit judged: fit, criteria, checks, and its errors on a second record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.criteria import criteria, skipped
from ambid.estimation.estimate import OutputFit
from ambid.nonlinear.fit import NonlinearFit
from ambid.validate.nonlinear.checks import (
    extrapolation_warnings,
    feedback_warnings,
    finite_prediction,
    residual_verdicts,
    simulation_stable,
    unconverged_warnings,
)
from ambid.validate.nonlinear.residual_tests import material, residual_tests
from ambid.validate.nonlinear.runs import Run, beyond, looks_back, model_of, run, sizes


def judged(fit: NonlinearFit, records: Sequence[IOData], *, second: IOData | None = None) -> NonlinearFit:
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
    checks = {"finite_prediction": finite_prediction(runs)}
    coloured = leaves_colour_open(fit, records, runs)
    tests = None
    if checks["finite_prediction"].passed:
        prepared = material(fit, records, runs, coloured=coloured)
        if prepared is not None:
            tests = residual_tests(prepared, with_now=all(x.open_loop for x in records))
            checks |= residual_verdicts(fit, tests, coloured=coloured)
    stable = simulation_stable(records, runs, tests)
    if stable is not None:
        checks["simulation_stable"] = stable
    more = unconverged_warnings(fit)
    more += feedback_warnings(fit, records, tests, coloured=coloured)
    found = None if second is None else validation(fit, second)
    if found is not None:
        more += extrapolation_warnings(outside(found), "the second record")
    return replace(
        fit,
        fit=_output_fits(fit, records, runs),
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
    for j, name in enumerate(second.outputs):
        if not np.any(second.y[:, j] != second.y[0, j]):
            raise EstimationError(
                f"output {name!r} is constant over the second record; nothing can be judged on it. Give another record"
            )
    found = run(fit, second)
    novelty = model.novelty(second.u, second.y)[found.lag :]
    share = float(np.mean(beyond(novelty)))
    one, free = _sizes([second], [found], free=False), _sizes([second], [found], free=True)
    return {
        name: {"one_step": one and one[j], "simulation": free and free[j], "extrapolated": share}
        for j, name in enumerate(fit.outputs)
    }


def outside(found: Mapping[str, Mapping[str, Any]]) -> float:
    """Return which part of a second record lies outside the training data.

    `found`: as `validation` gives it. Returns 0 to 1.
    """
    return float(next(iter(found.values()))["extrapolated"])


def _sizes(records: Sequence[IOData], runs: Sequence[Run], *, free: bool) -> list[dict[str, float]] | None:
    """Fit and rmse of each output over all records; None where a run is not finite."""
    errors = [r.simulation if free else r.one_step for r in runs]
    cut = [e[r.lag :] for e, r in zip(errors, runs, strict=True) if e is not None]
    if len(cut) < len(runs) or not all(np.all(np.isfinite(e)) for e in cut):
        return None
    fits, rmse = sizes(cut, [x.y[r.lag :] for x, r in zip(records, runs, strict=True)])
    return [{"fit": float(f), "rmse": float(e)} for f, e in zip(fits, rmse, strict=True)]


def _output_fits(fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run]) -> dict[str, OutputFit]:
    one, free = _sizes(records, runs, free=False), _sizes(records, runs, free=True)
    sd = np.sqrt(np.maximum(np.diag(fit.noise_covariance), 0.0))
    return {
        name: OutputFit(
            one_step=float("nan") if one is None else one[j]["fit"],
            simulation=None if free is None else free[j]["fit"],
            innovation_sd=float(sd[j]),
        )
        for j, name in enumerate(fit.outputs)
    }


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
