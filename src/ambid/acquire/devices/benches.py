"""The bench behind a device that has no hardware: a named preset, or the rig's own numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ambid.errors import DeviceError, nearest
from ambid.physics.loop import Limits, Noise
from ambid.physics.models import model
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.presets import Preset, preset, preset_names
from ambid.rig.load import load_rig
from ambid.rig.rig import Rig
from ambid.simulate.plant import LinearPlant
from ambid.simulate.rig_bench import parts_of_rig


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """What a simulation of it needs."""

    name: str
    plant: LinearPlant | NonlinearPlant
    point: OperatingPoint  # where the linear one holds, SI
    limits: Limits  # its stops count
    noise: Noise


def bench_of(rig: Rig, bench: Preset | Rig | None) -> Bench:
    """Return the bench that stands behind a rig.

    `rig`: of the device.
    """
    truth = _named(rig) if bench is None else bench
    if isinstance(truth, Preset):
        of = model(truth.model)
        if of.inputs != ("voltage",):
            raise DeviceError(f"bench {truth.name!r} is not driven by a voltage; a controller drives one. Give another")
        return Bench(
            name=truth.name,
            plant=truth.plant or LinearPlant(model=of, parameters=truth.parameters),
            point=truth.operating_point,
            limits=truth.limits,
            noise=truth.noise,
        )
    plant, _, point = parts_of_rig(truth, None)
    return Bench(
        name=truth.name or "rig",
        plant=plant,
        point=point,
        limits=truth.limits or Limits(),
        noise=truth.noise or Noise(),
    )


def bench_parameters(rig: Rig, bench: Preset | Rig | None) -> Mapping[str, float]:
    """Return what is known of the linear plant of the bench behind a rig.

    `rig`: of the device; `bench`: as `bench_of`. Returns SI, under the names of the model's parameters.
    """
    truth = _named(rig) if bench is None else bench
    if isinstance(truth, Preset):
        return truth.parameters
    return {p.name: p.value for p in truth.parameters if p.value is not None}


def _named(rig: Rig) -> Preset | Rig:
    """Return what daq.bench names: a preset, or a rig file beside this one; the rig itself where it names none."""
    name = rig.daq.bench if rig.daq else None
    if name is None:
        return rig
    if name in preset_names():
        return preset(name)
    path = Path(name) if rig.source is None else rig.source.parent / name
    if path.suffix != ".toml":
        known = preset_names()
        raise DeviceError(
            f"rig {rig.name!r}: daq.bench is {name!r}; it is a preset ({', '.join(known)}) or a rig file (.toml)."
            f"{nearest(name, known)} Correct it"
        )
    return load_rig(path)
