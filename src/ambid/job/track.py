"""The on-line job: a record is replayed through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.job._progress import Tick, silent
from ambid.job.bench_rows import rows_of
from ambid.job.follow import Flag, Pace, follow
from ambid.job.track_settings import check_settings
from ambid.job.track_start import start_of
from ambid.record import Record
from ambid.recursive.lines import Track, TrackHeader, TrackLine
from ambid.rig import Rig, default_rig, load_rig


def track(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    method: str = "rpem",
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
    **settings: Any,
) -> Track:
    """Follow the physical parameters of a bench through a record, or with another `method` what that estimates.

    `method`: ``rpem``, the supervised tracker, or one of `ambid.job.track_estimator.METHODS`, which takes `settings`;
    `start`: where tracking begins; default: an identification of the first part of the record; `start_s`: length of
    that part, s; `every_s`: reporting interval, s of record; `limit`: acceptable model error, in multiples of that at
    identification; `pace`: replay as fast as possible, or as the record was taken; `flags`: what an operator sets and
    when, s of record; `from_s`, `to_s`: part of the record to use, s; `rate_hz`: sampling rate for a file without a
    time column; `on_header`: called once, before the first line; `keep`: keep the lines for the result; without, memory
    stays constant.
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
    if method != "rpem" or settings:
        from ambid.job.track_estimator import track_estimator

        if pace != "fastest" or flags:
            raise EstimationError(f"method {method} has no supervisor: it takes no pace and no flags. Leave them out")
        return track_estimator(
            record, told, method=method, start=start, start_s=start_s, every_s=every_s, limit=limit, memory=memory,
            from_s=from_s, to_s=to_s, rate_hz=rate_hz, on_header=on_header, on_line=on_line, keep=keep, **settings,
        )  # fmt: skip
    source = rows_of(record, told, from_s=from_s, to_s=to_s, rate_hz=rate_hz)
    say("start")
    begin = start_of(source, bench_rig, given=start, start_s=start_s, rig_speaks=told is not None)
    say("track")
    return follow(
        source.replay.since(begin.first), source, begin, bench_rig, every_s=every_s, limit=limit, memory=memory,
        pace=pace, flags=flags, on_header=on_header, on_line=on_line, keep=keep,
    )  # fmt: skip
