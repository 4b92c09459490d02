"""Designed experiments against flat multisines at equal peaks: what identify reports, what was promised, the limits.

Each record is simulated from rest with the bench's noise, and identified with a rig whose values are unknown. Alone:
``python bench/experiment_design.py``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import ambid
from ambid.arrays import Array
from ambid.control.experiment import Experiment
from ambid.estimation.estimate import Estimate
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.rig import Rig, rig_of_preset
from ambid.simulation import simulate_rig
from table import Table

SEEDS, RUNS = 8, 50
ROTORS, ROTOR_SEEDS, ROTOR_RUNS, ROTOR_SECONDS = ("rmit", "spindle", "central-mass", "utrc"), 4, 20, 4.0
_OFF = 0.1  # of the parameters of the plants that are off
_SIGNALS = ("position", "current", "voltage")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A bench, the length of its records, and the band of both excitations."""

    bench: str
    seconds: float
    band: tuple[float, float]
    noise: Noise | None = None
    known: tuple[str, ...] = ("m", "c")  # fixed; the others are estimated

    @property
    def rig(self) -> Rig:
        """The rig of the bench, without steps of its converters."""
        rig = rig_of_preset(preset(self.bench))
        parameters = tuple(replace(p, role="fixed" if p.name in self.known else "free") for p in rig.parameters)
        assert rig.noise is not None
        steps = {f"{role}_resolution": 0.0 for role in ("position", "current", "voltage")}
        return replace(rig, parameters=parameters, noise=self.noise or replace(rig.noise, **steps))


CASES = (
    Case(bench="thesis", seconds=2.0, band=(2.0, 2000.0), noise=Noise(position=1e-5, current=1.5e-3), known=("c",)),
    Case(bench="unstable-bearing", seconds=1.0, band=(4.0, 2000.0)),
    Case(bench="prototype", seconds=4.0, band=(1.0, 400.0), known=("c",)),
)


def use(rig: Rig, found: Experiment, wave: Array) -> float:
    """Return the largest part of the limits that a wave uses, simulated without noise from rest."""
    record = simulate_rig(replace(rig, noise=Noise()), wave, rate_hz=found.rate_hz, seed=0).record
    return max(float(np.max(np.abs(record[n].values))) / float(found.signals[n].high or np.inf) for n in _SIGNALS)


def identified(rig: Rig, found: Experiment, wave: Array) -> list[Estimate]:
    """Return the estimates of records with one excitation, a seed each."""
    blind = replace(rig, parameters=tuple(p if p.role == "fixed" else replace(p, value=None) for p in rig.parameters))
    estimates = []
    for seed in range(SEEDS):
        estimate = ambid.identify(simulate_rig(rig, wave, rate_hz=found.rate_hz, seed=seed).record, blind)
        assert isinstance(estimate, Estimate)
        estimates.append(estimate)
    return estimates


def compared(case: Case) -> Iterator[tuple[str, ...]]:
    """Return a row for each parameter: flat and designed sd, promised over reached, scatter over sd."""
    rig = case.rig
    # known within 1 %, as after a first short record
    found = ambid.design_experiment(rig, seconds=case.seconds, band=case.band, spread=0.01)
    designed = found.played(found.period * found.periods, found.rate_hz)[:, 0]
    flat = np.tile(
        ambid.excitation("schroeder", found.period, found.rate_hz, amplitude=1.0, band=case.band), found.periods
    )
    flat *= use(rig, found, designed) / use(rig, found, flat)
    by = {name: identified(rig, found, wave) for name, wave in (("flat", flat), ("designed", designed))}
    truth = {p.name: float(p.value or 0.0) for p in rig.parameters}
    for name, x in found.expected.items():
        if name not in truth:
            continue
        sd = {k: float(np.sqrt(np.mean([e[name].sd ** 2 for e in es]))) for k, es in by.items()}
        scatter = np.sqrt(np.mean([((e[name].value - truth[name]) / e[name].sd) ** 2 for e in by["designed"]]))
        size = abs(truth[name]) / 100.0
        yield (
            case.bench, name, f"{sd['flat'] / size:.3g} %", f"{sd['designed'] / size:.3g} %",
            f"{sd['flat'] / sd['designed']:.2f}", f"{x.sd / sd['designed']:.3f}", f"{scatter:.2f}",
        )  # fmt: skip


def kept(case: Case) -> tuple[str, ...]:
    """Return how many plants that are off keep the limits, with noise, from rest, and the time of the design."""
    rig = case.rig
    free = replace(rig, parameters=tuple(replace(p, role="free" if p.value else "fixed") for p in rig.parameters))
    began = time.process_time()
    found = ambid.design_experiment(free, seconds=case.seconds, band=case.band)
    took = time.process_time() - began
    wave, good, largest = found.played(3 * found.period, found.rate_hz)[:, 0], 0, 0.0
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        off = tuple(replace(p, value=float(p.value or 0.0) * (1.0 + rng.uniform(-_OFF, _OFF))) for p in rig.parameters)
        record = simulate_rig(replace(rig, parameters=off), wave, rate_hz=found.rate_hz, seed=seed).record
        part = max(float(np.max(np.abs(record[n].values))) / float(found.signals[n].high or np.inf) for n in _SIGNALS)
        good, largest = good + (part <= 1.0), max(largest, part)
    lines = found.frequency_hz.size
    return case.bench, f"{good} of {RUNS}", f"{100 * largest:.0f} %", str(lines), f"{took:.1f} s"


def used(found: Experiment, record: ambid.Record) -> float:
    """Return the largest part of the limits of a rotor that a record shows."""
    parts = [float(np.max(np.abs(record[n].values))) / float(found.signals[n].high or np.inf)
             for n in found.signals if n in record.names]  # fmt: skip
    return max(parts)


def rotor(name: str) -> tuple[str, ...]:
    """Return the weakest parameter by the default zippered excitation and as designed, what was promised, the limits.

    Both excitations use the same part of the limits in their records.
    """
    rig = rig_of_preset(preset(name))
    began = time.process_time()
    found = ambid.design_experiment(rig, seconds=ROTOR_SECONDS)
    took = time.process_time() - began
    sds: dict[str, list[list[float]]] = {"zippered": [], "designed": []}
    for seed in range(ROTOR_SEEDS):
        records = {"designed": ambid.simulate(rig, excitation=found, seed=seed)}
        part, peak = used(found, records["designed"]), 1.0
        settings = {"duration": found.seconds, "periods": found.periods, "seed": seed}
        still = used(found, ambid.simulate(rig, **settings, amplitude=1e-3))
        for _ in range(6):
            records["zippered"] = ambid.simulate(rig, **settings, amplitude=peak)
            grown = (part - still) / max(used(found, records["zippered"]) - still, 1e-9)
            peak *= float(np.clip(grown, 0.25, 4.0))
        for kind, record in records.items():
            estimate = ambid.identify(record, rig)
            sd = dict(zip(estimate.covariance_names, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True))
            sds[kind].append([sd[n] for n in found.expected])
    sizes = np.array([x.sd / x.relative_sd for x in found.expected.values()])
    flat, own = (np.sqrt(np.mean(np.square(sds[k]), axis=0)) / sizes for k in ("zippered", "designed"))
    ratio = np.array([x.relative_sd for x in found.expected.values()]) / own
    good, largest = 0, 0.0
    for seed in range(ROTOR_RUNS):
        rng = np.random.default_rng(seed)
        off = tuple(
            replace(p, value=p.value * (1.0 + rng.uniform(-_OFF, _OFF))) if p.role == "free" and p.value else p
            for p in rig.parameters
        )
        record = ambid.simulate(replace(rig, parameters=off), excitation=found, settle=0, seed=seed)
        good, largest = good + (used(found, record) <= 1.0), max(largest, used(found, record))
    names = list(found.expected)
    return (
        name, f"{100 * flat.max():.3g} % ({names[int(flat.argmax())]})", f"{100 * own.max():.3g} % "
        f"({names[int(own.argmax())]})", f"{(flat / own).min():.2f} to {(flat / own).max():.2f}",
        f"{ratio.min():.3f} to {ratio.max():.3f}", f"{good} of {ROTOR_RUNS}", f"{100 * largest:.0f} %", f"{took:.0f} s",
    )  # fmt: skip


def experiment_tables() -> Iterator[Table]:
    """Return the tables of designed experiments."""
    yield Table(
        group=f"Designed experiments and flat multisines at equal peaks, {SEEDS} records each",
        columns=("bench", "parameter", "sd, flat", "sd, designed", "flat over designed", "promised over reached",
                 "rms of error over sd"),
        rows=tuple(row for case in CASES for row in compared(case)),
    )  # fmt: skip
    yield Table(
        group=f"Limits kept by plants up to {100 * _OFF:.0f} % off in every parameter, from rest, with noise",
        columns=("bench", "kept", "largest part of a limit", "lines", "CPU time of the design"),
        rows=tuple(kept(case) for case in CASES),
    )  # fmt: skip
    yield Table(
        group=f"Rotors: designed and default zippered multisines at equal peaks, {ROTOR_SEEDS} records each; limits "
        f"kept by rotors up to {100 * _OFF:.0f} % off",
        columns=("bench", "weakest, zippered", "weakest, designed", "zippered over designed, all parameters",
                 "promised over reached", "kept", "largest part of a limit", "CPU time of the design"),
        rows=tuple(rotor(name) for name in ROTORS),
    )  # fmt: skip


if __name__ == "__main__":
    for made in experiment_tables():
        print(made.as_markdown(), flush=True)
