"""What a rig says of numbers, ``[parameters]`` and ``[magnet]``: units become SI, the entries are checked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from ambid.errors import RigError, UnitError, nearest
from ambid.physics.bearing_numbers import BEARING_NUMBERS, NOT_NEGATIVE
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter, ParameterSpec
from ambid.rig.rig import RigMagnet
from ambid.units import Unit, parse_unit

if TYPE_CHECKING:
    from ambid.rig.schema import MagnetEntry, ParameterEntry

_EXPONENTIAL, _HYPERBOLIC = ("L_g", "zeta"), ("k", "s")


def parameter_of(spec: ParameterSpec, entry: ParameterEntry, place: str) -> Parameter:
    """Convert one parameter to SI and check it against what it is.

    `spec`: what it is; `entry`: as written; `place`: where it stands, for messages. Returns SI.
    """
    unit = None
    if entry.unit is not None:
        unit = unit_of(entry.unit, f"{place}.unit")
        if unit.si != parse_unit(spec.unit).si:
            raise RigError(
                f"{place} ({spec.meaning}) is in [{entry.unit}]; it is measured in [{spec.unit}]. Correct unit"
            )
    elif entry.value is not None:
        raise RigError(f'{place} has a value but no unit. Give unit, e.g. unit = "{spec.unit}"')
    if entry.role != "free" and entry.value is None:
        raise RigError(f'{place} is {entry.role} but has no value. Give value, or set role = "free"')
    if entry.role == "prior" and (entry.sd is None or entry.sd <= 0):
        got = "no sd" if entry.sd is None else f"sd = {entry.sd}"
        raise RigError(f"{place} is a prior with {got}; it needs a positive standard deviation. Give sd")
    if entry.role != "prior" and entry.sd is not None:
        raise RigError(f'{place} is {entry.role} but has an sd. Remove sd, or set role = "prior"')
    if spec.positive and entry.value is not None and entry.value <= 0:
        raise RigError(f"{place} ({spec.meaning}) is {entry.value} {entry.unit}; it must be positive. Correct value")
    value = unit.to_si(entry.value) if unit is not None and entry.value is not None else None
    sd = unit.to_si(entry.sd) if unit is not None and entry.sd is not None else None
    return Parameter(name=spec.name, unit=spec.unit, role=entry.role, value=value, sd=sd)


def magnet_of(entry: MagnetEntry, plant: LinearModel, where: str) -> RigMagnet:
    """Check ``[magnet]`` against the model and itself.

    `entry`: as written; `plant`: the rig's model; `where`: the file, for messages. Returns SI.
    """
    if plant.name != "one-axis":
        raise RigError(
            f"{where}: [magnet] is given; model {plant.name!r} has no nonlinear magnet. Remove it, or take 'one-axis'"
        )
    specs = {spec.name: spec for spec in BEARING_NUMBERS}
    for name, given in entry.parameters.items():
        place = f"{where}: magnet.parameters.{name}"
        if name in ("m", "R", "c"):
            raise RigError(f"{place} is the linear model's too. Write it in [parameters]")
        if name not in specs:
            raise RigError(
                f"{where}: unknown parameter {name!r} in [magnet.parameters]; a magnet has {', '.join(specs)}."
                f"{nearest(name, list(specs))}"
            )
        if name in NOT_NEGATIVE and given.value is not None and not _allowed(given.value, given.role):
            rule = "must not be negative" if given.value < 0 else "must be positive unless it is fixed"
            raise RigError(f"{place} ({specs[name].meaning}) is {given.value} {given.unit}; it {rule}. Correct value")
    known = tuple(parameter_of(specs[n], p, f"{where}: magnet.parameters.{n}") for n, p in entry.parameters.items())
    try:
        return RigMagnet(
            kind=entry.kind,
            gap=_gap(entry, where),
            asymmetric=entry.asymmetric,
            saturation=entry.saturation,
            rise=entry.rise,
            eddy=entry.eddy,
            drift=entry.drift,
            off_below=entry.off_below,
            parameters=known,
        )
    except RigError as error:
        raise RigError(f"{where}: {error}") from None


def _allowed(value: float, role: str) -> bool:
    """The search moves the logarithm: a zero has to be fixed."""
    return value > 0 or (value == 0 and role == "fixed")


def _gap(entry: MagnetEntry, where: str) -> Literal["hyperbolic", "exponential"] | None:
    """The gap law, which numbers may tell too."""
    told: list[Literal["hyperbolic", "exponential"]] = []
    told += ["hyperbolic"] if any(n in entry.parameters for n in _HYPERBOLIC) else []
    told += ["exponential"] if any(n in entry.parameters for n in _EXPONENTIAL) else []
    if len(told) == 2:
        raise RigError(
            f"{where}: [magnet.parameters] names numbers of both gap laws (k, s and L_g, zeta). Leave one pair out"
        )
    return entry.gap or (told[0] if told else None)


def unit_of(text: str, place: str) -> Unit:
    """Read a unit of a rig file.

    `text`, `place`: the unit, and where it stands, for messages.
    """
    try:
        return parse_unit(text)
    except UnitError as error:
        raise RigError(f"{place}: {error}") from None
