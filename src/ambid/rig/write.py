"""From a rig to a rig file, in SI units; :func:`ambid.rig.load_rig` reads the same rig back."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path

from ambid.errors import RigError
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.models import model
from ambid.physics.parameters import Parameter
from ambid.record.calibration import Calibration
from ambid.rig.load import role_units
from ambid.rig.rig import Daq, RecordSettings, Rig, RigChannel, RigMagnet


def write_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as TOML.

    Parameters
    ----------
    rig : Rig
        What to write.
    path : str or Path
        Overwritten if it exists. Calibration tables stay where they are and are named relative to this file.

    Raises
    ------
    RigError
        If the file cannot be written, or a calibration table has no file.
    """
    path = Path(path)
    text = rig_text(rig, path.parent)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as failure:
        raise RigError(f"rig {path} cannot be written: {failure.strerror or failure}. Check the folder") from None


def rig_text(rig: Rig, folder: Path) -> str:
    """Return the TOML text of a rig.

    Parameters
    ----------
    rig : Rig
        What to write.
    folder : Path
        Folder to which the paths of calibration tables are relative.

    Returns
    -------
    str
        A rig file, schema ``ambid.rig/1``.

    Raises
    ------
    RigError
        If a calibration table has no file.
    """
    lines = ['schema = "ambid.rig/1"', f"name = {toml_text(rig.name)}", f"model = {toml_text(rig.model)}"]
    lines += ["open_loop = true"] if rig.open_loop else []
    inputs = model(rig.model).inputs
    for c in rig.channels:
        lines += ["", *_channel_lines(c, folder, is_input=c.role in inputs)]
    lines += ["", "[parameters]", *(_parameter_line(p) for p in rig.parameters)]
    if rig.magnet is not None:
        lines += ["", *_magnet_lines(rig.magnet)]
    units = role_units(model(rig.model))
    if rig.operating_point:
        lines += ["", "[operating_point]"]
        lines += [f'{role} = {{ value = {x!r}, unit = "{units[role]}" }}' for role, x in rig.operating_point.items()]
    if rig.loop or rig.limits:
        lines += ["", *_loop_lines(rig.loop or Loop(), rig.limits)]
    if rig.noise:
        lines += ["", *_noise_lines(rig.noise)]
    if rig.record != RecordSettings():
        lines += ["", *_record_lines(rig.record)]
    if rig.daq:
        lines += ["", *_daq_lines(rig.daq)]
    return "\n".join(lines) + "\n"


def toml_text(text: str) -> str:
    """Quote a text for TOML.

    `text`: any text. Returns a TOML basic string.
    """
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _channel_lines(c: RigChannel, folder: Path, *, is_input: bool) -> list[str]:
    lines = [f"[channels.{c.role}]", f"column = {toml_text(c.column)}"]
    lines += [f"variable = {toml_text(c.variable)}"] if c.variable else []
    lines += [f"unit = {toml_text(c.unit)}"] if c.unit else []
    lines += _calibration_lines(c.calibration, c.role, folder) if c.calibration else []
    if is_input:
        lines.append('delay = "auto"' if c.delay == "auto" else f"delay = {c.delay}")
    return lines


def _calibration_lines(calibration: Calibration, role: str, folder: Path) -> list[str]:
    if calibration.raw is None:
        gain = [] if calibration.unit_in == calibration.unit_out else [f"gain = {calibration.gain!r}"]
        return [*gain, f"offset = {calibration.offset!r}"]
    if not calibration.source:
        raise RigError(f"channels.{role} has a calibration table without a file; a rig file names one. Write it as CSV")
    table = os.path.relpath(Path(calibration.source).resolve(), folder.resolve())
    return [
        f"table = {toml_text(Path(table).as_posix())}",
        *(["extrapolate = true"] if calibration.extrapolate else []),
    ]


def _parameter_line(p: Parameter) -> str:
    entries = [f"value = {p.value!r}"] if p.value is not None else []
    entries += [f'unit = "{p.unit}"', f'role = "{p.role}"']
    entries += [f"sd = {p.sd!r}"] if p.sd is not None else []
    return f"{p.name} = {{ {', '.join(entries)} }}"


def _magnet_lines(magnet: RigMagnet) -> list[str]:
    lines = ["[magnet]", f'kind = "{magnet.kind}"']
    lines += [f'gap = "{magnet.gap}"'] if magnet.gap else []
    switches = {
        "asymmetric": magnet.asymmetric,
        "saturation": magnet.saturation,
        "eddy": magnet.eddy,
        "drift": magnet.drift,
    }
    lines += [f"{name} = true" for name, on in switches.items() if on]
    choices = {"asymmetric": magnet.asymmetric, "rise": magnet.rise}
    lines += [f"{name} = {str(on).lower()}" for name, on in choices.items() if on is not None]
    lines += [] if magnet.off_below is None else [f"off_below = {magnet.off_below!r}"]
    return [*lines, "[magnet.parameters]", *map(_parameter_line, magnet.parameters)] if magnet.parameters else lines


def _loop_lines(loop: Loop, limits: Limits | None) -> list[str]:
    lines = ["[loop]", 'kind = "pid"']
    numbers: Mapping[str, float] = {"kp": loop.kp, "ki": loop.ki, "kd": loop.kd, "kc": loop.kc}
    lines += [f"{name} = {value!r}" for name, value in numbers.items()]
    if math.isfinite(loop.derivative_cutoff_hz):
        lines.append(f"derivative_cutoff_hz = {loop.derivative_cutoff_hz!r}")
    lines.append(f"delay = {loop.delay!r}")
    if limits is not None:
        intervals = {role: getattr(limits, role) for role in ("voltage", "current", "position")}
        given = {role: x for role, x in intervals.items() if x != (-math.inf, math.inf)}
        for role, (low, high) in given.items():
            if not (math.isfinite(low) and math.isfinite(high)):
                raise RigError(f"limits.{role} is ({low}, {high}); a rig file holds both ends or none. Give both")
        inside = ", ".join(f"{role} = [{low!r}, {high!r}]" for role, (low, high) in given.items())
        lines += [f"limits = {{ {inside} }}"] if inside else []
    return lines


def _noise_lines(noise: Noise) -> list[str]:
    lines = ["[noise]", *(f"{name} = {getattr(noise, name)!r}" for name in ("position", "current", "force", "voltage"))]
    steps = {role: getattr(noise, f"{role}_resolution") for role in ("position", "current", "voltage")}
    inside = ", ".join(f"{role} = {step!r}" for role, step in steps.items() if step)
    return [*lines, f"resolutions = {{ {inside} }}"] if inside else lines


def _record_lines(record: RecordSettings) -> list[str]:
    lines = ["[record]"]
    numbers = {"rate_hz": record.rate_hz, "from": record.from_s, "to": record.to_s}
    lines += [f"{key} = {value!r}" for key, value in numbers.items() if value is not None]
    lines += [f'gaps = "{record.gaps}"'] if record.gaps else []
    if record.time is not None:
        lines.append(f"time = {{ variable = {toml_text(record.time[0])}, unit = {toml_text(record.time[1])} }}")
    return lines


def _daq_lines(daq: Daq) -> list[str]:
    lines = ["[daq]", f"rate_hz = {daq.rate_hz!r}", f"baud = {daq.baud}"]
    lines += [f"duty = [{daq.duty[0]}, {daq.duty[1]}]"] if daq.duty else []
    lines += [f"duty_off = {daq.duty_off}"] if daq.duty_off is not None else []
    lines += [f"host_ms = {daq.host_ms}", f"lift_ms = {daq.lift_ms}"]
    lines += [f"third = {toml_text(daq.third)}"] if daq.third else []
    lines += [f"bench = {toml_text(daq.bench)}"] if daq.bench else []
    trips = {"position": daq.position_trip, "current": daq.current_trip}
    inside = ", ".join(f"{role} = [{x[0]!r}, {x[1]!r}]" for role, x in trips.items() if x is not None)
    return [*lines, f"trip = {{ {inside} }}"] if inside else lines
