"""What fusion tells of a sensor: its notes in numbers, turned into events with a reason for people."""

from __future__ import annotations

from collections.abc import Sequence

from ambid.arrays import Array
from ambid.recursive.fusion.sensor import FusedSensor
from ambid.recursive.lines import Event, EventKind

_MISSING, _RAIL, _STUCK, _STEP, _NOISE, _GAIN, _RESTORED, _DISPUTE, _MOTION, _AGREEMENT = range(1, 11)
_NAMES = {
    _MISSING: "missing", _RAIL: "rail", _STUCK: "stuck", _STEP: "step", _NOISE: "noise", _GAIN: "gain",
    _RESTORED: "restored", _DISPUTE: "one_of", _MOTION: "motion", _AGREEMENT: "agreement",
}  # fmt: skip


def reason(row: Array, sensors: Sequence[FusedSensor], working: Sequence[str], rate_hz: float, start_s: float) -> Event:
    """Return one note of the compiled recursion as an event.

    `row`: (5,); `working`: names of those that are used after it. Returns ``excluded``, ``restored`` or ``disturbed``;
    `values` has ``cause_<name>`` = 1 for programs.
    """
    code, sensor = int(row[0]), sensors[int(row[1])]
    left = f"; left: {', '.join(working)}" if working else "; no sensor is left, the position is predicted only"
    values = {f"cause_{_NAMES[code]}": 1.0}
    why, kind, who = "", "excluded", sensor.name
    shift, x = float(row[3]), float(row[4])
    if code == _MISSING:
        why = "its values are missing" + left
    elif code == _RAIL:
        values["value"] = shift
        why = f"at its rail, {shift:.4g}" + left
    elif code == _STUCK:
        values["value"] = shift
        why = f"stands still at {shift:.4g}" + left
    elif code in (_STEP, _GAIN):
        values |= {"shift": shift, "position": x}
        words = "it stepped" if code == _STEP else "its gain fell"
        why = f"{words}: {shift * 1e6:+.3g} um off the others at {x * 1e6:.3g} um" + left
    elif code == _NOISE:
        why = "noisier than it should be" + left
    elif code == _RESTORED:
        kind, values["out_s"] = "restored", shift / rate_hz
        why = f"agrees with the others again, after {shift / rate_hz:.3g} s"
    elif code == _DISPUTE:
        kind, who, values["shift"] = "disturbed", "", shift
        why = f"one of {', '.join(working)} is at fault, which cannot be told: both are used, sd covers either"
    elif code == _AGREEMENT:
        kind, who = "restored", ""
        why = f"{', '.join(working)} agree again, for {shift / rate_hz:.3g} s"
    else:
        kind, who, values["shift"] = "disturbed", "", shift
        why = f"the rotor moved as the motion model does not allow, or {' and '.join(working)} are at fault together"
    return Event(kind=_kind(kind), t=start_s + float(row[2]) / rate_hz, why=why, parameter=who or None, values=values)


def _kind(word: str) -> EventKind:
    return "excluded" if word == "excluded" else "restored" if word == "restored" else "disturbed"
