"""A sudden change of k_i by -15 % under feedback: how soon it is found, named, and followed."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ambid.record import write_record
from ambid.recursive.lines import Event
from processes import command, watched
from table import Table
from timing import quantity
from tracking_benches import (
    BENCHES,
    BLOCK,
    RATE,
    START_S,
    TrackBench,
    blocks,
    identified,
    record_of,
    supervised,
)

SEEDS = 20
AT_S, LENGTH_S = 2.0, 4.0
TO, WITHIN = 0.85, 0.02
BARS = {"detected_s": 0.020, "within_s": 0.25, "update_s": 0.005}
GROUP = "Tracking: a sudden change of k_i by -15 % under feedback, 20 kHz"
COLUMNS = ("bench", "figure", "median", "90 %", "largest", "bar", "records within it")
WHAT = {
    "detected_s": "from the change to its detection, s of record",
    "within_s": "until the published k_i is within 2 % of the truth and stays there, s of record",
    "update_s": "computing time of the update",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """One record; infinite where it did not happen."""

    seed: int
    detected_s: float
    within_s: float
    update_s: float
    first_name: str
    last_name: str
    alarms: int
    before: int


def followed(bench: TrackBench, seed: int) -> Followed:
    """Track one record through its change."""
    samples = bench.samples("change", seed, LENGTH_S, AT_S)
    begin = round(START_S * RATE)
    events: list[Event] = []
    supervisor = supervised(identified(samples), first=begin, listener=events.append)
    times, values = [], []
    for k, part in blocks(samples, begin):
        supervisor.feed(part, k)
        times.append((k + part.y.shape[0]) / RATE)
        values.append(supervisor.parameters["k_i"].value)
    alarms = [e for e in events if e.kind in ("change", "disturbed") and "detected" in e.values]
    after = [e for e in alarms if e.values["detected"] > AT_S]
    named = [e.parameter for e in after if e.kind == "change"]
    return Followed(
        seed=seed,
        detected_s=after[0].values["detected"] - AT_S if after else np.inf,
        within_s=_settled(np.array(times), np.array(values) / (TO * bench.truth["k_i"])) - AT_S,
        update_s=supervisor.diagnosis.update_s or np.inf,
        first_name=after[0].parameter or "none" if after else "none",
        last_name=named[-1] or "none" if named else "none",
        alarms=len(after),
        before=len(alarms) - len(after),
    )


def _settled(times: np.ndarray, ratios: np.ndarray) -> float:
    """When the ratio is near 1 for good."""
    off = np.flatnonzero(np.abs(ratios - 1.0) > WITHIN)
    last = int(off[-1]) + 1 if off.size else 0
    return float(times[last]) if last < times.size else np.inf


def change_tables() -> Iterator[Table]:
    """One table over both benches, the command's own record among the remarks."""
    rows: list[tuple[str, ...]] = []
    remarks: list[str] = []
    data: dict[str, object] = {}
    for make in BENCHES.values():
        bench = make()
        followed(bench, SEEDS)  # compiles
        found = [followed(bench, seed) for seed in range(1, SEEDS + 1)]
        rows += [_row(bench, name, found) for name in BARS]
        remarks.append(_names(bench, found))
        remarks.append(_by_command(bench))
        data[bench.name] = [asdict(f) for f in found]
        for row in rows[-len(BARS) :]:
            print("; ".join(row), flush=True)
        print("\n".join(remarks[-2:]), flush=True)
    before = (
        f"Scenario `change`, {SEEDS} records of {LENGTH_S:.0f} s for each bench, each with its own noise and"
        f" excitation; the start is identified from the first {START_S:.0f} s, then samples come in blocks of"
        f" {BLOCK}. An update is the search for the changed number in the samples after the change."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=tuple(remarks), data=data)


def _row(bench: TrackBench, name: str, found: Sequence[Followed]) -> tuple[str, ...]:
    values = np.array([getattr(f, name) for f in found])
    bar = BARS[name]
    shown = [_shown(v) for v in (np.median(values), np.quantile(values, 0.9, method="higher"), values.max())]
    return (bench.name, WHAT[name], *shown, quantity(bar, "s"), f"{np.count_nonzero(values < bar)} of {values.size}")


def _shown(value: float) -> str:
    return quantity(float(value), "s") if np.isfinite(value) else "never"


def _names(bench: TrackBench, found: Sequence[Followed]) -> str:
    n = len(found)
    first, last = (sum(getattr(f, w) == "k_i" for f in found) for w in ("first_name", "last_name"))
    others = ", ".join(sorted({f.first_name for f in found} - {"k_i"}))
    return (
        f"{bench.name}: the first alarm names k_i in {first} of {n}{f' (others: {others})' if others else ''},"
        f" the last change in {last} of {n}; alarms before the change: {sum(f.before for f in found)}; alarms after it"
        f" beyond the first: {sum(max(f.alarms - 1, 0) for f in found)}."
    )


def _by_command(bench: TrackBench) -> str:
    """The same through the command, on a file."""
    samples = bench.samples("change", SEEDS + 1, LENGTH_S, AT_S)
    with tempfile.TemporaryDirectory() as folder:
        record, lines = Path(folder) / "record.csv", Path(folder) / "track.jsonl"
        write_record(record_of(samples), record)
        words = [command(), "track", str(record), "--json", str(lines)]
        watched(words)
        took = watched(words)
        told = [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()]
    body = [line for line in told if "parameters" in line and "t" in line]
    times = np.array([line["t"] for line in body])
    ratios = np.array([line["parameters"]["k_i"]["value"] for line in body]) / (TO * bench.truth["k_i"])
    changes = told[-1]["summary"]["changes"]
    names = ", ".join(f"{c['parameter']} at {c['t']:.4f} s" for c in changes) or "no change"
    return (
        f"{bench.name}, `ambid track` on a CSV of {LENGTH_S:.0f} s: {names}; within 2 % from"
        f" {_shown(_settled(times, ratios) - AT_S)} after the change; {quantity(took['wall_s'], 's')} from start to"
        " exit."
    )
