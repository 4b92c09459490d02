"""A black-box fit judged: fit, criteria, checks, and its errors on a second record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError
from ambid.estimation.criteria import criteria
from ambid.estimation.estimate import OutputFit
from ambid.validate.blackbox.checks import coloured_warning, feedback_warning, residual_verdicts, stable_predictor
from ambid.validate.blackbox.colour import coloured_covariance
from ambid.validate.blackbox.gradient import gradient
from ambid.validate.blackbox.order_support import orders_supported
from ambid.validate.blackbox.predictor import Errors, errors, errors_elsewhere
from ambid.validate.blackbox.residual_tests import residual_tests
from ambid.validate.prediction import fit_of

_MOST = 2e7  # numbers in the derivatives of one output that are kept at once
_ASSUME_WHITE = ("fir", "oe")  # covariance of white noise; the instrumental structures allow for the colour
_LEAST = 60  # samples from which residuals can be tested


def judged(fit: BlackBoxFit, data: IOData, *, second: IOData | None = None) -> BlackBoxFit:
    """Judge a fit on its own record and, where given, on another.

    `fit`: as an estimator returns it; `data`: what it was estimated from; `second`: data that were not used; same
    channels, same rate. Returns with `fit`, `criteria`, `checks` and, for a second record, `validation`: ``{output:
    {"one_step": {"fit", "rmse"}, "simulation": {"fit", "rmse"} or None}}``. An output-error model whose residuals are
    coloured gets the covariance that holds for coloured noise, and says so in its warnings.
    """
    found = errors(fit, data)
    sound = bool(np.all(np.isfinite(found.one_step)))
    checks = {"stable_predictor": stable_predictor(found)}
    covariance, more = fit.covariance, list[str]()
    if sound and checks["stable_predictor"].passed and data.n_samples >= _LEAST:
        part, tail = _last(data, found)
        slopes = gradient(fit, part, tail)
        in_loop = not found.claims_noise and structure(fit.structure).feedback == "consistent"
        tests = residual_tests(part, tail, slopes, with_reference=in_loop and bool(data.references))
        if any(c.size > 1 for c in tests.colours) and fit.structure in _ASSUME_WHITE:
            whole = slopes if part is data else None
            again = None if whole is None else coloured_covariance(fit, found.one_step, whole, tests.colours)
            covariance = fit.covariance if again is None else again
            more += coloured_warning(fit, adjusted=again is not None)
        checks |= residual_verdicts(fit, data, found, tests)
        more += feedback_warning(fit, data, tests)
    fit = replace(fit, covariance=covariance)
    supported = orders_supported(fit)
    if supported is not None:
        checks["orders_supported"] = supported
    return replace(
        fit,
        fit=_output_fits(fit, data, found),
        criteria=criteria(found.one_step, data.y, fit.n_estimated) if sound else {},
        checks=checks,
        validation=None if second is None else validation(fit, second),
        warnings=(*fit.warnings, *more),
    )


def validation(fit: BlackBoxFit, second: IOData) -> dict[str, object]:
    """Judge a fit on data that were not used in the estimation.

    Returns by output: ``one_step`` and ``simulation`` (None where unstable, or without inputs), each with ``fit`` (1 -
    |e|/|y - mean|) and ``rmse`` (SI). The model is kept; initial state and a constant error are fitted, because a
    record's operating point is not a property of the model.
    """
    for j, name in enumerate(second.outputs):
        if not np.any(second.y[:, j] != second.y[0, j]):
            raise EstimationError(
                f"output {name!r} is constant over the second record; nothing can be judged on it. Give another record"
            )
    found = errors_elsewhere(fit, second)
    return {
        name: {
            "one_step": _sizes(found.one_step[:, j], second.y[:, j]),
            "simulation": None if found.simulation is None else _sizes(found.simulation[:, j], second.y[:, j]),
        }
        for j, name in enumerate(fit.outputs)
    }


def _sizes(e: Array, y: Array) -> dict[str, float]:
    return {"fit": _nrmse(e, y), "rmse": float(np.sqrt(np.mean(e**2)))}


def _nrmse(e: Array, y: Array) -> float:
    return float(fit_of(e[:, None], y[:, None])[0])


def _output_fits(fit: BlackBoxFit, data: IOData, found: Errors) -> dict[str, OutputFit]:
    sd = np.sqrt(np.maximum(np.diag(fit.noise_covariance), 0.0))
    return {
        name: OutputFit(
            one_step=_nrmse(found.one_step[:, j], data.y[:, j]),
            simulation=None if found.simulation is None else _nrmse(found.simulation[:, j], data.y[:, j]),
            innovation_sd=float(sd[j]),
        )
        for j, name in enumerate(fit.outputs)
    }


def _last(data: IOData, found: Errors) -> tuple[IOData, Errors]:
    """Return the last part of a long record: as much as the derivatives of a large model leave room for."""
    m = found.model
    width = (m.order + 1) * (m.order + m.n_inputs + m.n_outputs)
    first = data.n_samples - int(_MOST / width)
    if first <= 0:
        return data, found
    return data.part(first, data.n_samples), replace(found, one_step=found.one_step[first:], simulation=None)
