"""The on-line job: a record is replayed through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from ambid.errors import EstimationError
from ambid.identify.estimate import Estimate
from ambid.job._progress import Tick
from ambid.record import Record
from ambid.rig import Rig
from ambid.track.lines import Track, TrackHeader, TrackLine

Flag = Literal["track", "hold", "accept", "revert"]
Pace = Literal["fastest", "real-time"]


def track(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    start: Estimate | str | Path | None = None,
    start_s: float | None = None,
    every_s: float = 0.01,
    limit: float = 1.5,
    memory: float | Literal["auto", "all"] = "auto",
    pace: Pace = "fastest",
    flags: Sequence[tuple[float, Flag]] = (),
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    on_header: Callable[[TrackHeader], None] | None = None,
    on_line: Callable[[TrackLine], Sequence[Flag] | None] | None = None,
    keep: bool = True,
    tick: Tick | None = None,
) -> Track:  # noqa: ARG001
    """Follow the physical parameters of a bench through a record.

    Parameters
    ----------
    record : Record, str or Path
        A file in the rig's columns, or a record whose channels are named by role. Gaps are met, not refused.
    rig : Rig, str or Path, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    start : Estimate, str or Path, optional
        Where tracking begins; default: an identification of the first part of the record.
    start_s : float, optional
        Length of that part, s.
    every_s : float
        Reporting interval, s of record.
    limit : float
        Acceptable model error, in multiples of that at identification.
    memory : float, "auto" or "all"
        Time constant with which old data are forgotten, s; found from the data; or none is forgotten.
    pace : {"fastest", "real-time"}
        Replay as fast as possible, or as the record was taken.
    flags : sequence of (float, str)
        What an operator sets and when, s of record.
    from_s, to_s : float, optional
        Part of the record to use, s.
    rate_hz : float, optional
        Sampling rate for a file without a time column.
    on_header : callable, optional
        Called once, before the first line.
    on_line : callable, optional
        Called with each line as it comes; may return flags that an operator set meanwhile.
    keep : bool
        Keep the lines for the result; without, memory stays constant.
    tick : callable, optional
        Called with the name of the present stage now and then; may raise to interrupt.

    Returns
    -------
    Track

    Raises
    ------
    AmbidError
        If record, rig or start break a rule.
    """
    raise EstimationError("tracking is not connected yet")
