"""The truth beside a track, where its record holds it: columns ``true_NAME`` of a simulated record."""

from __future__ import annotations

import gzip
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ambid.errors import AmbidError
from ambid.record import Record, read_record


def truth_beside(
    record: Record | Path | str, rate: float | None, units: Mapping[str, str]
) -> dict[str, tuple[Any, Any]]:
    """Read the truth that a simulated record holds: columns ``true_NAME``.

    `rate`: sampling rate in Hz, for a record without time; `units`: SI unit of each tracked number; empty where it is
    not known. Returns ndarrays of shape (n_samples,), s of record and SI; without parameters that have no such column,
    or one in another unit.
    """
    if not isinstance(record, Record) and not _may_hold_truth(Path(record)):
        return {}
    try:
        raw = record if isinstance(record, Record) else read_record(record, rate_hz=rate, gaps="interpolate")
    except AmbidError as refused:
        print(f"ambid: drawn without the truth: {refused}", file=sys.stderr)
        return {}
    truth = {}
    for channel in raw.channels:
        name = channel.name.removeprefix("true_")
        if name == channel.name or name not in units:
            continue
        if units[name] not in ("", channel.unit):
            inside = f"is in [{channel.unit}], the tracked number in [{units[name]}]"
            print(f"ambid: column {channel.name!r} {inside}: it is not drawn", file=sys.stderr)
            continue
        truth[name] = (raw.time_s, channel.values)
    return truth


def _may_hold_truth(record: Path) -> bool:
    """Tell by the name, of a text file by its beginning, so that a long record is not read again for nothing."""
    if not record.name.lower().endswith((".csv", ".csv.gz")):
        return record.name.lower().endswith((".h5", ".hdf5"))  # simulations write no other
    try:
        with gzip.open(record) if record.name.lower().endswith(".gz") else record.open("rb") as file:
            return b"true_" in file.read(65536)
    except (OSError, EOFError):
        return False
