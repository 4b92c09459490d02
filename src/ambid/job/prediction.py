"""What the models of results do: predict a record, run on inputs alone, become objects of python-control."""

from __future__ import annotations

from numbers import Integral
from typing import Any, Unpack

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet_result import NonlinearBearingEstimate, linearised
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.prediction import errors_ahead, errors_elsewhere, plant_form, run_states, state_space_to_control
from ambid.blackbox.prediction import to_control as black_box_to_control
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.job.data import Reading, signals_of
from ambid.job.exchange import export, plant_of
from ambid.job.results import AnyEstimate, AnyFit, data_of, validate
from ambid.nonlinear.fit import NonlinearFit
from ambid.physics.linear_model import StateSpace, discretise, model
from ambid.rotor.estimate import RotorEstimate

validated, exported = validate, export


def predict(result: AnyEstimate | AnyFit, record: Any, ahead: int, **reading: Unpack[Reading]) -> dict[str, Array]:
    """Predict the outputs of a record some samples ahead, (n_samples,) by output in SI; NaN where nothing precedes."""
    if isinstance(ahead, bool) or not isinstance(ahead, Integral) or ahead < 1:
        raise EstimationError(f"ahead is {ahead!r}; it is a whole number of samples, 1 or more. Correct it")
    if isinstance(result, RotorEstimate):
        raise EstimationError(
            "a rotor on many axes is not predicted sample by sample: its estimate holds no predictor. Validate it "
            "on the record instead"
        )
    ahead, data = int(ahead), data_of(result, record, where="the result", **reading)
    n = int((data.record.y.shape if isinstance(result, NonlinearBearingEstimate) else (data.n_samples,))[0])
    if ahead >= n:
        raise EstimationError(f"ahead is {ahead}, and the record has {n} samples. Give a smaller number")
    if isinstance(result, Estimate):
        from ambid.estimation.likelihood import prediction_error
        from ambid.validation.second_record import replay

        signals, names = signals_of(data, model(result.model)), model(result.model).outputs
        y, first = signals.y, replay(result, signals)
        found = y[first.first + ahead - 1 :] - prediction_error(first.fit, ahead)
    elif isinstance(result, BlackBoxFit):
        y, names, run = data.y, result.outputs, errors_elsewhere(result, data)
        found = y[ahead - 1 :] - errors_ahead(run, ahead)
    elif isinstance(result, NonlinearFit):
        y, names = data.y, result.outputs
        found = _nonlinear(result, data, ahead)
    else:
        from ambid.validation.nonlinear_bearing import replay as bearing_replay

        if ahead > 1:
            raise EstimationError("the nonlinear bearing is predicted one sample ahead. Leave ahead out")
        y, names, found = data.record.y, ("position", "current"), bearing_replay(result, data.record).predicted
    whole = np.vstack([np.full((y.shape[0] - found.shape[0], found.shape[1]), np.nan), found])
    return dict(zip(names, whole.T, strict=True))


def _nonlinear(fit: NonlinearFit, data: Any, ahead: int) -> Array:
    """Predict by running freely from each sample on."""
    from ambid.validation.fits import model_of

    of = model_of(fit, data)
    if ahead == 1:
        return np.asarray(of.predict(data.u, data.y)[of.lag :])
    n = data.n_samples - of.lag - ahead + 1
    windows = (slice(k, k + of.lag + ahead) for k in range(n))
    return np.array([of.simulate(data.u[w], data.y[w])[-1] for w in windows]).reshape(n, data.n_outputs)


def simulate(result: Estimate | AnyFit, u: Any, start: Any = None) -> dict[str, Array]:
    """Run a model on inputs alone, from rest at its operating point, (n_samples,) by output in SI."""
    names = model(result.model).inputs if isinstance(result, Estimate) else result.inputs
    try:
        given = np.asarray(u)
    except ValueError:  # rows of several lengths
        given = np.empty(0, dtype=object)
    inputs = given[:, None] if given.ndim == 1 else given
    real = given.dtype.kind in "iuf" and inputs.size and np.all(np.isfinite(inputs))
    if not real or inputs.ndim != 2 or inputs.shape[1] != len(names):
        raise EstimationError(
            f"the inputs have shape {given.shape} and type {given.dtype}; finite real numbers of shape (n_samples, "
            f"{len(names)}), {', '.join(names)} in SI units, are needed. Correct u"
        )
    inputs = inputs.astype(np.float64)
    if isinstance(result, Estimate):
        plant, at = model(result.model), result.operating_point
        y = _delayed(result, inputs - [at[role] for role in plant.inputs]) + [at[role] for role in plant.outputs]
        return dict(zip(plant.outputs, y.T, strict=True))
    if isinstance(result, BlackBoxFit):
        form, z = plant_form(result), inputs - result.offsets.u
        y = run_states(form.A, form.B, z) @ form.C.T + z @ form.D.T + result.offsets.y
    else:
        if result.model is None:
            raise EstimationError(f"the fit has no model: {result.reason}. Fit again")
        first = np.zeros((result.model.lag, len(result.outputs)))
        first[:] = 0.0 if start is None else np.asarray(start, dtype=np.float64).reshape(first.shape)
        y = result.model.simulate(inputs, first)
    return dict(zip(result.outputs, y.T, strict=True))


def _delayed(estimate: Estimate, u: Array) -> Array:
    """Outputs (n, n_y) of a plant whose held input comes whole samples and a part of one late."""
    c, late = estimate.continuous, estimate.delay[model(estimate.model).inputs[0]]
    space = StateSpace(A=c.A, B=c.B, C=c.C, E=np.zeros((c.A.shape[0], 0)))
    d, _ = discretise(space, 1.0 / float(str(estimate.record["rate_hz"])), fraction=late.fraction)
    shifted = np.vstack([np.zeros((late.samples + 1, u.shape[1])), u])
    now, last = shifted[1 : 1 + u.shape[0]], shifted[: u.shape[0]]
    return run_states(d.A, np.hstack([d.B, d.B_late]), np.hstack([now, last])) @ d.C.T


def to_control(result: Any) -> Any:
    """Return a linear plant as an object of python-control, its signals named."""
    if isinstance(result, BlackBoxFit):
        found = black_box_to_control(result.model)
        found.update_names(inputs=list(result.inputs), outputs=list(result.outputs))
        return found
    at = linearised(result) if isinstance(result, NonlinearBearingEstimate) else result.continuous
    found = state_space_to_control(at.A, at.B, at.C)
    plant = plant_of(result)
    found.update_names(inputs=list(plant.inputs), outputs=list(plant.outputs), states=list(at.states))
    return found
