"""Rows of a damaged record as they stand in the file: missing values, gaps and jumps of time are kept, not refused.

For whoever meets damage itself, such as a stream that is replayed; everything else needs `read_record`.
"""

from __future__ import annotations

from dataclasses import dataclass

from ambid.arrays import Array
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
