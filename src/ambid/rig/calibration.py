"""Calibration of a rig's channels, and how well they and the planes are known: gains, offsets, tables, lengths."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from ambid.errors import AmbidError, RigError
from ambid.record.calibration import Calibration, read_calibration_table
from ambid.rig.rotor import read_at, si_of

if TYPE_CHECKING:
    from ambid.rig.schema import ChannelEntry, RigFile


def calibration_of(entry: ChannelEntry, unit: str, place: str, folder: Path) -> Calibration | None:
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


def channel_sd_of(entry: ChannelEntry, unit: str, place: str, *, known: bool) -> dict[str, float | None]:
    """Return ``gain_sd`` and ``offset_sd`` of a channel, the offset in its SI `unit`.

    `known`: whether it is a whole input or output, the only ones that have them.
    """
    gain, offset = entry.gain_sd, entry.offset_sd
    if not known and (gain, offset) != (None, None):
        raise RigError(
            f"{place}.{'offset_sd' if gain is None else 'gain_sd'} is given; only a whole input or output of the model "
            "has it. Omit it here"
        )
    of_unit = offset if offset is None or isinstance(offset, float) else si_of(offset, unit, f"{place}.offset_sd")
    return {"gain_sd": gain, "offset_sd": of_unit}


def plane_sd_of(file: RigFile, where: str) -> Mapping[str, float]:
    """Return how well the planes of bearings are known, m, by ``<bearing>.<key>``."""
    known = dict[str, float]()
    for name, b in file.bearings.items():
        magnet, read = [] if b.z is None else [b.z], read_at(b)
        for key, at in {"z_sd": [*magnet, *read], "z_magnet_sd": magnet, "z_sensor_sd": read}.items():
            if getattr(b, key) is None:
                continue
            if b.axial or any(z.value is None or z.role not in (None, "fixed") for z in at):
                raise RigError(
                    f"{where}: bearings.{name}.{key} is of planes that are measured and fixed. Omit it, or give such"
                    ' planes; one with role = "prior" has an sd of its own'
                )
            known[f"{name}.{key}"] = si_of(getattr(b, key), "m", f"{where}: bearings.{name}.{key}")
    return MappingProxyType(known)
