"""The estimate of a nonlinear bearing as JSON, schema ``ambid.estimate/1`` with ``law``, ``records`` and ``curves``.

What follows from the rest (``record``, ``continuous``, ``curves``, ``at_operating_point``, the ``fit`` over all
records) is written for other programs, and not read again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.bearing.magnet.linearised import linearised
from ambid.bearing.magnet.problem import BODY, LEVELS, UNITS
from ambid.bearing.magnet.result import Curve, NonlinearBearingEstimate
from ambid.estimation.documents import (
    covariance_apart,
    covariance_together,
    fields_json,
    json_text,
    plain_json,
    read_as,
    read_whole,
)
from ambid.estimation.estimate_file import SCHEMA

_POSITIONS, _CURRENTS = 9, 5  # of the grid of the curves
_ROLES = ("position", "current")


def bearing_text(estimate: NonlinearBearingEstimate) -> str:
    """Return the JSON text of an estimate."""
    return json_text(bearing_to_json(estimate))


def bearing_to_json(estimate: NonlinearBearingEstimate) -> dict[str, Any]:
    """Return an estimate in the form of schema ``ambid.estimate/1``: SI values, JSON numbers only."""
    document = covariance_together(fields_json(estimate, without=("eddy", "drift", "delay", "fit")))
    by_rate = plain_json(estimate.delay)
    more = {
        "record": estimate.records[0],
        "model": estimate.model,
        "law": {**document["law"], "eddy": estimate.eddy, "drift": estimate.drift},
        "delay": {"voltage": {**next(iter(by_rate.values())), "by_rate": by_rate}},
        "at_operating_point": _at_operating_point(estimate),
        "continuous": linearised(estimate),
        "curves": curves_json(estimate),
        "fit": fit_over_all(estimate),
        "fit_by_record": estimate.fit,
    }
    return {"schema": SCHEMA, **document, **plain_json(more)}


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


def bearing_from_json(document: Mapping[str, Any], where: str) -> NonlinearBearingEstimate:
    """Read an estimate back, bit by bit; `where` is the name of its file, for messages."""

    def read() -> NonlinearBearingEstimate:
        law = document["law"]
        entries = {
            **covariance_apart(document),
            "eddy": law["eddy"],
            "drift": law["drift"],
            "delay": document["delay"]["voltage"]["by_rate"],
            "fit": document["fit_by_record"],
        }
        estimate = read_as(NonlinearBearingEstimate, entries)
        _check_consistent(estimate)
        return estimate

    return read_whole(read, where, "estimate", "identify --nonlinear")


def _check_consistent(e: NonlinearBearingEstimate) -> None:
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
