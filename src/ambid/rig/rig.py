"""The rig: what is known of a bench before its records are looked at; and its file, in SI units, as it is written."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from ambid.errors import RigError, choices
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.physics.loop import UNLIMITED, Interval, Limits, Loop, Noise
from ambid.physics.presets import Turning
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import Material, Shaft
from ambid.record.calibration import Calibration
from ambid.record.sampling import GapPolicy
from ambid.rig.rotor import Operation, RigModes
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
    gain_sd, offset_sd : float or None
        How well its calibration is known: standard deviations of the gain, relative, and of the offset in the role's
        SI unit; None: nothing is said of it.
    commanded : bool
        Of the current that drives one axis: whether it is the command, held over each sample (``[channels.command]``),
        or measured, and then linear between samples.
    """

    role: str
    column: str
    unit: str | None = None
    calibration: Calibration | None = None
    delay: int | Literal["auto"] = 0
    variable: str | None = None
    gain_sd: float | None = None
    offset_sd: float | None = None
    commanded: bool = False

    @property
    def key(self) -> str:
        """Its name in a rig file."""
        return "command" if self.commanded else self.role


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
        Whether the force has a pole a/(s + a), and whether a force and a voltage drift beside the law.
    off_below : float or None
        Voltage in V at or below which the power stage is off, so that the coil's voltage is not known.
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
            "drift = false": () if self.drift else ("tau",),
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
    operation : Operation or None
        Speeds and clearances that its machine is accepted for.
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
    operation: Operation | None = None
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
    def clearance(self) -> float | None:
        """Radial clearance in the touch-down bearings, m: that of ``[operation]``, else `position_limit`."""
        own = None if self.operation is None else self.operation.touch_down
        return self.position_limit if own is None else own

    @property
    def position_limit(self) -> float | None:
        """The smaller end of ``loop.limits.position``, m; None where it is not given."""
        least = math.inf if self.limits is None else min(abs(x) for x in self.limits.position)
        return least if math.isfinite(least) else None

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

    def __repr__(self) -> str:
        fixed = ", ".join(f"{p.name} = {p.value:.4g} {p.unit}" for p in self.parameters if p.role == "fixed")
        columns = ", ".join(f"{c.role} from {c.column!r}" for c in self.channels)
        return f"<Rig {self.name!r}, model {self.model}: {columns}; fixed: {fixed or 'nothing'}>"

    @property
    def measured_input(self) -> bool:
        """Whether a measured current drives one axis, so that it is not held between samples."""
        return self.plant.inputs == ("current",) and not self.channel("current").commanded

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
        by_role = {c.role: c for c in self.channels}
        if role not in by_role:
            raise RigError(f"the rig has no channel {role!r}; it has {choices(role, by_role)}")
        return by_role[role]

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
        by_name = {p.name: p for p in self.parameters}
        if name not in by_name:
            raise RigError(f"model {self.model!r} has no parameter {name!r}; it has {choices(name, by_name)}")
        return by_name[name]


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
    rotor, plant, units = rig.rotor, rig.plant, role_units(rig.plant)
    lines = toml_lines(
        {
            "schema": "ambid.rig/1", "name": rig.name, "model": rig.model, "open_loop": rig.open_loop or None,
            "speed": _quantity(rotor.speed, "rad/s") if rotor and rotor.speed else None,
        }
    )  # fmt: skip
    lines += _rotor_lines(rig, rotor) if rotor else []
    for c in rig.channels:
        lines += ["", *_channel_lines(c, folder, is_input=c.role in plant.inputs)]
    planes = () if rotor is None else rotor.places
    lines += ["", "[parameters]", *_parameter_lines(p for p in rig.parameters if p.name not in planes)]
    if rig.magnet is not None:
        lines += ["", *_magnet_lines(rig.magnet)]
    if rig.operating_point:
        point = {role: _quantity(x, units[role]) for role, x in rig.operating_point.items()}
        lines += ["", "[operating_point]", *toml_lines(point)]
    if rig.loop or rig.limits:
        lines += ["", *_loop_lines(rig.loop or Loop(), rig.limits)]
    if rig.noise:
        steps = {role: getattr(rig.noise, f"{role}_resolution") or None for role in ("position", "current", "voltage")}
        levels = {name: getattr(rig.noise, name) for name in ("position", "current", "force", "voltage")}
        lines += ["", "[noise]", *toml_lines({**levels, "resolutions": steps if any(steps.values()) else None})]
    if (r := rig.record) != RecordSettings():
        record = {
            "rate_hz": r.rate_hz, "rate_sd": r.rate_sd, "from": r.from_s, "to": r.to_s, "gaps": r.gaps,
            "time": r.time and {"variable": r.time[0], "unit": r.time[1]}, "layout": r.layout or None,
        }  # fmt: skip
        lines += ["", "[record]", *toml_lines(record)]
    if (d := rig.daq) is not None:
        trips = {"position": d.position_trip, "current": d.current_trip}
        daq = {
            "rate_hz": d.rate_hz, "baud": d.baud, "duty": d.duty, "duty_off": d.duty_off, "host_ms": d.host_ms,
            "lift_ms": d.lift_ms, "third": d.third or None, "bench": d.bench or None,
            "trip": trips if any(trips.values()) else None,
        }  # fmt: skip
        lines += ["", "[daq]", *toml_lines(daq)]
    return "\n".join(lines) + "\n"


def toml_text(text: str) -> str:
    """Quote a text for TOML.

    `text`: any text. Returns a TOML basic string.
    """
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_lines(entries: Mapping[str, object]) -> list[str]:
    """Return a line ``key = value`` of TOML for each entry that is not None; mappings become inline tables."""
    return [f"{key} = {_toml(value)}" for key, value in entries.items() if value is not None]


def _toml(value: object) -> str:
    if isinstance(value, str):
        return toml_text(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return f"{{ {', '.join(toml_lines(value))} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value)


def _quantity(value: float, unit: str) -> dict[str, object]:
    return {"value": value, "unit": unit}


def _channel_lines(c: RigChannel, folder: Path, *, is_input: bool) -> list[str]:
    entries = {
        "column": c.column, "variable": c.variable or None, "unit": c.unit or None,
        **(_calibration_entries(c.calibration, c.role, folder) if c.calibration else {}),
        "delay": c.delay if is_input or c.delay else None, "gain_sd": c.gain_sd, "offset_sd": c.offset_sd,
    }  # fmt: skip
    return [f"[channels.{c.key}]", *toml_lines(entries)]


def _calibration_entries(calibration: Calibration, role: str, folder: Path) -> dict[str, object]:
    if calibration.raw is None:
        gain = None if calibration.unit_in == calibration.unit_out else calibration.gain
        return {"gain": gain, "offset": calibration.offset}
    if not calibration.source:
        raise RigError(f"channels.{role} has a calibration table without a file; a rig file names one. Write it as CSV")
    table = os.path.relpath(Path(calibration.source).resolve(), folder.resolve())
    return {"table": Path(table).as_posix(), "extrapolate": calibration.extrapolate or None}


def _parameter_entry(p: Parameter) -> dict[str, object]:
    return {"value": p.value, "unit": p.unit, "role": p.role, "sd": p.sd}


def _parameter_lines(parameters: Iterable[Parameter]) -> list[str]:
    return toml_lines({toml_text(p.name) if "." in p.name else p.name: _parameter_entry(p) for p in parameters})


def _rotor_lines(rig: Rig, rotor: RotorModel) -> list[str]:
    lines: list[str] = []
    for b in rotor.bearings:
        runout = next(({**_quantity(r.value, "m"), "phase": r.phase} for r in rig.runout if r.name == b.name), None)
        entries: dict[str, object] = {"axes": b.axes, "runout": runout}
        if b.axial:
            entries["axial"] = True
        else:
            read = [_parameter_entry(rig.parameter(b.sensor_parameter(k))) for k in range(len(b.z_sensors))]
            entries["z"] = _parameter_entry(rig.parameter(f"{b.name}.z"))
            entries |= {"z_sensor": read[0]} if len(read) == 1 else {"z_sensors": read}
            own = {key.removeprefix(f"{b.name}."): x for key, x in rig.plane_sd.items() if key.startswith(f"{b.name}.")}
            entries |= {key: _quantity(x, "m") for key, x in own.items()}
        lines += ["", f"[bearings.{b.name}]", *toml_lines(entries)]
    if (modes := rig.modes) != RigModes():
        count = "auto" if modes.count is None else modes.count
        lines += ["", "[modes]", *toml_lines({"count": count, "frequency_hz": modes.frequency_hz or None})]
        lines += _mode_lines(modes.numbers, len(modes.frequency_hz)) if modes.numbers else []
    for u in rig.unbalance:
        entries = {**_quantity(u.value, "kg m"), "phase": u.phase, "z": _quantity(u.z, "m")}
        lines += ["", f"[unbalance.{u.name}]", *toml_lines(entries)]
    if (o := rig.operation) is not None:
        values = {f.name: getattr(o, f.name) for f in fields(o)}
        units = {name: "rad/s" if "speed" in name else "m" for name in values}
        given = {name: _quantity(x, units[name]) for name, x in values.items() if x is not None}
        lines += ["", "[operation]", *toml_lines(given)]
    return lines + (["", *_shaft_lines(rig.shaft)] if rig.shaft else [])


def _mode_lines(numbers: Mapping[str, float], n: int) -> list[str]:
    places = [name.removeprefix("mode1.") for name in numbers if name.startswith("mode1.")]
    of = {place: [numbers[f"mode{r}.{place}"] for r in range(1, n + 1)] for place in places if place != "omega"}
    lines = [*toml_lines({"damping": of.pop("zeta")}), f"[modes.shapes]{_NOTE}"]
    lines += toml_lines({toml_text(place): shape for place, shape in of.items()})
    terms = {f'"{name.removeprefix("gyro.")}"': x for name, x in numbers.items() if name.startswith("gyro.")}
    return [*lines, "[modes.gyroscopic]", *toml_lines(terms)] if terms else lines


def _shaft_lines(shaft: Shaft) -> list[str]:
    lines = ["[shaft]"]
    entries = {"z": _quantity(shaft.z, "m"), "material": _material_entry(shaft.material), "damping": shaft.zeta or None}
    lines += toml_lines(entries)
    for step in shaft.steps:
        sizes = {"length": step.length, "diameter": step.diameter} | ({"bore": step.bore} if step.bore else {})
        material = _material_entry(step.material) if step.material else None
        lines += ["[[shaft.steps]]", *toml_lines({k: _quantity(x, "m") for k, x in sizes.items()})]
        lines += toml_lines({"material": material})
    for disc in shaft.discs:
        units = {"z": "m", "m": "kg", "Id": "kg m^2", "Ip": "kg m^2"}
        lines += ["[[shaft.discs]]", *toml_lines({k: _quantity(getattr(disc, k), unit) for k, unit in units.items()})]
    return lines


def _material_entry(material: Material) -> dict[str, object]:
    return {"E": _quantity(material.E, "Pa"), "rho": _quantity(material.rho, "kg/m^3"), "nu": material.nu}


def _magnet_lines(magnet: RigMagnet) -> list[str]:
    entries = {
        "kind": magnet.kind, "gap": magnet.gap, "saturation": magnet.saturation, "eddy": magnet.eddy or None,
        "drift": magnet.drift or None, "asymmetric": magnet.asymmetric, "rise": magnet.rise,
        "off_below": magnet.off_below,
    }  # fmt: skip
    lines = ["[magnet]", *toml_lines(entries)]
    return [*lines, "[magnet.parameters]", *_parameter_lines(magnet.parameters)] if magnet.parameters else lines


def _loop_lines(loop: Loop, limits: Limits | None) -> list[str]:
    law: dict[str, object] = {name: getattr(loop, name) for name in ("kp", "ki", "kd", "kc")}
    if loop.law is not None:
        law = {"rate_hz": loop.law.rate_hz, **{name: getattr(loop.law, name).tolist() for name in "ABCDG"}}
    intervals = {}
    for role in ("voltage", "current", "position") if limits is not None else ():
        low, high = getattr(limits, role)
        if (low, high) == UNLIMITED:
            continue
        if not (math.isfinite(low) and math.isfinite(high)):
            raise RigError(f"limits.{role} is ({low}, {high}); a rig file holds both ends or none. Give both")
        intervals[role] = (low, high)
    entries = {
        "kind": "pid" if loop.law is None else "state-space", **law,
        "derivative_cutoff_hz": loop.derivative_cutoff_hz if math.isfinite(loop.derivative_cutoff_hz) else None,
        "delay": loop.delay, "limits": intervals or None,
    }  # fmt: skip
    return ["[loop]", *toml_lines(entries)]
