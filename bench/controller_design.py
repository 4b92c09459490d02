"""Controllers designed on identified models against the same design on models 10 % off, judged around the truth.

Each record is simulated, with a seed of its own, and identified; the other model has m, k_x and k_i 10 % off, with
random signs. The plants that judge are drawn around the truth, and no design knows them. Alone:
``python bench/controller_design.py``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

import ambid
from ambid.control.closed import Plant
from ambid.control.design import GOALS, Figures, Goals, noise_of, verify, worst_of
from ambid.control.drawn import draw_plants
from ambid.control.tuning import tune_pid
from ambid.estimation.estimate import Estimate
from ambid.estimation.progress import silent
from ambid.job.closed_loop import plant_of
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.simulation.margins import zone_of
from table import Table

DRAWS, JUDGES, TUNING = 30, 200, 60
_OFF = 0.1
_RECORDS = {"unstable-bearing": 0.5, "prototype": 5.0}  # s


@dataclass(frozen=True, kw_only=True)
class Design:
    """What a design does on the plants that judge, and how long it took."""

    figures: tuple[Figures, ...]
    seconds: float

    @property
    def worst(self) -> Figures:
        """The worst over the plants."""
        return worst_of(self.figures)


def designs(name: str) -> tuple[Figures, Mapping[str, list[Design]]]:
    """Return the worst of the present loop, and the designs on both kinds of models."""
    bench = preset(name)
    rig = rig_of_preset(bench)
    noise = noise_of(rig.noise, {})[:2]
    truth = Plant(
        model=rig.plant, theta=bench.parameters, delays=np.array([bench.loop.delay]), rate_hz=bench.rate_hz
    )  # fmt: skip
    judging = draw_plants(truth, rig, JUDGES, seed=999).plants
    rng, found = np.random.default_rng(1), dict[str, list[Design]](identified=[], off=[])
    for k in range(DRAWS):
        estimate = ambid.identify(ambid.simulate(name, duration=_RECORDS[name], seed=100 + k), rig)
        assert isinstance(estimate, Estimate)
        off = {
            n: truth.theta[n] * (1.0 + _OFF * s)
            for n, s in zip(("m", "k_x", "k_i"), rng.choice([-1, 1], 3), strict=True)
        }
        models = {"identified": plant_of(estimate, bench.rate_hz), "off": replace(truth, theta={**truth.theta, **off})}
        for kind, plant in models.items():
            drawn = draw_plants(plant, rig, TUNING, seed=k).plants
            before = worst_of([x.figures for x in verify(drawn, bench.loop, noise)])
            began = time.process_time()
            loop = tune_pid([d.plant for d in drawn], rig, Goals.of(GOALS, {}, before), silent)
            took = time.process_time() - began
            seen = tuple(x.figures for x in verify(judging, loop, noise))
            found[kind].append(Design(figures=seen, seconds=took))
    return worst_of([x.figures for x in verify(judging, bench.loop, noise)]), found


def controller_tables() -> Iterator[Table]:
    """Return the table of designed controllers."""
    rows = []
    for name in _RECORDS:
        before, found = designs(name)
        rows.append((name, "present loop", "", f"{before.peak_db:.2f} dB ({zone_of(before.peak)})", "", "1", "1", ""))
        for kind, made in found.items():
            peaks = np.array([d.worst.peak_db for d in made])
            lost = sum(not f.stable for d in made for f in d.figures)
            zones = sum(zone_of(d.worst.peak) == "A" for d in made)
            ratios = [[getattr(d.worst, x) / getattr(before, x) for d in made] for x in ("compliance", "settling")]
            rows.append(
                (
                    name, {"identified": "identified model", "off": "model 10 % off"}[kind],
                    f"{lost} of {DRAWS * JUDGES}", f"{peaks.mean():.2f} dB, up to {peaks.max():.2f}",
                    f"{zones} of {DRAWS}", *(f"up to {max(r):.2f}" for r in ratios),
                    f"{max(d.seconds for d in made):.1f} s",
                )
            )  # fmt: skip
    yield Table(
        group=f"PID tuned over {TUNING} plants, on {DRAWS} identified models and on {DRAWS} models 10 % off",
        columns=("bench", "designed on", "plants not held", f"peak of sensitivity, worst of {JUDGES} plants",
                 "designs in zone A", "compliance over before", "settling over before", "CPU time, longest"),
        rows=tuple(rows),
    )  # fmt: skip


if __name__ == "__main__":
    for made in controller_tables():
        print(made.as_markdown(), flush=True)
