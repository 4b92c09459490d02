"""Rotors: how often the 95 % intervals hold the truth, and what a wrong model makes of them.

Records are simulated from the presets, and identified with a rig that knows nothing but the planes. Alone:
``python bench/rotor_montecarlo.py``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

import ambid
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.record import Record
from ambid.rig import Rig, rig_of_preset
from ambid.rig.rig import RigModes
from ambid.rotor import RotorEstimate
from ambid.simulation.rotor_bench import RotorBench
from table import Table

RUNS, SEEDS = 100, (1, 2, 3)
_Z, _FAR = 1.959964, 3.5
_SECONDS, _PERIODS = 2.0, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What is wrong with a record or its rig."""

    name: str
    nonlinear: bool = False
    simulated: Callable[[Rig], Rig] = lambda rig: rig
    recorded: Callable[[Record], Record] = lambda record: record
    known: Callable[[Rig], Rig] = lambda rig: rig


def run(
    case: Case, seed: int, *, bench: str = "rmit", amplitude: float | None = None
) -> tuple[RotorEstimate, dict[str, float]]:
    """Return the estimate of one record, and its errors in standard deviations."""
    rig = rig_of_preset(preset(bench))
    assert rig.rotor is not None
    truth = RotorBench.of(rig, None, None).plant.parameters
    blind = tuple(p if p.name in rig.rotor.places else Parameter(name=p.name, unit=p.unit) for p in rig.parameters)
    record = ambid.simulate(
        case.simulated(rig), duration=_SECONDS, periods=_PERIODS, excitation="zippered", amplitude=amplitude,
        nonlinear=case.nonlinear, seed=seed,
    )  # fmt: skip
    found = _identified(case.recorded(record), case.known(replace(rig, parameters=blind)))
    errors = {p.name: (p.value - truth[p.name]) / p.sd for p in found.parameters if p.sd}
    return found, errors


def _identified(record: Record, rig: Rig) -> RotorEstimate:
    """Return the estimate with a rig that knows nothing of its modes."""
    found = ambid.identify(record, replace(rig, modes=RigModes()))
    assert isinstance(found, RotorEstimate)
    return found


def coverage() -> Table:
    """Return how often the intervals of each parameter hold the truth."""
    rows, data = [], {}
    for name, bench, amplitude in (
        ("rigid", "rmit", None),
        ("rigid, a tenth", "rmit", 2.5),
        ("two bending modes", "central-mass", None),
    ):
        began = time.perf_counter()
        runs = [run(Case(name=name), seed, bench=bench, amplitude=amplitude) for seed in range(RUNS)]
        errors = {n: np.array([e[n] for _, e in runs]) for n in runs[0][1]}
        z = np.concatenate(list(errors.values()))
        each = {n: float(np.mean(np.abs(x) < _Z)) for n, x in errors.items()}
        rows.append(
            (
                name,
                f"{np.mean(np.abs(z) < _Z):.3f}",
                f"{min(each.values()):.2f} to {max(each.values()):.2f}",
                f"{np.sqrt(np.mean(z**2)):.2f}",
                f"{np.max(np.abs(z)):.1f}",
                f"{sum(found.verdict.word == 'usable' for found, _ in runs)} of {RUNS}",
                f"{(time.perf_counter() - began) / RUNS:.2f} s",
            )
        )
        data[name] = {"covered": each}
    return Table(
        group="Rotors: coverage of the 95 % intervals",
        columns=("bench", "all", "by parameter", "rms of z", "largest", "usable", "time a run"),
        rows=tuple(rows),
        before=f"{RUNS} records of {_SECONDS:g} s each; z: error over standard deviation.",
        data=data,
    )


def robustness() -> Table:
    """Return what errors of sensors, planes, magnets and amplifiers do, and whether they are told."""
    rows = []
    for case in _wrong():
        worst, words, checks = 0.0, [], set[str]()
        for seed in SEEDS:
            found, errors = run(case, seed)
            worst = max(worst, *(abs(x) for x in errors.values()))
            words.append(found.verdict.word)
            checks |= {r.check for r in found.verdict.reasons}
        told = all(word != "usable" for word in words)
        kept = "yes" if worst <= _FAR else "told" if told else "NO"
        rows.append((case.name, f"{worst:.1f}", ", ".join(sorted(checks)) or "none", kept))
    return Table(
        group="Rotors: errors of sensors, planes, magnets and amplifiers",
        columns=("case", "largest error in sd", "failed checks", "within 3.5 sd or told"),
        rows=tuple(rows),
        before=f"{len(SEEDS)} records each.",
    )


def _wrong() -> Iterator[Case]:
    yield Case(name="nothing")
    for color in (0.9, 0.99):
        yield Case(name=f"sensor noise with a pole at {color}", recorded=lambda r, c=color: _colored(r, c))
    for mm in (1.0, 2.0):
        yield Case(name=f"a sensor plane {mm:g} mm off", known=lambda rig, mm=mm: _moved(rig, mm))
    yield Case(name="sensors with poles at 2.2 to 3.5 kHz", recorded=_lagged)
    yield Case(name="1 % of cross-talk", recorded=_mixed)
    yield Case(name="converters of 12 bits", simulated=_quantised)
    yield Case(name="voltage at its limit in 1 % of the samples", recorded=_clipped)
    yield Case(name="nonlinear magnets, half of the limits", nonlinear=True)


def _positions(record: Record, change: Callable[[np.ndarray, int], np.ndarray]) -> Record:
    found = (
        replace(c, values=np.ascontiguousarray(change(c.values, k))) if c.name.endswith("_position") else c
        for k, c in enumerate(record.channels)
    )
    return replace(record, channels=tuple(found))


def _colored(record: Record, pole: float) -> Record:
    def add(x: np.ndarray, k: int) -> np.ndarray:
        e = np.random.default_rng(k).standard_normal(x.size) * np.sqrt(1.0 - pole**2)
        return np.asarray(x + 3e-7 * lfilter([1.0], [1.0, -pole], e))

    return _positions(record, add)


def _lagged(record: Record) -> Record:
    def through(x: np.ndarray, k: int) -> np.ndarray:
        a = np.exp(-2.0 * np.pi * (2200.0 + 433.0 * (k % 4)) / record.rate_hz)
        return np.asarray(lfilter([0.5 * (1.0 - a), 0.5 * (1.0 - a)], [1.0, -a], x))  # linear between the samples

    return _positions(record, through)


def _mixed(record: Record) -> Record:
    names = [c.name for c in record.channels if c.name.endswith("_position")]
    other = dict(zip(names, [*names[1::-1], *names[:1:-1]], strict=True))
    channels = (
        replace(c, values=c.values + 0.01 * record[other[c.name]].values) if c.name in other else c
        for c in record.channels
    )
    return replace(record, channels=tuple(channels))


def _clipped(record: Record) -> Record:
    """Return a record whose voltages were logged before a limit that 1 % of the samples reach."""
    found: list[Any] = []
    for c in record.channels:
        if c.name.endswith("_voltage"):
            most = float(np.quantile(np.abs(c.values), 0.99))
            over = np.sign(c.values) * np.maximum(np.abs(c.values) - most, 0.0)
            c = replace(c, values=c.values + over)  # what was commanded beyond what the coil saw
        found.append(c)
    return replace(record, channels=tuple(found))


def _moved(rig: Rig, mm: float) -> Rig:
    assert rig.rotor is not None
    name = rig.rotor.bearings[0].sensor_parameter(0)
    found = (
        replace(p, value=p.value + 1e-3 * mm) if p.name == name and p.value is not None else p for p in rig.parameters
    )
    return replace(rig, parameters=tuple(found))


def _quantised(rig: Rig) -> Rig:
    assert rig.noise is not None
    steps = {"position_resolution": 2 * 350e-6 / 4096, "current_resolution": 2 * 5.0 / 4096}
    return replace(rig, noise=replace(rig.noise, **steps))


def rotor_tables() -> Iterator[Table]:
    """Yield the tables of coverage and robustness."""
    yield coverage()
    yield robustness()


if __name__ == "__main__":
    for table in rotor_tables():
        print(table.as_markdown(), flush=True)
