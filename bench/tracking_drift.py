"""The coil warms: R rises by 20 % in 60 s. How far off is the estimate, and how often is its interval right?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ambid.recursive.lines import Event
from table import Table
from tracking_benches import BENCHES, BLOCK, PHYSICAL, RATE, START_S, Array, TrackBench, blocks, identified, supervised

SEEDS = 10
DRIFT_S, SIZE = 60.0, 0.2
GROUP = "Tracking: R drifts by 20 % in 60 s"
COLUMNS = (
    "bench", "number", "largest error", "rms error", "median sd", "in the 95 % interval", "least, most of a record",
)  # fmt: skip
_Z = 1.959964


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """One record: by parameter the largest and rms relative error, median relative sd, share of time inside."""

    seed: int
    largest: dict[str, float]
    rms: dict[str, float]
    sd: dict[str, float]
    inside: dict[str, float]
    alarms: int


def drift_of(bench: TrackBench, seed: int) -> Drift:
    """Track one record; the drift begins where the start's record ends."""
    stream = bench.stream("drift", seed, START_S + DRIFT_S, START_S)
    _, first = next(stream)  # a second
    events, values, sds, times = list[Event](), [], [], []
    supervisor = supervised(identified(first), first=first.y.shape[0], listener=events.append)
    for k, part in stream:
        for j, piece in blocks(part):
            supervisor.feed(piece, k + j)
            now = supervisor.parameters
            values.append([now[name].value for name in PHYSICAL])
            sds.append([now[name].sd for name in PHYSICAL])
            times.append((k + j + piece.y.shape[0]) / RATE)
    truth = _truth(bench, np.array(times))
    error, sd = np.array(values) / truth - 1.0, np.array(sds) / np.abs(truth)
    inside = np.abs(error) < _Z * sd

    def named(x: Array) -> dict[str, float]:
        return dict(zip(PHYSICAL, x.tolist(), strict=True))

    return Drift(
        seed=seed,
        largest=named(np.abs(error).max(axis=0)),
        rms=named(np.sqrt(np.mean(error**2, axis=0))),
        sd=named(np.median(sd, axis=0)),
        inside=named(inside.mean(axis=0)),
        alarms=sum(event.kind in ("change", "disturbed") for event in events),
    )


def _truth(bench: TrackBench, times: Array) -> Array:
    found = np.tile([bench.truth[name] for name in PHYSICAL], (times.size, 1))
    found[:, PHYSICAL.index("R")] *= 1.0 + SIZE * np.clip((times - START_S) / DRIFT_S, 0.0, 1.0)
    return np.asarray(found)


def drift_tables() -> Iterator[Table]:
    """One table over both benches."""
    rows: list[tuple[str, ...]] = []
    remarks: list[str] = []
    data: dict[str, object] = {}
    for make in BENCHES.values():
        bench = make()
        found = [drift_of(bench, seed) for seed in range(1, SEEDS + 1)]
        rows += [_row(bench.name, name, found) for name in PHYSICAL]
        pooled = np.array([[f.inside[name] for name in PHYSICAL] for f in found])
        remarks.append(
            f"{bench.name}: all parameters together {pooled.mean():.1%} of the time inside (bar: 90 to 98 %); largest"
            f" error of R {max(f.largest['R'] for f in found):.2%} (bar: 1 %); false alarms:"
            f" {sum(f.alarms for f in found)}."
        )
        print(remarks[-1], flush=True)
        data[bench.name] = [asdict(f) for f in found]
    before = (
        f"Scenario `drift`, {SEEDS} records of {START_S + DRIFT_S:.0f} s for each bench; the start is identified from"
        f" the first {START_S:.0f} s, the drift begins there. The published estimate after each {BLOCK} samples against"
        " the truth of that moment, errors relative."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=tuple(remarks), data=data)


def _row(bench: str, name: str, found: Sequence[Drift]) -> tuple[str, ...]:
    inside = [f.inside[name] for f in found]
    return (
        bench,
        name,
        f"{max(f.largest[name] for f in found):.2%}",
        f"{np.sqrt(np.mean([f.rms[name] ** 2 for f in found])):.3%}",
        f"{np.median([f.sd[name] for f in found]):.3%}",
        f"{np.mean(inside):.1%}",
        f"{min(inside):.0%}, {max(inside):.0%}",
    )
