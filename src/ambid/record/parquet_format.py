"""Records as Parquet, Arrow and Feather, read by pyarrow; units are in the fields' metadata or in the names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.errors import RecordError
from ambid.record.frames import imported, label_of
from ambid.record.record import Record
from ambid.record.sampling import GapPolicy
from ambid.record.streams import PIECE, Stream, is_time, library, record_of

_UNITS = (b"unit", b"units")


def read_parquet(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from a Parquet or Arrow file; Feather 2 is the latter."""
    with library(path, "Parquet or Arrow", (b"PAR1", b"ARROW1")) as digest:
        pyarrow = imported("pyarrow", "a Parquet or Arrow file", "formats")
        schema, rows, pieces, kind = _opened(path)
        numeric = [f for f in schema if _is_number(pyarrow, f.type)]
        dates = [f.name for f in numeric if pyarrow.types.is_temporal(f.type)]
        names = [label_of(f.name)[0] for f in numeric]
        # dates are time where nothing is called so
        clock = dates[0] if len(dates) == 1 and not any(map(is_time, names)) else None
        streams = [
            Stream(
                name=label_of(f.name)[0], size=rows, pieces=lambda name=f.name: pieces(name),  # type: ignore[misc]
                units=frozenset(_units(f)), time=f.name == clock or is_time(label_of(f.name)[0]),
            )
            for f in numeric
        ]  # fmt: skip
        twice = next((x for k, x in enumerate(names) if x in names[:k]), None)
        if twice is not None:
            raise RecordError(f"record {path}: column {twice!r} occurs twice; names must differ. Rename one")
        left = [f.name for f in schema if f not in numeric]
        settings = {"format": kind, **({"left_out": left} if left else {})}
        return record_of(path, digest, streams, settings, layout, rate_hz, gaps)


def _opened(path: Path) -> tuple[Any, int, Callable[[str], Iterator[np.ndarray]], str]:
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


def _is_number(pyarrow: Any, kind: Any) -> bool:
    types = pyarrow.types
    tests = types.is_integer, types.is_floating, types.is_boolean, types.is_timestamp, types.is_duration
    return any(test(kind) for test in tests)


def _units(field: Any) -> Iterator[str]:
    inside, metadata = label_of(field.name)[1], field.metadata or {}
    for text in (inside, *(metadata[k].decode("utf-8", "replace") for k in _UNITS if k in metadata)):
        if text is not None and text.strip():
            yield text.strip()
