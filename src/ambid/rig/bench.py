"""A record through the eyes of a rig: its columns become roles, calibrated, in the units that the model wants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from ambid.errors import RecordError, UnitError, nearest
from ambid.physics.models import model
from ambid.record import Channel, GapPolicy, Record, Step, read_record
from ambid.rig.load import role_units
from ambid.rig.rig import Rig, RigChannel
from ambid.units import UNKNOWN, parse_unit


def read_bench(path: str | Path, rig: Rig, *, rate_hz: float | None = None, gaps: GapPolicy | None = None) -> Record:
    """Read a record file as the rig says, and name its columns by their roles.

    Parameters
    ----------
    path : str or Path
        The record.
    rig : Rig
        Its `record` settings are used where the arguments do not override them; ``record.from`` and ``to`` are left to
        the caller, who knows of other ones.
    rate_hz : float, optional
        Sampling rate in Hz.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps.

    Returns
    -------
    Record
        As :func:`bench_record` gives it.

    Raises
    ------
    AmbidError
        If the file or its columns break a rule.
    """
    record = read_record(
        path,
        rate_hz=rate_hz if rate_hz is not None else rig.record.rate_hz,
        gaps=gaps or rig.record.gaps or "error",
        variables=mat_variables(rig) if Path(path).suffix.lower() == ".mat" else None,
    )
    return bench_record(record, rig)


def mat_variables(rig: Rig) -> dict[str, tuple[str, str]]:
    """Return which variable of a ``.mat`` file is which column, for :func:`ambid.record.read_record`.

    Parameters
    ----------
    rig : Rig
        With ``channels.<role>.variable`` and ``unit``.

    Returns
    -------
    dict of str to (str, str)
        Column name to (variable, unit); the unit is ``"?"`` where the rig gives none. ``time`` stands in it if the rig
        names a time variable.
    """
    variables = {c.column: (c.variable or c.column, c.unit or UNKNOWN) for c in rig.channels}
    if rig.record.time is not None:
        variables["time"] = rig.record.time
    return variables


def bench_record(record: Record, rig: Rig) -> Record:
    """Select the rig's columns, check their units, calibrate them and name them by their roles.

    Parameters
    ----------
    record : Record
        As read from a file: columns by name, SI units.
    rig : Rig
        Which column is which role, and its calibration.

    Returns
    -------
    Record
        Channels named by role, in the rig's order, in the units of the model; the history says what was done.

    Raises
    ------
    RecordError
        If a column is missing.
    UnitError
        If a column's unit is missing or unknown, or is not the role's and no gain or table turns it into that.
    """
    wanted = role_units(model(rig.model))
    for c in rig.channels:
        if c.column not in record.names:
            raise RecordError(
                f"the record has no column {c.column!r} (wanted by channels.{c.role}); it has"
                f" {', '.join(record.names)}."
                f"{nearest(c.column, record.names)} Correct channels.{c.role}.column"
            )
    found = {c.role: _in_declared_unit(record.channel(c.column), c) for c in rig.channels}
    _refuse_swapped(found, wanted, rig)
    channels, steps = [], []
    for c in rig.channels:
        channel, step = _calibrated(found[c.role], c, wanted[c.role])
        channels.append(replace(channel, name=c.role))
        steps += [step] if step else []
    columns = MappingProxyType({c.role: c.column for c in rig.channels})
    history = (*record.history, *steps, Step(name="select", settings=columns))
    return replace(record, channels=tuple(channels), history=history)


def _in_declared_unit(channel: Channel, c: RigChannel) -> Channel:
    """Apply channels.<role>.unit, which says in what unit the column was written, whatever its header says."""
    if c.unit is not None and c.unit != channel.source_unit:
        raw = channel.values
        if channel.unit != UNKNOWN:
            raw = raw / parse_unit(channel.source_unit).scale
        declared = parse_unit(c.unit)
        return Channel(name=channel.name, unit=declared.si, values=declared.to_si(raw), source_unit=declared.symbol)
    if channel.unit == UNKNOWN:
        unknown = channel.source_unit != UNKNOWN
        what = f"is in [{channel.source_unit}], an unknown unit" if unknown else "has no unit"
        raise UnitError(
            f"column {channel.name!r} {what} (wanted by channels.{c.role}). Write '{channel.name} [unit]' in the header"
            f" ([1] for a plain number), or give channels.{c.role}.unit"
        )
    return channel


def _refuse_swapped(found: dict[str, Channel], wanted: dict[str, str], rig: Rig) -> None:
    """Refuse two columns each of which has exactly the unit of the other's role."""
    plain = [c.role for c in rig.channels if c.calibration is None and found[c.role].unit != wanted[c.role]]
    for a in plain:
        for b in plain:
            if a != b and found[a].unit == wanted[b] and found[b].unit == wanted[a]:
                raise UnitError(
                    f"swapped columns? channels.{a} is column {found[a].name!r} in [{found[a].unit}] and channels.{b}"
                    f" is column {found[b].name!r} in [{found[b].unit}]. Swap the two, or fix the header"
                )


def _calibrated(channel: Channel, c: RigChannel, unit: str) -> tuple[Channel, Step | None]:
    """Return the channel in the role's unit, and the line for the history if it was calibrated."""
    if c.calibration is None:
        if channel.unit != unit:
            raise UnitError(
                f"column {channel.name!r} is in [{channel.source_unit}]; the rig wants a {c.role} in [{unit}]."
                f" Fix the header, or give channels.{c.role}.gain or table"
            )
        return channel, None
    # A gain is per SI unit of whatever the column is in, so its input unit is known only now.
    calibration = c.calibration if c.calibration.unit_in else replace(c.calibration, unit_in=channel.unit)
    return calibration.apply(channel), calibration.step(c.column)
