"""Accuracy: 100 records of 1000 samples for each experiment, every program on each record in turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from experiments import EXPERIMENTS, Experiment
from peers import Answer, Array, Bench, Way, bench, ways
from table import Table
from timing import quantity

RUNS, SAMPLES = 100, 1000
GROUP = "Accuracy beside peers: 100 records of 1000 samples"
COLUMNS = ("experiment", "program", "models", "worst RMSE / bound", "RMSE / bound", "simulation error", "time")
BEFORE = (
    "Root mean square error of each coefficient over all runs, divided by its Cramér-Rao bound (at the truth, initial"
    " state and offset known): 1 is the best that can be, and 100 runs tell it to 7 %. Simulation error: mean of"
    " |y0 - G u| / |y0| without noise, from rest, on the input of the record. Times: median of one fit. All programs"
    " see the same records; `models` counts the stable models, and the others are left out of the row. `From rest`: the"
    " record starts at rest at zero, which the peers always take for granted and ambid is told (`at_rest`). `In"
    " operation`: the record is cut out of a longer run about an operating point, as measured records are; ambid"
    " estimates initial state and offset, the peers get the record with the means taken off."
)


@dataclass(slots=True)
class Tally:
    """What one program did in one experiment."""

    seconds: list[float] = field(default_factory=list)
    vectors: list[Array] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    problems: dict[int, str] = field(default_factory=dict)

    def add(self, run: int, experiment: Experiment, found: Answer, u: Array) -> None:
        self.seconds.append(found.seconds)
        if found.problem:
            self.problems[run] = found.problem
        if found.model is None:
            return
        error = experiment.simulation_error(found.model, u)
        if not np.isfinite(error):
            self.problems[run] = "unstable"
            return
        self.errors.append(error)
        self.vectors.append(experiment.vector(found.model))

    def ratios(self, experiment: Experiment, bound: Array) -> Array:
        if not self.vectors:
            return np.full(bound.size, np.inf)
        off = np.array(self.vectors) - np.array(list(experiment.coefficients.values()))
        return np.asarray(np.sqrt(np.mean(off**2, axis=0)) / bound)


def accuracy_tables() -> Iterator[Table]:
    """One table with all experiments and programs."""
    rows: list[tuple[str, ...]] = []
    remarks = [f"{e.name}: {e.says}." for e in EXPERIMENTS]
    data: dict[str, object] = {}
    with bench() as children:
        for experiment in EXPERIMENTS:
            tallies, bound = run(experiment, children)
            for way, tally in tallies.items():
                rows.append(_row(experiment, way, tally, bound))
                data[f"{experiment.name}; {way.label}"] = _numbers(experiment, tally, bound)
                remarks += _problems(experiment, way, tally)
            remarks.append(_verdict(experiment, tallies, bound))
            print(remarks[-1], flush=True)
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=BEFORE, remarks=tuple(remarks), data=data)


def run(experiment: Experiment, children: Bench, runs: int = RUNS) -> tuple[dict[Way, Tally], Array]:
    """Fit every record with every program; return what came out, and the bound of each coefficient."""
    tallies = {way: Tally() for way in ways(experiment.structure)}
    information = np.zeros((len(experiment.coefficients),) * 2)
    for way in tallies:  # once before, unwatched: whatever is compiled or loaded then is not measured
        u, y, _ = experiment.record(SAMPLES, seed=10**6)
        _answer(children, way, experiment, u, y)
    for k in range(runs):
        u, y, sensitivity = experiment.record(SAMPLES, seed=k)
        information += sensitivity.T @ sensitivity / experiment.sd**2 / runs
        for way, tally in tallies.items():
            tally.add(k, experiment, _answer(children, way, experiment, u, y), u)
    return tallies, np.sqrt(np.diag(np.linalg.inv(information)))


def _answer(children: Bench, way: Way, experiment: Experiment, u: Array, y: Array) -> Answer:
    u, y = given(way, experiment, u, y)
    return children.answer(way, experiment.structure, experiment.orders, u, y, at_rest=experiment.at_rest)


def given(way: Way, experiment: Experiment, u: Array, y: Array) -> tuple[Array, Array]:
    """Take the means off for the peers, who know no offsets; what starts at rest has none."""
    if way.program == "ambid" or experiment.at_rest:
        return u, y
    return u - np.mean(u), y - np.mean(y)


def _row(experiment: Experiment, way: Way, tally: Tally, bound: Array) -> tuple[str, ...]:
    ratios = tally.ratios(experiment, bound)
    each = ", ".join(
        f"{name} {'–' if np.isnan(r) else f'{r:.3g}'}" for name, r in zip(experiment.coefficients, ratios, strict=True)
    )
    return (
        experiment.name,
        way.label,
        str(len(tally.errors)),
        f"{np.nanmax(ratios):.3g}",
        each,
        f"{np.mean(tally.errors):.3g}" if tally.errors else "–",
        quantity(float(np.median(tally.seconds)), "s"),
    )


def _numbers(experiment: Experiment, tally: Tally, bound: Array) -> dict[str, object]:
    return {
        "rmse_over_bound": dict(zip(experiment.coefficients, tally.ratios(experiment, bound).tolist(), strict=True)),
        "bound": dict(zip(experiment.coefficients, bound.tolist(), strict=True)),
        "simulation_errors": tally.errors,
        "seconds": tally.seconds,
        "problems": {str(k): v for k, v in tally.problems.items()},
    }


def _problems(experiment: Experiment, way: Way, tally: Tally) -> Iterator[str]:
    for problem in sorted(set(tally.problems.values())):
        runs = [k for k, v in tally.problems.items() if v == problem]
        yield f"{experiment.name}, {way.label}: {problem} in {len(runs)} run(s), the first {runs[0]}."


def _verdict(experiment: Experiment, tallies: dict[Way, Tally], bound: Array) -> str:
    """Ambid beside the best peer: the worst coefficient, the mean of all, the simulation error, the time."""

    def figures(tally: Tally) -> Array:
        ratios = tally.ratios(experiment, bound)
        if np.isnan(ratios).any():
            ratios = np.full(ratios.size, np.inf)
        error = np.mean(tally.errors) if tally.errors else np.inf
        return np.array([np.max(ratios), np.mean(ratios), error, np.median(tally.seconds)])

    all_figures = {way.program: figures(tally) for way, tally in tallies.items() if way.program == "ambid"}
    others = np.array([figures(tally) for way, tally in tallies.items() if way.program != "ambid"])
    over = all_figures["ambid"] / np.min(others, axis=0)
    return (
        f"{experiment.name}, ambid over the best peer of each column: worst coefficient {over[0]:.3f}, mean of the"
        f" coefficients {over[1]:.3f}, simulation error {over[2]:.3f}, time {over[3]:.3g}."
    )
