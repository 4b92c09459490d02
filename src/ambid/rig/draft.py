"""A first rig file, guessed from the columns of a record, with comments that say what to check (``ambid init``)."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ambid.physics.linear_model import LinearModel, model
from ambid.record.record import Channel, Record
from ambid.rig.rig import OPTIONAL_ROLES, role_units, toml_text
from ambid.units import UNKNOWN, parse_unit

_NAMES = {
    "voltage": r"volt|^u|^v\b|^v_|duty|pwm|command|input|drive",
    "current": r"curr|^i\b|^i_|amp",
    "position": r"pos|disp|gap|^x|^y|^z|eddy|hall|sensor|output",
    "speed": r"speed|omega|rpm|rotat|spin",
    "angle": r"angle|phi|theta|encoder",
}
_SET_POINT = r"ref|set|target|desired|goal"


def draft_rig(record: Record) -> str:
    """Guess a rig file.

    Parameters
    ----------
    record : Record
        As read from its file, columns under their own names.

    Returns
    -------
    str
        TOML text that :func:`ambid.rig.load_rig` reads, with a comment on each guess.
    """
    guesses = {
        role: _best(record, role, unit) for role, unit in (("voltage", "V"), ("current", "A"), ("position", "m"))
    }
    guesses = _without_doubles(guesses)
    plant = model("one-axis" if guesses["position"] or not (guesses["voltage"] and guesses["current"]) else "coil")
    name = record.provenance.get("file", "a record")
    lines = [
        f"# Guessed from {name}: check every line marked CHECK, then run: ambid identify {name} --rig <this file>",
        'schema = "ambid.rig/1"',
        f"name   = {toml_text(f'bench of {name}')}",
        f'model  = "{plant.name}"',
        "",
    ]
    units = role_units(plant)
    for role in (*plant.inputs, *plant.outputs):
        lines += [*_channel_lines(role, guesses[role], units[role], record, is_input=role in plant.inputs), ""]
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
        "# [record]",
        "# from = 2.0          # s: leave out what comes before, such as the pick-up from rest",
        '# gaps = "error"      # or "interpolate", "cut"',
    ]
    return "\n".join(lines) + "\n"


def _turning(record: Record) -> dict[str, Channel]:
    """Return speed and angle of the rotor where a column has both the name and the unit: nothing needs them."""
    found: dict[str, Channel] = {}
    for role in ("speed", "angle"):
        fits = [
            c
            for c in record.channels
            if c.unit == OPTIONAL_ROLES[role]
            and re.search(_NAMES[role], c.name.lower())
            and not re.search(_SET_POINT, c.name.lower())
        ]
        found |= {role: fits[0]} if fits else {}
    return found


def _best(record: Record, role: str, unit: str) -> Channel | None:
    """Return the column that looks most like a role, None if none does."""
    scored = [(_score(c, role, unit), c) for c in record.channels]
    best = max(scored, key=lambda pair: pair[0])
    return best[1] if best[0] > 0 else None


def _score(c: Channel, role: str, unit: str) -> float:
    """Rate a column: its unit counts most, then its name, then whether it moves (an unused coil does not)."""
    named = re.search(_NAMES[role], c.name.lower()) is not None
    if re.search(_SET_POINT, c.name.lower()):
        return 0.0
    if c.unit == unit:
        fit = 4.0 + 2.0 * named
    elif c.unit in ("1", UNKNOWN, "V") and named:
        fit = 2.0
    else:
        return 0.0
    spread, size = float(np.ptp(c.values)), float(np.abs(c.values).max())
    moves = spread / (spread + size) if spread > 0 else -1.0
    return fit + moves


def _without_doubles(guesses: Mapping[str, Channel | None]) -> dict[str, Channel | None]:
    """Give a column that two roles want to the one that it fits better."""
    units = {"voltage": "V", "current": "A", "position": "m"}
    kept = dict(guesses)
    for role, c in guesses.items():
        rivals = [r for r, other in guesses.items() if other is c and c is not None]
        if len(rivals) > 1 and c is not None and role != max(rivals, key=lambda r: _score(c, r, units[r])):
            kept[role] = None
    return kept


def _channel_lines(role: str, c: Channel | None, unit: str, record: Record, *, is_input: bool) -> list[str]:
    lines = [f"[channels.{role}]"]
    if c is None:
        listing = ", ".join(f"{x.name} [{x.source_unit}]" for x in record.channels)
        return [*lines, f"column = {toml_text(role)}   # CHECK: no column looks like it; there are {listing}"]
    others = [x.name for x in record.channels if x is not c and _score(x, role, unit) > 0]
    note = f"   # CHECK; or {', '.join(others)}" if others else "   # CHECK"
    lines.append(f"column = {toml_text(c.name)}{note}")
    if c.unit == UNKNOWN:
        lines.append(f'unit   = "{unit}"   # CHECK: the record names no unit for it')
    elif c.unit != unit:
        lines += [
            f"# CHECK: the column is in [{c.source_unit}], the model wants [{unit}]. Give a table (two columns,"
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
        "# [magnet]            # for ambid identify --nonlinear, which takes several records",
        '# kind = "single"     # or "pair"; default: a pair where the current changes its sign',
        "# [magnet.parameters] # 'ambid models' lists them",
        '# g = { value = 9.81, unit = "m/s^2", role = "fixed" }',
    ]
