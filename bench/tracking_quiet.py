"""Hours in which nothing happens, with and without excitation: false alarms, drift, covariance, memory, computing time.

Each run is a process of its own; as many at once as there are cores. ``TRACK_HOURS`` sets the hours of a run.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from ambid.recursive.lines import Event
from ambid.tracking.numbers import tracked_numbers
from ambid.tracking.supervisor import Supervisor
from table import Table
from timing import quantity
from tracking_benches import BENCHES, BLOCK, RATE, Array, identified, supervised, told_of

HOURS = float(os.environ.get("TRACK_HOURS", "1"))
RUNS = {"quiet": 2, "steady": 1}  # seeds for each bench
SHOWN = {"quiet": "quiet", "steady": "excited"}
FALSE = ("change", "disturbed")
CONFIDENCE = 0.95
SETTLED_S = 60  # from which on memory must not grow
GROUP = "Tracking: hours in which nothing happens, 20 kHz"


@dataclass(slots=True, kw_only=True)
class Hours:
    """What happened in one run."""

    bench: str
    scenario: str
    seed: int
    seconds: float = 0.0
    computing_s: float = 0.0
    from_start_sd: float = 0.0
    off_truth_sd: float = 0.0
    inside: dict[str, float] = field(default_factory=dict)
    growth: float = 0.0
    definite: int = 0
    smallest_eigenvalue: float = np.inf
    memory_early: int = 0
    memory_late: int = 0
    states: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    events: list[dict[str, object]] = field(default_factory=list)

    @property
    def alarms(self) -> list[dict[str, object]]:
        return [e for e in self.events if e["kind"] in FALSE]


def hours_of(bench: str, scenario: str, seed: int, seconds: float) -> Hours:
    """Track one run, looking at everything once a second."""
    b, found = BENCHES[bench](), Hours(bench=bench, scenario=scenario, seed=seed)
    start = tracked_numbers(identified(b.samples("steady", seed, 1.0)))

    def listen(event: Event) -> None:
        found.counts[event.kind] = found.counts.get(event.kind, 0) + 1
        if len(found.events) < 1000:
            found.events.append(told_of(event))

    supervisor = supervised(start, listener=listen)
    first = {name: (p.value, p.sd) for name, p in supervisor.parameters.items()}
    inside = dict.fromkeys(first, 0)
    for k, part in b.stream(scenario, 1000 + seed, seconds, 0.0):
        before = time.process_time()
        supervisor.feed(part, k)
        found.computing_s += time.process_time() - before
        found.seconds += part.y.shape[0] / RATE
        found.states[supervisor.state] = found.states.get(supervisor.state, 0) + 1
        for name, p in supervisor.parameters.items():
            value, sd = first[name]
            off = abs(p.value - b.truth[name]) / p.sd
            inside[name] += off < 1.959964
            found.off_truth_sd = max(found.off_truth_sd, off)
            found.from_start_sd = max(found.from_start_sd, abs(p.value - value) / sd)
            found.growth = max(found.growth, p.sd / sd)
        _covariance(found, supervisor)
        if found.seconds <= SETTLED_S:
            found.memory_early = max(found.memory_early, _resident())
        found.memory_late = max(found.memory_late, _resident())
    found.inside = {name: n / sum(found.states.values()) for name, n in inside.items()}
    return found


def _covariance(found: Hours, supervisor: Supervisor) -> None:
    """Count a second in which both covariances, published and working, are symmetric and positive definite."""
    smallest = min(
        smallest_eigenvalue(supervisor.publication.gate.accepted.covariance),
        smallest_eigenvalue(supervisor.rpem.filter.covariance),
    )
    found.smallest_eigenvalue = min(found.smallest_eigenvalue, smallest)
    found.definite += smallest > 0.0


def smallest_eigenvalue(covariance: Array) -> float:
    """The smallest eigenvalue of the correlations; below zero where the matrix is not symmetric."""
    size = np.sqrt(np.diag(covariance))
    if not (np.all(np.isfinite(covariance)) and np.all(size > 0.0) and np.array_equal(covariance, covariance.T)):
        return -1.0
    return float(np.linalg.eigvalsh(covariance / np.outer(size, size))[0])


def _resident() -> int:
    """Memory of this process at present, in bytes; 0 where the system does not tell."""
    status = Path("/proc/self/statm")
    return int(status.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGESIZE") if status.exists() else 0


def bound(alarms: int, hours: float) -> float:
    """Upper limit of a Poisson rate: a higher one would show so few alarms in less than 5 % of such runs."""
    return float(chi2.ppf(CONFIDENCE, 2 * (alarms + 1)) / 2 / hours)


def quiet_tables() -> Iterator[Table]:
    """False alarms, and what an hour leaves of the estimate."""
    jobs = [
        (bench, scenario, seed, HOURS * 3600)
        for scenario, n in RUNS.items()
        for bench in BENCHES
        for seed in range(1, n + 1)
    ]
    for bench in BENCHES:  # compiles once, before the processes
        hours_of(bench, "quiet", 1, 2.0)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        runs = []
        for found in pool.map(hours_of, *zip(*jobs, strict=True)):
            runs.append(found)
            print(f"{found.bench}, {found.scenario}, {found.seconds / 3600:.3g} h: {found.counts}", flush=True)
    yield _alarms(runs)
    yield _left(runs)


def _alarms(runs: Sequence[Hours]) -> Table:
    rows = []
    for scenario in RUNS:
        for bench in (*BENCHES, "both"):
            some = [r for r in runs if r.scenario == scenario and bench in (r.bench, "both")]
            hours, alarms = sum(r.seconds for r in some) / 3600, sum(len(r.alarms) for r in some)
            rows.append(
                (
                    bench,
                    SHOWN[scenario],
                    f"{hours:.3g} h",
                    f"{alarms}",
                    f"{alarms / hours:.2g}",
                    f"{bound(alarms, hours):.2g}",
                )
            )
    remarks = [
        f"{r.bench}, {SHOWN[r.scenario]}, seed {r.seed}, {e['t']:.3f} s: {e['kind']}; {e['why']}."
        for r in runs
        for e in r.alarms
    ]
    before = (
        "Nothing changes: every event of kind `change` or `disturbed` is a false alarm (bar: under one an hour of quiet"
        f" running). The last column is the rate that so few alarms exclude at {CONFIDENCE:.0%}."
    )
    columns = ("bench", "running", "simulated", "false alarms", "per hour", "per hour, at most")
    return Table(
        group=GROUP, columns=columns, rows=tuple(rows), before=before, remarks=tuple(remarks),
        data={f"{r.bench}, {r.scenario}, {r.seed}": asdict(r) for r in runs},
    )  # fmt: skip


def _left(runs: Sequence[Hours]) -> Table:
    rows = []
    for r in runs:
        looks = sum(r.states.values())
        states = ", ".join(f"{name} {n / looks:.2%}" for name, n in sorted(r.states.items(), key=lambda x: -x[1]))
        rows.append(
            (
                f"{r.bench}, {SHOWN[r.scenario]}, {r.seed}",
                f"{r.from_start_sd:.2f}",
                f"{r.off_truth_sd:.2f}",
                f"{r.growth:.3f}",
                f"{r.definite} of {looks}",
                f"{r.memory_early / 1e6:.1f} → {r.memory_late / 1e6:.1f} MB",
                states,
                quantity(r.computing_s / (r.seconds * RATE / BLOCK), "s"),
            )
        )
    columns = (
        "run", "largest move from the start, its sd", "largest error, own sd", "largest sd over the start's",
        "covariance definite", "memory", "state", f"computing, {BLOCK} samples",
    )  # fmt: skip
    before = (
        f"The same runs, {HOURS:g} h each ({HOURS * 3600 * RATE:.3g} samples), looked at once a second: the published"
        " estimate against that of the start (one second, excited) and against the truth; covariances published and"
        f" working; resident memory, highest in the first {SETTLED_S} s and in all; time of the processor."
    )
    return Table(group=f"{GROUP}: what is left", columns=columns, rows=tuple(rows), before=before)
