"""What is said of a closed loop by axis: sensitivity, margins, compliance, checks; file schema ``ambid.margins/1``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop
from ambid.control.measured import MeasuredSensitivity
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.modes import EstimatedNumber
from ambid.rotor.spectra import smoothed
from ambid.simulation.margins import OpenLoop, zone_of

SCHEMA = "ambid.margins/1"
_KEPT = 500  # frequencies of the curves that a result keeps, beside those of the peaks
MISFIT = 0.01
"""Residual of an identified controller over the inputs, up to which it is taken."""
_FAR = 8.0  # mean square of measured less predicted sensitivity, over its scatter, in its standard deviations
_NEAR = 0.03  # rms of that difference that is passed whatever the scatter
_LONG_TERM = "AB"  # zones of ISO 14839-3 for unrestricted operation


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisSensitivity:
    """Peak of the sensitivity of an axis at its position signal, all loops closed."""

    peak_db: EstimatedNumber
    frequency_hz: float
    zone: str  # of ISO 14839-3
    measured_peak_db: float | None  # from the record alone, at its excited lines; None where it has no excitation
    measured_frequency_hz: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """Margins of the loop of one axis, opened at one signal while the others stay closed."""

    gain_down: float | None  # factors on the gain at which it becomes unstable; None: at none
    gain_up: float | None
    phase_deg: float | None
    delay_s: float | None  # further delay at which it becomes unstable
    peak_db: float  # of the sensitivity there

    @classmethod
    def of(cls, loop: OpenLoop) -> Opening:
        """Return the margins of an opened loop."""
        down, up = loop.gain_between
        return cls(
            gain_down=down, gain_up=up, phase_deg=loop.phase_deg, delay_s=loop.delay_s,
            peak_db=float(20.0 * np.log10(loop.peak[0])),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisMargins:
    """Margins of one axis."""

    position: Opening  # opened at the position signal, other loops and its current loop closed
    command: Opening  # opened at the input, where all that the controller orders passes


@dataclass(frozen=True, slots=True, kw_only=True)
class Compliance:
    """Displacement at the magnet of an axis by a force there, the loop closed."""

    largest: float  # m/N; its inverse is the least dynamic stiffness
    frequency_hz: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curves:
    """What is drawn, by axis."""

    frequency_hz: Array  # (n,)
    sensitivity: Mapping[str, Complex]  # S at the position signal, (n,)
    compliance: Mapping[str, Array]  # modulus, (n,), m/N
    measured: Mapping[str, MeasuredSensitivity]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Margins(Judged):
    """A closed loop as it is.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
        Of the estimate that the plant comes from.
    model : str
    record : Mapping[str, object]
    controller : Mapping[str, object]
        ``source`` ("record" or "rig"), ``order`` of each axis, ``misfit``: residual over the inputs.
    speed : float
        rad/s.
    sensitivity : Mapping[str, AxisSensitivity]
        By axis ("x" of one axis), in dB.
    largest_singular : Mapping[str, object]
        ``peak_db``, ``frequency_hz`` and ``zone`` of the largest singular value of the sensitivity of all axes.
    margins : Mapping[str, AxisMargins]
    compliance : Mapping[str, Compliance]
    checks : Mapping[str, Check]
    curves : Curves
    warnings : tuple of str
    timing_s : Mapping[str, float]
    rig : Mapping[str, object]
    """

    status: Literal["converged", "stalled", "failed"]
    model: str
    record: Mapping[str, object]
    controller: Mapping[str, object]
    speed: float
    sensitivity: Mapping[str, AxisSensitivity]
    largest_singular: Mapping[str, object]
    margins: Mapping[str, AxisMargins]
    compliance: Mapping[str, Compliance]
    checks: Mapping[str, Check]
    curves: Curves
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))


def sensitivity_by_axis(
    loop: ClosedLoop, measured: Sequence[MeasuredSensitivity | None] = ()
) -> dict[str, AxisSensitivity]:
    """Return the peak of the sensitivity of each axis."""
    found: dict[str, AxisSensitivity] = {}
    for axis, peak, seen in zip(loop.plant.axes, loop.peaks(), measured or (None,) * len(loop.plant.axes), strict=True):
        top = None if seen is None else seen.peak
        found[axis] = AxisSensitivity(
            peak_db=EstimatedNumber.of(peak.decibel, peak.sd_db, size=1.0), frequency_hz=peak.frequency_hz,
            zone=zone_of(peak.ratio), measured_peak_db=None if top is None else float(20.0 * np.log10(top[0])),
            measured_frequency_hz=None if top is None else top[1],
        )  # fmt: skip
    return found


def margins_by_axis(loop: ClosedLoop) -> dict[str, AxisMargins]:
    """Return the margins of each axis, its loop opened alone."""

    def opened(S: Complex) -> Opening:
        return Opening.of(OpenLoop(frequency_hz=loop.frequency_hz, open_loop=1.0 / S - 1.0))

    return {
        axis: AxisMargins(position=opened(loop.of_axes[:, j]), command=opened(loop.at_commands[:, j]))
        for j, axis in enumerate(loop.plant.axes)
    }


def compliance_by_axis(loop: ClosedLoop) -> tuple[dict[str, Compliance], dict[str, Array]]:
    """Return the largest compliance of each axis, and its modulus over frequency."""
    size = dict(zip(loop.plant.axes, np.abs(loop.compliance()).T, strict=True))
    worst = {axis: int(np.argmax(x)) for axis, x in size.items()}
    return {
        axis: Compliance(largest=float(size[axis][k]), frequency_hz=float(loop.frequency_hz[k]))
        for axis, k in worst.items()
    }, size


def curves_of(
    loop: ClosedLoop, compliance: Mapping[str, Array], measured: Sequence[MeasuredSensitivity | None]
) -> Curves:
    """Return the curves of a loop, thinned between their peaks."""
    size, axes = np.abs(loop.of_axes), loop.plant.axes
    even = np.linspace(0, loop.frequency_hz.size - 1, _KEPT).round().astype(int)
    near = [k for x in (size.T, *([np.array(list(compliance.values()))])) for k in np.argmax(x, axis=1)]
    kept = np.unique(np.concatenate([even, *(np.arange(k - 3, k + 4) for k in near)]))
    kept = kept[(kept >= 0) & (kept < loop.frequency_hz.size)]
    return Curves(
        frequency_hz=loop.frequency_hz[kept],
        sensitivity={axis: loop.of_axes[kept, j] for j, axis in enumerate(axes)},
        compliance={axis: x[kept] for axis, x in compliance.items()},
        measured={axis: m for axis, m in zip(axes, measured, strict=True) if m is not None},
    )


def checks_of(
    loop: ClosedLoop,
    found: Mapping[str, AxisSensitivity],
    measured: Sequence[MeasuredSensitivity | None],
    band_hz: tuple[float, float] | None,
) -> dict[str, Check]:
    """Judge the controller, the model against the measured sensitivity, the band, and the zone."""
    checks = {"controller": _controller(loop)}
    seen = [(j, m) for j, m in enumerate(measured) if m is not None and np.all(m.sd > 0.0)]
    if seen:
        checks["agreement"] = _agreement(loop, seen)
    if band_hz is not None:
        checks["band"] = _band(found, band_hz)
    checks["zone"] = _zone(found)
    return checks


def _controller(loop: ClosedLoop) -> Check:
    """Judge whether a linear controller makes the inputs of the record."""
    of = loop.controller
    if of.source == "rig":
        return Check(passed=True, detail="the controller is the rig's [loop]")
    return Check(
        passed=of.misfit <= MISFIT, values={"misfit": of.misfit},
        detail=f"a controller of order {max(of.orders)} makes the inputs of the record but for {of.misfit:.1g} of them",
    )  # fmt: skip


def _agreement(loop: ClosedLoop, seen: Sequence[tuple[int, MeasuredSensitivity]]) -> Check:
    """Judge the predicted sensitivity by the measured one, line by line."""
    worst, where, size = 0.0, "", 0.0
    for j, m in seen:
        left = m.ratio - np.abs(loop.at(m.frequency_hz).of_axes[:, j])
        ratio = float(np.mean(left**2 / smoothed(m.sd[:, None] ** 2)[:, 0]))
        far = (ratio - 1.0) / np.sqrt(2.0 / left.size)
        if far >= worst:
            worst, where, size = float(far), loop.plant.axes[j], float(np.sqrt(np.mean(left**2)))
    good = size < _NEAR or worst < _FAR
    return Check(
        passed=good, values={"z": worst, "rms": size},
        detail="the sensitivity as measured agrees with that of plant and controller" if good else
        f"the measured sensitivity of axis {where} differs from that of plant and controller by {size:.2g} rms, more "
        "than its scatter: the plant is not that of this record. Identify it from this record",
    )  # fmt: skip


def _band(found: Mapping[str, AxisSensitivity], band_hz: tuple[float, float]) -> Check:
    """Judge whether the peaks lie where the record is excited."""
    outside = [a for a, x in found.items() if not band_hz[0] <= x.frequency_hz <= band_hz[1]]
    band = f"{band_hz[0]:.4g} to {band_hz[1]:.4g} Hz"
    return Check(
        passed=not outside, values={"low_hz": band_hz[0], "high_hz": band_hz[1]},
        detail=f"the peaks lie in the excited band, {band}" if not outside else
        f"the peak of {', '.join(outside)} lies outside the excited band, {band}, where the model is not tested. "
        "Excite there",
    )  # fmt: skip


def _zone(found: Mapping[str, AxisSensitivity]) -> Check:
    """Judge the peaks by ISO 14839-3."""
    axis, worst = max(found.items(), key=lambda x: x[1].peak_db.value)
    peak = f"{worst.peak_db.value:.1f} dB at {worst.frequency_hz:.3g} Hz (axis {axis}), zone {worst.zone}"
    good = worst.zone in _LONG_TERM
    return Check(
        passed=good, values={"peak_db": worst.peak_db.value},
        detail=f"largest sensitivity {peak} of ISO 14839-3" if good else
        f"the largest sensitivity is {peak} of ISO 14839-3: the loop has too little margin for unrestricted operation. "
        "Add damping around that frequency",
    )  # fmt: skip
