"""The rig: what is known of a bench before its records are looked at; and its file, in SI units, as it is written."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from ambid.errors import RigError, nearest
from ambid.physics.law import StateLaw
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.physics.loop import UNLIMITED, Interval, Limits, Loop, Noise
from ambid.physics.presets import Turning
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import Shaft
from ambid.record.calibration import Calibration
from ambid.record.sampling import GapPolicy
from ambid.rig.rotor import RigModes, shaft_lines
from ambid.settings.caller import setting

TRIP_SHARE = 0.9
"""Share of ``loop.limits.position`` in which the controller holds the rotor, unless ``[daq.trip]`` says otherwise."""

DAQ_RATE_HZ = 2000.0
"""Rate of a controller where neither ``[daq]`` nor ``[record]`` gives one, Hz."""

OPTIONAL_ROLES: Mapping[str, str] = MappingProxyType({"reference": "m", "speed": "rad/s", "angle": "rad"})
"""Roles that every model may have beside its own, with their units: set point, speed and angle of a turning rotor."""
_TURNING_ROLES = {role: OPTIONAL_ROLES[role] for role in ("speed", "angle")}
_EMPTY: Mapping[str, float] = MappingProxyType({})
_NOTE = "  # one number a mode, modal mass 1 kg"


@dataclass(frozen=True, slots=True, kw_only=True)
class RigChannel:
    """Where a role of the model is found in a record.

    Attributes
    ----------
    role : str
        Input or output of the model (``voltage``, ``current``, ``position``), or one that every model may have:
        ``reference``, ``speed`` (rad/s) and ``angle`` (rad) of a turning rotor.
    column : str
        Column of the record.
    unit : str or None
        Unit of that column, where it overrides the header's.
    calibration : Calibration or None
        From the column's SI unit to the role's; None if the column is the role already.
    delay : int or "auto"
        Samples by which an input acts later than logged (``"auto"``: the identification finds it), or by which
        another channel is logged later than the rest.
    variable : str or None
        Variable of a ``.mat`` file that holds the column; None: it is called like the column.
    sensors : tuple of RigChannel
        Two or more columns that are made into this one, where several sensors look at one position.
    gain_sd, offset_sd : float or None
        How well its calibration is known: standard deviations of the gain, relative, and of the offset in the role's
        SI unit; None: nothing is said of it.
    """

    role: str
    column: str
    unit: str | None = None
    calibration: Calibration | None = None
    delay: int | Literal["auto"] = 0
    variable: str | None = None
    sensors: tuple[RigChannel, ...] = ()
    gain_sd: float | None = None
    offset_sd: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordSettings:
    """How records of the bench are read.

    Attributes
    ----------
    rate_hz : float or None
        Sampling rate in Hz for records without time.
    rate_sd : float or None
        Relative standard deviation of the sampling rate, of records with time too; None: nothing is said of it.
    gaps : {"error", "interpolate", "cut"} or None
        What to do about gaps; None: refuse them.
    from_s, to_s : float or None
        Which part of a record is used, s.
    time : (variable, unit) or None
        Time variable of a ``.mat`` file.
    layout : Mapping of str to str
        What files leave open, as `ambid.record.read_record` takes it.
    """

    rate_hz: float | None = None
    rate_sd: float | None = None
    gaps: GapPolicy | None = None
    from_s: float | None = None
    to_s: float | None = None
    time: tuple[str, str] | None = None
    layout: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Daq:
    """How the controller of a bench samples, drives and protects.

    Attributes
    ----------
    rate_hz : float
        Ticks of the control loop in one second, each with one sample.
    baud : int
        Of the serial line, bit/s.
    duty : (int, int) or None
        Least and largest pulse width, counts; None: what keeps the voltage inside ``loop.limits.voltage``.
    duty_off : int or None
        Pulse width of the safe state, counts; None: the count nearest to 0 V.
    host_ms : int
        Longest silence of the host while the output is on, ms.
    lift_ms : int
        Time after the start of levitation in which the rotor may still lie outside its gap, ms.
    third : str or None
        Column of the third analog input; None: it is not sampled.
    bench : str or None
        Plant that an emulated or simulated controller stands before: a preset, or a rig file (path relative to this
        one); None: the rig's own parameters.
    position_trip, current_trip : (float, float) or None
        Where the controller goes to its safe state, m and A; None: see :meth:`Rig.trip`.
    """

    rate_hz: float = DAQ_RATE_HZ
    baud: int = 1_000_000
    duty: tuple[int, int] | None = None
    duty_off: int | None = None
    host_ms: int = 250
    lift_ms: int = 300
    third: str | None = None
    bench: str | None = None
    position_trip: Interval | None = None
    current_trip: Interval | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RigMagnet:
    """What is known of the law of a magnet (`ambid.physics.coenergy_law`), for nonlinear identification.

    Attributes
    ----------
    kind : {"auto", "single", "pair"}
        One magnet or two that oppose each other; "auto": a pair where the current changes its sign.
    gap : {"hyperbolic", "exponential"} or None
        Gap law of one magnet; None: the records decide.
    asymmetric : bool or None
        Whether the magnets of a pair may differ in strength and bias (k_asym, i0_asym); None: the records decide.
    saturation : bool or None
        Whether the iron may saturate (sigma); None: the records decide.
    rise : bool or None
        Whether the leakage inductance may rise with the current; None: the records decide.
    eddy, drift : bool
        Whether the force has a pole a/(s + a), and whether a slowly walking force takes up what the law leaves over.
    off_below : float or None
        Voltage in V at or below which the power stage is off, so that the coil's voltage is not known.
    cone : float
        Of a rotor: angle of its pole faces to the shaft in rad, by which radial magnets act on the axial axis too.
    parameters : tuple of Parameter
        Numbers of which something is known, SI; a number that is absent takes its default role.
    """

    kind: Literal["auto", "single", "pair"] = "auto"
    gap: Literal["hyperbolic", "exponential"] | None = None
    asymmetric: bool | None = None
    saturation: bool | None = None
    rise: bool | None = None
    eddy: bool = False
    drift: bool = False
    off_below: float | None = None
    cone: float = 0.0
    parameters: tuple[Parameter, ...] = ()

    def __post_init__(self) -> None:
        if self.asymmetric and self.kind != "pair":
            raise RigError(
                f"magnet.asymmetric is set; kind = {self.kind!r} is no pair. Remove it, or give kind = 'pair'"
            )
        if self.kind == "pair" and self.gap == "exponential":
            raise RigError("magnet.gap is 'exponential'; a pair has the hyperbolic law. Remove gap, or correct kind")
        excluded: Mapping[str, tuple[str, ...]] = {
            f"kind = {self.kind!r}": ("L_g", "zeta") if self.kind == "pair" else ("i0", "k_asym", "i0_asym"),
            f"gap = {self.gap!r}": ("k", "s") if self.gap == "exponential" else ("L_g", "zeta") if self.gap else (),
            "asymmetric = false": ("k_asym", "i0_asym") if self.asymmetric is False else (),
            "saturation = false": ("sigma",) if self.saturation is False else (),
            "rise = false": ("L_rise", "i_knee") if self.rise is False else (),
            "eddy = false": () if self.eddy else ("a",),
        }
        for p in self.parameters:
            for entry, names in excluded.items():
                if p.name in names:  # it would be passed over in silence
                    raise RigError(
                        f"magnet.parameters.{p.name} is given, but magnet.{entry} leaves it out. Remove one,"
                        " or correct it"
                    )

    def known(self, name: str) -> Parameter | None:
        """Return what is known of a number.

        Parameters
        ----------
        name : str
            Such as ``"L_leak"``.

        Returns
        -------
        Parameter or None
        """
        return next((p for p in self.parameters if p.name == name), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """A bench: model, channels and their calibration, parameters, loop, noise. All numbers SI.

    Attributes
    ----------
    name : str
        A line for reports.
    model : str
        Name of the model, one of :func:`ambid.physics.linear_model.model_names`.
    channels : tuple of RigChannel
        One per role: the model's inputs, then its outputs, then ``reference``, ``speed`` and ``angle`` where given.
    parameters : tuple of Parameter
        One per parameter of the model, in its order. Those that the file does not name are free, or fixed at the
        model's default where it has one.
    magnet : RigMagnet or None
        What is known of the nonlinear law of its magnet.
    rotor : RotorModel or None
        Bearings, axes, planes and speed of a rotor on many axes (``[bearings.X]``).
    plane_sd : Mapping[str, float]
        Standard deviations of where its bearings stand, m: ``A.z_sd`` of both planes of bearing A together,
        ``A.z_magnet_sd`` and ``A.z_sensor_sd`` of each beside that.
    modes : RigModes
        What is known of its bending modes.
    shaft : Shaft or None
        Its drawing, for expected modes, start values and simulation.
    unbalance, runout : tuple of Turning
        What turns with it, for simulation.
    operating_point : Mapping[str, float]
        Declared values of roles, SI; a role that is absent takes the mean of the record.
    loop : Loop or None
        Controller and delay, for simulation.
    limits : Limits or None
        Intervals in which the bench works, for simulation.
    noise : Noise or None
        Process and sensor noise, for simulation.
    record : RecordSettings
        How records are read.
    daq : Daq or None
        How its controller samples, drives and protects.
    open_loop : bool
        The user declares that records are taken without feedback.
    source : Path or None
        The file it came from.
    """

    name: str
    model: str
    channels: tuple[RigChannel, ...]
    parameters: tuple[Parameter, ...]
    magnet: RigMagnet | None = None
    rotor: RotorModel | None = None
    plane_sd: Mapping[str, float] = field(default_factory=lambda: _EMPTY)
    modes: RigModes = field(default_factory=RigModes)
    shaft: Shaft | None = None
    unbalance: tuple[Turning, ...] = ()
    runout: tuple[Turning, ...] = ()
    operating_point: Mapping[str, float] = field(default_factory=lambda: _EMPTY)
    loop: Loop | None = None
    limits: Limits | None = None
    noise: Noise | None = None
    record: RecordSettings = field(default_factory=RecordSettings)
    daq: Daq | None = None
    open_loop: bool = False
    source: Path | None = None

    @property
    def plant(self) -> LinearModel:
        """The linear model of the rig: the rotor of its bearings, or the one-axis model that it names."""
        return model(self.model) if self.rotor is None else self.rotor

    @property
    def rate_hz(self) -> float | None:
        """Sampling rate that the rig gives: of its records, else of the law of its loop, else of its controller."""
        law = None if self.loop is None else self.loop.law
        return next((x.rate_hz for x in (self.record, law, self.daq) if x is not None and x.rate_hz is not None), None)

    def rate_for(self, rate_hz: float | None) -> float:
        """Return the rate in Hz of a simulation: `rate_hz` where it is given, else the rig's own.

        Raises
        ------
        RigError
            If neither is given.
        """
        if (rate := self.rate_hz if rate_hz is None else rate_hz) is None:
            raise RigError(
                f"rig {self.source or self.name} gives no rate; a simulation needs one. Give "
                f"{setting('rate_hz', 'HZ')}, or "
                "record.rate_hz"
            )
        return rate

    def channel(self, role: str) -> RigChannel:
        """Return the channel of a role.

        Parameters
        ----------
        role : str
            Such as ``"voltage"``.

        Returns
        -------
        RigChannel
            The channel.

        Raises
        ------
        RigError
            If the rig has no such role.
        """
        for c in self.channels:
            if c.role == role:
                return c
        roles = [c.role for c in self.channels]
        raise RigError(f"the rig has no channel {role!r}; it has {', '.join(roles)}.{nearest(role, roles)}")

    def trip(self, role: Literal["position", "current"]) -> Interval:
        """Return the interval outside which the controller goes to its safe state.

        Parameters
        ----------
        role : {"position", "current"}
            Of which quantity.

        Returns
        -------
        (float, float)
            In m or A: as ``[daq.trip]`` gives it, else the middle 90 % of ``loop.limits.position`` or all of
            ``loop.limits.current``; infinite where the rig says nothing.
        """
        trip = (self.daq.position_trip if role == "position" else self.daq.current_trip) if self.daq else None
        if trip is not None:
            return trip
        low, high = UNLIMITED if self.limits is None else getattr(self.limits, role)
        if role == "current" or (low, high) == UNLIMITED:
            return low, high
        middle, half = (low + high) / 2.0, TRIP_SHARE * (high - low) / 2.0
        return middle - half, middle + half

    def parameter(self, name: str) -> Parameter:
        """Return the parameter called `name`.

        Parameters
        ----------
        name : str
            Such as ``"k_i"``.

        Returns
        -------
        Parameter
            In SI units.

        Raises
        ------
        RigError
            If the model has none of that name.
        """
        for p in self.parameters:
            if p.name == name:
                return p
        names = [p.name for p in self.parameters]
        raise RigError(
            f"model {self.model!r} has no parameter {name!r}; it has {', '.join(names)}.{nearest(name, names)}"
        )


def role_units(plant: LinearModel) -> dict[str, str]:
    """Return the roles that a rig of this model may name (inputs, outputs, `optional_roles`) with their SI units."""
    return {**{role: plant.units[role] for role in (*plant.inputs, *plant.outputs)}, **optional_roles(plant)}


def optional_roles(plant: LinearModel) -> Mapping[str, str]:
    """Return the roles that a rig of this model may leave out, with their SI units; ``"?"``: any unit."""
    return OPTIONAL_ROLES if not isinstance(plant, RotorModel) else {**_TURNING_ROLES, **plant.optional_roles}


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as TOML.

    Parameters
    ----------
    rig : Rig
        What to write.
    path : str or Path
        Overwritten if it exists. Calibration tables stay where they are and are named relative to this file.

    Raises
    ------
    RigError
        If the file cannot be written, or a calibration table has no file.
    """
    path = Path(path)
    text = rig_text(rig, path.parent)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as failure:
        raise RigError(f"rig {path} cannot be written: {failure.strerror or failure}. Check the folder") from None


def rig_text(rig: Rig, folder: Path) -> str:
    """Return the TOML text of a rig.

    Parameters
    ----------
    rig : Rig
        What to write.
    folder : Path
        Folder to which the paths of calibration tables are relative.

    Returns
    -------
    str
        A rig file, schema ``ambid.rig/1``.

    Raises
    ------
    RigError
        If a calibration table has no file.
    """
    lines = ['schema = "ambid.rig/1"', f"name = {toml_text(rig.name)}", f"model = {toml_text(rig.model)}"]
    lines += ["open_loop = true"] if rig.open_loop else []
    lines += [f'speed = {{ value = {rig.rotor.speed!r}, unit = "rad/s" }}'] if rig.rotor and rig.rotor.speed else []
    lines += _rotor_lines(rig) if rig.rotor else []
    inputs = rig.plant.inputs
    for c in rig.channels:
        lines += ["", *_channel_lines(c, folder, is_input=c.role in inputs)]
    planes = () if rig.rotor is None else rig.rotor.places
    lines += ["", "[parameters]", *(_parameter_line(p) for p in rig.parameters if p.name not in planes)]
    if rig.magnet is not None:
        lines += ["", *_magnet_lines(rig.magnet)]
    units = role_units(rig.plant)
    if rig.operating_point:
        lines += ["", "[operating_point]"]
        lines += [f'{role} = {{ value = {x!r}, unit = "{units[role]}" }}' for role, x in rig.operating_point.items()]
    if rig.loop or rig.limits:
        lines += ["", *_loop_lines(rig.loop or Loop(), rig.limits)]
    if rig.noise:
        lines += ["", *_noise_lines(rig.noise)]
    if rig.record != RecordSettings():
        lines += ["", *_record_lines(rig.record)]
    if rig.daq:
        lines += ["", *_daq_lines(rig.daq)]
    return "\n".join(lines) + "\n"


def toml_text(text: str) -> str:
    """Quote a text for TOML.

    `text`: any text. Returns a TOML basic string.
    """
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _channel_lines(c: RigChannel, folder: Path, *, is_input: bool) -> list[str]:
    lines = [f"[channels.{c.role}]", f"column = {toml_text(c.column)}"]
    lines += [f"variable = {toml_text(c.variable)}"] if c.variable else []
    lines += [f"unit = {toml_text(c.unit)}"] if c.unit else []
    lines += _calibration_lines(c.calibration, c.role, folder) if c.calibration else []
    if is_input or c.delay:
        lines.append('delay = "auto"' if c.delay == "auto" else f"delay = {c.delay}")
    lines += [f"{key} = {x!r}" for key in ("gain_sd", "offset_sd") if (x := getattr(c, key)) is not None]
    for sensor in c.sensors:
        _, *entries = _channel_lines(sensor, folder, is_input=False)
        lines += ["", f"[[channels.{c.role}.sensors]]", *entries]
    return lines


def _calibration_lines(calibration: Calibration, role: str, folder: Path) -> list[str]:
    if calibration.raw is None:
        gain = [] if calibration.unit_in == calibration.unit_out else [f"gain = {calibration.gain!r}"]
        return [*gain, f"offset = {calibration.offset!r}"]
    if not calibration.source:
        raise RigError(f"channels.{role} has a calibration table without a file; a rig file names one. Write it as CSV")
    table = os.path.relpath(Path(calibration.source).resolve(), folder.resolve())
    return [
        f"table = {toml_text(Path(table).as_posix())}",
        *(["extrapolate = true"] if calibration.extrapolate else []),
    ]


def _parameter_line(p: Parameter) -> str:
    entries = [f"value = {p.value!r}"] if p.value is not None else []
    entries += [f'unit = "{p.unit}"', f'role = "{p.role}"']
    entries += [f"sd = {p.sd!r}"] if p.sd is not None else []
    return f"{toml_text(p.name) if '.' in p.name else p.name} = {{ {', '.join(entries)} }}"


def _rotor_lines(rig: Rig) -> list[str]:
    assert rig.rotor is not None
    lines: list[str] = []

    def plane(name: str) -> str:
        return _parameter_line(replace(rig.parameter(name), name="x")).removeprefix("x = ")

    for b in rig.rotor.bearings:
        lines += ["", f"[bearings.{b.name}]", f"axes = {json.dumps(list(b.axes))}"]
        lines += [f"runout = {_turning(r, 'm')}" for r in rig.runout if r.name == b.name]
        if b.axial:
            lines.append("axial = true")
            continue
        lines.append(f"z = {plane(f'{b.name}.z')}")
        read = [plane(b.sensor_parameter(k)) for k in range(len(b.z_sensors))]
        lines.append(f"z_sensor = {read[0]}" if len(read) == 1 else f"z_sensors = [{', '.join(read)}]")
        own = {key.removeprefix(f"{b.name}."): x for key, x in rig.plane_sd.items() if key.startswith(f"{b.name}.")}
        lines += [f'{key} = {{ value = {x!r}, unit = "m" }}' for key, x in own.items()]
    if rig.modes != RigModes():
        count = '"auto"' if rig.modes.count is None else rig.modes.count
        lines += ["", "[modes]", f"count = {count}"]
        lines += [f"frequency_hz = {list(rig.modes.frequency_hz)}"] if rig.modes.frequency_hz else []
        lines += _mode_lines(rig.modes.numbers, len(rig.modes.frequency_hz)) if rig.modes.numbers else []
    for u in rig.unbalance:
        lines += ["", f"[unbalance.{u.name}]", f"value = {u.value!r}", 'unit = "kg m"', f"phase = {u.phase!r}"]
        lines.append(f'z = {{ value = {u.z!r}, unit = "m" }}')
    return lines + (["", *shaft_lines(rig.shaft)] if rig.shaft else [])


def _turning(turning: Turning, unit: str) -> str:
    return f'{{ value = {turning.value!r}, unit = "{unit}", phase = {turning.phase!r} }}'


def _mode_lines(numbers: Mapping[str, float], n: int) -> list[str]:
    places = [name.removeprefix("mode1.") for name in numbers if name.startswith("mode1.")]
    of = {place: [numbers[f"mode{r}.{place}"] for r in range(1, n + 1)] for place in places if place != "omega"}
    lines = [f"damping = {of.pop('zeta')}", f"[modes.shapes]{_NOTE}"]
    lines += [f"{toml_text(place)} = {shape}" for place, shape in of.items()]
    terms = {name.removeprefix("gyro."): x for name, x in numbers.items() if name.startswith("gyro.")}
    return [*lines, "[modes.gyroscopic]", *(f'"{name}" = {x!r}' for name, x in terms.items())] if terms else lines


def _magnet_lines(magnet: RigMagnet) -> list[str]:
    lines = ["[magnet]", f'kind = "{magnet.kind}"']
    lines += [f'gap = "{magnet.gap}"'] if magnet.gap else []
    lines += [f"{name} = true" for name, on in (("eddy", magnet.eddy), ("drift", magnet.drift)) if on]
    choices = {"asymmetric": magnet.asymmetric, "saturation": magnet.saturation, "rise": magnet.rise}
    lines += [f"{name} = {str(on).lower()}" for name, on in choices.items() if on is not None]
    lines += [] if magnet.off_below is None else [f"off_below = {magnet.off_below!r}"]
    lines += [f"cone = {magnet.cone!r}"] if magnet.cone else []
    return [*lines, "[magnet.parameters]", *map(_parameter_line, magnet.parameters)] if magnet.parameters else lines


def _law_lines(law: StateLaw) -> list[str]:
    return [f"{name} = {getattr(law, name).tolist()!r}" for name in "ABCDG"]


def _loop_lines(loop: Loop, limits: Limits | None) -> list[str]:
    lines = ["[loop]", f'kind = "{"pid" if loop.law is None else "state-space"}"']
    if loop.law is None:
        numbers: Mapping[str, float] = {"kp": loop.kp, "ki": loop.ki, "kd": loop.kd, "kc": loop.kc}
        lines += [f"{name} = {value!r}" for name, value in numbers.items()]
    else:
        lines += [f"rate_hz = {loop.law.rate_hz!r}", *_law_lines(loop.law)]
    if math.isfinite(loop.derivative_cutoff_hz):
        lines.append(f"derivative_cutoff_hz = {loop.derivative_cutoff_hz!r}")
    lines.append(f"delay = {loop.delay!r}")
    if limits is not None:
        intervals = {role: getattr(limits, role) for role in ("voltage", "current", "position")}
        given = {role: x for role, x in intervals.items() if x != (-math.inf, math.inf)}
        for role, (low, high) in given.items():
            if not (math.isfinite(low) and math.isfinite(high)):
                raise RigError(f"limits.{role} is ({low}, {high}); a rig file holds both ends or none. Give both")
        inside = ", ".join(f"{role} = [{low!r}, {high!r}]" for role, (low, high) in given.items())
        lines += [f"limits = {{ {inside} }}"] if inside else []
    for speed, law in loop.laws[1:]:
        lines += ["", "[[loop.laws]]", f'speed = {{ value = {speed!r}, unit = "rad/s" }}', *_law_lines(law)]
    return lines


def _noise_lines(noise: Noise) -> list[str]:
    lines = ["[noise]", *(f"{name} = {getattr(noise, name)!r}" for name in ("position", "current", "force", "voltage"))]
    steps = {role: getattr(noise, f"{role}_resolution") for role in ("position", "current", "voltage")}
    inside = ", ".join(f"{role} = {step!r}" for role, step in steps.items() if step)
    return [*lines, f"resolutions = {{ {inside} }}"] if inside else lines


def layout_line(layout: Mapping[str, str]) -> str:
    """Return the line of ``[record]`` that tells the layout of files."""
    return f"layout = {{ {', '.join(f'{key} = {toml_text(value)}' for key, value in layout.items())} }}"


def _record_lines(record: RecordSettings) -> list[str]:
    lines = ["[record]"]
    numbers = {"rate_hz": record.rate_hz, "rate_sd": record.rate_sd, "from": record.from_s, "to": record.to_s}
    lines += [f"{key} = {value!r}" for key, value in numbers.items() if value is not None]
    lines += [f'gaps = "{record.gaps}"'] if record.gaps else []
    if record.time is not None:
        lines.append(f"time = {{ variable = {toml_text(record.time[0])}, unit = {toml_text(record.time[1])} }}")
    lines += [layout_line(record.layout)] if record.layout else []
    return lines


def _daq_lines(daq: Daq) -> list[str]:
    lines = ["[daq]", f"rate_hz = {daq.rate_hz!r}", f"baud = {daq.baud}"]
    lines += [f"duty = [{daq.duty[0]}, {daq.duty[1]}]"] if daq.duty else []
    lines += [f"duty_off = {daq.duty_off}"] if daq.duty_off is not None else []
    lines += [f"host_ms = {daq.host_ms}", f"lift_ms = {daq.lift_ms}"]
    lines += [f"third = {toml_text(daq.third)}"] if daq.third else []
    lines += [f"bench = {toml_text(daq.bench)}"] if daq.bench else []
    trips = {"position": daq.position_trip, "current": daq.current_trip}
    inside = ", ".join(f"{role} = [{x[0]!r}, {x[1]!r}]" for role, x in trips.items() if x is not None)
    return [*lines, f"trip = {{ {inside} }}"] if inside else lines
