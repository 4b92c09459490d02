"""Speed of the recursive estimators, in blocks and sample by sample, beside the same job in public Python packages."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from peers import Bench, bench
from table import Table
from timing import quantity
from tracking_job import BLOCKS, Job, Same
from tracking_jobs import jobs

ROUNDS = 7
SINGLES = 20_000
GROUP = "Tracking: speed in blocks of 1000 and sample by sample, beside peers"
COLUMNS = (
    "job", "samples/s in blocks", "one sample", "peer", "samples/s", "one sample", "ratio in blocks", "what came out",
)  # fmt: skip


@dataclass(slots=True)
class Measured:
    """Seconds a sample, in each round."""

    blocks: list[float] = field(default_factory=list)
    single: list[float] = field(default_factory=list)
    peer: list[float] = field(default_factory=list)
    peer_single: list[float] = field(default_factory=list)
    problem: str = ""
    found: dict[str, Any] = field(default_factory=dict)


def speed_tables() -> Iterator[Table]:
    """One table; the bars among its remarks."""
    rows, data, seen = [], {}, {}
    with bench() as children:
        for job in jobs():
            m = _measured(job, children)
            same = job.compare(m.found) if m.found else Same(text="–" if not m.problem else m.problem)
            rows.append(_row(job, m, same))
            print("; ".join(rows[-1]), flush=True)
            seen[job.name] = m
            data[f"{job.name}; {job.peer or 'alone'}"] = {
                "seconds_in_blocks": m.blocks, "seconds_single": m.single, "peer_seconds": m.peer,
                "peer_seconds_single": m.peer_single, "problem": m.problem, **same.numbers,
            }  # fmt: skip
    before = (
        f"Warm, in memory, one core, in turn, medians of {ROUNDS} rounds (fewer where a peer takes seconds). A peer"
        " gets its samples in its own call for whole records where it has one, its own loop otherwise; the ratio is"
        " samples a second over the peer's. One sample: a call of `update` from Python for each."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=_bars(seen), data=data)


def _measured(job: Job, children: Bench) -> Measured:
    m = Measured()
    _in_blocks(job)
    for k in range(ROUNDS + 1):  # the first of the peer fills its caches
        m.blocks.append(_in_blocks(job))
        if job.single is not None:
            m.single.append(_one_by_one(job))
        if job.ask is None or m.problem or (k > 2 and m.peer and m.peer[-1] * job.peer_n > 1.0):
            continue
        said = job.ask(children, "")
        m.problem = said.get("problem", "")
        if m.problem:
            continue
        m.found = {name: np.array(v) for name, v in said["found"].items()}
        m.peer.append(said["seconds"] / job.peer_n)
        if job.peer_single:
            m.peer_single.append(job.ask(children, "single")["seconds"] / job.peer_n)
    del m.peer[:1], m.peer_single[:1]
    return m


def _in_blocks(job: Job) -> float:
    """Seconds a sample."""
    feed, n = job.feed(), 0
    before = time.perf_counter()
    for k in range(0, job.n, BLOCKS):
        feed(k, k + BLOCKS)
        n += BLOCKS
    return (time.perf_counter() - before) / n


def _one_by_one(job: Job) -> float:
    assert job.single is not None
    feed: Callable[[int], object] = job.single()
    before = time.perf_counter()
    for k in range(SINGLES):
        feed(k)
    return (time.perf_counter() - before) / SINGLES


def _row(job: Job, m: Measured, same: Same) -> tuple[str, ...]:
    peer = statistics.median(m.peer) if m.peer else None
    return (
        job.name,
        _rate(statistics.median(m.blocks)),
        quantity(statistics.median(m.single), "s") if m.single else "–",
        job.peer or "–",
        _rate(peer) if peer else "–",
        quantity(statistics.median(m.peer_single), "s") if m.peer_single else "–",
        f"{peer / statistics.median(m.blocks):.3g}" if peer else "–",
        same.text,
    )


def _rate(seconds: float) -> str:
    return f"{1e-6 / seconds:.3g} million" if seconds < 1e-5 else f"{1.0 / seconds:.3g}"


def _bars(seen: dict[str, Measured]) -> tuple[str, ...]:
    """Medians, and the fastest round: on a busy machine the median is not the program's."""
    rls, kalman = (seen[x] for x in ("RLS, 4 coefficients, forgetting", "Kalman filter, position and velocity"))
    both = [a + b for a, b in zip(rls.blocks, kalman.blocks, strict=True)]
    one = [quantity(statistics.median(m.single), "s") for m in (rls, kalman)]
    lines = [
        f"RLS(4) and Kalman filter, one after the other: {_rate(statistics.median(both))} samples a second in blocks"
        f" (fastest round {_rate(min(both))}; bar: 10 million); one sample {one[0]} and {one[1]} (bar: 6 µs).",
    ]
    for name in (n for n in seen if n.startswith("RPEM")):
        taken = seen[name].blocks
        lines.append(
            f"{name}: {_rate(statistics.median(taken))} samples a second in blocks (fastest round {_rate(min(taken))};"
            " bar: 1 million)."
        )
    return tuple(lines)
