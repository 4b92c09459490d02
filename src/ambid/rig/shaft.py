"""Numbers with a unit in a rig file, in SI, and its ``[shaft]``: from tables to the drawing of a rotor, and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.errors import RigError, UnitError
from ambid.units import Unit, parse_unit

if TYPE_CHECKING:
    from ambid.rig.schema import PlaneEntry, QuantityEntry, TurningEntry

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ambid.errors import ModelError
from ambid.physics.linear_model import Parameter
from ambid.physics.shaft import Disc, Material, Shaft, Step

if TYPE_CHECKING:
    from ambid.rig.schema import DiscEntry, MaterialEntry, ShaftEntry, StepEntry

_DISC = {"m": "kg", "Id": "kg m^2", "Ip": "kg m^2", "outer": "m", "inner": "m", "width": "m", "rho": "kg/m^3"}


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


def shaft_lines(shaft: Shaft) -> list[str]:
    """Return a shaft as lines of TOML, in SI units."""
    lines = ["[shaft]", f"z = {_quantity(shaft.z, 'm')}", f"material = {_material_text(shaft.material)}"]
    lines += [f"damping = {list(shaft.zeta)}"] if shaft.zeta else []
    for step in shaft.steps:
        sizes = {"length": step.length, "diameter": step.diameter} | ({"bore": step.bore} if step.bore else {})
        lines += ["[[shaft.steps]]", *(f"{name} = {_quantity(size, 'm')}" for name, size in sizes.items())]
        lines += [f"material = {_material_text(step.material)}"] if step.material else []
    for disc in shaft.discs:
        lines += ["[[shaft.discs]]", f"z = {_quantity(disc.z, 'm')}"]
        lines += [f"{name} = {_quantity(getattr(disc, name), _DISC[name])}" for name in ("m", "Id", "Ip")]
    return lines


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


def _quantity(value: float, unit: str) -> str:
    return f'{{ value = {value!r}, unit = "{unit}" }}'


def _material_text(material: Material) -> str:
    E, rho = _quantity(material.E, "Pa"), _quantity(material.rho, "kg/m^3")
    return f"{{ E = {E}, rho = {rho}, nu = {material.nu!r} }}"


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
