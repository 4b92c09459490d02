"""A nonlinear model run over a record: one-step errors and the free run, each from the first measured samples on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.model import NonlinearModel
from ambid.validate.prediction import fit_of

_ROUNDING = 1e-9  # of a novelty of 1
_SAME = 1e-9  # one-step prediction against free run, relative to the output's size


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


def sizes(errors: list[Array], outputs: list[Array]) -> tuple[Array, Array]:
    """Return fit and root mean square error of each output over several records.

    `errors`, `outputs`: (n_samples, n_outputs), SI, one for each record, without the samples at the start that are not
    predicted. Returns `fit`: (n_outputs,), 1 - |e| / |y - mean|, with the mean of each record: a level that differs
    from record to record does not help; `rmse`: (n_outputs,), SI.
    """
    e, y = np.concatenate(errors), np.concatenate([x - x.mean(axis=0) for x in outputs])
    return fit_of(e, y), np.sqrt(np.mean(e**2, axis=0))
