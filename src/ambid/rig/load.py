"""From a rig file to a rig: units become SI, the entries are checked against the model and each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from ambid.errors import AmbidError, ModelError, RigError, nearest
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.models import model
from ambid.physics.parameters import Parameter, ParameterSpec
from ambid.record.calibration import Calibration, read_calibration_table
from ambid.rig._daq import daq_of
from ambid.rig._known import magnet_of, parameter_of, unit_of
from ambid.rig.rig import RecordSettings, Rig, RigChannel

if TYPE_CHECKING:
    from ambid.rig.schema import ChannelEntry, LimitsEntry, LoopEntry, NoiseEntry, ParameterEntry, RigFile

OPTIONAL_ROLES: Mapping[str, str] = MappingProxyType({"reference": "m", "speed": "rad/s", "angle": "rad"})
"""Roles that every model may have beside its own, with their units: set point, speed and angle of a turning rotor."""


def load_rig(path: str | Path) -> Rig:
    """Read a rig file.

    Parameters
    ----------
    path : str or Path
        TOML file of schema ``ambid.rig/1``; paths inside it are relative to its folder.

    Returns
    -------
    Rig
        In SI units, complete: every role and every parameter of the model.

    Raises
    ------
    RigError
        If the file or one of its entries breaks a rule; the message names the place and the nearest known key.
    """
    from ambid.rig.schema import read_rig_file

    path = Path(path)
    return _build(read_rig_file(path), path)


def rig_from_text(text: str, path: str | Path) -> Rig:
    """Read a rig from its text.

    Parameters
    ----------
    text : str
        TOML of schema ``ambid.rig/1``.
    path : str or Path
        Where it stood: paths inside it are relative to that folder, and messages name it.

    Returns
    -------
    Rig
        As `load_rig`.

    Raises
    ------
    RigError
        As `load_rig`.
    """
    from ambid.rig.schema import parse_rig

    path = Path(path)
    return _build(parse_rig(text, path), path)


def default_rig(model_name: str = "one-axis") -> Rig:
    """Return the rig that is taken when none is given: columns named like the roles, every parameter free.

    Parameters
    ----------
    model_name : str
        One of :func:`ambid.physics.models.model_names`.

    Returns
    -------
    Rig
        Parameters for which the model has a default are fixed at it.

    Raises
    ------
    ModelError
        If there is no such model.
    """
    plant = model(model_name)
    return Rig(
        name=f"{model_name}, nothing known",
        model=model_name,
        channels=_default_channels(plant),
        parameters=tuple(_unnamed(spec) for spec in plant.parameters),
    )


def role_units(plant: LinearModel) -> dict[str, str]:
    """Return the roles that a rig of this model may name, with their SI units.

    `plant`: a model. Returns its inputs, its outputs, and `OPTIONAL_ROLES`.
    """
    return {**{role: plant.units[role] for role in (*plant.inputs, *plant.outputs)}, **OPTIONAL_ROLES}


def _build(file: RigFile, path: Path) -> Rig:
    where = f"rig {path}"
    try:
        plant = model(file.model)
    except ModelError as error:
        raise RigError(f"{where}: {error}") from None
    record = file.record
    if record.from_ is not None and record.to is not None and record.to <= record.from_:
        raise RigError(f"{where}: record.to is {record.to} s, not after record.from = {record.from_} s. Correct one")
    channels = _channels(file.channels, plant, path) if file.channels else _default_channels(plant)
    limits = _limits(file.loop.limits, where) if file.loop and file.loop.limits else None
    return Rig(
        name=file.name,
        model=file.model,
        channels=channels,
        parameters=_parameters(file.parameters, plant, where),
        magnet=None if file.magnet is None else magnet_of(file.magnet, plant, where),
        operating_point=_operating_point(file.operating_point, plant, where),
        loop=_loop(file.loop) if file.loop else None,
        limits=limits,
        noise=_noise(file.noise) if file.noise else None,
        record=RecordSettings(
            rate_hz=record.rate_hz,
            gaps=record.gaps,
            from_s=record.from_,
            to_s=record.to,
            time=(record.time.variable, record.time.unit) if record.time else None,
        ),
        daq=daq_of(file.daq, channels=channels, plant=plant, limits=limits, record_rate_hz=record.rate_hz, where=where)
        if file.daq
        else None,
        open_loop=file.open_loop,
        source=path,
    )


def _default_channels(plant: LinearModel) -> tuple[RigChannel, ...]:
    inputs = tuple(RigChannel(role=role, column=role, delay="auto") for role in plant.inputs)
    return inputs + tuple(RigChannel(role=role, column=role) for role in plant.outputs)


def _channels(entries: Mapping[str, ChannelEntry], plant: LinearModel, path: Path) -> tuple[RigChannel, ...]:
    """Build the channels in the model's order; refuse unknown and missing roles and a column used twice."""
    units, where = role_units(plant), f"rig {path}"
    for role in entries:
        if role not in units:
            raise RigError(
                f"{where}: unknown role [channels.{role}]; model {plant.name!r} has {', '.join(units)}."
                f"{nearest(role, list(units))}"
            )
    channels = []
    for role in units:
        if role in entries:
            channels.append(_channel(role, entries[role], units[role], plant, path))
        elif role not in OPTIONAL_ROLES:
            raise RigError(
                f"{where}: [channels.{role}] is missing; model {plant.name!r} needs it. Add it with its column"
            )
    taken: dict[str, str] = {}
    for c in channels:
        if c.column in taken:
            raise RigError(
                f"{where}: column {c.column!r} is both channels.{taken[c.column]} and channels.{c.role};"
                " a column has one role. Correct one"
            )
        taken[c.column] = c.role
    return tuple(channels)


def _channel(role: str, entry: ChannelEntry, unit: str, plant: LinearModel, path: Path) -> RigChannel:
    place = f"rig {path}: channels.{role}"
    if entry.delay not in (None, 0) and role not in plant.inputs:
        raise RigError(
            f"{place}.delay is {entry.delay!r}; only inputs ({', '.join(plant.inputs)}) have a delay. Remove it"
        )
    delay = entry.delay if entry.delay is not None else "auto"
    return RigChannel(
        role=role,
        column=entry.column or role,
        unit=unit_of(entry.unit, f"{place}.unit").symbol if entry.unit else None,
        calibration=_calibration(entry, unit, place, path.parent),
        delay=delay if role in plant.inputs else 0,
        variable=entry.variable,
    )


def _calibration(entry: ChannelEntry, unit: str, place: str, folder: Path) -> Calibration | None:
    """Build gain and offset, or read the table; `unit` is the role's."""
    if entry.table is not None:
        if entry.gain is not None or entry.offset is not None:
            raise RigError(f"{place} has both a table and a gain or offset; it can have one of them. Remove one")
        try:
            table = read_calibration_table(folder / entry.table, extrapolate=entry.extrapolate)
        except AmbidError as error:
            raise RigError(f"{place}.table: {error}") from None
        if table.unit_out != unit:
            raise RigError(
                f"{place}.table gives [{table.unit_out}] in its second column; the role is in [{unit}]. Fix it"
            )
        return table
    if entry.extrapolate:
        raise RigError(f"{place}.extrapolate is set but there is no table. Remove it, or give table")
    if entry.gain is None and entry.offset is None:
        return None
    if entry.gain == 0:
        raise RigError(f"{place}.gain is 0; every sample would be the same. Give the gain")
    # Without a gain the column must be in the role's unit already; with one, the bench tells which unit it is in.
    unit_in = unit if entry.gain is None else ""
    return Calibration(
        unit_in=unit_in, unit_out=unit, gain=1.0 if entry.gain is None else entry.gain, offset=entry.offset or 0.0
    )


def _parameters(entries: Mapping[str, ParameterEntry], plant: LinearModel, where: str) -> tuple[Parameter, ...]:
    names = [spec.name for spec in plant.parameters]
    for name in entries:
        if name not in names:
            raise RigError(
                f"{where}: unknown parameter {name!r} in [parameters]; model {plant.name!r} has {', '.join(names)}."
                f"{nearest(name, names)}"
            )
    return tuple(
        parameter_of(spec, entries[spec.name], f"{where}: parameters.{spec.name}")
        if spec.name in entries
        else _unnamed(spec)
        for spec in plant.parameters
    )


def _unnamed(spec: ParameterSpec) -> Parameter:
    if spec.default is None:
        return Parameter(name=spec.name, unit=spec.unit)
    return Parameter(name=spec.name, unit=spec.unit, role="fixed", value=spec.default)


def _operating_point(entry: object, plant: LinearModel, where: str) -> Mapping[str, float]:
    """Convert declared operating values to SI; what is "auto" is left out."""
    if not isinstance(entry, Mapping):
        return MappingProxyType({})
    units = {role: plant.units[role] for role in (*plant.inputs, *plant.outputs)}
    values: dict[str, float] = {}
    for role, quantity in entry.items():
        if role not in units:
            known = ", ".join(units)
            raise RigError(
                f"{where}: unknown key {role!r} in [operating_point]; known: {known}.{nearest(role, list(units))}"
            )
        if quantity == "auto":
            continue
        place = f"{where}: operating_point.{role}"
        unit = unit_of(quantity.unit, f"{place}.unit")
        if unit.si != units[role]:
            raise RigError(f"{place} is in [{quantity.unit}]; it is measured in [{units[role]}]. Correct unit")
        values[role] = unit.to_si(quantity.value)
    return MappingProxyType(values)


def _loop(entry: LoopEntry) -> Loop:
    cutoff = math.inf if entry.derivative_cutoff_hz is None else entry.derivative_cutoff_hz
    return Loop(kp=entry.kp, ki=entry.ki, kd=entry.kd, kc=entry.kc, derivative_cutoff_hz=cutoff, delay=entry.delay)


def _limits(entry: LimitsEntry, where: str) -> Limits:
    intervals: dict[str, tuple[float, float]] = {}
    for role in ("voltage", "current", "position"):
        given = getattr(entry, role)
        if given is None:
            continue
        low, high = given if isinstance(given, tuple) else (-given, given)
        if not low < high:
            raise RigError(
                f"{where}: loop.limits.{role} is [{low}, {high}]; the lower comes first. Swap or correct them"
            )
        intervals[role] = (low, high)
    return Limits(**intervals)


def _noise(entry: NoiseEntry) -> Noise:
    return Noise(
        position=entry.position,
        current=entry.current,
        force=entry.force,
        voltage=entry.voltage,
        position_resolution=entry.resolutions.position,
        current_resolution=entry.resolutions.current,
        voltage_resolution=entry.resolutions.voltage,
    )
