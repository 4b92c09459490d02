"""The bench behind a device that has no hardware: a named preset, or the rig's own numbers; and as a plant file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ambid.acquisition.scales import ADC_TOP, Scale, scale_of
from ambid.acquisition.settings import has_position
from ambid.errors import DeviceError, nearest
from ambid.physics.linear_model import model
from ambid.physics.magnet import CoEnergy, DifferentialPair
from ambid.physics.nonlinear import IDEAL, NonlinearPlant
from ambid.physics.presets import Preset, preset, preset_names
from ambid.rig.load import load_rig
from ambid.rig.rig import Rig
from ambid.simulation.plant import LinearPlant
from ambid.simulation.rig_bench import Bench

_VOLT_PER_COUNT = 5.0 / (ADC_TOP + 1)
_NO_POSITION = {"position_gain": 0.0, "position_offset": 2.5}
_HELD = {"m": 1.0, "k_x": 0.0, "k_i": 0.0}  # a coil alone, in the words of one axis: nothing moves, nothing moves it
_THIRD = {"third_position_gain": 0.0, "third_current_gain": 0.0, "third_offset": 2.5}


def bench_of(rig: Rig, bench: Preset | Rig | None) -> Bench:
    """Return the bench behind a rig, nonlinear where a preset is; its loop and rate have no meaning. The rig's own
    bench has a force that grows with the current as the controller assumes, whatever the sign of its k_i: it follows no
    belief.
    """
    truth = _named(rig) if bench is None else bench
    if isinstance(truth, Preset) and truth.rotor is None and model(truth.model).inputs != ("voltage",):
        raise DeviceError(f"bench {truth.name!r} is not driven by a voltage; a controller drives one. Give another")
    result = Bench.of(truth, 1.0, None, nonlinear=isinstance(truth, Preset) and truth.plant is not None)
    plant = result.plant
    if truth is rig and rig.loop is not None and rig.loop.pull and isinstance(plant, LinearPlant):
        k_i = math.copysign(plant.parameters["k_i"], rig.loop.pull)
        result = replace(result, plant=replace(plant, parameters={**plant.parameters, "k_i": k_i}))
    return replace(result, name=truth.name or "rig")


def instruments(rig: Rig, bench: Preset | Rig | None) -> dict[str, Scale]:
    """Return by role what really stands between a bench and its controller (the rig only claims it): from the bench's
    own rig file where it is calibrated, else the rig's, wired so that each rises with its counts.
    """
    truth = _named(rig) if bench is None else bench
    scales = {}
    for c in rig.channels:
        if c.role in ("voltage", "current", "position"):
            own = truth if isinstance(truth, Rig) and truth is not rig else None
            calibrated = own is not None and any(t.role == c.role and t.calibration is not None for t in own.channels)
            scales[c.role] = scale_of(own, c.role) if own is not None and calibrated else _rising(scale_of(rig, c.role))
    return scales


def _rising(scale: Scale) -> Scale:
    """Return a scale that falls over its counts as one that rises over the same values."""
    if scale.si[-1] > scale.si[0]:
        return scale
    return replace(
        scale, raw=np.ascontiguousarray(scale.top - scale.raw[::-1]), si=np.ascontiguousarray(scale.si[::-1])
    )


def _named(rig: Rig) -> Preset | Rig:
    """Return what daq.bench names: a preset, or a rig file beside this one; the rig itself where it names none."""
    name = rig.daq.bench if rig.daq else None
    if name is None:
        return rig
    if name in preset_names(rotors=False):
        return preset(name)
    path = Path(name) if rig.source is None else rig.source.parent / name
    if path.suffix != ".toml":
        names = preset_names(rotors=False)
        raise DeviceError(
            f"rig {rig.name!r}: daq.bench is {name!r}; it is a preset ({', '.join(names)}) or a rig file (.toml)."
            f"{nearest(name, names)} Correct it"
        )
    return load_rig(path)


def plant_text(rig: Rig, *, bench: Preset | Rig | None = None) -> str:
    """Return the bench behind a rig as a plant file of ``firmware/bench``: what is at the controller's pins.

    A count c stands for the volts in the middle of its step, (c + 1/2) 5 V / 1024: a calibrated reading is right in the
    mean. The rotor begins where it comes to lie without current; nothing is at the third input.
    """
    truth = bench_of(rig, bench)
    body = tuple(_plant(truth))  # first: a bench that is not known is refused by its name
    scales = instruments(rig, bench)
    voltage = scales["voltage"]
    if voltage.raw.size > 2:
        raise DeviceError(
            f"rig {rig.name!r}: channels.voltage is calibrated by a table; the emulated power stage is a straight line"
            " from counts to volts. Give gain and offset"
        )
    low, high = (float(v) for v in voltage.to_si([0.0, float(voltage.top)]))
    stage = {"high_voltage": high, "low_voltage": low}
    lines = [
        f"# {truth.name}",
        *body,
        *_numbers(stage),
        *_numbers(
            {f"{signal}_noise": getattr(truth.noise, signal) for signal in ("position", "current", "force", "voltage")}
        ),
        *_numbers(_THIRD),
    ]
    # A rig without position leaves that input alone: it shows half of the supply.
    position = _sensor("position", scales["position"]) if has_position(rig) else _numbers(_NO_POSITION)
    lines += [*position, *_sensor("current", scales["current"])]
    lines += _numbers({"start_position": _resting_place(truth)})
    # A single transistor with its diode: no current the other way, and a coil that is switched off runs out slowly.
    one_way = min(low, high) >= 0.0
    lines += ["pwm switched", *(("off short", "current one-way") if one_way else ("off diodes", "current both-ways"))]
    return "\n".join(lines)


def _plant(bench: Bench) -> Iterator[str]:
    plant, point = bench.plant, bench.point
    if isinstance(plant, NonlinearPlant):
        w = plant.magnet.coenergy
        pair = isinstance(plant.magnet, DifferentialPair)
        if not isinstance(w, CoEnergy):
            raise DeviceError(
                f"bench {bench.name!r} has a magnet with another law; the emulated bench has ideal magnets only. "
                "Simulate it with ambid.simulation"
            )
        if plant.stage != IDEAL or math.isfinite(plant.eddy_pole):
            raise DeviceError(
                f"bench {bench.name!r} has an eddy pole or a lossy stage; the emulated bench has neither. "
                "Simulate it with ambid.simulation"
            )
        yield f"kind {'differential' if pair else 'single'}"
        yield from _numbers({"m": plant.m, "R": plant.R, "c": plant.c, "k": w.k_b, "leakage": w.leakage})
        yield from _numbers({"gravity": plant.gravity} | ({"gap": w.s_b, "bias": w.i0} if pair else {}))
    elif plant.model.name in ("one-axis", "coil"):
        yield "kind linear"
        yield from _numbers((_HELD if plant.model.name == "coil" else {}) | dict(plant.parameters))
        rest = {"position": point.position, "current": point.current, "voltage": point.voltage}
        yield from _numbers({f"rest_{name}": value for name, value in rest.items()})
    else:
        raise DeviceError(
            f"bench {bench.name!r} is of model {plant.model.name!r}; the emulated bench supports coil, one-axis "
            "and its magnets. Give a bench of those"
        )
    low, high = bench.limits.position
    floor, ceiling = (-math.inf, math.inf) if not isinstance(plant, NonlinearPlant) else plant.magnet.range
    if isinstance(plant, NonlinearPlant) and not floor < low < high < ceiling:
        raise DeviceError(
            f"bench {bench.name!r}: limits.position is {low:g} to {high:g} m; the emulated rotor needs stops inside its"
            f" air gap, {floor:g} to {ceiling:g} m. Give loop.limits.position"
        )
    yield from _numbers({k: v for k, v in (("stop_low", low), ("stop_high", high)) if math.isfinite(v)})


def _sensor(role: str, scale: Scale) -> Iterator[str]:
    volts = (scale.raw + 0.5) * _VOLT_PER_COUNT
    if scale.raw.size > 2:
        yield from (f"{role}_point {v!r} {q!r}" for v, q in zip(volts.tolist(), scale.si.tolist(), strict=True))
        return
    gain = float((volts[1] - volts[0]) / (scale.si[1] - scale.si[0]))
    yield from _numbers({f"{role}_gain": gain, f"{role}_offset": float(volts[0]) - gain * float(scale.si[0])})


def _resting_place(bench: Bench) -> float:
    """Return where an unpowered rotor lies: on a stop if nothing brings it back, along its weight if it has one."""
    plant, stops = bench.plant, bench.limits.position
    if not isinstance(plant, NonlinearPlant) and plant.model.name == "coil":
        return 0.0
    if isinstance(plant, NonlinearPlant):
        stable, stop = False, stops[1 if plant.gravity > 0.0 else 0]
    else:
        stable, stop = plant.parameters["k_x"] > 0.0, stops[0]
    return bench.point.position if stable or not math.isfinite(stop) else stop


def _numbers(values: dict[str, float]) -> list[str]:
    return [f"{name} {float(value)!r}" for name, value in values.items()]
