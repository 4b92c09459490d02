"""Records that npTDMS, asammdf and pyarrow read in physical values: TDMS of LabVIEW, DAQmx and DIAdem, MDF 3 and 4 of
vehicles, Parquet, Arrow and Feather. Units are in the files' properties, metadata or names.
"""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.errors import RecordError
from ambid.record.frames import imported
from ambid.record.record import Record
from ambid.record.sampling import GapPolicy
from ambid.record.streams import PIECE, Stream, chosen_group, library, record_of
from ambid.record.words import is_time, label_of

_TDMS_UNITS = ("unit_string", "NI_UnitDescription", "unit", "Unit", "units", "Units")
_FIELD_UNITS = (b"unit", b"units")  # of Parquet and Arrow
_FRAGMENT = 1 << 22  # bytes of records of an MDF file that are read at once


def read_tdms(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from a TDMS file: the channels of one group."""
    nptdms = imported("nptdms", "a TDMS file", "formats")
    for name in ("nptdms.reader", "nptdms.tdms_segment", "nptdms.base_segment", "nptdms.daqmx"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what it says of damage is refused below
    with library(path, "TDMS", (b"TDSm",)) as digest, nptdms.TdmsFile.open(path) as file:
        if file.file_status.incomplete_final_segment:
            raise RecordError(
                f"record {path} is cut off within its last segment: samples are missing at its end. Copy it again, or "
                "record again where the program that wrote it was stopped"
            )
        groups = {group.name: group.channels() for group in file.groups() if any(map(len, group.channels()))}
        group = chosen_group(path, {k: [c.name for c in v] for k, v in groups.items()}, layout.get("group"))
        numeric = [c for c in groups[group] if c.dtype.kind in "fiubM"]
        streams = [_tdms_stream(c) for c in numeric]
        left = [c.name for c in groups[group] if c not in numeric]
        settings = {"format": "tdms", "group": group, **({"left_out": left} if left else {})}
        return record_of(path, {"file": path.name, "sha256": digest}, streams, settings, layout, rate_hz, gaps)


def _tdms_stream(channel: Any) -> Stream:
    properties, time = channel.properties, is_time(channel.name)
    step = 0.0 if time else properties.get("wf_increment", 0.0)
    date = properties.get("wf_start_time")

    def pieces() -> Iterator[np.ndarray]:
        for at in range(0, len(channel), PIECE):
            yield channel.read_data(at, min(PIECE, len(channel) - at))

    return Stream(
        name=channel.name, size=len(channel), time=time, pieces=pieces,
        units=frozenset(str(properties[k]).strip() for k in _TDMS_UNITS if str(properties.get(k, "")).strip()),
        rate_hz=float(f"{1 / step:.10g}") if isinstance(step, float | int) and 0 < step < np.inf else None,
        start=(float(properties.get("wf_start_offset", 0.0)), "" if date is None else f"{date}Z"),
    )  # fmt: skip


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
        _opened_mdf(asammdf, file) as mdf,
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
                    pieces=lambda k=k: _mdf_pieces(mdf, at, k),  # type: ignore[misc]
                    units=frozenset({unit} - {""}) or frozenset({"s"} if time else ()),
                    start=(0.0, mdf.header.start_time.isoformat()),
                )
            )  # fmt: skip
        settings = {"format": f"mdf {mdf.version}", "group": group, **({"left_out": left} if left else {})}
        return record_of(path, {"file": path.name, "sha256": digest}, streams, settings, layout, rate_hz, gaps)


def _opened_mdf(asammdf: Any, file: Any) -> Any:
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


def _mdf_pieces(mdf: Any, group: int, index: int) -> Iterator[np.ndarray]:
    """Yield physical values; NaN where the file says that they are invalid."""
    for values, invalid in mdf.iter_get(group=group, index=index, samples_only=True):
        yield values if invalid is None or not np.any(invalid) else np.where(invalid, np.nan, values)


def read_parquet(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from a Parquet or Arrow file; Feather 2 is the latter."""
    with library(path, "Parquet or Arrow", (b"PAR1", b"ARROW1")) as digest:
        pyarrow = imported("pyarrow", "a Parquet or Arrow file", "formats")
        schema, rows, pieces, kind = _opened_table(path)
        types = pyarrow.types
        tests = types.is_integer, types.is_floating, types.is_boolean, types.is_timestamp, types.is_duration
        numeric = [f for f in schema if any(test(f.type) for test in tests)]
        dates = [f.name for f in numeric if pyarrow.types.is_temporal(f.type)]
        names = [label_of(f.name)[0] for f in numeric]
        # dates are time where nothing is called so
        clock = dates[0] if len(dates) == 1 and not any(map(is_time, names)) else None
        streams = [
            Stream(
                name=label_of(f.name)[0], size=rows, pieces=lambda name=f.name: pieces(name),  # type: ignore[misc]
                units=frozenset(_field_units(f)), time=f.name == clock or is_time(label_of(f.name)[0]),
            )
            for f in numeric
        ]  # fmt: skip
        twice = next((x for k, x in enumerate(names) if x in names[:k]), None)
        if twice is not None:
            raise RecordError(f"record {path}: column {twice!r} occurs twice; names must differ. Rename one")
        left = [f.name for f in schema if f not in numeric]
        settings = {"format": kind, **({"left_out": left} if left else {})}
        return record_of(path, {"file": path.name, "sha256": digest}, streams, settings, layout, rate_hz, gaps)


def _opened_table(path: Path) -> tuple[Any, int, Callable[[str], Iterator[np.ndarray]], str]:
    """Return the schema, the number of rows, what yields a column by pieces, and the format."""
    import pyarrow

    def plain(column: Any) -> np.ndarray:
        return np.asarray(column.to_numpy(zero_copy_only=False))

    with path.open("rb") as file:
        magic = file.read(4)
    if magic == b"PAR1":
        from pyarrow import parquet

        whole = parquet.ParquetFile(path)

        def pages(name: str) -> Iterator[np.ndarray]:
            return (plain(batch.column(0)) for batch in whole.iter_batches(PIECE, columns=[name]))

        return whole.schema_arrow, whole.metadata.num_rows, pages, "parquet"
    reader = pyarrow.ipc.open_file(pyarrow.memory_map(str(path)))
    batches = [reader.get_batch(k) for k in range(reader.num_record_batches)]  # of the map: nothing is copied
    for batch in batches:
        batch.validate(full=True)

    def columns(name: str) -> Iterator[np.ndarray]:
        return (plain(batch.column(name)) for batch in batches)

    return reader.schema, sum(batch.num_rows for batch in batches), columns, "arrow"


def _field_units(field: Any) -> Iterator[str]:
    inside, metadata = label_of(field.name)[1], field.metadata or {}
    for text in (inside, *(metadata[k].decode("utf-8", "replace") for k in _FIELD_UNITS if k in metadata)):
        if text is not None and text.strip():
            yield text.strip()
