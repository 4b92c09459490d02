"""A first rig file, guessed from the columns of a record, with comments that say what to check (``ambid init``)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from ambid.physics.linear_model import LinearModel, model
from ambid.record.record import Channel, Record
from ambid.rig.rig import OPTIONAL_ROLES, layout_line, role_units, toml_text
from ambid.rig.roles import NAMES, SET_POINT, Candidate, at_rest, rank_roles
from ambid.settings.caller import command, setting
from ambid.units import UNKNOWN, parse_unit


def draft_rig(record: Record, ranked: Mapping[str, Sequence[Candidate]] | None = None) -> str:
    """Guess a rig file.

    Parameters
    ----------
    record : Record
        As read from its file, columns under their own names.
    ranked : Mapping of str to sequence of Candidate, optional
        Columns for each role, the chosen one first; default: as `ambid.rig.roles.rank_roles` ranks them.

    Returns
    -------
    str
        TOML text that :func:`ambid.rig.load_rig` reads, with a comment on each guess; of a rotor on many axes once the
        planes of its bearings are given.
    """
    axes = axes_of(record)
    if len(axes) > 1:
        return _draft_rotor(record, axes)
    ranked = rank_roles(record) if ranked is None else ranked
    coil, held = bool(ranked["voltage"] and ranked["current"]), at_rest(ranked)
    plant = model("coil" if coil and (held or not ranked["position"]) else "one-axis")
    name = record.provenance.get("file", "a record")
    lines = [
        f"# Guessed from {name}: check every line marked CHECK, then run: "
        f"{command('identify', name, rig='<this file>')}",
        'schema = "ambid.rig/1"',
        f"name   = {toml_text(f'bench of {name}')}",
        f'model  = "{plant.name}"'
        + ("   # CHECK: the position does not move with voltage and current" if held else ""),
        "",
    ]
    units = role_units(plant)
    for role in (*plant.inputs, *plant.outputs):
        lines += [*_channel_lines(role, ranked[role], units[role], record, is_input=role in plant.inputs), ""]
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
        *_record_lines(record),
        "# from = 2.0          # s: leave out what comes before, such as the pick-up from rest",
        '# gaps = "error"      # or "interpolate", "cut"',
    ]
    return "\n".join(lines) + "\n"


def _record_lines(record: Record) -> list[str]:
    """Begin the section of records with the layout that the file was read in."""
    layout = record.history[0].settings.get("layout") if record.history else None
    return ["[record]", layout_line(layout)] if isinstance(layout, Mapping) else ["# [record]"]


def axes_of(record: Record) -> list[str]:
    """Return the axes of a record whose columns are named ``<axis>_position`` with ``<axis>_voltage`` or a current."""
    names = set(record.names)
    found = [name.removesuffix("_position") for name in record.names if name.endswith("_position")]
    return [axis for axis in found if axis and names & {f"{axis}_voltage", f"{axis}_current"}]


def _draft_rotor(record: Record, axes: Sequence[str]) -> str:
    """Guess the rig of a rotor on many axes: two axes a bearing; without its planes, to be measured, it is refused."""
    name = record.provenance.get("file", "a record")
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
            '# z_sensor = { value = 0.0, unit = "mm" }   # CHECK: measure the plane of the sensors', "",
        ]  # fmt: skip
    for axis in axes:
        for what in ("voltage", "current", "position", "reference"):
            if f"{axis}_{what}" in record:
                lines += [f"[channels.{axis}_{what}]", f"column = {toml_text(f'{axis}_{what}')}", ""]
    for role, column in _turning(record).items():
        lines += [f"[channels.{role}]", f"column = {toml_text(column.name)}   # CHECK", ""]
    return "\n".join(
        [*lines, *_record_lines(record), "", "# What is not named here is free. A weighed rotor:", "# [parameters]",
         '# m = { value = 6.2, unit = "kg", role = "fixed" }', "# [modes]", '# count = "auto"', ""]
    )  # fmt: skip


def _turning(record: Record) -> dict[str, Channel]:
    """Return speed and angle of the rotor where a column has both the name and the unit: nothing needs them."""
    found: dict[str, Channel] = {}
    for role in ("speed", "angle"):
        fits = [
            c
            for c in record.channels
            if c.unit == OPTIONAL_ROLES[role]
            and re.search(NAMES[role], c.name.lower())
            and not re.search(SET_POINT, c.name.lower())
        ]
        found |= {role: fits[0]} if fits else {}
    return found


def _channel_lines(role: str, ranked: Sequence[Candidate], unit: str, record: Record, *, is_input: bool) -> list[str]:
    lines = [f"[channels.{role}]"]
    if not ranked:
        listing = ", ".join(f"{x.name} [{x.source_unit}]" for x in record.channels)
        return [*lines, f"column = {toml_text(role)}   # CHECK: no column looks like it; there are {listing}"]
    c, *others = (candidate.channel for candidate in ranked)
    lines += [f"# {x.channel.name}: score {x.score:.2f}; {x.why}" for x in ranked]
    note = f"   # CHECK; or {', '.join(x.name for x in others)}" if others else "   # CHECK"
    lines.append(f"column = {toml_text(c.name)}{note}")
    if c.unit == UNKNOWN:
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
    return lines


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
