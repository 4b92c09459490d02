"""The on-line job: a record is replayed through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from ambid.errors import EstimationError
from ambid.identify.estimate import Estimate
from ambid.job._progress import Tick, silent
from ambid.job.bench_rows import rows_of
from ambid.job.follow import Flag, Pace, follow
from ambid.job.track_settings import check_settings
from ambid.job.track_start import start_of
from ambid.record import Record
from ambid.rig import Rig, default_rig, load_rig
from ambid.track.lines import Track, TrackHeader, TrackLine


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
) -> Track:
    """Follow the physical parameters of a bench through a record.

    Parameters
    ----------
    record : Record, str or Path
        A file in the rig's columns, or a record whose channels are named by role. Gaps are met, not refused.
    rig : Rig, str or Path, optional
        What is known of the bench; default: columns voltage, current and position, of a turning rotor also speed and
        angle, everything free.
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
    EstimationError
        If a setting makes no sense, or the start cannot be tracked from.
    """
    check_settings(
        record, start=start, start_s=start_s, every_s=every_s, limit=limit, memory=memory, pace=pace, flags=flags,
        rate_hz=rate_hz, from_s=from_s, to_s=to_s,
    )  # fmt: skip
    say = tick or silent
    if not (rig is None or isinstance(rig, (Rig, str, Path))):
        raise EstimationError(f"rig is a {type(rig).__name__}; it must be a Rig or the path of a rig file. Give one")
    told = rig if rig is None or isinstance(rig, Rig) else load_rig(rig)
    bench_rig = told or default_rig()
    source = rows_of(record, told, from_s=from_s, to_s=to_s, rate_hz=rate_hz)
    say("start")
    begin = start_of(source, bench_rig, given=start, start_s=start_s, rig_speaks=told is not None)
    say("track")
    return follow(
        source.replay.since(begin.first), source, begin, bench_rig, every_s=every_s, limit=limit, memory=memory,
        pace=pace, flags=flags, on_header=on_header, on_line=on_line, keep=keep,
    )  # fmt: skip
