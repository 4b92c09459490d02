"""What an on-line job is asked for, checked before anything is read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from ambid.errors import EstimationError, nearest
from ambid.record import Record

FLAGS = ("track", "hold", "accept", "revert")
PACES = ("fastest", "real-time")
SHORTEST_S, LONGEST_S = 1e-3, 1e9  # of a memory: below a block, and beyond any record


def check_settings(
    record: object,
    *,
    start: object,
    start_s: object,
    every_s: object,
    limit: object,
    memory: object,
    pace: object,
    flags: Sequence[object],
    rate_hz: object,
    from_s: object = None,
    to_s: object = None,
) -> None:
    """Refuse settings that make no sense, or that contradict one another.

    `record`, `start`, `start_s`, `every_s`, `limit`, `memory`, `pace`, `flags`, `rate_hz`, `from_s`, `to_s`: as
    `ambid.job.track.track` takes them.
    """
    for name, x in (("every_s", every_s), ("limit", limit)):
        _positive(name, x)
    for name, x in (("start_s", start_s), ("rate_hz", rate_hz)):
        if x is not None:
            _positive(name, x)
    for name, x in (("from_s", from_s), ("to_s", to_s)):
        if x is not None and math.isnan(_number(x)):
            raise EstimationError(f"{name} is {_short(x)}; it must be a time in s. Correct it")
    if memory not in ("auto", "all"):
        _positive("memory", memory, other="'auto', 'all' or ")
        if not SHORTEST_S <= _number(memory) <= LONGEST_S:
            raise EstimationError(
                f"memory is {_short(memory)} s; it must lie between {SHORTEST_S:g} and {LONGEST_S:g}. Give 'all' where"
                " nothing is to be forgotten"
            )
    if pace not in PACES:
        raise EstimationError(f"pace is {pace!r}; known: {', '.join(PACES)}. Correct it")
    if not isinstance(record, (Record, str, Path)):
        raise EstimationError(f"record is {_short(record)}; it must be a Record or the path of a file. Give one")
    if start is not None and start_s is not None:
        raise EstimationError(
            "start_s is for a start identified from the record; start gives one. Leave one of them out"
        )
    if rate_hz is not None and isinstance(record, Record):
        raise EstimationError(
            f"rate_hz = {rate_hz} is for files without a time column; this record has {record.rate_hz:g} Hz. Leave it"
            " out, or replace the record's"
        )
    for flag in flags:
        _check_flag(flag)


def _positive(name: str, x: object, *, other: str = "") -> None:
    number = _number(x)
    if not (math.isfinite(number) and number > 0):
        raise EstimationError(f"{name} is {_short(x)}; it must be {other}a positive number. Correct it")


def _number(x: object) -> float:
    """A number as float; NaN for anything else."""
    try:
        return math.nan if isinstance(x, (str, bool)) else float(x)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _check_flag(flag: object) -> None:
    """Refuse a flag that is not a pair of a finite time and a known name."""
    if isinstance(flag, str) or not isinstance(flag, Sequence) or len(flag) != 2:
        raise EstimationError(f"flag {_short(flag)} is no pair of a time in s and a name, such as (12.5, 'hold')")
    t, name = flag
    if isinstance(t, (str, bool)) or not isinstance(t, (int, float)) or not math.isfinite(t):
        raise EstimationError(f"flag {_short(flag)}: its time is {_short(t)}; it must be finite, in s. Correct it")
    if name not in FLAGS:
        near = nearest(name, FLAGS) if isinstance(name, str) else ""
        raise EstimationError(f"flag {_short(flag)}: {_short(name)} is unknown; known: {', '.join(FLAGS)}.{near}")


def _short(x: object) -> str:
    text = repr(x)
    return text if len(text) <= 60 else f"{text[:57]}..."
