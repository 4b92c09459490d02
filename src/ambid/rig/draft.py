"""A first rig file: guessed from the columns of a record (``ambid init``), or of a named bench."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

from ambid.physics.coenergy_law import law_numbers
from ambid.physics.law_magnet import BEARING_NUMBERS
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.physics.magnet import CoEnergy
from ambid.physics.nonlinear import NonlinearPlant
from ambid.physics.presets import Preset
from ambid.record.record import Channel, Record
from ambid.record.words import is_set_point, quantities
from ambid.rig.load import rig_from_text
from ambid.rig.rig import (
    OPTIONAL_ROLES,
    RecordSettings,
    Rig,
    RigChannel,
    RigMagnet,
    rig_text,
    role_units,
    toml_lines,
    toml_text,
)
from ambid.rig.roles import Candidate, at_rest, rank_roles
from ambid.rig.rotor import RigModes
from ambid.settings.caller import command, setting
from ambid.units import UNKNOWN, parse_unit

WIRED = ("prototype",)
"""Presets with a controller of their own, whose rig, in which columns are its counts, is among the package's data."""


def draft_rig(
    record: Record,
    ranked: Mapping[str, Sequence[Candidate]] | None = None,
    *,
    reading: Mapping[str, object] | None = None,
    coil: bool = False,
    units: Mapping[str, tuple[str, str]] = MappingProxyType({}),
    variables: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Guess a rig file.

    Parameters
    ----------
    record : Record
        As read from its file, columns under their own names.
    ranked : Mapping of str to sequence of Candidate, optional
        Columns for each role, the chosen one first; default: as `ambid.rig.roles.rank_roles` ranks them.
    reading : Mapping of str to object, optional
        What the record was read with, ``rate_hz`` or ``gaps``: others of its bench are read alike.
    coil : bool, optional
        Draft the coil alone.
    units : Mapping of str to (str, str), optional
        Unit by role where it is not that of the record, and why.
    variables : Mapping of str to str, optional
        Path of the variable by role, and of time, where the columns were named so.

    Returns
    -------
    str
        TOML text that :func:`ambid.rig.load_rig` reads, with a comment on each guess; of a rotor on many axes once the
        planes of its bearings are given.
    """
    axes = axes_of(record)
    if len(axes) > 1:
        return _draft_rotor(record, axes, reading or {})
    ranked = rank_roles(record) if ranked is None else ranked
    plant, resting = model(model_of(ranked, coil=coil)), not coil and at_rest(ranked)
    name = _source_name(record)
    lines = [
        f"# Guessed from {name}: check every line marked CHECK, then run: "
        f"{command('identify', name, rig='<this file>')}",
        'schema = "ambid.rig/1"',
        f"name   = {toml_text(f'bench of {name}')}",
        f'model  = "{plant.name}"'
        + ("   # CHECK: the position does not move with voltage and current" if resting else ""),
        f"# Time: {_clock_words(record)}",
        "",
    ]
    wanted = role_units(plant)
    for role in (*plant.inputs, *plant.outputs):
        own = _channel_lines(role, ranked[role], wanted[role], record, units.get(role), is_input=role in plant.inputs)
        own[1:1] = [f"variable = {toml_text(variables[role])}"] if role in variables else []
        lines += [*own, ""]
    for role, column in _turning(record).items():
        lines += [f"[channels.{role}]", f"column = {toml_text(column.name)}   # CHECK", ""]
    lines += [
        '# Each parameter: role = "free" (to be found), "fixed" (value is known) or "prior" (value known to ± sd).',
        "[parameters]",
    ]
    lines += _parameter_lines(plant)
    lines += _magnet_lines() if plant.name == "one-axis" else []
    lines += [
        "",
        "# [operating_point]   # default: the means of the record",
        '# position = { value = 10.0, unit = "mm" }',
        "",
        *_record_lines(record, {**(reading or {}), **_clock(variables)}),
        "# from = 2.0          # s: leave out what comes before, such as the pick-up from rest",
        '# gaps = "error"      # or "interpolate", "cut"',
        _RATE_SD,
    ]
    return "\n".join(lines) + "\n"


def model_of(ranked: Mapping[str, Sequence[Candidate]], *, coil: bool = False) -> str:
    """Return the model of columns: a coil where that is told, or where the position does not move with it."""
    return "coil" if coil or at_rest(ranked) else "one-axis"


def _source_name(record: Record) -> str:
    """Return the name of a record's file as a comment may hold it: a line break in it would end the comment."""
    return "".join(x if x.isprintable() else "?" for x in record.provenance.get("file", "a record"))


def _clock_words(record: Record) -> str:
    """Say what was taken as time, and why."""
    settings = record.history[0].settings if record.history else {}
    return f"{settings.get('time', 'as the record names it')}; {record.rate_hz:g} Hz"


def _clock(variables: Mapping[str, str]) -> Mapping[str, object]:
    return {"time": {"variable": variables["time"], "unit": "s"}} if "time" in variables else {}


def _record_lines(record: Record, reading: Mapping[str, object]) -> list[str]:
    """Begin the section of records with the layout that the file was read in, and what it was read with."""
    layout = record.history[0].settings.get("layout") if record.history else None
    known = {**reading, **({"layout": layout} if isinstance(layout, Mapping) else {})}
    return ["[record]", *toml_lines(known)] if known else ["# [record]"]


def axes_of(record: Record) -> list[str]:
    """Return the axes of a record whose columns are named ``<axis>_position`` with ``<axis>_voltage`` or a current."""
    names = set(record.names)
    axes = [name.removesuffix("_position") for name in record.names if name.endswith("_position")]
    return [axis for axis in axes if axis and names & {f"{axis}_voltage", f"{axis}_current"}]


def _draft_rotor(record: Record, axes: Sequence[str], reading: Mapping[str, object]) -> str:
    """Guess the rig of a rotor on many axes: two axes a bearing; without its planes, to be measured, it is refused."""
    name = _source_name(record)
    lines = [
        f"# Guessed from {name}: complete every line marked CHECK, then run: "
        f"{command('identify', name, rig='<this file>')}",
        'schema = "ambid.rig/1"', f"name   = {toml_text(f'bench of {name}')}", 'model  = "rotor"',
        *([] if _turning(record) else ['# speed = { value = 3000, unit = "rpm" }   # 0 unless given']), "",
        "# Two axes a bearing, planes x and y, bearings in their order along the shaft; axial = true for an axial one.",
    ]  # fmt: skip
    for k in range(0, len(axes), 2):
        lines += [
            f"[bearings.{chr(ord('A') + k // 2)}]",
            f"axes     = [{', '.join(toml_text(axis) for axis in axes[k : k + 2])}]   # CHECK",
            '# z        = { value = 0.0, unit = "mm" }   # CHECK: measure the plane of the magnets, from any datum',
            '# z_sensor = { value = 0.0, unit = "mm" }   # CHECK: measure the plane of the sensors',
            '# z_sd     = { value = 0.5, unit = "mm" }   # how well both are known; each: z_magnet_sd, z_sensor_sd',
            "",
        ]  # fmt: skip
    for axis in axes:
        for what in ("voltage", "current", "position", "reference"):
            if f"{axis}_{what}" in record:
                known = [] if what == "reference" else [_GAIN_SD]
                lines += [f"[channels.{axis}_{what}]", f"column = {toml_text(f'{axis}_{what}')}", *known, ""]
    for role, column in _turning(record).items():
        lines += [f"[channels.{role}]", f"column = {toml_text(column.name)}   # CHECK", ""]
    return "\n".join(
        [*lines, *_record_lines(record, reading), _RATE_SD, "", "# What is not named here is free. A weighed rotor:",
         "# [parameters]", '# m = { value = 6.2, unit = "kg", role = "fixed" }', "# [modes]", '# count = "auto"', ""]
    )  # fmt: skip


def _turning(record: Record) -> dict[str, Channel]:
    """Return speed and angle of the rotor where a column has both the name and the unit: nothing needs them."""
    channels: dict[str, Channel] = {}
    for role in ("speed", "angle"):
        fits = [
            c
            for c in record.channels
            if c.unit == OPTIONAL_ROLES[role] and role in quantities(c.name) and not is_set_point(c.name)
        ]
        channels |= {role: fits[0]} if fits else {}
    return channels


def _channel_lines(
    role: str, ranked: Sequence[Candidate], unit: str, record: Record, told: tuple[str, str] | None, *, is_input: bool
) -> list[str]:
    lines = [f"[channels.{role}]"]
    if not ranked:
        listing = ", ".join(f"{x.name} [{x.source_unit}]" for x in record.channels)
        return [*lines, f"column = {toml_text(role)}   # CHECK: no column looks like it; there are {listing}"]
    c, *others = (candidate.channel for candidate in ranked)
    lines += [f"# {x.channel.name}: score {x.score:.2f}; {x.why}" for x in ranked]
    note = f"   # CHECK; or {', '.join(x.name for x in others)}" if others else "   # CHECK"
    lines.append(f"column = {toml_text(c.name)}{note}")
    if told is not None:
        lines.append(f'unit   = "{told[0]}"   # CHECK: {told[1]}')
    elif c.unit == UNKNOWN:
        lines.append(f'unit   = "{unit}"   # CHECK: the record names no unit for it')
    elif c.unit != unit:
        lines += [
            f"# CHECK: the column is in [{c.source_unit}], the model needs [{unit}]. Give a table (two columns,"
            f" '{c.name} [{c.source_unit}],{role} [{unit}]') or a gain:",
            f'# table  = "{c.name}_to_{role}.csv"',
            f"# gain   = 1.0      # {unit} per {'unit' if c.unit == '1' else parse_unit(c.source_unit).si}",
            "# offset = 0.0",
        ]
    if is_input:
        lines.append('delay  = "auto"   # samples between the logged value and the coil; "auto" finds it')
    return [*lines, _GAIN_SD]


def _parameter_lines(plant: LinearModel) -> list[str]:
    lines = []
    for spec in plant.parameters:
        default = "" if spec.default is None else f'value = {spec.default!r}, role = "fixed", '
        lines.append(f'{spec.name:3} = {{ {default}unit = "{spec.unit}" }}   # {spec.meaning}')
    return lines


def _magnet_lines() -> list[str]:
    return [
        "",
        "# [magnet]            # one magnet that carries the weight is checked against it; and for "
        f"{setting('identify_nonlinear')}",
        '# kind = "single"     # or "pair"; default: a pair where the current changes its sign',
        "# [magnet.parameters] # 'ambid models' lists them",
        '# g = { value = 9.81, unit = "m/s^2", role = "fixed" }',
    ]


_GAIN_SD = "# gain_sd = 0.01   # how well its gain is known, relative: no record shows that; offset_sd: its offset"
_RATE_SD = "# rate_sd = 1e-4      # how well the sampling rate is known, relative: no record shows that"
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
    body, rotor = bench.rotor, None if bench.rotor is None else bench.rotor.model.with_modes(0)
    plant: LinearModel = model(bench.model) if rotor is None else rotor
    roles, fixed = [*plant.inputs, *plant.outputs], _FIXED
    if rotor is not None:
        roles += ["angle"] if rotor.speed else []
        roles += [f"{axis}_reference" for axis in rotor.axes]
        fixed = frozenset({*rotor.places, *(p.name for p in rotor.parameters if p.name.endswith(".sensor_pole"))})
    values = {**{p.name: p.default for p in plant.parameters}, **bench.parameters}
    rig = Rig(
        name=bench.summary,
        model=bench.model,
        channels=tuple(RigChannel(role=r, column=r, delay="auto" if r in plant.inputs else 0) for r in roles),
        parameters=tuple(
            Parameter(name=p.name, unit=p.unit, value=values[p.name], role="fixed" if p.name in fixed else "free")
            for p in plant.parameters
        ),
        loop=bench.loop,
        limits=bench.limits,
        noise=bench.noise,
        record=RecordSettings(rate_hz=bench.rate_hz),
        open_loop=not bench.usually_closed,
    )
    if body is None:
        point = bench.operating_point._asdict()
        magnet = None if bench.plant is None else _magnet(bench.plant)
        return replace(rig, magnet=magnet, operating_point=point if any(point.values()) else {})
    numbers = {"s": body.gap, **({"sigma": body.sigma} if body.sigma else {})}
    specs = {spec.name: spec for spec in BEARING_NUMBERS}
    return replace(
        rig, rotor=rotor, shaft=body.shaft, unbalance=body.unbalance, runout=body.runout,
        modes=RigModes(count=body.model.n_modes or None) if body.shaft else RigModes(),
        magnet=RigMagnet(
            kind="pair", gap="hyperbolic", saturation=True if body.sigma else None,
            parameters=tuple(Parameter(name=n, unit=specs[n].unit, value=x, role="fixed") for n, x in numbers.items()),
        ),
    )  # fmt: skip


def wired_text(name: str) -> str:
    """Return the rig file of one of `WIRED`, in which the controller has its settings, and little is known."""
    return files("ambid").joinpath("data", f"{name}.toml").read_text(encoding="utf-8")


def as_logged(bench: Preset) -> Preset | Rig:
    """Return a bench that logs as its controller does: one of `WIRED` as a rig that simulates it in counts."""
    if bench.name not in WIRED:
        return bench
    return replace(rig_of_preset(bench), channels=rig_from_text(wired_text(bench.name), f"{bench.name}.toml").channels)


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
    numbers["g"] = plant.gravity
    if math.isfinite(plant.eddy_pole):
        numbers["a"] = plant.eddy_pole
    if plant.stage.v_drop != 0.0:
        numbers |= {"v_drop": plant.stage.v_drop, "i_drop": plant.stage.i_drop}
    left_out = ("k_asym", "i0_asym") if pair else ("i0", "k_asym", "i0_asym")
    return RigMagnet(
        kind="pair" if pair else "single",
        gap="hyperbolic",
        asymmetric=False if pair else None,
        rise=False,
        eddy=math.isfinite(plant.eddy_pole),
        parameters=tuple(
            Parameter(name=s.name, unit=s.unit, value=numbers[s.name], role="fixed" if s.name in _FIXED else "free")
            for s in BEARING_NUMBERS
            if s.name in numbers and s.name not in left_out
        ),
    )
