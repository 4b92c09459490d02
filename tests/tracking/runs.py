"""Short simulated records of a bench in its loop, with known truth, and the supervised tracker run on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ambid.estimation.estimate import Estimate
from ambid.job import identify
from ambid.physics.presets import preset
from ambid.record import Record
from ambid.recursive.lines import Event, TrackLine
from ambid.simulation import simulate_scenario
from ambid.simulation.rig_bench import Bench
from ambid.simulation.scenarios import Scenario, amplitude_for, one_period
from ambid.simulation.variation import Schedule, Variation
from ambid.tracking.blocks import Rejection
from ambid.tracking.evidence import Samples
from ambid.tracking.reporter import Reporter
from ambid.tracking.rpem import PhysicalRpem
from ambid.tracking.supervisor import Supervisor

RATE = 20_000
START_S = 1.0  # of every record, from which its tracking starts
PRESET = preset("unstable-bearing")
TRUE = PRESET.parameters
NOISE = {"position": 1e-7, "current": 2e-3}  # of the sensors


def step(name: str, factor: float, at_s: float) -> dict[str, Schedule]:
    """One parameter that jumps."""
    return {name: Schedule.step(TRUE[name], TRUE[name] * factor, at_s)}


def course(name: str, *knots: tuple[float, float]) -> dict[str, Schedule]:
    """One parameter that goes from factor to factor; a time that comes twice is a jump."""
    times, factors = zip(*knots, strict=True)
    return {name: Schedule(times_s=times, values=tuple(TRUE[name] * f for f in factors))}


@cache
def amplitude() -> float:
    """What a scenario chooses for seed 1, for all seeds: its search takes twice as long as a simulation."""
    bench = Bench.of(PRESET, None, None)
    return amplitude_for(bench, one_period(bench, 1), 1)


def simulated(
    parameters: Mapping[str, Schedule] | None = None,
    *,
    gains: Mapping[str, Schedule] | None = None,
    force: Schedule | None = None,
    seconds: float = 2.5,
    seed: int = 1,
) -> Record:
    """The unstable bearing under a multisine; nothing may change before START_S."""
    variation = Variation(parameters=parameters or {}, gains=gains or {}, force=force)
    own = Scenario(name="own", summary="", duration_s=seconds, vary=lambda *_: variation)
    record = simulate_scenario(own, PRESET, duration_s=seconds, seed=seed, amplitude=amplitude()).record
    return replace(record, channels=tuple(record.channel(c) for c in ("voltage", "current", "position")))


@cache
def start(seed: int = 1) -> Estimate:
    """From the first second, which is the same in all records of a seed."""
    record = simulated(seconds=START_S, seed=seed)
    return identify(record)


def arrays(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs, (n_samples, .), to be changed at will."""
    return record["voltage"][:, None].copy(), np.column_stack([record["position"], record["current"]])


@dataclass
class Run:
    """What came of a record."""

    supervisor: Supervisor
    reporter: Reporter
    lines: list[TrackLine]
    events: list[Event]

    def of(self, *kinds: str) -> list[Event]:
        """The events of some kinds."""
        return [e for e in self.events if e.kind in kinds]

    def at(self, t: float) -> TrackLine:
        """The first line at or after a time."""
        return next(line for line in self.lines if line.t >= t - 1e-9)

    def z(self, line: TrackLine, name: str, truth: float) -> float:
        """Distance from the truth in standard deviations."""
        value = {**line.parameters, **line.extra}[name]
        return (value.value - truth) / value.sd

    def states(self) -> list[str]:
        """States in the order in which they came."""
        found: list[str] = []
        for line in self.lines:
            if not found or found[-1] != line.state:
                found.append(line.state)
        return found


def tracked(
    record: Record,
    *,
    edit: Callable[[np.ndarray, np.ndarray], None] | None = None,
    flags: tuple[tuple[float, str], ...] = (),
    lost: tuple[float, float] | None = None,
    on_line: Callable[[TrackLine], tuple[str, ...]] = lambda _: (),
    seed: int = 1,
    block: int = 200,
    limit: float = 1.5,
) -> Run:
    """Track a record from START_S on; `edit` changes its inputs and outputs, `lost` leaves a stretch of time out."""
    u, y = arrays(record)
    if edit is not None:
        edit(u, y)
    events: list[Event] = []
    lines: list[TrackLine] = []
    supervisor = Supervisor(PhysicalRpem(start(seed)), limit=limit, listener=lambda e: reporter.note(e))

    def emit(line: TrackLine) -> tuple[str, ...]:
        lines.append(line)
        events.extend(line.events)
        return on_line(line)

    first = round(START_S * RATE)
    reporter = Reporter(supervisor, every_s=0.01, on_line=emit, flags=flags, first=first)
    a, b = (round(t * RATE) for t in lost) if lost else (u.shape[0], u.shape[0])
    for k in range(first, u.shape[0], block):
        stop = min(k + block, u.shape[0])
        if stop <= a or k >= b:
            reporter.consume(Samples(u=u[k:stop], y=y[k:stop]), k, restart=k == b)
        elif k == a:
            why = f"{b - a} samples never came"
            reporter.reject(Rejection(kind="gap", samples=b - a, t=k / RATE, why=why))
    reporter.finish()
    return Run(supervisor=supervisor, reporter=reporter, lines=lines, events=events)
