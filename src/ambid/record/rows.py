"""Rows of a damaged record as they stand in the file: missing values, gaps and jumps of time are kept, not refused.

For whoever meets damage itself, such as a stream that is replayed; everything else wants `read_record`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.csv_format import read_csv_rows
from ambid.record.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """A record of rows that need not be uniform.

    Attributes
    ----------
    record : Record
        The rows in the order of the file; NaN where a value is missing. Its rate is that of the usual interval; its
        own time, which is uniform, is not that of the rows unless `time_s` is None.
    time_s : ndarray, shape (n_rows,), or None
        The time column, s; NaN where a stamp is missing. None if the file has none.
    """

    record: Record
    time_s: Array | None


def read_rows(path: str | Path, *, rate_hz: float | None = None) -> Rows:
    """Read the rows of a record that may be damaged.

    Parameters
    ----------
    path : str or Path
        ``.csv``, ``.csv.gz``, ``.h5`` or ``.hdf5``.
    rate_hz : float, optional
        Sampling rate in Hz, for a file that does not hold it.

    Returns
    -------
    Rows
        In SI units.

    Raises
    ------
    RecordError
        If the format is another one, a row has too many or too few cells, or there is no rate.
    """
    path = Path(path)
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz")):
        record, time_s = read_csv_rows(path, rate_hz=rate_hz)
        return Rows(record=record, time_s=time_s)
    if name.endswith((".h5", ".hdf5")):
        from ambid.record.hdf5_format import read_hdf5

        return Rows(record=read_hdf5(path), time_s=None)
    raise RecordError(f"record {path}: rows are read from .csv, .csv.gz, .h5 and .hdf5 only. Write the record as one")
