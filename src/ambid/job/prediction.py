"""What the models of results do: predict a record, run on inputs alone, become objects of python-control."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.prediction import (
    errors,
    errors_ahead,
    errors_elsewhere,
    plant_form,
    run_states,
    state_space_to_control,
)
from ambid.blackbox.prediction import to_control as black_box_to_control
from ambid.errors import EstimationError, needs
from ambid.estimation.estimate import Estimate
from ambid.job.data import Reading, signals_of
from ambid.job.exchange import continuous_of, export, plant_of
from ambid.job.results import AnyEstimate, AnyFit, data_of, validate
from ambid.nonlinear.fit import NonlinearFit
from ambid.physics.linear_model import StateSpace, discretise, model
from ambid.record import ENDINGS, Record
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


def residuals(result: AnyEstimate | AnyFit) -> Any:
    """Return the innovations on the record that a result was made from, as a DataFrame over time."""
    data = result.used
    if data is None or not isinstance(result, Estimate | BlackBoxFit | NonlinearFit):
        why = "was read from a file, without its record" if data is None else "comes from several records or periods"
        raise EstimationError(f"the result {why}, so it has no residuals of its own. Use validate(record)")
    if isinstance(result, Estimate):
        from ambid.validation.second_record import replay

        plant = model(result.model)
        names, units, e = plant.outputs, plant.units, replay(result, signals_of(data, plant)).innovations
        start, n, rate = data.start_s, data.n_samples, data.rate_hz
    else:
        names, units, first = result.outputs, result.units, data[0][0]
        if isinstance(result, BlackBoxFit):
            e = errors(result, first).one_step
        else:
            from ambid.validation.fits import run

            found = run(result, first)
            e = found.one_step[found.lag :]
        start, n, rate = 0.0, first.n_samples, 1.0 / result.dt
    with needs("pandas", "a DataFrame", "frames"):
        import pandas
    time = pandas.Index(start + np.arange(n - len(e), n) / rate, name="time [s]")
    return pandas.DataFrame(e, index=time, columns=[f"{name} [{units[name]}]" for name in names])


def simulate(result: Estimate | AnyFit, u: Any, start: Any = None) -> dict[str, Array]:
    """Run a model on inputs alone, from rest at its operating point, (n_samples,) by output in SI."""
    names = model(result.model).inputs if isinstance(result, Estimate) else result.inputs
    if isinstance(u, Mapping) and {*names} <= {*u}:
        u = np.stack([np.asarray(u[name], dtype=np.float64) for name in names], axis=-1)
    is_file = isinstance(u, str | Path) and str(u).lower().endswith(ENDINGS)
    if is_file or isinstance(u, Record) or hasattr(u, "columns") or hasattr(u, "data_vars"):
        u = _inputs_of(result, data_of(result, u, where="the result"))
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
    if _runs_away(result, len(inputs)):
        return _in_its_loop(result, inputs[:, 0])
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


def _inputs_of(result: Estimate | AnyFit, data: Any) -> Any:
    """Return the inputs of a record; of a plant that runs away what was added to its controller's output."""
    if not isinstance(result, Estimate):
        return data.u
    if not _runs_away(result, data.n_samples):
        return signals_of(data, model(result.model)).u
    if "reference" not in data or data["reference"].unit != "V":
        raise EstimationError(
            "the plant is unstable in open loop, and the record has no reference in V that its loop could run on. Give "
            "what is added to the controller's output as an array, or use predict(record)"
        )
    return data["reference"].values


def _runs_away(result: Estimate | AnyFit, n: int) -> bool:
    """Whether an unstable plant grows by more than e within some samples."""
    if isinstance(result, Estimate):
        return bool(result.poles.real.max() * n > float(str(result.record["rate_hz"])))
    if isinstance(result, NonlinearFit) or not result.inputs:
        return False
    largest = np.abs(np.linalg.eigvals(plant_form(result).A)).max(initial=0.0)
    return bool(n * np.log(max(largest, 1e-300)) > 1.0)


def _in_its_loop(result: Estimate | AnyFit, wave: Array) -> dict[str, Array]:
    """Run an unstable plant in its rig's loop, without noise and limits; `wave` is added to the controller's output."""
    from ambid.job.simulation import rig_of_estimate
    from ambid.simulation.rig_bench import Bench

    rig = rig_of_estimate(result) if isinstance(result, Estimate) else None
    if rig is None or rig.loop is None or not rig.loop.closed:
        raise EstimationError(
            "the plant is unstable in open loop: on inputs alone its outputs run away, and no [loop] of a rig is "
            "known. Identify with a rig that has one, or use predict(record)"
        )
    bench = Bench.of(replace(rig, noise=None, limits=None), None, True)
    bench.refuse_unstable()
    warnings.warn(
        "the plant is unstable in open loop: it runs in its rig's [loop], and u is added to the controller's output",
        stacklevel=4,
    )
    done = bench.simulate(wave, seed=0, columns=False).record
    return {role: done[role].values for role in model(str(result.model)).outputs}


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
    at = continuous_of(result)
    found = state_space_to_control(at.A, at.B, at.C)
    plant = plant_of(result)
    found.update_names(inputs=list(plant.inputs), outputs=list(plant.outputs), states=list(at.states))
    return found
