"""Latency of the engine: a record comes at 20 kHz, block by block as each is due."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict

import numpy as np

from ambid.recursive.lines import Latency
from ambid.tracking.blocks import Stretch, blocks_of
from ambid.tracking.engine import StreamReport, run
from ambid.tracking.evidence import Samples
from ambid.tracking.guard import StreamGuard
from ambid.tracking.reporter import Reporter
from table import Table
from timing import quantity
from tracking_benches import RATE, preset_bench, record_of, start_of, supervised

SECONDS = float(os.environ.get("TRACK_LATENCY_S", "30"))
SIZES = (20, 100, 200)
EVERY_S = 0.01
CHANGE_S = 20.0
GROUP = "Tracking: latency in real time, 20 kHz"
COLUMNS = (
    "samples of a block", "comes every", "median", "99 %", "largest", "late blocks", "load of a core",
)  # fmt: skip


def replayed(samples: Samples, size: int) -> StreamReport:
    """Run the command's chain without its output: replay, guard, supervisor, lines."""
    replay = blocks_of(record_of(samples), size, channels=("voltage", "position", "current"))
    supervisor = supervised(start_of("unstable-bearing"))
    reporter = Reporter(supervisor, every_s=EVERY_S, on_line=lambda _: None)

    def consume(stretch: Stretch) -> None:
        u, y = np.ascontiguousarray(stretch.values[:, :1]), np.ascontiguousarray(stretch.values[:, 1:])
        reporter.consume(Samples(u=u, y=y), stretch.first, restart=stretch.restart)

    return run(
        replay, consume, reporter.reject, guard=StreamGuard(RATE, 3), pace="real-time",
    )  # fmt: skip


def latency_tables() -> Iterator[Table]:
    """One table over the sizes of blocks."""
    bench = preset_bench()
    at = min(CHANGE_S, SECONDS / 2)
    samples = bench.samples("change", 1, SECONDS, at)
    replayed(samples.part(0, round(RATE)), 100)  # compiles
    rows, data = [], {}
    for size in SIZES:
        report = replayed(samples, size)
        rows.append(_row(size, report))
        print("; ".join(rows[-1]), flush=True)
        assert report.latency is not None
        data[f"{size}"] = {**asdict(report.latency), "working_s": report.working_s, "seconds": report.seconds}
    before = (
        f"A record of {SECONDS:.0f} s with a change of k_i, replayed at its own pace; from the"
        " moment at which a block is due to the end of the work on it, guard, supervisor and a line every"
        f" {quantity(EVERY_S, 's')} included. A late block's successor was due before its end; {os.cpu_count()} cores,"
        f" load average before {os.getloadavg()[0]:.1f}."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)


def _row(size: int, report: StreamReport) -> tuple[str, ...]:
    of: Latency | None = report.latency
    assert of is not None
    times = [quantity(t, "s") for t in (size / RATE, of.median, of.p99, of.largest)]
    return (str(size), *times, f"{of.late} of {report.blocks}", f"{report.working_s / SECONDS:.1%}")
