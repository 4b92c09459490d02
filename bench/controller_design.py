"""Controllers designed on identified models against the same design on models 10 % off, judged around the truth.

Each record is simulated, with a seed of its own, and identified; the other model has m, k_x and k_i (of a rotor those
of every axis) 10 % off, with random signs. The plants that judge are drawn around the truth, and no design knows them.
Alone: ``python bench/controller_design.py [BENCH ...]``; "flexible" needs the independent simulator.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import ambid
from ambid.control.closed import Plant
from ambid.control.design import GOALS, Figures, Goals, noise_of, verify, worst_of
from ambid.control.drawn import Drawn, draw_plants, over_speeds
from ambid.control.tuning import tune_pid
from ambid.control.zones import zone_of
from ambid.errors import EstimationError
from ambid.estimation.progress import silent
from ambid.job.closed_loop import Numbers, plant_of
from ambid.physics.linear_model import Parameter
from ambid.physics.loop import Interval
from ambid.physics.presets import preset
from ambid.physics.rotor_model import RotorModel
from ambid.rig import Rig, rig_of_preset
from ambid.rig.rig import RigModes
from ambid.simulation.rotor_bench import RotorBench
from table import Table

JUDGES = 200
_OFF = 0.1


@dataclass(frozen=True, kw_only=True)
class Case:
    """A bench whose present loop is designed again."""

    truth: Plant
    rig: Rig
    identify: Callable[[int], Numbers]  # a record of some seed
    draws: int
    tuning: int
    form: str = "axes"
    speeds: Interval | None = None  # rad/s

    def drawn(self, plant: Plant, n: int, seed: int) -> tuple[Drawn, ...]:
        """Return plants around one."""
        found = draw_plants(plant, self.rig, n, seed=seed)
        return (found if self.speeds is None else over_speeds(found, self.speeds)).plants

    def off(self, rng: np.random.Generator) -> Plant:
        """Return the truth with wrong numbers."""
        wrong = [name for name in self.truth.theta if name == "m" or name.endswith(("k_x", "k_i"))]
        signs = rng.choice([-1, 1], len(wrong))
        theta = {n: self.truth.theta[n] * (1.0 + _OFF * s) for n, s in zip(wrong, signs, strict=True)}
        return replace(self.truth, theta={**self.truth.theta, **theta})


def _one_axis(name: str, seconds: float) -> Case:
    bench, rig = preset(name), rig_of_preset(preset(name))
    truth = Plant(
        model=rig.plant, theta=bench.parameters, delays=np.array([bench.loop.delay]), rate_hz=bench.rate_hz
    )  # fmt: skip

    def identify(seed: int) -> Numbers:
        return ambid.identify(ambid.simulate(name, duration=seconds, seed=100 + seed), rig)

    return Case(truth=truth, rig=rig, identify=identify, draws=30, tuning=60)


def _flexible() -> Case:
    root = str(Path(__file__).resolve().parents[1])
    if root not in sys.path:
        sys.path.insert(0, root)
    from tests.rotor_benches import free_rig, model_of, record_of, rig_of, truth

    bench = truth.BENCHES["flexible"]
    rig, (model, theta) = rig_of(bench), model_of(bench)
    plant = Plant(model=model, theta=theta, delays=np.full(4, float(bench.delay)), rate_hz=bench.rate)
    return Case(
        truth=plant, rig=rig, identify=lambda seed: ambid.identify(record_of(bench, seed), free_rig(bench)),
        draws=5, tuning=20,
    )  # fmt: skip


def _utrc() -> Case:
    rig = rig_of_preset(preset("utrc"))
    bench = RotorBench.of(rig, None, True)
    known = bench.model.places
    blind = tuple(p if p.name in known else Parameter(name=p.name, unit=p.unit) for p in rig.parameters)
    delays = np.full(len(bench.model.inputs), bench.loop.delay)

    def identify(seed: int) -> Numbers:
        record = ambid.simulate(
            rig, duration=1.0, periods=4, excitation="zippered", band=(4.0, 700.0), seed=2 + seed
        )  # fmt: skip
        return ambid.identify(record, replace(rig, parameters=blind, modes=RigModes()))

    truth = Plant(model=bench.model, theta=bench.plant.parameters, delays=delays, rate_hz=bench.rate_hz)
    return Case(
        truth=truth, rig=rig, identify=identify, draws=3, tuning=20, form="bearings", speeds=(0.0, bench.model.speed)
    )  # fmt: skip


CASES: Mapping[str, Callable[[], Case]] = {
    "unstable-bearing": lambda: _one_axis("unstable-bearing", 0.5),
    "prototype": lambda: _one_axis("prototype", 5.0),
    "flexible": _flexible,
    "utrc": _utrc,
}


@dataclass(frozen=True, kw_only=True)
class Design:
    """What a design does on the plants that judge, and how long it took; nothing where there is none."""

    figures: tuple[Figures, ...]
    seconds: float

    @property
    def worst(self) -> Figures:
        """The worst over the plants."""
        return worst_of(self.figures)


def designs(case: Case) -> tuple[Figures, Mapping[str, list[Design]]]:
    """Return the worst of the present loop, and the designs on both kinds of models."""
    assert case.rig.loop is not None
    noise, judging = noise_of(case.rig.noise, {})[:2], case.drawn(case.truth, JUDGES, 999)
    rng, found = np.random.default_rng(1), dict[str, list[Design]](identified=[], off=[])
    of = case.truth.model
    speed = of.speed if isinstance(of, RotorModel) else 0.0
    for k in range(case.draws):
        models = {"off": case.off(rng)}
        known = case.identify(k)
        if known.status == "converged":
            models["identified"] = plant_of(known, case.truth.rate_hz, speed)
        else:
            print(f"identified {k}: the search did not converge", file=sys.stderr)
            found["identified"].append(Design(figures=(), seconds=math.nan))
        for kind, plant in models.items():
            drawn = case.drawn(plant, case.tuning, k)
            before = [x.figures for x in verify(drawn, case.rig.loop, noise)]
            began = time.process_time()
            took, seen = math.nan, tuple[Figures, ...]()
            try:
                if not before[0].stable:
                    raise EstimationError("the present loop does not hold the model")
                goals = Goals.of(GOALS, {}, worst_of(before))
                plants = [d.plant for d in drawn]
                loop = tune_pid(plants, case.rig, goals, silent, form=case.form)
                took = time.process_time() - began
                seen = tuple(x.figures for x in verify(judging, loop, noise))
            except EstimationError as none:
                print(f"{kind} {k}: no design: {none}", file=sys.stderr)
            found[kind].append(Design(figures=seen, seconds=took))
    return worst_of([x.figures for x in verify(judging, case.rig.loop, noise)]), found


def controller_tables(names: Sequence[str] = tuple(CASES)) -> Iterator[Table]:
    """Return a table of designed controllers for each bench."""
    for name in names:
        case = CASES[name]()
        before, found = designs(case)
        rows = [("present loop", "", f"{before.peak_db:.2f} dB ({zone_of(before.peak_db)})", "", "1", "1", "", "")]
        for kind, all_of in found.items():
            made = [d for d in all_of if d.figures]
            peaks = np.array([d.worst.peak_db for d in made] or [math.nan])
            lost = sum(not f.stable for d in made for f in d.figures)
            zones = sum(zone_of(d.worst.peak_db) == "A" for d in made if all(f.stable for f in d.figures))
            ratios = [[getattr(d.worst, x) / getattr(before, x) for d in made] for x in ("compliance", "settling")]
            rows.append(
                (
                    {"identified": "identified model", "off": "model 10 % off"}[kind],
                    f"{lost} of {len(made) * JUDGES}",
                    f"{peaks.mean():.2f} dB, up to {peaks.max():.2f}", f"{zones} of {case.draws}",
                    *(f"up to {max(r, default=math.nan):.2f}" for r in ratios), str(case.draws - len(made)),
                    f"{max((d.seconds for d in made), default=math.nan):.1f} s",
                )
            )  # fmt: skip
        yield Table(
            group=f"{name}: PID ({case.form}) tuned over {case.tuning} plants, {case.draws} draws",
            columns=("designed on", "plants not held", f"peak of sensitivity, worst of {JUDGES} plants",
                     "designs in zone A", "compliance over before", "settling over before", "no design",
                     "CPU time, longest"),
            rows=tuple(rows),
        )  # fmt: skip


if __name__ == "__main__":
    for made in controller_tables(sys.argv[1:] or tuple(CASES)):
        print(made.as_markdown(), flush=True)
