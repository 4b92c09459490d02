"""The estimate of a rotor: parameters of the machine, its bending modes, and what was found beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import (
    SCHEMA,
    Check,
    Continuous,
    Delay,
    EstimatedParameter,
    Judged,
    OutputFit,
    Parametric,
    check_schema,
    covariance_apart,
    covariance_together,
    fields_json,
    json_text,
    read_as,
    read_whole,
)
from ambid.estimation.modes import Mode
from ambid.estimation.result import Linear, Predicting
from ambid.physics.rotor_model import RotorModel

_EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class RotorEstimate(Parametric, Judged, Predicting, Linear):
    """Physical parameters of a rotor in magnetic bearings, with its bending modes.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
    model : str
        ``"rotor"``.
    method : {"periods", "predictor"}
        Maximum likelihood on period spectra, or innovations-form predictor.
    record : Mapping[str, object]
        ``samples``, ``rate_hz``, ``sha256``, ``file`` and history of the first record.
    records : tuple of Mapping
        The same of every record, with ``speed`` in rad/s, and ``periods`` where the excitation is periodic.
    parameters : tuple of EstimatedParameter
        Of the machine, under the rig's names, SI.
    modes : tuple of Mode
        Bending modes within the excited band, in order of frequency, at rest; shape by bearing and sensor plane,
        modal mass 1 kg.
    plant : RotorModel
        The model that was identified: bearings, axes, modes, at the speed of `continuous`.
    numbers : Mapping[str, float]
        All its numbers, modes above the band included, SI.
    covariance_names : tuple of str
        Estimated numbers, modes and delays included; order of `covariance`.
    covariance : ndarray, shape (n, n), SI
    delay : Mapping[str, Delay]
        By input.
    continuous : Continuous
        The plant at `speed`.
    noise : Mapping[str, float]
        Standard deviation of each source of noise by name, SI: sensors by output, ``<axis>_force``, ``<axis>_voltage``.
    fit : Mapping[str, OutputFit]
        By output.
    checks : Mapping[str, Check]
    sensitivity : Mapping[str, Any]
        Peak of the sensitivity by axis, where a loop is known or a reference is logged.
    calibration : Mapping[str, Mapping[str, float]]
        By channel, ``"rate"`` and plane (``"A.z"``: all of bearing A, ``"A.z_magnet"``, ``"A.z_sensor"``), the per cent
        by which 1 % of it would move each estimated number; lengths count against the span of the bearings.
    calibration_sd : Mapping[str, float]
        What the rig says of these errors: relative standard deviations of gains and rate, of planes in m, of offsets
        (``"ax_current.offset"``, which move the operating point alone) in SI units.
    synchronous : Mapping[str, Any]
        What the synchronous response of records at speed shows; empty without one. The angle runs from x to y, phases
        are in rad against its zero, a number is ``{"value", "sd", "phase", "phase_sd", "identifiable"}``.

        - ``records``: of each its number in `records`, ``speed`` in rad/s, ``drift`` (its range over its mean),
          ``source`` of the angle, harmonics (``orders``); ``response`` by role with ``amplitude``, ``phase`` and ``sd``
          of each harmonic, the part of the excitation taken out (``excitation_apart``); ``orbits`` by bearing at its
          first sensors: ``major`` and ``minor`` radius of the synchronous orbit in m, whether it turns ``forward``,
          the largest radius of the rest (``non_synchronous``) with some ``samples`` of x and y, and the ``clearance``.
        - ``used``: numbers of the records that the following comes from, with ``misfit``, the mean square of what it
          leaves over the noise, and its degrees of ``freedom``; ``hint``: what stands against it.
        - ``unbalance``: ``planes`` (the outer bearing planes, kg m, at ``z``), their sum ``static`` with ``grade_mm_s``
          (e W of ISO 21940-11), ``modes`` (what each bending mode sees beyond the planes, kg^(1/2) m), and
          ``one_plane``: where along the shaft it stands if ``fits`` one plane.
        - ``runout``: of the sensors by their plane, m; x reads value cos(angle + phase), y the sine.
        - ``influence``: by record and plane, motion at each position sensor of 1 kg m, m.
        - ``balancing``: ``correction`` by plane in kg m, and ``vibration`` at each sensor in m without runout:
          ``before``, expected ``after``, and ``at_most`` with 95 %.
    validation : Mapping[str, object] or None
    warnings : tuple of str
    timing_s : Mapping[str, float]
    information : Mapping[str, object]
        Condition number and the weakest direction.
    rig : Mapping[str, object]
        Name and text of the rig.
    """

    status: Literal["converged", "stalled", "failed"]
    model: str = "rotor"
    method: Literal["periods", "predictor"]
    record: Mapping[str, object]
    records: tuple[Mapping[str, object], ...]
    parameters: tuple[EstimatedParameter, ...]
    modes: tuple[Mode, ...]
    plant: RotorModel
    numbers: Mapping[str, float]
    covariance_names: tuple[str, ...]
    covariance: Array
    delay: Mapping[str, Delay]
    continuous: Continuous
    noise: Mapping[str, float]
    fit: Mapping[str, OutputFit]
    checks: Mapping[str, Check]
    sensitivity: Mapping[str, Any] = field(default_factory=lambda: _EMPTY)
    calibration: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: _EMPTY)
    calibration_sd: Mapping[str, float] = field(default_factory=lambda: _EMPTY)
    synchronous: Mapping[str, Any] = field(default_factory=lambda: _EMPTY)
    validation: Mapping[str, object] | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: _EMPTY)
    information: Mapping[str, object] = field(default_factory=lambda: _EMPTY)
    rig: Mapping[str, object] = field(default_factory=lambda: _EMPTY)

    @property
    def n_modes(self) -> int:
        """Bending modes of the model."""
        return self.plant.n_modes

    @property
    def speed(self) -> float:
        """Speed of `continuous`, rad/s."""
        return self.plant.speed

    @property
    def mode_parameters(self) -> tuple[EstimatedParameter, ...]:
        """Frequency and damping of each bending mode as parameters, ``mode1.frequency_hz``, ``mode1.damping`` …"""
        entries = [
            (f"mode{r}.{what}", unit, number)
            for r, m in enumerate(self.modes, 1)
            for what, unit, number in (("frequency_hz", "Hz", m.frequency_hz), ("damping", "1", m.damping))
        ]
        return tuple(
            EstimatedParameter(
                name=name, unit=unit, value=x.value, sd=x.sd, ci95=x.ci95, role="free", identifiable=x.identifiable
            )
            for name, unit, x in entries
        )

    def dumps(self) -> str:
        """Return the estimate as JSON text, schema ``ambid.estimate/1``.

        Returns
        -------
        str
        """
        return json_text({"schema": SCHEMA, **covariance_together(fields_json(self))})

    def covariance_of(self, names: tuple[str, ...]) -> Array:
        """Return the covariance of some numbers; what was not estimated has none.

        Parameters
        ----------
        names : tuple of str

        Returns
        -------
        ndarray, shape (n, n), SI
        """
        matrix = np.zeros((len(names), len(names)))
        at = {name: k for k, name in enumerate(self.covariance_names)}
        rows = [k for k, name in enumerate(names) if name in at]
        index = [at[names[k]] for k in rows]
        matrix[np.ix_(rows, rows)] = self.covariance[np.ix_(index, index)]
        return matrix


def rotor_estimate_from_json(document: Mapping[str, Any], where: str) -> RotorEstimate:
    """Read an estimate of a rotor back; `where` is the name of its file, for messages."""
    check_schema(document, SCHEMA, where, "an estimate", "identify")

    def read() -> RotorEstimate:
        estimate = read_as(RotorEstimate, covariance_apart(document))
        size = len(estimate.covariance_names)
        if estimate.covariance.shape != (size, size):
            raise ValueError("the covariance is not of the numbers")
        if estimate.continuous.A.shape != (len(estimate.continuous.states),) * 2:
            raise ValueError("the continuous plant is not of its states' size")
        for spec in estimate.plant.parameters:
            if spec.name not in estimate.numbers:
                raise ValueError(f"numbers.{spec.name} is missing")
            if spec.positive and not estimate.numbers[spec.name] > 0.0:
                raise ValueError(f"numbers.{spec.name} is not positive")
        for p in estimate.parameters:
            if p.name in estimate.numbers and p.value != estimate.numbers[p.name]:
                raise ValueError(f"parameters.{p.name} is not numbers.{p.name}")
        estimate.continuous.check_is_of(estimate.plant, estimate.numbers)
        if any(p.sd < 0 for p in estimate.parameters):
            raise EstimationError("a standard deviation is negative")
        return estimate

    return read_whole(read, where, "estimate", "identify")
