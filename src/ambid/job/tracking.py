"""The on-line job: a record, or a running device, through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.data import known_rig
from ambid.job.track_start import BenchRows, Start, check_settling, credible_limits, rows_of, start_of
from ambid.physics.models import model
from ambid.record import Record
from ambid.recursive.lines import Track, TrackHeader, TrackLine
from ambid.rig import Rig, load_rig
from ambid.track.blocks import Block, Stretch
from ambid.track.engine import run
from ambid.track.evidence import Samples
from ambid.track.guard import ABSURD, StreamGuard
from ambid.track.numbers import Forcing
from ambid.track.reporter import Reporter, header
from ambid.track.ring import BlockRing
from ambid.track.rpem import PhysicalRpem
from ambid.track.supervisor import Supervisor, warm_up

Flag = Literal["track", "hold", "accept", "revert"]
Memory = float | Literal["auto", "all"]
Pace = Literal["fastest", "real-time"]

FLAGS: tuple[Flag, ...] = ("track", "hold", "accept", "revert")
_PACES = ("fastest", "real-time")
_SHORTEST_S, _LONGEST_S = 1e-3, 1e9  # of a memory: below a block, and beyond any record


@dataclass(frozen=True, slots=True, kw_only=True)
class Following:
    """How a track is made and told; see `track`."""

    every_s: float = 0.01
    limit: float = 1.5
    memory: Memory = "auto"
    pace: Pace = "fastest"
    flags: Sequence[tuple[float, Flag]] = ()
    on_header: Callable[[TrackHeader], None] | None = None
    on_line: Callable[[TrackLine], Sequence[Flag] | None] | None = None
    keep: bool = True


def track(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    method: str = "rpem",
    start: Estimate | str | Path | None = None,
    start_s: float | None = None,
    every_s: float = 0.01,
    limit: float = 1.5,
    memory: Memory = "auto",
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

    Parameters
    ----------
    record : Record, str or Path
    rig : Rig, str or Path, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    method : str, optional
        ``rpem``, the supervised tracker, or one of `ambid.job.track_estimator.METHODS`.
    start : Estimate, str or Path, optional
        Where tracking begins; default: an identification of the first part of the record.
    start_s : float, optional
        Length of that part, s.
    every_s : float, optional
        Reporting interval, s of record.
    limit : float, optional
        Acceptable model error, in multiples of that at identification.
    memory : float, "auto" or "all", optional
        How long data count: a time constant in s, found from the data, or for ever.
    pace : {"fastest", "real-time"}, optional
        Replay as fast as possible, or as the record was taken.
    flags : sequence of (float, str), optional
        What an operator sets and when, s of record: ``track``, ``hold``, ``accept`` or ``revert``.
    from_s, to_s : float, optional
        Part of the record to use, s.
    rate_hz : float, optional
        Sampling rate for a file without a time column.
    on_header, on_line : callable, optional
        Called once before the first line, and with each line; flags that `on_line` returns are set.
    keep : bool, optional
        Keep the lines for the result; without, memory stays constant.
    tick : callable, optional
    **settings
        Of another method: ``inputs``, ``outputs``, ``references``, ``orders``, ``open_loop``, ``step``.

    Returns
    -------
    Track

    Raises
    ------
    AmbidError
        If record or rig break a rule.
    EstimationError
        If start or settings make no sense, or nothing can be identified to start from.
    """
    check_settings(
        record, start=start, start_s=start_s, every_s=every_s, limit=limit, memory=memory, pace=pace, flags=flags,
        rate_hz=rate_hz, from_s=from_s, to_s=to_s,
    )  # fmt: skip
    say = tick or silent
    if not (rig is None or isinstance(rig, (Rig, str, Path))):
        raise EstimationError(f"rig is a {type(rig).__name__}; it must be a Rig or the path of a rig file. Give one")
    given = load_rig(rig) if isinstance(rig, (str, Path)) else rig
    bench_rig = known_rig(given)
    if method != "rpem" or settings:
        from ambid.job.track_estimator import track_estimator

        if pace != "fastest" or flags:
            raise EstimationError(f"method {method} has no supervisor: it takes no pace and no flags. Leave them out")
        return track_estimator(
            record, given, method=method, start=start, start_s=start_s, every_s=every_s, limit=limit, memory=memory,
            from_s=from_s, to_s=to_s, rate_hz=rate_hz, on_header=on_header, on_line=on_line, keep=keep, **settings,
        )  # fmt: skip
    source = rows_of(record, given, from_s=from_s, to_s=to_s, rate_hz=rate_hz)
    say("start")
    begin = start_of(source, bench_rig, given=start, start_s=start_s, rig_speaks=given is not None)
    say("track")
    how = Following(
        every_s=every_s, limit=limit, memory=memory, pace=pace, flags=flags, on_header=on_header, on_line=on_line,
        keep=keep,
    )  # fmt: skip
    return follow(source.replay.since(begin.first), source, begin, bench_rig, how)


def follow(
    blocks: Iterable[Block] | BlockRing,
    source: BenchRows,
    begin: Start,
    rig: Rig,
    how: Following,
    *,
    live: bool = False,
) -> Track:
    """Follow the physical parameters of a bench through blocks, SI, from sample ``begin.first`` on.

    What replayed and live tracking share: guard, supervisor and reporter. `live`: the stream has no known end.
    """
    numbers, first, forcing = begin.numbers, begin.first, source.forcing
    rpem = PhysicalRpem(numbers, memory=how.memory)
    check_settling(rpem, float("inf") if live else source.duration_s, first)
    supervisor = Supervisor(rpem, limit=how.limit, t0=source.t0, listener=lambda event: reporter.note(event))
    lines: list[TrackLine] = []

    def emit(line: TrackLine) -> Sequence[Flag] | None:
        if how.keep:
            lines.append(line)
        return None if how.on_line is None else how.on_line(line)

    warm_up(numbers, how.memory)
    reporter = Reporter(supervisor, every_s=how.every_s, on_line=emit, flags=how.flags, t0=source.t0, first=first)
    samples = None if live else int(np.count_nonzero(source.replay.numbers >= first))
    top = header(
        supervisor, limit=how.limit, every_s=reporter.every_s, method=f"rpem, memory {how.memory}",
        record={**source.origin, "samples": samples}, warnings=begin.warnings,
    )  # fmt: skip
    if how.on_header is not None:
        how.on_header(top)
    n_u = len(model(rig.model).inputs)
    with one_thread():
        report = run(
            blocks,
            lambda stretch: reporter.consume(_samples(stretch, n_u, forcing), stretch.first, restart=stretch.restart),
            reporter.reject,
            guard=_guard(source, begin.estimate),
            pace=how.pace,
            producer="process" if how.pace == "real-time" else "none",
            block_samples=source.replay.block_samples,
        )
    reporter.finish()
    summary = reporter.summary(computing_s=report.working_s, latency=report.latency, complete=not report.interrupted)
    return Track(header=top, lines=tuple(lines), summary=summary)


def _guard(source: BenchRows, estimate: Estimate) -> StreamGuard:
    """A guard that watches outputs for freezing, but no input and no forcing: these may rest."""
    plant, n_f = model(estimate.model), 0 if source.forcing is None else 2
    n_u, n_y = len(plant.inputs), len(plant.outputs)
    outputs: list[int | Literal["auto"] | None] = ["auto"] * n_y
    return StreamGuard(
        source.replay.rate_hz,
        n_u + n_y + n_f,
        limits=credible_limits(source, estimate) + [ABSURD] * n_f,
        stuck=[*[None] * n_u, *outputs, *[None] * n_f],
    )


def _samples(stretch: Stretch, n_u: int, forcing: Forcing | None) -> Samples:
    """Take the columns of a stretch apart."""
    n = stretch.values.shape[1] - (0 if forcing is None else 2)
    u, y, extra = np.split(stretch.values, [n_u, n], axis=1)
    return Samples(
        u=np.ascontiguousarray(u),
        y=np.ascontiguousarray(y),
        forcing=None if forcing is None else np.ascontiguousarray(extra),
    )


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
    names: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """Refuse settings of `track` that make no sense, or that contradict one another, in the `names` of the caller."""
    for name, x in (("every_s", every_s), ("limit", limit)):
        _positive(names.get(name, name), x)
    for name, x in (("start_s", start_s), ("rate_hz", rate_hz)):
        if x is not None:
            _positive(names.get(name, name), x)
    for name, x in (("from_s", from_s), ("to_s", to_s)):
        if x is not None and math.isnan(_number(x)):
            raise EstimationError(f"{name} is {_short(x)}; it must be a time in s. Correct it")
    if memory not in ("auto", "all"):
        name = names.get("memory", "memory")
        _positive(name, memory, other="'auto', 'all' or ")
        if not _SHORTEST_S <= _number(memory) <= _LONGEST_S:
            raise EstimationError(
                f"{name} is {_short(memory)} s; it must lie between {_SHORTEST_S:g} and {_LONGEST_S:g}. Give 'all'"
                " where nothing is to be forgotten"
            )
    if pace not in _PACES:
        raise EstimationError(f"pace is {pace!r}; known: {', '.join(_PACES)}. Correct it")
    if not isinstance(record, (Record, str, Path)):
        raise EstimationError(f"record is {_short(record)}; it must be a Record or the path of a file. Give one")
    if start is not None and start_s is not None:
        raise EstimationError(
            f"{names.get('start_s', 'start_s')} is for a start identified from the record; "
            f"{names.get('start', 'start')} gives one. Leave one of them out"
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
