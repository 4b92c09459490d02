"""Records of measurement systems of vehicles: MDF 3 and 4, read by asammdf with its conversions."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.record.frames import imported
from ambid.record.record import Record
from ambid.record.sampling import GapPolicy
from ambid.record.streams import Stream, chosen_group, library, record_of

_FRAGMENT = 1 << 22  # bytes of records that are read at once


def read_mdf(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from an MDF file: the channels of one group, which share a time base. Attachments are not read."""
    asammdf = imported("asammdf", "an MDF file", "formats")
    logging.getLogger("asammdf").setLevel(
        logging.CRITICAL
    )  # what it says of damage, it raises too, or the lengths tell
    with (
        library(path, "MDF", (b"MDF     ", b"UnFinMF ")) as digest,
        path.open("rb") as file,  # a path would be mapped, and all of it counted as memory
        _opened(asammdf, file) as mdf,
    ):
        mdf.configure(read_fragment_size=_FRAGMENT)
        groups = {k: g for k, g in enumerate(mdf.groups) if g.channel_group.cycles_nr}
        names = {k: getattr(g.channel_group, "acq_name", "") or f"{k}" for k, g in groups.items()}
        called = {k: f"{k}" if list(names.values()).count(name) > 1 else name for k, name in names.items()}
        listed = {called[k]: [c.name for c in g.channels] for k, g in groups.items()}
        group = chosen_group(path, listed, layout.get("group"))
        at = next(k for k, name in called.items() if name == group)
        master, streams, left = mdf.masters_db.get(at), list[Stream](), list[str]()
        for k, channel in enumerate(groups[at].channels):
            first = mdf.get(group=at, index=k, record_count=1, ignore_invalidation_bits=True)
            if first.samples.dtype.kind not in "fiub" or first.samples.ndim != 1:
                left.append(channel.name)
                continue
            unit, time = str(first.unit).strip(), k == master
            streams.append(
                Stream(
                    name=channel.name, size=groups[at].channel_group.cycles_nr, time=time,
                    pieces=lambda k=k: _pieces(mdf, at, k),  # type: ignore[misc]
                    units=frozenset({unit} - {""}) or frozenset({"s"} if time else ()),
                    start=(0.0, mdf.header.start_time.isoformat()),
                )
            )  # fmt: skip
        settings = {"format": f"mdf {mdf.version}", "group": group, **({"left_out": left} if left else {})}
        return record_of(path, digest, streams, settings, layout, rate_hz, gaps)


def _opened(asammdf: Any, file: Any) -> Any:
    """Open a file; the half-made object of a damaged one fails once more when it goes, and Python would print that."""
    usual, failure = sys.unraisablehook, ""
    sys.unraisablehook = lambda _: None
    try:
        return asammdf.MDF(file)
    except Exception as raised:  # its parser raises whatever it meets in a damaged file
        failure = f"{type(raised).__name__}: {raised}"
    finally:
        if failure:
            gc.collect()  # it may be in a circle
        sys.unraisablehook = usual
    raise ValueError(failure)


def _pieces(mdf: Any, group: int, index: int) -> Iterator[np.ndarray]:
    """Yield physical values; NaN where the file says that they are invalid."""
    for values, invalid in mdf.iter_get(group=group, index=index, samples_only=True):
        yield values if invalid is None or not np.any(invalid) else np.where(invalid, np.nan, values)
