"""Between counts of the controller and SI, by the calibration of a rig's channel: the only place of scaling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambid.acquire.board import ADC_TOP, PWM_TOP
from ambid.arrays import Array
from ambid.errors import RigError
from ambid.rig.rig import Rig, RigChannel
from ambid.units import parse_unit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scale:
    """A straight or bent line from counts to SI, everywhere rising or everywhere falling."""

    role: str  # of the rig's channel
    column: str
    top: int  # largest count that the controller gives or takes; the least is 0
    raw: Array  # (n_points,), counts, corners of the line, increasing; at least two
    si: Array  # (n_points,), SI, values there, increasing or decreasing. The first and last piece go on outside.
    # counts outside which the calibration table refuses to be read; None: nowhere
    ends: tuple[float, float] | None = None

    def to_si(self, counts: ArrayLike) -> Array:
        """Return what counts mean.

        `counts`: what the controller gives. Returns continued in a straight line outside the corners.
        """
        return _line(np.asarray(counts, dtype=np.float64), self.raw, self.si)

    def to_counts(self, si: ArrayLike) -> Array:
        """Return the counts that mean a value, not rounded.

        `si`: values of the role. Returns continued in a straight line outside the corners; may lie outside 0 to `top`.
        """
        order = slice(None) if self.si[-1] > self.si[0] else slice(None, None, -1)
        return _line(np.asarray(si, dtype=np.float64), self.si[order], self.raw[order])

    def slope(self, counts: float) -> float:
        """Return SI per count at a point of the line; at a corner the mean of both sides.

        `counts`: where. Returns positive or negative, never 0.
        """
        slopes = np.diff(self.si) / np.diff(self.raw)
        last = slopes.size - 1
        after = int(np.clip(np.searchsorted(self.raw, counts, side="right") - 1, 0, last))
        before = int(np.clip(np.searchsorted(self.raw, counts, side="left") - 1, 0, last))
        return float((slopes[before] + slopes[after]) / 2.0)

    def slopes(self, low: float, high: float) -> tuple[float, float]:
        """Return the least and the largest slope by magnitude between two counts.

        `low`, `high`: the stretch, counts. Returns SI per count, without sign.
        """
        slopes = np.abs(np.diff(self.si) / np.diff(self.raw))
        touched = (self.raw[:-1] < high) & (self.raw[1:] > low)
        inside = slopes[touched] if touched.any() else np.abs([self.slope(low)])
        return float(inside.min()), float(inside.max())


def scale_of(rig: Rig, role: str) -> Scale:
    """Return the scale of a role.

    `rig`: with a calibration from counts for that role; `role`: ``voltage`` (counts of pulse width), or an analog
    input: ``position``, ``current``, ``speed``, ``angle``. Returns from counts to the role's SI unit.
    """
    c = rig.channel(role)
    top = PWM_TOP if role == "voltage" else ADC_TOP
    of = c.calibration
    if of is None:
        raise RigError(
            f"{who(rig)}: channels.{role} has no calibration; the controller gives counts (0 to {top})."
            f" Give channels.{role}.gain and offset, or a table, from counts"
        )
    _check_counts(rig, c)
    if of.raw is None or of.out is None:
        raw = np.array([0.0, float(top)])
        si = of.gain * raw + of.offset
        _check_slopes(rig, role, raw, si)
        return Scale(role=role, column=c.column, top=top, raw=raw, si=si)
    steps = np.diff(of.out)
    if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
        raise RigError(
            f"{who(rig)}: channels.{role}.table rises and falls, or stands still; the controller needs one value"
            " for each count and back. Cut the table to a part that only rises or only falls"
        )
    _check_slopes(rig, role, of.raw, of.out)
    ends = None if of.extrapolate else (float(of.raw[0]), float(of.raw[-1]))
    return Scale(role=role, column=c.column, top=top, raw=of.raw, si=of.out, ends=ends)


def who(rig: Rig) -> str:
    """Return how messages call a rig.

    `rig`: any. Returns by its file, else by its name.
    """
    return f"rig {rig.source}" if rig.source is not None else f"rig {rig.name!r}"


def _check_slopes(rig: Rig, role: str, raw: Array, si: Array) -> None:
    """Refuse values that do not differ from count to count, or are beyond all numbers."""
    with np.errstate(all="ignore"):
        slopes = np.concatenate([np.diff(si) / np.diff(raw), np.diff(raw) / np.diff(si)])
    if not np.all(np.isfinite(slopes)):
        raise RigError(
            f"{who(rig)}: channels.{role} gives {si[0]:.6g} at {raw[0]:g} counts and {si[-1]:.6g} at {raw[-1]:g}; each"
            " count has to be another value. Correct its gain, offset or table"
        )


def _check_counts(rig: Rig, c: RigChannel) -> None:
    """Refuse a calibration that begins with anything but plain counts."""
    assert c.calibration is not None
    unit = c.calibration.unit_in or "1"
    if c.unit is not None and (parse_unit(c.unit).si != "1" or parse_unit(c.unit).scale != 1.0):
        unit = c.unit
    if unit != "1":
        raise RigError(
            f"{who(rig)}: channels.{c.role} is calibrated from [{unit}]; the controller gives counts, a plain"
            " number [1]. Calibrate it from counts"
        )


def _line(x: Array, corners: Array, values: Array) -> Array:
    piece = np.clip(np.searchsorted(corners, x, side="right") - 1, 0, corners.size - 2)
    slope = np.diff(values) / np.diff(corners)
    return np.asarray(values[piece] + slope[piece] * (x - corners[piece]), dtype=np.float64)
