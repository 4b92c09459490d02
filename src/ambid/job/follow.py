"""What replayed and live tracking share: blocks through guard, supervisor and reporter, from a start to a track."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal

import numpy as np

from ambid.estimation.estimate import Estimate
from ambid.estimation.threads import one_thread
from ambid.job.bench_rows import BenchRows
from ambid.job.track_start import Start, check_settling, credible_limits
from ambid.physics.models import model
from ambid.recursive.lines import Track, TrackHeader, TrackLine
from ambid.rig import Rig
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
Pace = Literal["fastest", "real-time"]


def follow(
    blocks: Iterable[Block] | BlockRing,
    source: BenchRows,
    begin: Start,
    rig: Rig,
    *,
    every_s: float = 0.01,
    limit: float = 1.5,
    memory: float | Literal["auto", "all"] = "auto",
    pace: Pace = "fastest",
    flags: Sequence[tuple[float, Flag]] = (),
    on_header: Callable[[TrackHeader], None] | None = None,
    on_line: Callable[[TrackLine], Sequence[Flag] | None] | None = None,
    keep: bool = True,
    live: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Track:
    """Follow the physical parameters of a bench through a stream of blocks.

    `blocks`: inputs, outputs and forcing, SI, from sample ``begin.first`` on; `begin`: estimate and numbers to begin
    with; `rig`: the bench; `every_s`, `limit`, `memory`, `pace`, `flags`, `on_header`, `on_line`, `keep`: as
    `ambid.job.track.track`; `live`: whether the stream has no known end; `stopped`: asked between blocks; True ends the
    stream. Returns header, lines where they are kept, summary.
    """
    numbers, first, forcing = begin.numbers, begin.first, source.forcing
    rpem = PhysicalRpem(numbers, memory=memory)
    check_settling(rpem, float("inf") if live else source.duration_s, first)
    supervisor = Supervisor(rpem, limit=limit, t0=source.t0, listener=lambda event: reporter.note(event))
    lines: list[TrackLine] = []

    def emit(line: TrackLine) -> Sequence[Flag] | None:
        if keep:
            lines.append(line)
        return None if on_line is None else on_line(line)

    warm_up(numbers, memory)
    reporter = Reporter(supervisor, every_s=every_s, on_line=emit, flags=flags, t0=source.t0, first=first)
    samples = None if live else int(np.count_nonzero(source.replay.numbers >= first))
    top = header(
        supervisor, limit=limit, every_s=reporter.every_s, method=f"rpem, memory {memory}",
        record={**source.origin, "samples": samples}, warnings=begin.warnings,
    )  # fmt: skip
    if on_header is not None:
        on_header(top)
    n_u = len(model(rig.model).inputs)
    with one_thread():
        report = run(
            blocks,
            lambda stretch: reporter.consume(_samples(stretch, n_u, forcing), stretch.first, restart=stretch.restart),
            reporter.reject,
            guard=_guard(source, begin.estimate),
            pace=pace,
            producer="process" if pace == "real-time" else "none",
            block_samples=source.replay.block_samples,
            stopped=stopped,
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
