"""A black-box fit judged: fit, criteria, checks, and its errors on a second record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.estimate import Check, OutputFit
from ambid.validate.blackbox.criteria import criteria
from ambid.validate.blackbox.predictor import Errors, errors, errors_elsewhere
from ambid.validate.prediction import fit_of

Array = NDArray[np.float64]


def judged(fit: BlackBoxFit, data: IOData, *, second: IOData | None = None) -> BlackBoxFit:
    """Judge a fit on its own record and, where given, on another.

    Parameters
    ----------
    fit : BlackBoxFit
        As an estimator returns it.
    data : IOData
        What it was estimated from.
    second : IOData, optional
        Data that were not used; same channels, same rate.

    Returns
    -------
    BlackBoxFit
        With `fit`, `criteria`, `checks` and, for a second record, `validation`:
        ``{output: {"one_step": {"fit", "rmse"}, "simulation": {"fit", "rmse"} or None}}``.

    Raises
    ------
    EstimationError
        If channels or rate of a record differ from those of the fit.
    """
    found = errors(fit, data)
    return replace(
        fit,
        fit=_output_fits(fit, data, found),
        criteria=criteria(found.one_step, data.y, fit.n_estimated),
        checks=_checks(found),
        validation=None if second is None else validation(fit, second),
    )


def validation(fit: BlackBoxFit, second: IOData) -> dict[str, object]:
    """Judge a fit on data that were not used in the estimation.

    Parameters
    ----------
    fit : BlackBoxFit
    second : IOData

    Returns
    -------
    dict
        By output: ``one_step`` and ``simulation`` (None where unstable, or without inputs), each with ``fit``
        (1 - |e|/|y - mean|) and ``rmse`` (SI). The model is kept; initial state and a constant error are fitted,
        because a record's operating point is not a property of the model.

    Raises
    ------
    EstimationError
        If channels or rate of the record differ from those of the fit, or an output of it is constant.
    """
    found = errors_elsewhere(fit, second)
    for j, name in enumerate(fit.outputs):
        if not np.any(second.y[:, j] != second.y[0, j]):
            raise EstimationError(
                f"output {name!r} is constant over the second record; nothing can be judged on it. Give another record"
            )
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


def _checks(found: Errors) -> dict[str, Check]:
    return {"stable_predictor": _stable_predictor(found)}


def _stable_predictor(found: Errors) -> Check:
    m = found.model
    radius = float(np.max(np.abs(np.linalg.eigvals(m.A - m.K @ m.C)), initial=0.0)) if m.order else 0.0
    ok = radius < 1.0
    return Check(
        passed=ok,
        values={"radius": radius},
        detail=f"the predictor's poles are within {radius:.4g} of zero"
        + ("" if ok else ": its errors grow without bound. Take a structure with a noise model, or other orders"),
    )
