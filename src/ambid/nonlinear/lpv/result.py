"""The fit that comes out of an LPV search: model in SI, covariance, table of frozen models, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.linear import information_inverse
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import provenance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.lpv.model import LpvModel, regressors

if TYPE_CHECKING:
    from ambid.nonlinear.lpv.candidates import Work


_POINTS = 9  # of the table over the range of p
_CLOSE = 2.0  # difference of Akaike's criterion that says nothing (Burnham and Anderson 2002, sec. 2.6)


def finished(records: Sequence[IOData], used: Mapping[str, object], work: Work, *, seed: int) -> NonlinearFit:
    """Return the fit of a model that runs.

    `used`: settings.
    """
    problem, theta = work.problem(work.shape), work.theta
    noise = problem.cost(theta) / problem.freedom
    R = problem.triangle(theta)
    inverse, condition = information_inverse(R[:, :-1]) if np.all(np.isfinite(R)) else (None, np.inf)
    model = _model(records, work)
    warnings = [*work.warnings, *_cautions(records, work)]
    covariance = None
    if inverse is None:
        warnings.append(
            "no covariance, and so no standard deviations: the data do not determine the coefficients (condition "
            f"number {condition:.1e}). Lower degree or error_order, or give records at more set points"
        )
    else:
        covariance = noise * inverse * model.unit[:, None] * model.unit
    return NonlinearFit(
        structure="lpv",
        settings=dict(used),
        model=model,
        covariance=covariance,
        covariance_from="" if covariance is None else "information",
        n_estimated=int(theta.size),
        noise_covariance=np.array([[noise * float(work.data.y_scale[0]) ** 2]]),
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=tuple(warnings),
        timing_s=dict(work.timing_s),
        details={
            "schedule": {
                "signal": work.schedule.name,
                "low": work.schedule.low,
                "high": work.schedule.high,
                "time_constant_s": work.schedule.time_constant,
                "unit": records[0].units[records[0].outputs[0] if model.schedule.column < 0 else work.schedule.name],
            },
            "condition": condition,
            "frozen": frozen_table(model, covariance, records[0].inputs),
            "tried": list(work.tried),
        },
        **provenance(records),
    )


def _model(records: Sequence[IOData], work: Work) -> LpvModel:
    d, of = work.data, work.schedule
    seen = [
        regressors(work.shape, y[:, 0], u, of.scaled(of.signal(x.u, x.y, x.dt)))
        for x, (y, u) in zip(records, d.parts, strict=True)
    ]
    model = LpvModel(
        dt=records[0].dt,
        n_inputs=records[0].n_inputs,
        shape=work.shape,
        schedule=of,
        theta=work.theta,
        u_level=d.u_level,
        u_scale=d.u_scale,
        y_level=d.y_level,
        y_scale=d.y_scale,
        cloud=cloud_of(np.concatenate(seen)),
    )
    return model.with_theta(work.theta * model.unit)


def frozen_table(model: LpvModel, covariance: Array | None, inputs: Sequence[str]) -> list[dict[str, object]]:
    """Return poles and gains over the range of the scheduling signal.

    `covariance`: (n_theta, n_theta), SI, or None; `inputs`: names of all inputs. Returns by value of p: ``p``,
    ``poles_rad_s`` (real and imaginary part, and their standard deviations) and ``dc_gain`` by input (value, standard
    deviation); None where there is no number.
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


def _cautions(records: Sequence[IOData], work: Work) -> list[str]:
    found = []
    of = work.shape
    if of.columns and not (of.ar or of.ma) and not all(x.open_loop for x in records):
        what = "noise is white" if of.form == "output" else "equation errors are white"
        found.append(
            f"without an error model (error_order = 0) lpv is biased under feedback unless its {what}, and nothing "
            "says that these records are open loop: raise error_order, or say --open-loop if there was no feedback"
        )
    if not of.columns and records[0].n_inputs:
        found.append(
            f"no input acts on the output: {work.schedule.name!r}, the only one, moves coefficients alone. Say "
            "exciting = yes if it does, or name the input that does"
        )
    if of.degree == 0:
        found.append(
            f"no coefficient depends on the scheduling signal {work.schedule.name!r} (degree 0"
            f"{'' if not work.tried or len(work.tried) < 2 else ', by the criterion'}): this is a linear model"
        )
    return found + _close_calls(work)


def _close_calls(work: Work) -> list[str]:
    """Other degrees that the data hardly tell from the chosen one, everything else alike."""
    of = work.shape
    alike = {
        str(x["degree"]): x["aicc"]
        for x in work.tried
        if (x["form"], x["ar"], x["ma"]) == (of.form, of.ar, of.ma) and isinstance(x["aicc"], float)
    }
    own = alike.pop(str(of.degree), None)
    close = [k for k, value in alike.items() if own is not None and abs(value - own) < _CLOSE]
    if not close:
        return []
    return [
        f"degree {of.degree} is a close call: degree {' and '.join(close)} would explain the data about as "
        "well. The standard deviations take the degree for given and are too small by that choice. Name it if you know "
        "it"
    ]
