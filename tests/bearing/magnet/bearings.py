"""Simulated nonlinear bearings of known truth, in motion over most of their gap, and what is asked of them."""

from dataclasses import dataclass

import numpy as np

from ambid.bearing.magnet_problem import BODY, SIGNED, BearingProblem, BearingRecord, Number
from ambid.physics.coenergy_law import MagnetLaw, law_numbers
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.loop import Limits
from ambid.physics.presets import Preset, preset
from ambid.simulation import Simulation, simulate

MAGNITUDE = {"x_offset": 1e-6, "v_offset": 1e-2, "i_offset": 1e-3, "g": 9.81, "v_drop": 0.1, "k_asym": 0.1,
             "i0_asym": 0.1}  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """How a bench is moved: set point (part of the gap, Hz), and a two-level voltage that may change every `hold`."""

    swing: float
    swing_hz: float
    volts: float
    hold: int


LARGE = Motion(swing=0.30, swing_hz=2.0, volts=3.0, hold=20)


def moved(bench: Preset, motion: Motion, n: int, seed: int) -> Simulation:
    rng, rate, gap = np.random.default_rng(1000 + seed), bench.rate_hz, numbers_of(bench)["s"]
    setpoint = motion.swing * gap * np.sin(2 * np.pi * (motion.swing_hz * np.arange(n) / rate + rng.random()))
    levels = rng.choice([-motion.volts, motion.volts], n // motion.hold + 1)
    return simulate(
        bench.plant, np.repeat(levels, motion.hold)[:n], rate_hz=rate, seed=seed, loop=bench.loop, noise=bench.noise,
        limits=Limits(voltage=bench.limits.voltage, position=(-0.9 * gap, 0.9 * gap)), setpoint=setpoint, substeps=2,
    )  # fmt: skip


def as_seen(done: Simulation, name: str = "record") -> BearingRecord:
    record = done.record
    y = np.column_stack([record["position"], record["current"]])
    return BearingRecord(
        name=name, rate_hz=record.rate_hz, u=np.array(record["voltage"]), loose=np.zeros(y.shape[0]), y=y,
        valid=np.ones(y.shape, dtype=bool),
    )  # fmt: skip


def truth_of(bench: Preset) -> dict[str, float]:
    plant = bench.plant
    rest = {"sigma": 0.0, "L_rise": 0.0, "i_knee": 1.0, "c": plant.c, "g": plant.gravity, "a": 500.0, "tau": 3e-3,
            "x_offset": 0.0, "i_offset": 0.0, "v_offset": 0.0, "v_drop": 0.0, "i_drop": 0.02, "m": plant.m,
            "R": plant.R}  # fmt: skip
    return {**rest, **numbers_of(bench)}


def numbers_of(bench: Preset) -> dict[str, float]:
    """Numbers of the magnet: of two that differ as its law has them."""
    magnet = bench.plant.magnet
    return dict(magnet.values) if isinstance(magnet, LawMagnet) else law_numbers(magnet.coenergy)


def problem_of(
    records: list[BearingRecord], truth: dict[str, float], law: MagnetLaw, estimated: set[str], noise: list[float],
    delay: float, **more: object,
) -> BearingProblem:  # fmt: skip
    """A problem whose numbers start at the truth."""
    numbers = tuple(
        Number(name=n, value=truth[n], estimated=n in estimated, signed=n in SIGNED, magnitude=MAGNITUDE.get(n, 1.0))
        for n in (*law.names, *BODY)
    )
    settings = {"eddy": False, "drift": False, "free_delay": frozenset(), **more}
    return BearingProblem(
        law=law, records=tuple(records), numbers=numbers, delays={r.rate_hz: delay for r in records},
        noise_center=np.log(np.tile(noise, (len(records), 1))), **settings,
    )  # fmt: skip


def unstable(n: int, seeds: range, motion: Motion = LARGE) -> tuple[list[Simulation], dict[str, float]]:
    bench = preset("unstable-bearing")
    return [moved(bench, motion, n, s) for s in seeds], truth_of(bench)
