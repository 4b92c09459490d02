"""The on-line job: a record is replayed through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from ambid.errors import EstimationError
from ambid.identify.estimate import Estimate
from ambid.identify.threads import one_thread
from ambid.job._progress import Tick, silent
from ambid.job.estimates import read_estimate
from ambid.job.physical import identify, load
from ambid.physics.linear_model import LinearModel
from ambid.physics.models import model
from ambid.record import Channel, Record
from ambid.rig import Rig, default_rig, load_rig
from ambid.signals.samples import cut
from ambid.track.lines import Track, TrackHeader, TrackLine
from ambid.track.physical.numbers import tracked_numbers
from ambid.track.physical.rpem import PhysicalRpem
from ambid.track.physical.signals import Samples
from ambid.track.physical.synchronous import Forcing, forcing_of
from ambid.track.reporter import Reporter, header
from ambid.track.stream.block import Block
from ambid.track.stream.guard import StreamGuard
from ambid.track.stream.outcome import Passed, Rejection
from ambid.track.stream.replay import blocks_of
from ambid.track.supervise.supervisor import Supervisor

Flag = Literal["track", "hold", "accept", "revert"]
Pace = Literal["fastest", "real-time"]

_START_S, _START_SAMPLES = 1.0, 10_000  # at least, where the record has three times as much
_BLOCK_S = 0.01  # of the stream
_FORCING = ("forcing_cos", "forcing_sin")


def track(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    start: Estimate | str | Path | None = None,
    start_s: float | None = None,
    every_s: float = 0.01,
    limit: float = 1.5,
    memory: float | Literal["auto", "all"] = "auto",
    pace: Pace = "fastest",  # noqa: ARG001
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
    say = tick or silent
    bench_rig = default_rig() if rig is None else rig if isinstance(rig, Rig) else load_rig(rig)
    bench = load(record, bench_rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=None)
    plant = model(bench_rig.model)
    say("start")
    estimate, first = _start(bench, bench_rig, start, start_s)
    say("track")
    forcing = forcing_of(bench) if "force" in plant.disturbances else None
    rpem = PhysicalRpem(
        tracked_numbers(estimate, synchronous=forcing is not None, top_speed=forcing.top_speed if forcing else 1.0),
        memory=memory,
    )
    supervisor = Supervisor(rpem, limit=limit, t0=bench.start_s, listener=lambda event: reporter.note(event))
    lines: list[TrackLine] = []

    def emit(line: TrackLine) -> Sequence[Flag] | None:
        if keep:
            lines.append(line)
        return None if on_line is None else on_line(line)

    reporter = Reporter(supervisor, every_s=every_s, on_line=emit, flags=flags, t0=bench.start_s, first=first)
    top = header(
        supervisor, limit=limit, every_s=every_s, method=f"rpem, memory {memory}",
        record={
            "file": bench.provenance.get("file"),
            "sha256": bench.provenance.get("sha256"),
            "samples": bench.n_samples - first,
        },
    )  # fmt: skip
    if on_header is not None:
        on_header(top)
    begun = time.perf_counter()
    stream = _columns(bench, plant, forcing)
    blocks = blocks_of(stream, max(1, round(_BLOCK_S * bench.rate_hz)))
    guard = StreamGuard(bench.rate_hz, len(stream.channels))
    with one_thread():
        _run((b for b in blocks if b.first >= first), guard, plant, reporter)
    reporter.finish()
    return Track(header=top, lines=tuple(lines), summary=reporter.summary(computing_s=time.perf_counter() - begun))


def _start(bench: Record, rig: Rig, start: Estimate | str | Path | None, start_s: float | None) -> tuple[Estimate, int]:
    """The estimate to begin with, and the number of the first sample that is tracked."""
    if isinstance(start, Estimate):
        return start, 0
    if start is not None:
        return _read_start(start), 0
    length = (
        start_s if start_s is not None else min(max(_START_S, _START_SAMPLES / bench.rate_hz), bench.duration_s / 3)
    )
    n = round(length * bench.rate_hz)
    if not 0 < n < bench.n_samples:
        raise EstimationError(
            f"the start of {length:g} s leaves nothing of {bench.duration_s:g} s to track. Give less, or an estimate"
        )
    return identify(cut(bench, None, bench.start_s + n / bench.rate_hz), rig), n


def _read_start(path: str | Path) -> Estimate:
    found = read_estimate(path)
    if not isinstance(found, Estimate):
        raise EstimationError(
            f"{path} holds a black-box fit; tracking starts from physical parameters. Give what 'ambid identify --json'"
            " wrote"
        )
    return found


def _columns(bench: Record, plant: LinearModel, forcing: Forcing | None) -> Record:
    """The channels that the tracker takes, forcing included, in its order."""
    roles = (*plant.inputs, *plant.outputs)
    more = () if forcing is None else forcing.columns.T
    extra = [Channel(name=name, unit="1", values=column) for name, column in zip(_FORCING, more, strict=False)]
    return replace(bench, channels=(*(bench.channel(role) for role in roles), *extra))


def _run(blocks: Iterable[Block], guard: StreamGuard, plant: LinearModel, reporter: Reporter) -> None:
    """Pass blocks through the guard into the tracker."""
    for block in blocks:
        for passed in guard.take(block):
            _consume(passed, plant, reporter)
    for passed in guard.flush():
        _consume(passed, plant, reporter)


def _consume(passed: Passed, plant: LinearModel, reporter: Reporter) -> None:
    if isinstance(passed, Rejection):
        reporter.reject(passed)
        return
    n_u, n = len(plant.inputs), len(plant.inputs) + len(plant.outputs)
    values = passed.values
    forcing = np.ascontiguousarray(values[:, n:]) if values.shape[1] > n else None
    samples = Samples(
        u=np.ascontiguousarray(values[:, :n_u]), y=np.ascontiguousarray(values[:, n_u:n]), forcing=forcing
    )
    reporter.consume(samples, passed.first, restart=passed.restart)
