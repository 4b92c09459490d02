"""Numbers with a unit in a rig file, in SI."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.errors import RigError, UnitError
from ambid.units import Unit, parse_unit

if TYPE_CHECKING:
    from ambid.rig.schema import PlaneEntry, QuantityEntry, TurningEntry


def unit_of(text: str, place: str) -> Unit:
    """Read a unit of a rig file; `place` is where it stands, for messages."""
    try:
        return parse_unit(text)
    except UnitError as error:
        raise RigError(f"{place}.unit: {error}") from None


def si_of(given: QuantityEntry | PlaneEntry | TurningEntry | None, si: str, place: str) -> float:
    """Return a quantity in its SI unit, 0 where none is given."""
    if given is None or given.value is None:
        return 0.0
    unit = unit_of(given.unit, place)
    if unit.si != parse_unit(si).si:
        raise RigError(f"{place} is in [{given.unit}]; it is measured in [{si}]. Correct unit")
    return unit.to_si(given.value)
