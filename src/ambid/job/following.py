"""How a track is made and told: its settings, and which of them make no sense."""

from __future__ import annotations

import gzip
import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypedDict

from ambid.blackbox.data import Orders
from ambid.errors import AmbidError, EstimationError
from ambid.job.data import Names
from ambid.record import Record, read_record
from ambid.recursive.lines import Event, Track, TrackHeader, TrackLine
from ambid.report.track_figures import TrackHistory
from ambid.settings.caller import setting
from ambid.tracking.gate import Flag
from ambid.tracking.lines_file import Tally

Memory = float | Literal["auto", "all"]
Pace = Literal["fastest", "real-time"]
OnLine = Callable[[TrackLine], Sequence[Flag] | None]

_PACES = ("fastest", "real-time")
_SHORTEST_S, _LONGEST_S = 1e-3, 1e9  # of a memory: below a block, and beyond any record


@dataclass(frozen=True, slots=True, kw_only=True)
class Following:
    """How a track is made and told."""

    every_s: float = 0.01  # reporting interval, s of record
    limit: float = 1.5  # acceptable model error, in multiples of that at identification
    memory: Memory = "auto"  # how long data count: a time constant in s, found from the data, or for ever
    pace: Pace = "fastest"  # replay as fast as possible, or as the record was taken
    on_header: Callable[[TrackHeader], None] | None = None  # called once before the first line
    on_line: OnLine | None = None  # called with each line; flags that it returns are set
    keep: bool = True  # keep all lines for the result; else the last one alone, and memory stays constant

    def collect(self, lines: list[TrackLine]) -> OnLine:
        """Return what takes each line: kept in `lines`, all or the last one, and passed on."""

        def take(line: TrackLine) -> Sequence[Flag] | None:
            if not self.keep:
                lines.clear()
            lines.append(line)
            return None if self.on_line is None else self.on_line(line)

        return take


def tell(header: TrackHeader, lines: Iterable[TrackLine], how: Following) -> Track:
    """Return the track of lines that come one by one, each told as `how` says."""
    collected = list[TrackLine]()
    tally, take, begun = Tally(header), how.collect(collected), time.perf_counter()
    if how.on_header is not None:
        how.on_header(header)
    for line in lines:
        tally.add(line)
        take(line)
    return Track(header=header, lines=tuple(collected), totals=tally.summary(computing_s=time.perf_counter() - begun))


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What a track is drawn and told with beside its lines."""

    record: Any = None  # which may hold the truth, in columns true_NAME, and its rate in Hz where it has no time
    rate_hz: float | None = None
    history: TrackHistory | None = None  # all lines as numbers, where only the last one was kept
    events: Sequence[Event] = ()  # decisions that are told


class FollowingWords(TypedDict, total=False):
    """The fields of `Following`."""

    every_s: float
    limit: float
    memory: Memory
    pace: Pace
    on_header: Callable[[TrackHeader], None] | None
    on_line: OnLine | None
    keep: bool


class EstimatorWords(TypedDict, total=False):
    """What methods with coefficients are told, as `fit`; and the step of lms and nlms, for signals of size one."""

    input: Names | None
    output: Names | None
    orders: Orders | str | None
    open_loop: bool
    step: float | None


def check_settings(said: Mapping[str, Any]) -> None:
    """Refuse what `track` is told where it makes no sense or contradicts itself."""
    for name in ("every_s", "limit", "rate_hz"):
        if name in said and not (said[name] is None and name == "rate_hz"):
            _positive(setting(name), said[name])
    if isinstance(said.get("start"), (int, float)):
        _positive(setting("start"), said["start"])
    for name in ("from_s", "to_s"):
        x = said.get(name)
        if x is not None and math.isnan(_number(x)):
            raise EstimationError(f"{setting(name)} is {_short(x)}; it must be a time in s. Correct it")
    memory = said.get("memory", "auto")
    if memory not in ("auto", "all"):
        name = setting("memory")
        _positive(name, memory, other="'auto', 'all' or ")
        if not _SHORTEST_S <= _number(memory) <= _LONGEST_S:
            raise EstimationError(
                f"{name} is {_short(memory)} s; it must be {_SHORTEST_S:g} to {_LONGEST_S:g} s. Give 'all' to "
                "forget nothing"
            )
    pace = said.get("pace", _PACES[0])
    if pace not in _PACES:
        raise EstimationError(f"{setting('pace')} is {pace!r}; known: {', '.join(_PACES)}. Correct it")


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


def _short(x: object) -> str:
    text = repr(x)
    return text if len(text) <= 60 else f"{text[:57]}..."


def truth_beside(
    record: Record | Path | str, rate: float | None, units: Mapping[str, str]
) -> dict[str, tuple[Any, Any]]:
    """Read the truth in a simulated record's columns ``true_NAME``: (n_samples,), s of record and SI, but those of
    another unit. `rate`: Hz, for a record without time; `units`: SI unit of each tracked number, empty where not known.
    """
    if not isinstance(record, Record) and not _may_hold_truth(Path(record)):
        return {}
    try:
        raw = record if isinstance(record, Record) else read_record(record, rate_hz=rate, gaps="interpolate")
    except AmbidError as refused:
        print(f"ambid: drawn without the truth: {refused}", file=sys.stderr)
        return {}
    truth = {}
    for channel in raw.channels:
        name = channel.name.removeprefix("true_")
        if name == channel.name or name not in units:
            continue
        if units[name] not in ("", channel.unit):
            inside = f"is in [{channel.unit}], the tracked number in [{units[name]}]"
            print(f"ambid: column {channel.name!r} {inside}: it is not drawn", file=sys.stderr)
            continue
        truth[name] = (raw.time_s, channel.values)
    return truth


def _may_hold_truth(record: Path) -> bool:
    """Tell by the name, of a text file by its beginning, so that a long record is not read again for nothing."""
    if not record.name.lower().endswith((".csv", ".csv.gz")):
        return record.name.lower().endswith((".h5", ".hdf5"))  # simulations write no other
    try:
        with gzip.open(record) if record.name.lower().endswith(".gz") else record.open("rb") as file:
            return b"true_" in file.read(65536)
    except (OSError, EOFError):
        return False
