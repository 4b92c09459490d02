"""The estimate of a nonlinear bearing: numbers with covariance, and curves of k_i, k_x and L with bands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_problem import BODY, LEVELS, UNITS
from ambid.estimation.estimate import (
    SCHEMA,
    Check,
    Continuous,
    Delay,
    EstimatedParameter,
    Judged,
    OutputFit,
    Parametric,
    covariance_apart,
    covariance_together,
    fields_json,
    json_text,
    plain_json,
    read_as,
    read_whole,
)
from ambid.estimation.result import NORMAL_95, Linear, Predicting
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.nonlinear import IDEAL, PowerStage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """One quantity over points, with its 95 % band by the delta method."""

    unit: str
    value: Array  # (n_points,), SI
    sd: Array

    @property
    def low(self) -> Array:
        """Lower edge of the 95 % band, shape (n_points,)."""
        return np.asarray(self.value - NORMAL_95 * self.sd)

    @property
    def high(self) -> Array:
        """Upper edge of the 95 % band, shape (n_points,)."""
        return np.asarray(self.value + NORMAL_95 * self.sd)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curves:
    """Force, k_i, k_x and L at points (f = k_i i - k_x x about each)."""

    position: Array  # (n_points,), m and A
    current: Array
    force: Curve
    k_i: Curve
    k_x: Curve
    L: Curve
    # (n_points,), bool, whether the free rotor came there; elsewhere the law extrapolates force, k_i and k_x, and the
    # band does not know it
    inside: NDArray[np.bool_]
    # (n_points,), bool, whether any record came there, of a held rotor too: where L was seen
    coil_inside: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class NonlinearBearingEstimate(Parametric, Judged, Predicting, Linear):
    """Result of the nonlinear grey box.

    Attributes
    ----------
    status : {"converged", "stalled"}
    law : MagnetLaw
        Which co-energy.
    eddy, drift : bool
        Whether the force has a pole a/(s + a), and whether a force and a voltage may drift.
    extended : tuple of str
        What the model was extended by: zeros of the position, one for each record but the first, and drift because they
        pay; lines and a drift of R that the innovations showed.
    records : tuple of Mapping
        ``samples``, ``rate_hz``, ``sha256``, ``file``, ``held`` of each.
    parameters : tuple of EstimatedParameter
        Every number that the law uses.
    covariance_names : tuple of str
        Estimated numbers, order of `covariance`.
    covariance : ndarray, shape (n, n), SI
    covariance_method : {"information", "robust"}
    delay : Mapping[str, Delay]
        Of the voltage, by sampling rate such as ``"1000 Hz"``.
    noise : Mapping[str, Mapping[str, float]]
        By record: levels in m, A, N, V, and of drifts in N and V (rms of one sample).
    fit : Mapping[str, Mapping[str, OutputFit]]
        By record and output.
    range, usual : Mapping[str, (float, float)]
        ``position`` and ``current`` between which the free rotor moved, always and for 95 % of the time, SI.
    operating_point : Mapping[str, float]
        Means of ``position`` and ``current`` of the records in which the rotor moved, SI.
    hull, coil_hull : ndarray, shape (n_corners, 2)
        Corners of the convex hull of all (position, current), counter-clockwise: of the records in which the rotor
        moved, and of all.
    criterion, bic : float
        Twice the negative log-likelihood but for constants, and with its price for each number.
    checks : Mapping[str, Check]
    calibration, calibration_sd : Mapping
        As of a linear `Estimate`; offsets that no number takes up are sources too, by an error of one SI unit.
    validation : Mapping[str, object] or None
        Results on a further record.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    rig : Mapping[str, object]
        Name and text of the rig, so that another record can be read alike.
    """

    status: Literal["converged", "stalled"]
    law: MagnetLaw
    eddy: bool
    drift: bool
    records: tuple[Mapping[str, object], ...]
    parameters: tuple[EstimatedParameter, ...]
    covariance_names: tuple[str, ...]
    covariance: Array
    covariance_method: Literal["information", "robust"]
    delay: Mapping[str, Delay]
    noise: Mapping[str, Mapping[str, float]]
    fit: Mapping[str, Mapping[str, OutputFit]]
    range: Mapping[str, tuple[float, float]]
    usual: Mapping[str, tuple[float, float]]
    operating_point: Mapping[str, float]
    hull: Array
    coil_hull: Array
    criterion: float
    bic: float
    checks: Mapping[str, Check] = field(default_factory=lambda: MappingProxyType({}))
    calibration: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MappingProxyType({}))
    calibration_sd: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    extended: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def model(self) -> str:
        """Name of the linear model that it is at each operating point."""
        return "one-axis"

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``."""

        return bearing_text(self)

    def delay_samples(self, rate_hz: float) -> float | None:
        """Return the delay of the voltage in samples at `rate_hz`; None at a rate that no record had."""
        delay = self.delay.get(f"{rate_hz:g} Hz")
        return None if delay is None else delay.samples + delay.fraction

    def curves(self, position: ArrayLike, current: ArrayLike) -> Curves:
        """Return force, k_i, k_x and L at points, with standard deviations by the delta method, with calibration where
        the rig says something of it.

        Parameters
        ----------
        position, current : array_like, shape (n_points,) or (), m and A
            As many currents as positions, or one for all; neither may have another shape.

        Returns
        -------
        Curves
        """
        x, i = np.broadcast_arrays(np.atleast_1d(np.asarray(position, float)), np.asarray(current, float))
        offset = self.values.get("x_offset", 0.0), self.values.get("i_offset", 0.0)
        true_x, true_i = np.ascontiguousarray(x) - offset[0], np.ascontiguousarray(i) - offset[1]
        table, slopes = self.law.table(true_x, true_i, self.values)
        gradient = np.zeros((x.size, 4, len(self.covariance_names)))
        for j, name in enumerate(self.covariance_names):
            if name in self.law.names:
                gradient[:, :, j] = slopes[:, :, self.law.names.index(name)]
        for name, point in (("x_offset", 0), ("i_offset", 1)):
            if name in self.covariance_names:
                gradient[:, :, self.covariance_names.index(name)] -= self._along(true_x, true_i, point)
        variance = np.einsum("ncj,jk,nck->nc", gradient, self.covariance, gradient)
        for source in self.calibration.keys() & self.calibration_sd.keys():
            moves = [self.calibration[source][name] * (self.values[name] or 1.0) for name in self.covariance_names]
            variance += (self.calibration_sd[source] * gradient @ np.array(moves)) ** 2
        sd = np.sqrt(np.maximum(variance, 0.0))
        force, k_x, k_i, ell = (
            Curve(unit=unit, value=table[:, c], sd=sd[:, c]) for c, unit in enumerate(("N", "N/m", "N/A", "H"))
        )
        points = np.column_stack([x, i])
        return Curves(
            position=np.array(x), current=np.array(i), force=force, k_i=k_i, k_x=k_x, L=ell,
            inside=self.covers(points), coil_inside=_within(self.coil_hull, points),
        )  # fmt: skip

    def _along(self, x: Array, i: Array, point: int) -> Array:
        """Derivatives of force, k_x, k_i, L by position (0) or current (1), in shape (n_points, 4)."""
        return self.law.gradients(x, i, self.values)[:, :, point]

    def covers(self, points: Array) -> NDArray[np.bool_]:
        """Tell which points the free rotor came to: inside the convex hull of its records, edges included.

        Parameters
        ----------
        points : ndarray, shape (n_points, 2)
            Position in m and current in A.

        Returns
        -------
        ndarray, shape (n_points,), bool
        """
        return _within(self.hull, points)


def _within(hull: Array, points: Array) -> NDArray[np.bool_]:
    """Which points lie left of all edges of a polygon that goes round counter-clockwise."""
    size = np.ptp(hull, axis=0)
    corners, at = hull / size, points / size
    edge = np.roll(corners, -1, axis=0) - corners
    side = edge[:, 0] * (at[:, None, 1] - corners[:, 1]) - edge[:, 1] * (at[:, None, 0] - corners[:, 0])
    return np.asarray(np.all(side > -1e-9, axis=1))


def linearised(
    estimate: NonlinearBearingEstimate, position: float | None = None, current: float | None = None
) -> Continuous:
    """Return the plant about a point in m and A, by default the records' operating point: m x'' = f - c x', L i' = V -
    R i - k_i x', f = k_i i - k_x x (thesis eq. 4.8); a drop adds its slope to R, an eddy pole the state f' = a (k_i i -
    k_x x - f).
    """
    x = estimate.operating_point["position"] if position is None else position
    i = estimate.operating_point["current"] if current is None else current
    at, v = estimate.curves(x, i), estimate.values
    k_x, k_i, ell = float(at.k_x.value[0]), float(at.k_i.value[0]), float(at.L.value[0])
    m, c, stage = v["m"], v["c"], PowerStage(v_drop=v.get("v_drop", 0.0), i_drop=v.get("i_drop", IDEAL.i_drop))
    R = v["R"] + stage.slope(i - v.get("i_offset", 0.0))
    states: tuple[str, ...] = ("position", "velocity", "current")
    A = np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, k_i / m], [0.0, -k_i / ell, -R / ell]])
    B, C = np.array([[0.0], [0.0], [1.0 / ell]]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if estimate.eddy:
        states, a = (*states, "force"), v["a"]
        A = np.vstack([np.hstack([A, [[0.0], [1.0 / m], [0.0]]]), [-a * k_x, 0.0, a * k_i, -a]])
        A[1, 0] = A[1, 2] = 0.0
        B, C = np.vstack([B, [[0.0]]]), np.hstack([C, np.zeros((2, 1))])
    return Continuous(states=states, A=A, B=B, C=C, poles=np.linalg.eigvals(A).astype(np.complex128))


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
    entries = {}
    for name, c in (("k_x", at.k_x), ("k_i", at.k_i), ("L", at.L)):
        ends = [float(c.low[0]), float(c.high[0])]
        entries[name] = {"value": float(c.value[0]), "sd": float(c.sd[0]), "ci95": ends, "unit": c.unit}
    return entries


def curves_json(estimate: NonlinearBearingEstimate) -> dict[str, Any]:
    """Return force, k_i, k_x and L over a grid of ``position`` (m) and ``current`` (A) where the free rotor usually
    was, rows by position: ``unit``, ``value``, ``sd``; ``inside``: whether the free rotor came there; ``coil_inside``:
    whether any record did, which is what L needs.
    """
    x = np.linspace(*estimate.usual["position"], _POSITIONS)
    i = np.linspace(*estimate.usual["current"], _CURRENTS)
    grid = np.meshgrid(x, i, indexing="ij")
    curves = estimate.curves(grid[0].ravel(), grid[1].ravel())

    def of(c: Curve) -> dict[str, Any]:
        return {"unit": c.unit, "value": c.value.reshape(grid[0].shape), "sd": c.sd.reshape(grid[0].shape)}

    return {
        "position": x, "current": i, "force": of(curves.force), "k_i": of(curves.k_i), "k_x": of(curves.k_x),
        "L": of(curves.L), "inside": curves.inside.reshape(grid[0].shape),
        "coil_inside": curves.coil_inside.reshape(grid[0].shape),
    }  # fmt: skip


def fit_over_all(estimate: NonlinearBearingEstimate) -> dict[str, dict[str, float | None]]:
    """Return each output's fit over all records that measure it, about their means: ``one_step``, ``innovation_sd`` in
    SI, and ``simulation``, None.
    """
    fits_by_role: dict[str, dict[str, float | None]] = {}
    for role in _ROLES:
        n = error = spread = 0.0
        for record, fits in zip(estimate.records, estimate.fit.values(), strict=True):
            if role not in fits:
                continue
            samples, f = float(str(record["samples"])), fits[role]
            n, error = n + samples, error + samples * f.innovation_sd**2
            spread += samples * (f.innovation_sd / max(1.0 - f.one_step, 1e-12)) ** 2
        fits_by_role[role] = {
            "one_step": 1.0 - math.sqrt(error / spread), "simulation": None, "innovation_sd": math.sqrt(error / n)
        }  # fmt: skip
    return fits_by_role


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

    return read_whole(read, where, "estimate", "identify_nonlinear")


def _check_consistent(e: NonlinearBearingEstimate) -> None:
    """Raise ValueError where the parts do not belong together: an edited file, or one of another program."""
    if e.law.gap not in ("hyperbolic", "exponential"):
        raise ValueError(f"{e.law.gap!r} is no gap law")
    acting = {*e.law.names, *BODY}
    for p in e.parameters:
        if p.name not in acting or p.unit != UNITS[p.name] or not math.isfinite(p.value):
            raise ValueError(f"{p.name} = {p.value:g} {p.unit} is not a parameter of this law")
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
    for record, fits in zip(e.records, e.fit.values(), strict=True):
        sizes = [f.innovation_sd for f in fits.values()]
        if set(fits) != (set(_ROLES) - ({"position"} if record["held"] else set())) or not all(x > 0 for x in sizes):
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
