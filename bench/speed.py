"""Speed beside peers: ARX, OE, ARMAX, BJ and N4SID on 10 000 and 100 000 samples, all programs in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from experiments import AT_SPEED, Experiment
from peers import Answer, Array, Bench, Way, bench, ways
from table import Table
from timing import Timing, quantity, shown

SIZES = (10_000, 100_000)
LIMIT_S = 20.0
ROUNDS = 7
LONG_S = 2.0  # what takes longer is not repeated
SUBSPACE = {"n": 2, "horizon": 10}
BY_HAND = "SciPy by hand"
GROUP = "Speed of black-box estimators beside peers"
COLUMNS = ("structure", "samples", "program", "time", "over ambid", "simulation error")
BEFORE = (
    f"The truths of the experiments above, from rest. Warm, in memory, one thread, all programs in turn, {ROUNDS}"
    f" rounds (one where longer than {LONG_S:.0f} s), median and in brackets minimum; more than {LIMIT_S:.0f} s"
    " is stopped. The ratio is that of the medians, above 1 where ambid takes less. Times of ambid include covariance,"
    " offsets and initial states, which no peer gives. N4SID: order 2, 10 block rows for all, on the ARMAX record."
)


@dataclass(slots=True)
class Watch:
    """What one program took and how close it came."""

    seconds: list[float] = field(default_factory=list)
    error: float = float("nan")
    problem: str = ""

    def add(self, found: Answer, experiment: Experiment, u: Array) -> None:
        self.seconds.append(found.seconds)
        self.problem = found.problem
        self.error = float("nan") if found.model is None else experiment.simulation_error(found.model, u)

    @property
    def stopped(self) -> bool:
        return self.problem.startswith("more than")

    @property
    def done(self) -> bool:
        return bool(self.problem) or (bool(self.seconds) and self.seconds[-1] > LONG_S)


def speed_tables() -> Iterator[Table]:
    """One table with all structures, sizes and programs."""
    rows: list[tuple[str, ...]] = []
    remarks: list[str] = []
    data: dict[str, object] = {}
    jobs = [(e.structure, e, e.orders) for e in AT_SPEED]
    armax = next(e for e in AT_SPEED if e.structure == "armax")
    jobs.append(("n4sid", armax, SUBSPACE))
    with bench() as children:
        for structure, experiment, orders in jobs:
            for n in SIZES:
                watches = _watched(children, structure, experiment, orders, n)
                ours = Timing.of(next(w.seconds for way, w in watches.items() if way.program == "ambid"))
                for way, watch in watches.items():
                    rows.append(_row(structure, n, way, watch, ours))
                    data[f"{structure}, {n}; {way.label}"] = {
                        "seconds": watch.seconds,
                        "simulation_error": watch.error,
                        "problem": watch.problem,
                    }
                    if watch.problem and not watch.stopped:
                        remarks.append(f"{structure}, {n} samples, {way.label}: {watch.problem}.")
                remarks.append(_verdict(structure, n, watches, ours))
                print(remarks[-1], flush=True)
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=BEFORE, remarks=tuple(remarks), data=data)


def _watched(
    children: Bench, structure: str, experiment: Experiment, orders: Mapping[str, int], n: int
) -> dict[Way, Watch]:
    u, y, _ = experiment.record(1000, seed=0)
    watches = {way: Watch() for way in ways(structure)}
    for way in watches:  # whatever is compiled or loaded at the first call is not measured
        children.answer(way, structure, orders, u, y, limit_s=LIMIT_S)
    u, y, _ = experiment.record(n, seed=0)
    for k in range(ROUNDS):
        for way, watch in watches.items():
            if not watch.done or not k:
                watch.add(children.answer(way, structure, orders, u, y, limit_s=LIMIT_S), experiment, u)
    return watches


def _row(structure: str, n: int, way: Way, watch: Watch, ours: Timing) -> tuple[str, ...]:
    taken = Timing.of(watch.seconds)
    time = f"> {LIMIT_S:.0f} s" if watch.stopped else shown(taken, "s")
    ratio = f"{'> ' if watch.stopped else ''}{taken.median / ours.median:.3g}"
    failed = bool(watch.problem) and not watch.stopped
    return (
        structure.upper(),
        f"{n}",
        way.label,
        "fails" if failed else time,
        "–" if failed or way.program == "ambid" else ratio,
        "–" if np.isnan(watch.error) else f"{watch.error:.2e}",
    )


def _verdict(structure: str, n: int, watches: Mapping[Way, Watch], ours: Timing) -> str:
    packages = {
        way.label: Timing.of(w.seconds).median
        for way, w in watches.items()
        if way.program not in ("ambid", "scipy") and (not w.problem or w.stopped)
    }
    if not packages:
        return f"{structure}, {n} samples: no package ends."
    best = min(packages, key=lambda k: packages[k])
    return (
        f"{structure}, {n} samples: {quantity(ours.median, 's')}; the fastest package ({best}) takes"
        f" {packages[best] / ours.median:.3g} times as long."
    )
