"""Simulated benches, and the off-line estimates that their tracking starts from; each made once."""

from __future__ import annotations

from functools import cache

import numpy as np

from ambid.estimation.estimate import Estimate
from ambid.job import identify
from ambid.physics.linear_model import LinearModel, model
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import default_rig
from ambid.signals import multisine
from ambid.simulation import simulate_preset
from tests.bearing.benches import run

Array = np.ndarray

BEARING, BEARING_HZ = "unstable-bearing", 20_000.0


@cache
def bearing(n: int, seed: int) -> Record:
    """The unstable bearing in its loop, under a multisine."""
    u = multisine(n, BEARING_HZ, amplitude=6.0, band=(5.0, 2000.0), seed=seed, amplitude_is="rms")
    return simulate_preset(preset(BEARING), u, seed=seed).record


@cache
def bearing_start(n: int, seed: int) -> Estimate:
    """From `n` samples of the bearing."""
    return identify(bearing(n, seed))


def columns(record: Record, first: int = 0, last: int | None = None) -> tuple[Array, Array]:
    """Inputs and outputs of a record, (n_samples, .), SI."""
    cut = slice(first, last)
    return record["voltage"][cut, None].copy(), np.column_stack([record["position"], record["current"]])[cut]


@cache
def bench_record(name: str, n: int, seed: int) -> Record:
    """A bench of `tests.bearing.benches` as a record."""
    bench = run(name, n, seed)
    of: LinearModel = bench.model
    signals = np.hstack([bench.signals.u, bench.signals.y])
    names = (*of.inputs, *of.outputs)
    return Record(
        rate_hz=bench.signals.rate_hz,
        channels=tuple(
            Channel(name=k, unit=of.units[k], values=np.ascontiguousarray(v))
            for k, v in zip(names, signals.T, strict=True)
        ),
    )


@cache
def bench_start(name: str, n: int, seed: int, of: str) -> Estimate:
    """From a record of `bench_record`; `of` is its model."""
    return identify(bench_record(name, n, seed), default_rig(of))


def signals(record: Record, of: str) -> tuple[Array, Array]:
    """Inputs and outputs of a record of any model."""
    m = model(of)
    return np.column_stack([record[c] for c in m.inputs]), np.column_stack([record[c] for c in m.outputs])
