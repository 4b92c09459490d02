"""The record and its files: CSV, HDF5 and MATLAB, one module per format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ambid.errors import RecordError
from ambid.record.csv_format import read_csv, write_csv
from ambid.record.record import Channel, Record, Step
from ambid.record.rows import Rows, read_rows
from ambid.record.sampling import GapPolicy

__all__ = ["Channel", "GapPolicy", "Record", "Rows", "Step", "read_record", "read_rows", "write_record"]


def read_record(
    path: str | Path,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy = "error",
    variables: Mapping[str, tuple[str, str]] | None = None,
) -> Record:
    """Read a record; the format is taken from the file's name.

    Parameters
    ----------
    path : str or Path
        ``.csv``, ``.csv.gz``, ``.h5``, ``.hdf5`` or ``.mat``.
    rate_hz : float, optional
        Sampling rate in Hz, for a file that does not hold it.
    gaps : {"error", "interpolate", "cut"}
        What to do about missing or non-finite values.
    variables : Mapping of channel name to (variable, unit), optional
        For ``.mat`` only: which variable is which channel, e.g. ``{"current": ("data.i", "mA")}``.

    Returns
    -------
    Record
        In SI units, with the file's SHA-256 in its provenance.

    Raises
    ------
    RecordError
        If the format is not known or the file breaks one of its rules.
    """
    path = Path(path)
    kind = _format_of(path)
    if variables is not None and kind != "mat":
        raise RecordError(f"{path}: a mapping of variables is for .mat files. Leave it out")
    if kind == "csv":
        return read_csv(path, rate_hz=rate_hz, gaps=gaps)
    if kind == "mat":
        from ambid.record.mat_format import read_mat

        return read_mat(path, variables=variables, rate_hz=rate_hz, gaps=gaps)
    from ambid.record.hdf5_format import read_hdf5_checked

    return read_hdf5_checked(path, rate_hz=rate_hz, gaps=gaps)


def write_record(record: Record, path: str | Path, *, comments: Sequence[str] = ()) -> None:
    """Write a record; the format is taken from the file's name.

    Parameters
    ----------
    record : Record
        What to write.
    path : str or Path
        ``.csv``, ``.csv.gz`` (values and units only), ``.h5`` or ``.hdf5`` (everything).
    comments : sequence of str
        Comment lines for CSV; HDF5 has the history instead and refuses them.

    Raises
    ------
    RecordError
        If the format is not known or cannot hold the record.
    """
    path = Path(path)
    kind = _format_of(path)
    if kind == "csv":
        write_csv(record, path, comments=comments)
        return
    if kind == "mat":
        raise RecordError(f"{path}: .mat files are read, not written. Write .csv, .csv.gz or .h5")
    if comments:
        raise RecordError(f"{path}: comment lines go into CSV only. Leave them out, or write .csv")
    from ambid.record.hdf5_format import write_hdf5

    write_hdf5(record, path)


_SUFFIXES = {".csv": "csv", ".csv.gz": "csv", ".h5": "hdf5", ".hdf5": "hdf5", ".mat": "mat"}


def _format_of(path: Path) -> str:
    for suffix, kind in _SUFFIXES.items():
        if path.name.lower().endswith(suffix):
            return kind
    if path.is_dir():
        raise RecordError(f"record {path} is a folder; a file is wanted. Name the file inside it")
    raise RecordError(f"record {path}: its format is not known by its name; known: {', '.join(_SUFFIXES)}. Rename it")
