"""From the tables of a rig file to a rotor on many axes: bearings, planes and speed, what drives it, its drawing, in
SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from ambid.errors import ModelError, RigError, UnitError, nearest
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import Turning
from ambid.physics.rotor_model import Bearing, Drive, RotorModel
from ambid.physics.shaft import Disc, Material, Shaft, Step
from ambid.units import Unit, parse_unit

if TYPE_CHECKING:
    from ambid.physics.linear_model import LinearModel
    from ambid.rig.schema import (
        BearingEntry,
        DiscEntry,
        MaterialEntry,
        OperationEntry,
        ParameterEntry,
        PlaneEntry,
        QuantityEntry,
        RigFile,
        ShaftEntry,
        StepEntry,
        TurningEntry,
    )

_DRIVES: tuple[Drive, ...] = ("voltage", "current", "command")
TURN = 2.0 * math.pi
_SPEEDS = {"rad/s": 1.0, "Hz": TURN}
"""SI units in which a speed may be given, and what makes rad/s of them."""
_FASTEST = 1e6  # rad/s, ten million turns a minute
_WIDEST = 5e-3  # m, clearance of a touch-down bearing
_DISC = {"m": "kg", "Id": "kg m^2", "Ip": "kg m^2", "outer": "m", "inner": "m", "width": "m", "rho": "kg/m^3"}


@dataclass(frozen=True, slots=True, kw_only=True)
class RigModes:
    """What is known of the bending modes of a rotor."""

    count: int | None = None  # how many are in the excited band; None: the record decides
    frequency_hz: tuple[float, ...] = ()  # where they may be found; searched everywhere without
    # for simulation, under the names of the rotor's model: ``mode1.omega``, ``mode1.zeta``, ``mode1.A.z`` …,
    # ``mode1.unbalance.<name>``, ``gyro.01`` …; SI
    numbers: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Operation:
    """What a machine is accepted for, ``[operation]``."""

    maximum_speed: float | None = None  # ends of the range of continuous operation, rad/s
    minimum_speed: float | None = None
    touch_down: float | None = None  # radial clearance in the touch-down bearings, the smallest to the stator, m
    axial_touch_down: float | None = None  # along the shaft


def rotor_of(file: RigFile, where: str) -> RotorModel:
    """Return the rotor that a rig file describes by ``[bearings.X]``.

    `where`: the file, for messages. An axis with a voltage channel, or of a rig without channels, is driven by that
    voltage; else by its current, or by the command of its amplifier.
    """
    if file.model != "rotor":
        raise RigError(f'{where}: [bearings] are given, but the model is {file.model!r}. Set model = "rotor"')
    bearings = tuple(_bearing(name, entry, f"{where}: bearings.{name}") for name, entry in file.bearings.items())
    _apart(bearings, where)
    speed = speed_of(file.speed, where)
    axes = [axis for b in bearings for axis in b.axes]
    drives: list[Drive] = []
    for axis in axes:
        found: list[Drive] = [x for x in _DRIVES if f"{axis}_{x}" in file.channels]
        if file.channels and not found:
            raise RigError(
                f"{where}: axis {axis!r} has none of [channels.{axis}_voltage], [channels.{axis}_current] and "
                f"[channels.{axis}_command]; one of them drives it. Add it with its column"
            )
        drives.append(found[0] if found else "voltage")
    known = {f"{axis}.{what}" for axis in axes for what in ("gain", "sensor_pole")} | {"a"}
    return RotorModel(
        bearings=bearings, speed=speed, drives=tuple(drives),
        polar=bool(speed) or not {"angle", "speed", "tacho"}.isdisjoint(file.channels) or "Ip" in file.parameters,
        extras=tuple(sorted(name for name in file.parameters if name in known)),
    )  # fmt: skip


def planes_of(file: RigFile) -> Mapping[str, ParameterEntry]:
    """Return the planes of all bearings and sensors as parameters, under the names of the model."""
    from ambid.rig.schema import ParameterEntry

    def entry(plane: PlaneEntry) -> ParameterEntry:
        role = plane.role or ("free" if plane.value is None else "fixed")
        return ParameterEntry(value=plane.value, unit=plane.unit, role=role, sd=plane.sd)

    entries: dict[str, ParameterEntry] = {}
    for name, given in file.bearings.items():
        if not given.axial:
            bearing = Bearing(name=name, axes=tuple(given.axes))
            planes = [
                (f"{name}.z", given.z),
                *((bearing.sensor_parameter(k), z) for k, z in enumerate(read_at(given))),
            ]
            entries |= {place: entry(plane) for place, plane in planes if plane is not None}
    return entries


def modes_of(file: RigFile, plant: LinearModel, where: str) -> RigModes:
    """Return what a rig file says of bending modes; with shapes, all numbers that a simulation needs."""
    entry = file.modes
    if entry is None or not isinstance(plant, RotorModel):
        return RigModes()
    count = None if entry.count == "auto" else int(entry.count)
    n, numbers = len(entry.frequency_hz), dict[str, float]()
    lone = "gyroscopic" if entry.gyroscopic else "damping" if entry.damping is not None else None
    if lone and not entry.shapes:
        raise RigError(
            f"{where}: modes.{lone} is given without modes.shapes; a simulation takes all of a mode from here, or from "
            "[shaft]. Give the shapes, or remove it"
        )
    if entry.shapes and entry.damping is None:
        raise RigError(f"{where}: modes.shapes are given without modes.damping. Give the ratio of each mode, or one")
    damping = entry.damping if isinstance(entry.damping, list) else [entry.damping or 0.0] * n
    if entry.shapes:
        places = {*plant.places, *(f"unbalance.{name}" for name in file.unbalance)}
        wrong = next((p for p in [*entry.shapes, *places] if (p in places) != (p in entry.shapes)), None)
        if wrong is not None:
            what = "is missing" if wrong in places else "is no plane of this rotor"
            raise RigError(
                f"{where}: modes.shapes.{wrong!r} {what}; shapes are given at {', '.join(sorted(places))}."
                f"{nearest(wrong, sorted(places - {wrong}))} Correct it"
            )
        for key, values in {"damping": damping, **{f"shapes.{p!r}": v for p, v in entry.shapes.items()}}.items():
            if len(values) != n:
                raise RigError(
                    f"{where}: modes.{key} has {len(values)} numbers, modes.frequency_hz {n}; give one for each mode"
                )
        for r in range(n):
            numbers |= {f"mode{r + 1}.omega": TURN * entry.frequency_hz[r], f"mode{r + 1}.zeta": damping[r]}
            numbers |= {f"mode{r + 1}.{place}": shape[r] for place, shape in entry.shapes.items()}
    terms = [p.name.removeprefix("gyro.") for p in plant.at_speed(1.0).with_modes(n).parameters if "gyro." in p.name]
    for term, value in entry.gyroscopic.items():
        if term not in terms:
            raise RigError(
                f"{where}: modes.gyroscopic.{term!r} is no pair of modes; they are {', '.join(terms)}, 0 the rigid "
                "slope. Correct it"
            )
        numbers[f"gyro.{term}"] = value
    return RigModes(count=count, frequency_hz=tuple(entry.frequency_hz), numbers=MappingProxyType(numbers))


def turning_of(file: RigFile, where: str) -> tuple[tuple[Turning, ...], tuple[Turning, ...]]:
    """Return unbalances and run-outs of a rig file."""
    unbalance = tuple(
        Turning(
            name=name, phase=u.phase, value=si_of(u, "kg m", f"{where}: unbalance.{name}"),
            z=si_of(u.z, "m", f"{where}: unbalance.{name}.z"),
        )
        for name, u in file.unbalance.items()
    )  # fmt: skip
    runout = tuple(
        Turning(name=name, phase=b.runout.phase, value=si_of(b.runout, "m", f"{where}: bearings.{name}.runout"))
        for name, b in file.bearings.items()
        if b.runout is not None
    )
    return unbalance, runout


def _bearing(name: str, entry: BearingEntry, place: str) -> Bearing:
    if entry.axial:
        if len(entry.axes) != 1:
            raise RigError(f"{place} is axial with {len(entry.axes)} axes; it has one. Name one, or remove axial")
        return Bearing(name=name, axes=tuple(entry.axes), axial=True)
    if entry.z is None:
        raise RigError(
            f'{place}.z is missing; the magnet stands there along the shaft. Give z = {{ value = …, unit = "mm" }}'
        )
    if entry.z_sensor is not None and entry.z_sensors is not None:
        raise RigError(f"{place} has both z_sensor and z_sensors; it has one of them. Remove one")
    sensors = read_at(entry)
    if not sensors:
        raise RigError(
            f"{place}.z_sensor is missing; it is the plane of the sensor. Give it, equal to z if they are one"
        )
    values = [None if plane.value is None else si_of(plane, "m", place) for plane in sensors]
    return Bearing(
        name=name,
        axes=tuple(entry.axes),
        z=None if entry.z.value is None else si_of(entry.z, "m", place),
        z_sensors=tuple(values),
    )


def _apart(bearings: tuple[Bearing, ...], where: str) -> None:
    """Refuse radial bearings, or their sensors, in one plane: a slope of the rotor would not show."""
    radial = [b for b in bearings if not b.axial]
    for what, planes in {
        "z": [b.z for b in radial],
        "z_sensor": [z for b in radial for z in b.z_sensors],
    }.items():
        if len(radial) > 1 and None not in planes and len(set(planes)) == 1:
            raise RigError(
                f"{where}: bearings.{radial[0].name}.{what} and bearings.{radial[-1].name}.{what} are both "
                f"{planes[0]:g} m; in one plane the rotor's slope does not show. Correct one"
            )


def read_at(entry: BearingEntry) -> list[PlaneEntry]:
    """Return the planes of the sensors of a bearing."""
    return entry.z_sensors or ([] if entry.z_sensor is None else [entry.z_sensor])


def speed_of(entry: QuantityEntry | None, where: str) -> float:
    """Return a speed of a rig in rad/s, 0 where it gives none."""
    if entry is None:
        return 0.0
    unit = unit_of(entry.unit, f"{where}: speed")
    if unit.si not in _SPEEDS:
        raise RigError(f"{where}: speed is in [{entry.unit}]; it is measured in [rpm], [rad/s] or [Hz]. Correct unit")
    speed = unit.to_si(entry.value) * _SPEEDS[unit.si]
    if not abs(speed) <= _FASTEST:
        raise RigError(f"{where}: speed is {speed:.4g} rad/s; no rotor is faster than {_FASTEST:g} rad/s. Correct it")
    return speed


def operation_of(entry: OperationEntry, where: str) -> Operation:
    """Return what a machine is accepted for; `where`: the file, for messages."""
    place = f"{where}: operation"
    sizes = {name: getattr(entry, name) for name in ("touch_down", "axial_touch_down")}
    speeds = {name: getattr(entry, name) for name in ("maximum_speed", "minimum_speed")}
    values = {name: si_of(x, "m", f"{place}.{name}") for name, x in sizes.items() if x is not None}
    values |= {name: speed_of(x, f"{place}.{name}") for name, x in speeds.items() if x is not None}
    wrong = next((name for name, x in values.items() if x <= 0.0), None)
    if wrong is not None:
        raise RigError(f"{place}.{wrong} is {values[wrong]:g}; it must be positive. Correct it")
    wide = next((name for name in sizes if values.get(name, 0.0) > _WIDEST), None)
    if wide is not None:
        raise RigError(
            f"{place}.{wide} is {1e3 * values[wide]:g} mm; no touch-down bearing leaves more than "
            f"{1e3 * _WIDEST:g} mm. Correct its value or unit"
        )
    if values.get("minimum_speed", 0.0) > values.get("maximum_speed", math.inf):
        raise RigError(f"{place}.minimum_speed is above maximum_speed. Correct one")
    return Operation(**values)


def shaft_of(entry: ShaftEntry, parameters: Sequence[Parameter], where: str) -> Shaft:
    """Return the shaft of a rig file, on which the planes among `parameters` lie; `where`: the file, for messages."""
    place = f"{where}: shaft"
    try:
        material = _material(entry.material, f"{place}.material")
        shaft = Shaft(
            steps=tuple(_step(x, f"{place}.steps.{k}") for k, x in enumerate(entry.steps, 1)),
            discs=tuple(_disc(x, material, f"{place}.discs.{k}") for k, x in enumerate(entry.discs, 1)),
            material=material,
            z=si_of(entry.z, "m", f"{place}.z"),
            zeta=tuple(entry.damping) if isinstance(entry.damping, list) else (entry.damping,),
        )
    except ModelError as error:
        raise RigError(f"{place}: {error}") from None
    for p in parameters:
        if p.unit == "m" and p.value is not None and not shaft.z <= p.value <= shaft.z + shaft.length:
            raise RigError(
                f"{place} goes from {shaft.z:g} to {shaft.z + shaft.length:g} m, but {p.name} is at {p.value:g} m. "
                "Correct shaft.z, which is its left end from the datum of the planes, or that plane"
            )
    return shaft


def _material(entry: MaterialEntry, place: str) -> Material:
    return Material(E=si_of(entry.E, "Pa", f"{place}.E"), rho=si_of(entry.rho, "kg/m^3", f"{place}.rho"), nu=entry.nu)


def _step(entry: StepEntry, place: str) -> Step:
    try:
        return Step(
            length=si_of(entry.length, "m", f"{place}.length"),
            diameter=si_of(entry.diameter, "m", f"{place}.diameter"),
            bore=si_of(entry.bore, "m", f"{place}.bore"),
            material=None if entry.material is None else _material(entry.material, f"{place}.material"),
        )
    except ModelError as error:
        raise RigError(f"{place}: {error}") from None


def _disc(entry: DiscEntry, material: Material, place: str) -> Disc:
    z = si_of(entry.z, "m", f"{place}.z")
    values = {name: getattr(entry, name) for name in _DISC if getattr(entry, name) is not None}
    sizes = {name: si_of(x, _DISC[name], f"{place}.{name}") for name, x in values.items()}
    try:
        if set(sizes) in ({"m"}, {"m", "Id", "Ip"}):
            return Disc(z=z, **sizes)
        if {"outer", "width"} <= set(sizes) <= {"outer", "inner", "width", "rho"}:
            return Disc.of_geometry(z=z, **{"inner": 0.0, "rho": material.rho, **sizes})
    except ModelError as error:
        raise RigError(f"{place}: {error}") from None
    raise RigError(
        f"{place} has {', '.join(sizes) or 'a plane alone'}; a disc has m, or m, Id and Ip, or outer and width (and "
        "inner, rho). Give one of these sets"
    )


def unit_of(text: str, place: str) -> Unit:
    """Read a unit of a rig file; `place` is where it stands, for messages."""
    try:
        return parse_unit(text)
    except UnitError as error:
        raise RigError(f"{place}.unit: {error}") from None


def si_of(entry: QuantityEntry | PlaneEntry | TurningEntry | None, si: str, place: str) -> float:
    """Return a quantity in its SI unit, 0 where none is given."""
    if entry is None or entry.value is None:
        return 0.0
    unit = unit_of(entry.unit, place)
    if unit.si != parse_unit(si).si:
        raise RigError(f"{place} is in [{entry.unit}]; it is measured in [{si}]. Correct unit")
    return unit.to_si(entry.value)
