"""What is said of a closed loop by axis: sensitivity, margins, compliance, noise, checks; ``ambid.margins/1``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import DECIBEL, ClosedLoop, MeasuredSensitivity
from ambid.control.zones import LONG_TERM, STANDARD, ZONES, Zone
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.modes import EstimatedNumber
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.balance import Machine
from ambid.rotor.spectra import smoothed
from ambid.simulation.margins import OpenLoop

# What noise, forces and unbalance ask of voltage, current and position in a closed loop, beside their limits.
#
# A quantity that answers white noise of standard deviation s through G has the variance ∫ |G|² 2 s²/rate df. Its
# largest answer to a step of force is that of the running sum over the impulse response, the inverse DFT of G.
# Unbalance U turns with a force U W² at the speed W, run-out r adds to what sensors read.

QUANTITIES: Mapping[str, str] = {"voltage": "V", "current": "A", "position": "m"}
_SPARED = 3.0  # standard deviations of the noise that a limit is left for
_LINES = 2048  # of the first window in which the answer to a step is looked for
_WINDOWS = 5  # each twice as long
_SETTLED = 0.01
_SPEEDS = 60
_SPEED_BAND = (1e-3, 0.05)  # of the rate: speeds that are looked at where none is known
_ABOVE = 1.2  # of a speed that is known
_MISSING = (None, None, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What one quantity of an axis is asked for, SI."""

    rms: float | None  # by all noise; None: it is not known
    sensors: float | None  # by the noise of the sensors alone
    process: float | None  # by the noise of force and voltage alone
    step: float  # its largest answer to a step of 1 N at the magnet
    room: float | None  # between where it stands and the nearer limit; None: there is no limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """What an axis bears before voltage, current or position comes to its limit; 3 rms of the noise are left for it."""

    quantities: Mapping[str, Demand]
    force_step: float | None  # largest step of force at the magnet, N; None: without a limit
    force_limit: str | None  # the quantity that comes to its limit
    unbalance: float | None  # largest unbalance in the plane of the magnet, kg m
    unbalance_limit: str | None
    unbalance_hz: float | None  # where


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vibration:
    """Motion of the rotor at its sensors by the unbalance and run-out that the rig gives, over the speed."""

    frequency_hz: Array  # (n,), of rotation
    amplitude: Mapping[str, Array]  # of each position output, m
    runout: bool
    clearance: float | None  # between where the rotor stands and the nearer stop, m


def room_by_axis(
    loop: ClosedLoop, noise: Mapping[str, float] | None, room: Mapping[str, float | None], machine: Machine | None
) -> dict[str, Room]:
    """Return what each axis bears; `noise`: sd of disturbances, held over a sample, and of outputs' noise, by name;
    `room`: by role; `machine`: the rotor, where unbalance can be said of it.
    """
    rooms = {}
    answers, peaks = _answers(loop), _step_peaks(loop)
    for axis in loop.plant.axes:
        rows = quantity_rows(loop, axis)
        parts = {q: _noise(loop, answers[:, row], noise) for q, row in rows.items()}
        demands = {
            q: Demand(
                rms=parts[q][0], sensors=parts[q][1], process=parts[q][2], step=peaks[axis][q],
                room=room[role_of(loop, axis, q)],
            )
            for q, row in rows.items()
        }  # fmt: skip
        free = {q: max(d.room - _SPARED * (d.rms or 0.0), 0.0) for q, d in demands.items() if d.room is not None}
        steps = {q: x / demands[q].step for q, x in free.items()}
        force = min(steps, key=lambda q: steps[q]) if steps else None
        unbalance = _unbalance(loop, axis, free, machine) if free else _MISSING
        rooms[axis] = Room(
            quantities=demands, force_step=None if force is None else steps[force], force_limit=force,
            unbalance=unbalance[0], unbalance_limit=unbalance[1], unbalance_hz=unbalance[2],
        )  # fmt: skip
    return rooms


def quantity_rows(loop: ClosedLoop, axis: str) -> dict[str, int]:
    """Return where an axis' input, current and position at the magnet stand: inputs, then `ClosedLoop.motions`."""
    plant_model, n_u = loop.plant.model, len(loop.plant.model.inputs)
    before = f"{axis}_" if isinstance(plant_model, RotorModel) else ""
    rows = {}
    for kind in ("voltage", "current"):
        if f"{before}{kind}" in plant_model.inputs:
            rows[kind] = plant_model.inputs.index(f"{before}{kind}")
        elif f"{before}{kind}" in plant_model.outputs:
            rows[kind] = n_u + plant_model.outputs.index(f"{before}{kind}")
    return {**rows, "position": n_u + len(plant_model.outputs) + loop.plant.axes.index(axis)}


def role_of(loop: ClosedLoop, axis: str, quantity: str) -> str:
    """Return the role of a quantity of an axis."""
    return f"{axis}_{quantity}" if isinstance(loop.plant.model, RotorModel) else quantity


def _answers(loop: ClosedLoop) -> Complex:
    """Return what inputs, outputs and magnets do by the causes of `ClosedLoop.answers`."""
    return np.concatenate([loop.answers, loop.motions], axis=1)


def _noise(
    loop: ClosedLoop, through: Complex, noise: Mapping[str, float] | None
) -> tuple[float | None, float | None, float | None]:
    """Return the rms of a quantity by all noise, by that of the sensors, and by that of the process."""
    if noise is None:
        return _MISSING
    plant_model, f = loop.plant.model, loop.frequency_hz
    n_d, n_y = len(plant_model.disturbances), len(plant_model.outputs)
    names = {
        **dict(enumerate(plant_model.disturbances)),
        **dict(enumerate(plant_model.outputs, through.shape[1] - n_y)),
    }
    power = {}
    for k, name in names.items():
        size = np.abs(through[:, k]) ** 2 * 2.0 * noise.get(name, 0.0) ** 2 / loop.plant.rate_hz
        power[k] = float(np.trapezoid(size, f))
    process = sum(x for k, x in power.items() if k < n_d)
    sensors = sum(x for k, x in power.items() if k >= n_d)
    return float(np.sqrt(process + sensors)), float(np.sqrt(sensors)), float(np.sqrt(process))


def _step_peaks(loop: ClosedLoop) -> dict[str, dict[str, float]]:
    """Return the largest answer of each quantity of each axis to a step of 1 N at its magnet."""
    axes = loop.plant.axes
    at = [(axis, q, row, j) for j, axis in enumerate(axes) for q, row in quantity_rows(loop, axis).items()]
    rows, causes = [row for _, _, row, _ in at], [j for *_, j in at]
    before = np.zeros(len(at))
    for k in range(_WINDOWS):
        f = np.linspace(0.0, 0.5, _LINES * 2**k + 1) * loop.plant.rate_hz
        f[0] = 1e-3 * f[1]  # at rest an integrator of the controller is infinite
        impulse = np.fft.irfft(_answers(loop.at(f))[:, rows, causes], axis=0)
        peaks = np.max(np.abs(np.cumsum(impulse, axis=0)), axis=0)
        if np.all(np.abs(peaks - before) <= _SETTLED * peaks):
            break
        before = peaks
    return {axis: {q: float(peaks[m]) for m, (a, q, *_) in enumerate(at) if a == axis} for axis in axes}


def _unbalance(
    loop: ClosedLoop, axis: str, free: Mapping[str, float], machine: Machine | None
) -> tuple[float | None, str | None, float | None]:
    """Return the largest unbalance in the plane of an axis' magnet, the quantity at its limit, and where in Hz."""
    plant_model, f = loop.plant.model, speeds_of(loop)
    rows = quantity_rows(loop, axis)
    if isinstance(plant_model, RotorModel):
        bearing, plane = plant_model.placed[plant_model.axes.index(axis)]
        if machine is None or plane == 2:
            return _MISSING
        n_u = len(plant_model.inputs)
        answer = synchronous(loop, machine, f, machine.shape(f"{bearing.name}.z")[:, None], None)[:, :, 0]
        rows["position"] = n_u + loop.plant.sensors[plant_model.axes.index(axis)][0]
    else:
        at = loop.at(f)
        answer = _answers(at)[:, :, len(plant_model.disturbances)] * (2.0 * np.pi * f[:, None]) ** 2
    most = {q: x / np.abs(answer[:, rows[q]]) for q, x in free.items()}
    first = min(most, key=lambda q: float(np.min(most[q])))
    k = int(np.argmin(most[first]))
    return float(most[first][k]), first, float(f[k])


def speeds_of(loop: ClosedLoop) -> Array:
    """Return speeds of rotation in Hz: up to somewhat above that of the model, else where rotors may turn."""
    plant_model = loop.plant.model
    speed = abs(plant_model.speed) / (2.0 * np.pi) if isinstance(plant_model, RotorModel) else 0.0
    if speed:
        return np.linspace(_ABOVE / _SPEEDS, _ABOVE, _SPEEDS) * speed
    return np.geomspace(*_SPEED_BAND, _SPEEDS) * loop.plant.rate_hz


def synchronous(
    loop: ClosedLoop, machine: Machine, frequency_hz: Array, unbalance: Array, runout: Complex | None
) -> Complex:
    """Return inputs and outputs' motion of a rotor over its speed, (n, n_u + n_y, columns), by `unbalance` in a plane
    of motion's coordinates, kg m times shape, and `runout` (n_y, columns), m.
    """
    K, rate = loop.at(frequency_hz).K, loop.plant.rate_hz
    motions = []
    for f, k in zip(frequency_hz, K, strict=True):
        omega = 2.0 * np.pi * float(f)
        pushed = machine.forced(omega, unbalance)
        H = machine.transfer(np.array([omega]), omega, rate)[0]
        read = 0.0 if runout is None else runout
        y = np.linalg.solve(np.eye(H.shape[0]) + H @ k, pushed + read)
        motions.append(np.vstack([-k @ y, y - read]))
    return np.array(motions)


SCHEMA = "ambid.margins/1"
_KEPT = 500  # frequencies of the curves that a result keeps, beside those of the peaks
MISFIT = 0.01
"""Residual of an identified controller over the inputs, up to which it is taken."""
_FAR = 8.0  # mean square of measured less predicted sensitivity, over its scatter, in its standard deviations
_NEAR = 0.03  # rms of that difference that is passed whatever the scatter
_STANDARD: Mapping[str, object] = MappingProxyType(
    {
        "edition": STANDARD, "limits_db": [round(float(20.0 * np.log10(x)), 2) for x, _ in ZONES],
        "note": "check these limits against the text of the standard",
    }
)  # fmt: skip
_NONE: Mapping[str, Array] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisSensitivity:
    """Peak of the sensitivity of an axis at its position signal, all loops closed."""

    peak_db: EstimatedNumber
    frequency_hz: float
    zone: str  # of ISO 14839-3, of the measured peak where there is one: "A"; "A or B" where its interval holds a limit
    measured_peak_db: float | None  # from the record alone, at its excited lines; None where it has no excitation
    measured_frequency_hz: float | None = None
    measured_sd_db: float | None = None
    # where T = 1 - S last falls through 1/sqrt(2): up to there the rotor follows its set point; None: it never does
    bandwidth_hz: float | None = None
    zone_probability: Mapping[str, float] | None = None  # of each zone; None: how well the peak is known is not known
    zone_from: Literal["measured", "predicted"] = "predicted"  # the peak that the zone is of

    @property
    def rating(self) -> Zone:
        """The zone with the peak that counts."""
        return Zone.of((self.peak_db.value, self.peak_db.sd), self.measured)

    @property
    def measured(self) -> tuple[float, float] | None:
        """The measured peak and its sd, dB."""
        return None if self.measured_peak_db is None else (self.measured_peak_db, self.measured_sd_db or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Disk:
    """Disk margin of skew 0: gain and phase may change at once by any factor (1 + d)/(1 - d), |d| < size/2, no more.

    size = 2 / max |S - T|; from 2 on any gain above gain_down is borne (Seiler, Packard and Gahinet 2020, sec. 3).
    """

    size: float
    frequency_hz: float
    gain_down: float
    gain_up: float | None  # None: no limit
    phase_deg: float

    @classmethod
    def of(cls, S: Complex, frequency_hz: Array) -> Disk:
        """Return the disk margin of a sensitivity, (n,), or a lower bound of that of all loops at once, (n, m, m)."""
        off = np.abs(2.0 * S - 1.0) if S.ndim == 1 else np.linalg.norm(2.0 * S - np.eye(S.shape[1]), ord=2, axis=(1, 2))
        k = int(np.argmax(off))
        size = 2.0 / float(off[k])
        return cls(
            size=size, frequency_hz=float(frequency_hz[k]), gain_down=max((2.0 - size) / (2.0 + size), 0.0),
            gain_up=(2.0 + size) / (2.0 - size) if size < 2.0 else None,
            phase_deg=float(np.degrees(2.0 * np.arctan(size / 2.0))),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """Margins of the loop of one axis, opened at one signal while the others stay closed."""

    gain_down: float | None  # factors on the gain at which it becomes unstable; None: at none
    gain_up: float | None
    phase_deg: float | None
    delay_s: float | None  # further delay at which it becomes unstable
    peak_db: float  # of the sensitivity there
    disk: Disk | None = None

    @classmethod
    def of(cls, S: Complex, frequency_hz: Array) -> Opening:
        """Return the margins of a loop by its sensitivity where it is opened."""
        loop = OpenLoop(frequency_hz=frequency_hz, open_loop=1.0 / S - 1.0)
        down, up = loop.gain_between
        return cls(
            gain_down=down, gain_up=up, phase_deg=loop.phase_deg, delay_s=loop.delay_s,
            peak_db=float(20.0 * np.log10(loop.peak[0])), disk=Disk.of(S, frequency_hz),
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
    # dynamic: real part of 1/compliance, N/m, and its imaginary part over the angular frequency, N s/m
    stiffness: Mapping[str, Array] = field(default_factory=lambda: _NONE)
    damping: Mapping[str, Array] = field(default_factory=lambda: _NONE)


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
    disk : Disk or None
        A lower bound of the disk margin of all position signals at once, from the largest singular value of S - T.
    compliance : Mapping[str, Compliance]
    checks : Mapping[str, Check]
    room : Mapping[str, Room]
        By axis: noise in voltage, current and position, and the forces and unbalance that come to a limit.
    noise : {"rig", "estimate"} or None
        Whose noise that is; None: it is not known.
    vibration : Vibration or None
        By the unbalance and run-out that the rig gives, over the speed.
    curves : Curves
    standard : Mapping[str, object]
        ``edition`` of ISO 14839-3, its ``limits_db`` between the zones, and a ``note`` to check them against its text.
    of : {"record", "estimate"}
        What was looked at: a record, or an estimate alone.
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
    standard: Mapping[str, object] = field(default_factory=lambda: _STANDARD)
    of: Literal["record", "estimate"] = "record"
    disk: Disk | None = None
    room: Mapping[str, Room] = field(default_factory=lambda: MappingProxyType({}))
    noise: Literal["rig", "estimate"] | None = None
    vibration: Vibration | None = None
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))


def sensitivity_by_axis(
    loop: ClosedLoop, measured: Sequence[MeasuredSensitivity | None] = ()
) -> dict[str, AxisSensitivity]:
    """Return the peak of the sensitivity of each axis."""
    result: dict[str, AxisSensitivity] = {}
    measured = measured or (None,) * len(loop.plant.axes)
    for axis, peak, S, of_record in zip(loop.plant.axes, loop.peaks(), loop.of_axes.T, measured, strict=True):
        top = None if of_record is None else of_record.peak
        pair = None if top is None else (float(20.0 * np.log10(top[0])), float(DECIBEL * top[2] / top[0]))
        zone = Zone.of((peak.decibel, peak.sd_db), pair)
        result[axis] = AxisSensitivity(
            peak_db=EstimatedNumber.of(peak.decibel, peak.sd_db, size=1.0), frequency_hz=peak.frequency_hz,
            zone=zone.letters, zone_probability=zone.probability, zone_from=zone.source,
            measured_peak_db=None if pair is None else pair[0], measured_frequency_hz=None if top is None else top[1],
            measured_sd_db=None if pair is None else pair[1], bandwidth_hz=_bandwidth(loop.frequency_hz, S),
        )  # fmt: skip
    return result


def _bandwidth(frequency_hz: Array, S: Complex) -> float | None:
    """Return where T = 1 - S last falls through 1/sqrt(2) (Skogestad and Postlethwaite 2005, sec. 2.4.5)."""
    size = np.abs(1.0 - S)
    k = np.flatnonzero((size[:-1] > np.sqrt(0.5)) & (size[1:] <= np.sqrt(0.5)))
    return float(frequency_hz[k[-1]]) if k.size else None


def margins_by_axis(loop: ClosedLoop) -> dict[str, AxisMargins]:
    """Return the margins of each axis, its loop opened alone."""
    f = loop.frequency_hz
    return {
        axis: AxisMargins(position=Opening.of(loop.of_axes[:, j], f), command=Opening.of(loop.at_commands[:, j], f))
        for j, axis in enumerate(loop.plant.axes)
    }


def compliance_by_axis(loop: ClosedLoop) -> dict[str, Compliance]:
    """Return the largest compliance of each axis."""
    size = np.abs(loop.compliance)
    return {
        axis: Compliance(largest=float(size[k, j]), frequency_hz=float(loop.frequency_hz[k]))
        for j, (axis, k) in enumerate(zip(loop.plant.axes, np.argmax(size, axis=0), strict=True))
    }


def curves_of(loop: ClosedLoop, measured: Sequence[MeasuredSensitivity | None]) -> Curves:
    """Return the curves of a loop, thinned between their peaks."""
    f, axes, S, G = loop.frequency_hz, loop.plant.axes, loop.of_axes, loop.compliance
    even = loop.shown[np.linspace(0, loop.shown.size - 1, _KEPT).round().astype(int)]
    near = [k for x in (S, G) for k in np.argmax(np.abs(x), axis=0)]
    places = np.unique(np.clip(np.concatenate([even, *(np.arange(k - 3, k + 4) for k in near)]), 0, f.size - 1))
    stiff = 1.0 / G[places]
    damping = stiff.imag / (2.0 * np.pi * f[places, None])
    return Curves(
        frequency_hz=f[places],
        sensitivity={axis: S[places, j] for j, axis in enumerate(axes)},
        compliance={axis: np.abs(G[places, j]) for j, axis in enumerate(axes)},
        measured={axis: m for axis, m in zip(axes, measured, strict=True) if m is not None},
        stiffness={axis: stiff[:, j].real for j, axis in enumerate(axes)},
        damping={axis: damping[:, j] for j, axis in enumerate(axes)},
    )


def checks_of(
    loop: ClosedLoop,
    sensitivity: Mapping[str, AxisSensitivity],
    measured: Sequence[MeasuredSensitivity | None],
    band_hz: tuple[float, float] | None,
) -> dict[str, Check]:
    """Judge the controller, the model against the measured sensitivity, the band, and the zone."""
    checks = {"controller": _controller(loop)}
    pairs = [(j, m) for j, m in enumerate(measured) if m is not None and np.all(m.sd > 0.0)]
    if pairs:
        checks["agreement"] = _agreement(loop, pairs)
    if band_hz is not None:
        checks["band"] = _band(sensitivity, band_hz)
    checks["zone"] = _zone(sensitivity)
    return checks


def _controller(loop: ClosedLoop) -> Check:
    """Judge whether a linear controller makes the inputs of the record."""
    controller = loop.controller
    if controller.source == "rig":
        return Check(passed=True, detail="the controller is the rig's [loop]")
    return Check(
        passed=controller.misfit <= MISFIT, values={"misfit": controller.misfit},
        detail=f"a controller of order {max(controller.orders)} makes the inputs of the record but for "
        f"{controller.misfit:.1g} of them",
    )  # fmt: skip


def _agreement(loop: ClosedLoop, pairs: Sequence[tuple[int, MeasuredSensitivity]]) -> Check:
    """Judge the predicted sensitivity by the measured one, line by line."""
    worst, where, size = 0.0, "", 0.0
    for j, m in pairs:
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


def _band(sensitivity: Mapping[str, AxisSensitivity], band_hz: tuple[float, float]) -> Check:
    """Judge whether the peaks lie where the record is excited."""
    outside = [a for a, x in sensitivity.items() if not band_hz[0] <= x.frequency_hz <= band_hz[1]]
    band = f"{band_hz[0]:.4g} to {band_hz[1]:.4g} Hz"
    return Check(
        passed=not outside, values={"low_hz": band_hz[0], "high_hz": band_hz[1]},
        detail=f"the peaks lie in the excited band, {band}" if not outside else
        f"the peak of {', '.join(outside)} lies outside the excited band, {band}, where the model is not tested. "
        "Excite there",
    )  # fmt: skip


def _zone(sensitivity: Mapping[str, AxisSensitivity]) -> Check:
    """Judge the upper ends of the peaks' 95 % intervals by ISO 14839-3."""
    axis, s = max(sensitivity.items(), key=lambda x: x[1].rating.upper_db)
    zone = s.rating
    hz = s.measured_frequency_hz if zone.source == "measured" else s.frequency_hz
    peak = f"{zone.value:.1f} dB at {hz:.3g} Hz (axis {axis}, {zone.source}), zone {zone.words}"
    good, doubt = zone.worst in LONG_TERM, " is not ruled out" * (zone.letters[0] in LONG_TERM)
    return Check(
        passed=good, values={"peak_db": zone.value, "upper_db": zone.upper_db},
        detail=f"largest sensitivity {peak} of ISO 14839-3" if good else
        f"the largest sensitivity is {peak} of ISO 14839-3 (up to {zone.upper_db:.1f} dB): too little margin for "
        f"unrestricted operation{doubt}. Add damping around that frequency",
    )  # fmt: skip
