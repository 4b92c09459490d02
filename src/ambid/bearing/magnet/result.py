"""The estimate of a nonlinear bearing: numbers with covariance, and curves of k_i, k_x and L with bands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, OutputFit, parameter_named
from ambid.physics.coenergy_law import MagnetLaw


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """One quantity over points, with its 95 % band by the delta method."""

    unit: str
    value: Array  # (n_points,), SI
    sd: Array

    @property
    def low(self) -> Array:
        """Lower edge of the 95 % band, shape (n_points,)."""
        return np.asarray(self.value - 1.96 * self.sd)

    @property
    def high(self) -> Array:
        """Upper edge of the 95 % band, shape (n_points,)."""
        return np.asarray(self.value + 1.96 * self.sd)


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NonlinearBearingEstimate:
    """Result of the nonlinear grey box.

    Attributes
    ----------
    status : {"converged", "stalled"}
    law : MagnetLaw
        Which co-energy.
    eddy, drift : bool
        Whether the force has a pole a/(s + a), and whether a slowly walking force was allowed for.
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
        By record: levels in m, A, N, V, N (rms of one sample).
    fit : Mapping[str, Mapping[str, OutputFit]]
        By record and output.
    range : Mapping[str, (float, float)]
        ``position`` and ``current`` between which the free rotor moved, SI.
    usual : Mapping[str, (float, float)]
        ``position`` and ``current`` between which the free rotor was for 95 % of the time, SI.
    operating_point : Mapping[str, float]
        Means of ``position`` and ``current`` of the records in which the rotor moved, SI.
    hull, coil_hull : ndarray, shape (n_corners, 2)
        Corners of the convex hull of all (position, current), counter-clockwise: of the records in which the rotor
        moved, and of all.
    criterion, bic : float
        Twice the negative log-likelihood but for constants, and with its price for each number.
    checks : Mapping[str, Check]
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
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def model(self) -> str:
        """Name of the linear model that it is at each operating point."""
        return "one-axis"

    @property
    def values(self) -> dict[str, float]:
        """All numbers by name, SI."""
        return {p.name: p.value for p in self.parameters}

    @property
    def passed(self) -> bool:
        """Whether the search converged and every check passed."""
        return self.status == "converged" and all(c.passed for c in self.checks.values())

    def parameter(self, name: str) -> EstimatedParameter:
        """Return one number by name.

        Parameters
        ----------
        name : str

        Returns
        -------
        EstimatedParameter

        Raises
        ------
        EstimationError
            If there is none of that name.
        """
        return parameter_named(self.parameters, name)

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``.

        Returns
        -------
        str
        """
        from ambid.bearing.magnet.result_file import bearing_text

        return bearing_text(self)

    def delay_samples(self, rate_hz: float) -> float | None:
        """Return the delay of the voltage at a sampling rate.

        Parameters
        ----------
        rate_hz : float

        Returns
        -------
        float or None
            In samples; None at a rate that no record had.
        """
        found = self.delay.get(f"{rate_hz:g} Hz")
        return None if found is None else found.samples + found.fraction

    def curves(self, position: ArrayLike, current: ArrayLike) -> Curves:
        """Return force, k_i, k_x and L at points, with standard deviations by the delta method.

        Parameters
        ----------
        position : array_like, shape (n_points,) or (), m
        current : array_like, shape (n_points,) or (), A
            As many as positions, or one for all; neither may have another shape.

        Returns
        -------
        Curves
        """
        x, i = np.broadcast_arrays(np.atleast_1d(np.asarray(position, float)), np.asarray(current, float))
        offset = self.values.get("x_offset", 0.0), self.values.get("i_offset", 0.0)
        true_x, true_i = np.ascontiguousarray(x) - offset[0], np.ascontiguousarray(i) - offset[1]
        found, slopes = self.law.table(true_x, true_i, self.values)
        gradient = np.zeros((x.size, 4, len(self.covariance_names)))
        for j, name in enumerate(self.covariance_names):
            if name in self.law.names:
                gradient[:, :, j] = slopes[:, :, self.law.names.index(name)]
        for name, point in (("x_offset", 0), ("i_offset", 1)):
            if name in self.covariance_names:
                gradient[:, :, self.covariance_names.index(name)] -= self._along(true_x, true_i, point)
        variance = np.einsum("ncj,jk,nck->nc", gradient, self.covariance, gradient)
        sd = np.sqrt(np.maximum(variance, 0.0))
        force, k_x, k_i, ell = (
            Curve(unit=unit, value=found[:, c], sd=sd[:, c]) for c, unit in enumerate(("N", "N/m", "N/A", "H"))
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
