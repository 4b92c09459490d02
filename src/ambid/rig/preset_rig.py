"""The rig of a named bench: its numbers, loop, limits and noise, and ``[magnet]`` where its magnet is nonlinear."""

from __future__ import annotations

import math
from pathlib import Path

from ambid.physics.bearing_numbers import BEARING_NUMBERS
from ambid.physics.coenergy_law import law_numbers
from ambid.physics.linear_model import Parameter, model
from ambid.physics.magnet import CoEnergy
from ambid.physics.named_bench import Preset, RotorBody
from ambid.physics.nonlinear import NonlinearPlant
from ambid.rig.rig import RecordSettings, Rig, RigChannel, RigMagnet, RigModes, rig_text

_FIXED = frozenset({"m", "c", "g", "i0"})  # what is weighed or set on a bench; the rest is to be found

_HEAD = """\
# The bench {name}: {summary}
# Values are those that a simulation takes. Where the role is "free" they are start values of an identification, which
# may be left out there: then it begins from nothing.
"""


def rig_of_preset(bench: Preset) -> Rig:
    """Return the rig that simulates as a preset does, the linear and the nonlinear plant.

    Mass, damping, gravity and bias are fixed, all other numbers free with their values. Of a rotor the planes, the
    poles of its sensors and the gap are fixed, and what follows from its drawing has no value beside it.

    Parameters
    ----------
    bench : Preset
        See `ambid.physics.presets.preset`.

    Returns
    -------
    Rig
        Columns are called like the roles; ``[magnet]`` stands there if the preset has a nonlinear plant.
    """
    if bench.rotor is not None:
        return _rig_of_rotor(bench, bench.rotor)
    of = model(bench.model)
    point = {"position": bench.operating_point.position, "current": bench.operating_point.current,
             "voltage": bench.operating_point.voltage}  # fmt: skip
    return Rig(
        name=bench.summary,
        model=bench.model,
        channels=tuple(
            RigChannel(role=role, column=role, delay="auto" if role in of.inputs else 0)
            for role in (*of.inputs, *of.outputs)
        ),
        parameters=tuple(_parameter(s.name, s.unit, bench.parameters[s.name]) for s in of.parameters),
        magnet=None if bench.plant is None else _magnet(bench.plant),
        operating_point=point if any(point.values()) else {},
        loop=bench.loop,
        limits=bench.limits,
        noise=bench.noise,
        record=RecordSettings(rate_hz=bench.rate_hz),
        open_loop=not bench.usually_closed,
    )


def _rig_of_rotor(bench: Preset, body: RotorBody) -> Rig:
    of = body.model.with_modes(0)
    values = {**{p.name: p.default for p in of.parameters}, **bench.parameters}
    known = {*of.places, *(p.name for p in of.parameters if p.name.endswith(".sensor_pole"))}
    turning = ("angle",) if of.speed else ()
    roles = (*of.inputs, *of.outputs, *turning, *(f"{axis}_reference" for axis in of.axes))
    numbers = {"s": body.gap, **({"sigma": body.sigma} if body.sigma else {})}
    specs = {spec.name: spec for spec in BEARING_NUMBERS}
    return Rig(
        name=bench.summary,
        model=bench.model,
        channels=tuple(RigChannel(role=r, column=r, delay="auto" if r in of.inputs else 0) for r in roles),
        rotor=of,
        parameters=tuple(
            Parameter(name=p.name, unit=p.unit, value=values[p.name], role="fixed" if p.name in known else "free")
            for p in of.parameters
        ),
        modes=RigModes(count=body.model.n_modes or None) if body.shaft else RigModes(),
        shaft=body.shaft,
        unbalance=body.unbalance,
        runout=body.runout,
        magnet=RigMagnet(
            kind="pair", gap="hyperbolic", saturation=body.sigma != 0.0, cone=body.cone,
            parameters=tuple(Parameter(name=n, unit=specs[n].unit, value=x, role="fixed") for n, x in numbers.items()),
        ),
        loop=bench.loop,
        limits=bench.limits,
        noise=bench.noise,
        record=RecordSettings(rate_hz=bench.rate_hz),
        open_loop=not bench.usually_closed,
    )  # fmt: skip


def preset_text(bench: Preset) -> str:
    """Return the rig file of a preset, with a comment on top.

    Parameters
    ----------
    bench : Preset

    Returns
    -------
    str
        TOML that :func:`ambid.rig.load_rig` reads.
    """
    return _HEAD.format(name=bench.name, summary=bench.summary) + rig_text(rig_of_preset(bench), Path())


def _magnet(plant: NonlinearPlant) -> RigMagnet | None:
    w = plant.magnet.coenergy
    if not isinstance(w, CoEnergy):
        return None
    numbers, pair = law_numbers(w), w.k_a != 0.0
    unequal = any(numbers[n] != 0.0 for n in ("k_asym", "i0_asym"))
    numbers["g"] = plant.gravity
    if math.isfinite(plant.eddy_pole):
        numbers["a"] = plant.eddy_pole
    if plant.stage.v_drop != 0.0:
        numbers |= {"v_drop": plant.stage.v_drop, "i_drop": plant.stage.i_drop}
    left_out = (() if pair else ("i0",)) + (() if unequal else ("k_asym", "i0_asym"))
    return RigMagnet(
        kind="pair" if pair else "single",
        gap="hyperbolic",
        asymmetric=unequal if pair else None,
        rise=False,
        eddy=math.isfinite(plant.eddy_pole),
        parameters=tuple(
            _parameter(s.name, s.unit, numbers[s.name])
            for s in BEARING_NUMBERS
            if s.name in numbers and s.name not in left_out
        ),
    )


def _parameter(name: str, unit: str, value: float) -> Parameter:
    return Parameter(name=name, unit=unit, value=value, role="fixed" if name in _FIXED else "free")
