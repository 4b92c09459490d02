"""What goes into a simulated record: the drawn noise, the channels, and how they were made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import Limits, Loop, Noise
from ambid.record.record import Channel, Record, Step
from ambid.simulate.plant import Standing


def drawn_noise(
    of: LinearModel, noise: Noise, n: int, rate_hz: float, seed: int | np.random.Generator
) -> tuple[Array, Array]:
    """Return sensor noise (n, n_outputs) and disturbances (n, n_disturbances), in SI units."""
    # All columns are drawn whatever their size, so that one level changed leaves the others' numbers as they were.
    rng, size = np.random.default_rng(seed), noise_sizes(of, noise, rate_hz)
    drawn = rng.standard_normal((n, size.size)) * size
    outputs = len(of.outputs)
    return np.ascontiguousarray(drawn[:, :outputs]), np.ascontiguousarray(drawn[:, outputs:])


def noise_sizes(of: LinearModel, noise: Noise, rate_hz: float) -> Array:
    """Return the rms of the noise of outputs, then disturbances (held over a sample), in SI units."""
    force, voltage = noise.held_rms(rate_hz)
    size = {"force": force, "voltage": voltage, "position": noise.position, "current": noise.current}
    return np.array([size[name] for name in (*of.outputs, *of.disturbances)])


def logged(
    standing: Standing,
    command: Array,
    measured: Array,
    rate_hz: float,
    seed: int | np.random.Generator,
    settings: Mapping[str, object],
) -> Record:
    """Return the record: input, current, position, as far as the model has them."""
    of = standing.model
    outputs = {name: measured[:, j] for j, name in enumerate(of.outputs)}
    columns = {of.inputs[0]: command}
    columns.update((name, outputs[name]) for name in ("current", "position") if name in outputs)
    how = "linear" if standing.linear else "nonlinear"
    named = "a generator" if isinstance(seed, np.random.Generator) else str(seed)
    return Record(
        rate_hz=rate_hz,
        channels=tuple(Channel(name=name, unit=of.units[name], values=values) for name, values in columns.items()),
        history=(Step(name="simulate", settings={"plant": f"{of.name}, {how}", "seed": named, **settings}),),
        provenance=MappingProxyType({"simulator": "ambid.simulate", "plant": f"{of.name}, {how}", "seed": named}),
    )


def written(values: Loop | Noise | Limits) -> dict[str, object]:
    """Return the settings that act, as JSON-able values: zeros and infinite limits are left out."""
    found: dict[str, object] = {}
    for name, value in asdict(values).items():
        if isinstance(value, tuple):
            ends = {end: v for end, v in zip(("low", "high"), value, strict=True) if math.isfinite(v)}
            if ends:
                found[name] = ends
        elif value and math.isfinite(value):
            found[name] = value
    return found
