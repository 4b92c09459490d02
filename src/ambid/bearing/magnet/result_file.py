"""The estimate of a nonlinear bearing as JSON, schema ``ambid.estimate/1`` with ``law``, ``records`` and ``curves``.

What follows from the rest (``record``, ``continuous``, ``curves``, ``at_operating_point``, the ``fit`` over all
records) is written for other programs, and not read again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.bearing.magnet.linearised import linearised
from ambid.bearing.magnet.problem import BODY, LEVELS, UNITS
from ambid.bearing.magnet.result import Curve, NonlinearBearingEstimate
from ambid.errors import EstimationError, ModelError
from ambid.estimation.estimate import Delay, EstimatedParameter, OutputFit
from ambid.estimation.estimate_file import SCHEMA, parameter_json
from ambid.estimation.json_values import check_from_json, check_json, delay_json, plain_json
from ambid.physics.coenergy_law import MagnetLaw

_POSITIONS, _CURRENTS = 9, 5  # of the grid of the curves
_ROLES = ("position", "current")


def bearing_text(estimate: NonlinearBearingEstimate) -> str:
    """Return the JSON text of an estimate."""
    return json.dumps(bearing_to_json(estimate), indent=1, allow_nan=False) + "\n"


def bearing_to_json(estimate: NonlinearBearingEstimate) -> dict[str, Any]:
    """Return an estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only."""
    plant, law = linearised(estimate), estimate.law
    by_rate = {rate: delay_json(d) for rate, d in estimate.delay.items()}
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "status": estimate.status,
        "record": dict(estimate.records[0]),
        "records": [dict(r) for r in estimate.records],
        "model": estimate.model,
        "law": {
            "gap": law.gap,
            "pair": law.pair,
            "asymmetric": law.asymmetric,
            "saturation": law.saturation,
            "rise": law.rise,
            "eddy": estimate.eddy,
            "drift": estimate.drift,
        },
        "parameters": {p.name: parameter_json(p) for p in estimate.parameters},
        "covariance": {
            "names": list(estimate.covariance_names),
            "matrix": estimate.covariance.tolist(),
            "method": estimate.covariance_method,
        },
        "delay": {"voltage": {**next(iter(by_rate.values())), "by_rate": by_rate}},
        "operating_point": dict(estimate.operating_point),
        "at_operating_point": _at_operating_point(estimate),
        "continuous": {
            "states": list(plant.states),
            "A": plant.A.tolist(),
            "B": plant.B.tolist(),
            "C": plant.C.tolist(),
            "poles": [[float(p.real), float(p.imag)] for p in plant.poles],
        },
        "curves": curves_json(estimate),
        "range": {role: list(x) for role, x in estimate.range.items()},
        "usual": {role: list(x) for role, x in estimate.usual.items()},
        "hull": estimate.hull.tolist(),
        "coil_hull": estimate.coil_hull.tolist(),
        "noise": {name: dict(levels) for name, levels in estimate.noise.items()},
        "fit": fit_over_all(estimate),
        "fit_by_record": {name: {role: _fit_json(f) for role, f in of.items()} for name, of in estimate.fit.items()},
        "criterion": estimate.criterion,
        "bic": estimate.bic,
        "checks": {name: check_json(c) for name, c in estimate.checks.items()},
        "validation": None if estimate.validation is None else dict(estimate.validation),
        "warnings": list(estimate.warnings),
        "timing_s": dict(estimate.timing_s),
        "rig": dict(estimate.rig),
    }
    return {name: plain_json(value) for name, value in document.items()}


def _at_operating_point(estimate: NonlinearBearingEstimate) -> dict[str, Any]:
    """The linear model's parameters where the records were."""
    at = estimate.curves(estimate.operating_point["position"], estimate.operating_point["current"])
    found = {}
    for name, c in (("k_x", at.k_x), ("k_i", at.k_i), ("L", at.L)):
        value, sd = float(c.value[0]), float(c.sd[0])
        found[name] = {"value": value, "sd": sd, "ci95": [value - 1.96 * sd, value + 1.96 * sd], "unit": c.unit}
    return found


def curves_json(estimate: NonlinearBearingEstimate) -> dict[str, Any]:
    """Return force, k_i, k_x and L over a grid of where the free rotor usually was.

    Returns ``position`` (m) and ``current`` (A) of the grid; each quantity with ``unit``, and ``value`` and ``sd`` in a
    row for each position and a column for each current; ``inside``: whether the free rotor came there; ``coil_inside``:
    whether any record did, which is what L needs.
    """
    x = np.linspace(*estimate.usual["position"], _POSITIONS)
    i = np.linspace(*estimate.usual["current"], _CURRENTS)
    grid = np.meshgrid(x, i, indexing="ij")
    found = estimate.curves(grid[0].ravel(), grid[1].ravel())

    def of(c: Curve) -> dict[str, Any]:
        return {"unit": c.unit, "value": c.value.reshape(grid[0].shape), "sd": c.sd.reshape(grid[0].shape)}

    return {
        "position": x, "current": i, "force": of(found.force), "k_i": of(found.k_i), "k_x": of(found.k_x),
        "L": of(found.L), "inside": found.inside.reshape(grid[0].shape),
        "coil_inside": found.coil_inside.reshape(grid[0].shape),
    }  # fmt: skip


def fit_over_all(estimate: NonlinearBearingEstimate) -> dict[str, dict[str, float | None]]:
    """Return the fit of each output over all records that measure it, each about its own mean.

    Returns by output: ``one_step``; ``simulation``, None; ``innovation_sd``, SI.
    """
    found: dict[str, dict[str, float | None]] = {}
    for role in _ROLES:
        n = error = spread = 0.0
        for record, fits in zip(estimate.records, estimate.fit.values(), strict=True):
            if role not in fits:
                continue
            samples, f = float(str(record["samples"])), fits[role]
            n, error = n + samples, error + samples * f.innovation_sd**2
            spread += samples * (f.innovation_sd / max(1.0 - f.one_step, 1e-12)) ** 2
        found[role] = {
            "one_step": 1.0 - math.sqrt(error / spread), "simulation": None, "innovation_sd": math.sqrt(error / n)
        }  # fmt: skip
    return found


def _fit_json(f: OutputFit) -> dict[str, float | None]:
    return {"one_step": f.one_step, "simulation": f.simulation, "innovation_sd": f.innovation_sd}


def bearing_from_json(document: Mapping[str, Any], where: str) -> NonlinearBearingEstimate:
    """Read an estimate back.

    `document`: parsed JSON of schema ``ambid.estimate/1`` with a ``law``; `where`: name of the file, for messages.
    Returns the same numbers, bit by bit.
    """
    try:
        estimate = _from_json(document)
        _consistent(estimate)
        return estimate
    except (ModelError, AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise EstimationError(
            f"{where} is not a whole estimate ({type(error).__name__}: {error}). "
            "Write it again with 'ambid identify --nonlinear --json'"
        ) from error


def _from_json(d: Mapping[str, Any]) -> NonlinearBearingEstimate:
    law, cov = d["law"], d["covariance"]
    return NonlinearBearingEstimate(
        status=d["status"],
        law=MagnetLaw(**{name: law[name] for name in ("gap", "pair", "asymmetric", "saturation", "rise")}),
        eddy=bool(law["eddy"]),
        drift=bool(law["drift"]),
        records=tuple(d["records"]),
        parameters=tuple(
            EstimatedParameter(
                name=name,
                unit=p["unit"],
                value=float(p["value"]),
                sd=float(p["sd"]),
                ci95=(p["ci95"][0], p["ci95"][1]),
                role=p["role"],
                identifiable=bool(p["identifiable"]),
                data_share=p.get("data_share"),
            )
            for name, p in d["parameters"].items()
        ),
        covariance_names=tuple(cov["names"]),
        covariance=np.array(cov["matrix"], dtype=np.float64),
        covariance_method=cov["method"],
        delay={
            rate: Delay(samples=int(x["samples"]), fraction=float(x["fraction"]), sd=x["sd"], how=x["how"])
            for rate, x in d["delay"]["voltage"]["by_rate"].items()
        },
        noise=d["noise"],
        fit={name: {role: OutputFit(**f) for role, f in of.items()} for name, of in d["fit_by_record"].items()},
        range={role: _interval(x) for role, x in d["range"].items()},
        usual={role: _interval(x) for role, x in d["usual"].items()},
        operating_point=d["operating_point"],
        hull=np.array(d["hull"], dtype=np.float64),
        coil_hull=np.array(d["coil_hull"], dtype=np.float64),
        criterion=float(d["criterion"]),
        bic=float(d["bic"]),
        checks={name: check_from_json(c) for name, c in d["checks"].items()},
        validation=d["validation"],
        warnings=tuple(d["warnings"]),
        timing_s=d["timing_s"],
        rig=d["rig"],
    )


def _interval(x: Sequence[float]) -> tuple[float, float]:
    low, high = x
    return low, high


def _consistent(e: NonlinearBearingEstimate) -> None:
    """Raise ValueError where the parts do not belong together: an edited file, or one of another program."""
    if e.law.gap not in ("hyperbolic", "exponential"):
        raise ValueError(f"{e.law.gap!r} is no gap law")
    acting = {*e.law.names, *BODY}
    for p in e.parameters:
        if p.name not in acting or p.unit != UNITS[p.name] or not math.isfinite(p.value):
            raise ValueError(f"{p.name} = {p.value:g} {p.unit} is no number of this law")
    missing = {*e.law.names[:2], "L_leak", "m", "R", "c", "g"} - set(e.values)
    if missing:
        raise ValueError(f"{sorted(missing)[0]} is missing")
    if not (e.values["m"] > 0 and e.values["R"] >= 0) or e.status not in ("converged", "stalled"):
        raise ValueError("mass, resistance or status is not that of a finished estimate")
    if set(e.covariance_names) - set(e.values) or e.covariance.shape != (len(e.covariance_names),) * 2:
        raise ValueError("the covariance is not of the parameters")
    if len(e.noise) != len(e.records) or list(e.fit) != list(e.noise):
        raise ValueError("noise, fits and records are not of the same number")
    for levels in e.noise.values():
        if not levels or set(levels) - set(LEVELS) or not all(0 < x < math.inf for x in levels.values()):
            raise ValueError("the noise levels are not those of a predictor")
    for record, of in zip(e.records, e.fit.values(), strict=True):
        sizes = [f.innovation_sd for f in of.values()]
        if set(of) != (set(_ROLES) - ({"position"} if record["held"] else set())) or not all(x > 0 for x in sizes):
            raise ValueError("the fits are not those of position and current")
    if not isinstance(e.rig, Mapping):
        raise ValueError("the rig is none")
    hulls = (e.hull, e.coil_hull)
    if (
        any(h.ndim != 2 or h.shape[1] != 2 for h in hulls)
        or set(e.usual) != set(_ROLES)
        or set(e.operating_point) != set(_ROLES)
    ):
        raise ValueError("the hull, the usual positions or the operating point are not of position and current")
    for record in e.records:
        if e.delay_samples(float(str(record["rate_hz"]))) is None:
            raise ValueError("a record's rate has no delay")
    for delay in e.delay.values():
        if not 0 <= delay.samples < 10**6 or not 0 <= delay.fraction < 1:
            raise ValueError("the delay is not whole samples and a fraction")
