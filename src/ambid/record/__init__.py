"""The record and its files: one module per format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from ambid.errors import RecordError, nearest
from ambid.record.csv_format import read_csv, read_csv_rows, write_csv
from ambid.record.record import Channel, Record, Step, cut
from ambid.record.sampling import GapPolicy, Rows, check_gap_policy, checked

__all__ = [
    "ENDINGS",
    "Channel",
    "Frame",
    "GapPolicy",
    "Record",
    "Rows",
    "Source",
    "Step",
    "cut",
    "read_record",
    "read_rows",
    "write_record",
]


class Frame(Protocol):
    """A DataFrame, of pandas or polars."""

    @property
    def columns(self) -> Any:
        """Its labels."""


Source = Record | str | Path | Frame | Mapping[str, Any]
"""A record, its file, or a table in memory: a DataFrame, a Dataset of xarray, or arrays by name."""


def read_record(
    source: Source,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy = "error",
    units: Mapping[str, str] | None = None,
    variables: Mapping[str, tuple[str, str]] | None = None,
    layout: Mapping[str, str] | None = None,
) -> Record:
    """Read a record from a file, whose name tells its format, or take it from a table in memory.

    Parameters
    ----------
    source : str, Path, Record, DataFrame, Dataset or Mapping of str to array
        A file that ends in one of `ENDINGS`; a table as `Record.from_dataframe` takes it; or a record, which stays as
        it is unless gaps are to be treated. TDMS, MDF, Parquet and Arrow need the extra ``ambid[formats]``.
    rate_hz : float, optional
        Sampling rate in Hz, for a source that does not hold it.
    gaps : {"error", "interpolate", "cut"}
        What to do about missing or non-finite values.
    units : Mapping of str to str, optional
        For tables only: unit by column.
    variables : Mapping of channel name to (variable, unit), optional
        For ``.mat`` only: which variable is which channel, e.g. ``{"current": ("data.i", "mA")}``.
    layout : Mapping of str to str, optional
        What a file leaves open, e.g. ``{"group": "Log"}`` or ``{"decimal": ","}``: `LAYOUTS` lists the words of each
        format. A reader that is not sure asks for one of them.

    Returns
    -------
    Record
        In SI units, with the file's SHA-256 in its provenance; of a table that of its numbers.

    Raises
    ------
    RecordError
        If the format is not known or the source breaks one of its rules.
    """
    if units and isinstance(source, (str, Path, Record)):
        raise RecordError("units= is for tables in memory; a file says its units itself. Omit it")
    if isinstance(source, Record):
        return source if rate_hz is None and gaps == "error" else checked(source, "the record", rate_hz, gaps)
    if not isinstance(source, (str, Path)):
        from ambid.record.frames import read_table

        return read_table(source, rate_hz=rate_hz, units=units, gaps=gaps)
    path = Path(source)
    kind, layout = format_of(path), dict(layout or {})
    if variables is not None and kind not in NAMED:
        raise RecordError(f"{path}: a mapping of variables is for .mat files and arrays by name. Omit it")
    _check_layout(kind, layout, path)
    if kind == "csv":
        return read_csv(path, rate_hz=rate_hz, gaps=gaps, layout=layout)
    if kind == "mat":
        from ambid.record.mat_format import read_mat

        return read_mat(path, variables=variables, rate_hz=rate_hz, gaps=gaps, layout=layout)
    if kind == "hdf5":
        from ambid.record.hdf5_format import is_own, read_hdf5

        if is_own(path):
            return checked(read_hdf5(path), f"record {path}", rate_hz, gaps)
        from ambid.record.array_formats import read_foreign_hdf5

        return read_foreign_hdf5(path, variables=variables, rate_hz=rate_hz, gaps=gaps, layout=layout)
    check_gap_policy(gaps)
    room = "array_formats" if kind in ("numpy", "xlsx") else "library_formats"
    reader: Any = getattr(import_module(f"ambid.record.{room}"), f"read_{kind}")
    named = {"variables": variables} if kind == "numpy" else {}
    return reader(path, layout=layout, rate_hz=rate_hz, gaps=gaps, **named)  # type: ignore[no-any-return]


def _check_layout(kind: str, layout: Mapping[str, str], path: Path) -> None:
    words = LAYOUTS.get(kind, ())
    for word, value in layout.items():
        if word not in words or not isinstance(value, str) or not value:
            has = f"the layout of .{kind} files has {', '.join(words)}" if words else f".{kind} files have no layout"
            raise RecordError(f"{path}: layout {word}={value!r}; {has}.{nearest(word, words)} Correct or omit it")


def read_rows(
    source: Source,
    *,
    rate_hz: float | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
) -> Rows:
    """Read the rows of a record that may be damaged.

    Parameters
    ----------
    source : str, Path, Record, DataFrame, Dataset or Mapping of str to array
        ``.csv``, ``.csv.gz``, ``.h5`` or ``.hdf5``, or as `read_record`.
    rate_hz : float, optional
        Sampling rate in Hz, for a source that does not hold it.
    units : Mapping of str to str, optional
        For tables only: unit by column.
    layout : Mapping of str to str, optional
        As `read_record`.

    Returns
    -------
    Rows
        In SI units.

    Raises
    ------
    RecordError
        If the format is another one, a row has too many or too few cells, or there is no rate.
    """
    if isinstance(source, Record):
        return Rows(record=read_record(source, units=units), time_s=None)
    if not isinstance(source, (str, Path)):
        from ambid.record.frames import read_table_rows

        return read_table_rows(source, rate_hz=rate_hz, units=units)
    path = Path(source)
    kind = format_of(path)
    _check_layout(kind, layout or {}, path)
    if kind == "csv":
        return read_csv_rows(path, rate_hz=rate_hz, layout=layout or {})
    if kind == "hdf5":
        from ambid.record.hdf5_format import read_hdf5

        return Rows(record=read_hdf5(path), time_s=None)
    raise RecordError(f"record {path}: rows are read from .csv, .csv.gz, .h5 and .hdf5 only. Write the record as one")


def write_record(record: Record, path: str | Path, *, comments: Sequence[str] = ()) -> None:
    """Write a record; the format is taken from the file's name.

    Parameters
    ----------
    record : Record
        What to write.
    path : str or Path
        ``.csv``, ``.csv.gz`` (values and units only), ``.h5`` or ``.hdf5`` (everything).
    comments : sequence of str
        For CSV, into a file ``NAME-metadata.json`` beside it; HDF5 has the history instead and refuses them.

    Raises
    ------
    RecordError
        If the format is not known or cannot hold the record.
    """
    path = Path(path)
    kind = format_of(path)
    if kind == "csv":
        write_csv(record, path, comments=comments)
        return
    if kind != "hdf5":
        raise RecordError(f"{path}: {path.suffix} files are read, not written. Write .csv, .csv.gz or .h5")
    if comments:
        raise RecordError(f"{path}: comment lines go into CSV only. Omit them, or write .csv")
    from ambid.record.hdf5_format import write_hdf5

    write_hdf5(record, path)


_SUFFIXES = {
    ".csv": "csv", ".csv.gz": "csv", ".txt": "csv", ".dat": "csv", ".lvm": "csv", ".tsv": "csv", ".asc": "csv",
    ".h5": "hdf5", ".hdf5": "hdf5", ".mat": "mat", ".fig": "mat", ".npz": "numpy", ".npy": "numpy", ".xlsx": "xlsx",
    ".xlsm": "xlsx", ".tdms": "tdms", ".mf4": "mdf", ".mdf": "mdf", ".parquet": "parquet", ".feather": "parquet",
    ".arrow": "parquet",
}  # fmt: skip

ENDINGS = tuple(_SUFFIXES)
"""How names of records end that can be read."""

NAMED = ("mat", "numpy", "hdf5")
"""Formats in which variables are named by their paths."""

LAYOUTS = {
    "csv": ("decimal", "separator", "thousands", "units", "encoding", "time", "time_unit"),
    "xlsx": ("sheet", "decimal", "thousands", "units", "time", "time_unit"),
    "numpy": ("group", "channels", "time", "time_unit"),
    "hdf5": ("group", "channels", "time", "time_unit"),
    "tdms": ("group", "channels"),
    "mdf": ("group", "channels"),
    "parquet": ("channels",),
    "mat": ("group", "channels", "units", "values", "time", "time_unit"),
}
"""Words by which the layout of a file is told, by format."""


def format_of(path: Path) -> str:
    """Return the format that a name ends in."""
    for suffix, kind in _SUFFIXES.items():
        if path.name.lower().endswith(suffix):
            return kind
    if path.is_dir():
        raise RecordError(f"record {path} is a folder; it must be a file. Name the file inside it")
    if path.suffix.lower() in (".uff", ".unv"):
        raise RecordError(f"record {path} is a universal file; its frequency responses are for 'ambid frf'. Use that")
    raise RecordError(f"record {path}: its format is not known by its name; known: {', '.join(_SUFFIXES)}. Rename it")
