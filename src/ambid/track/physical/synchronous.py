"""The forcing by unbalance, for a rotor whose angle is known: f = m e (speed^2) cos(angle + phase) (theory.md sec. 1).

With a = m e cos(phase) and b = -m e sin(phase) it is a speed^2 cos(angle) + b speed^2 sin(angle): linear in a and b,
with regressors that need no filter and follow the rotor through a spin-up. The force is held over a sample at its
middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.record import Record

_PARTS, _PART_RAD = 25, 10.0  # parts of a record in which speed and angle are compared, each at least so long
_AGREE = 0.05  # relative difference of speed and turning that sensors make


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Forcing:
    """Regressors of the unbalance."""

    # (n_samples, 2), (speed/top speed)^2 times cosine and sine of the angle, in the middle of each sample
    columns: Array
    top_speed: float  # rad/s


def forcing_of(record: Record) -> Forcing | None:
    """Return the regressors of a record that holds the speed or the angle of its rotor.

    Returns none where the record holds neither, or the rotor stands still.
    """
    if "angle" not in record.names and "speed" not in record.names:
        return None
    period = 1.0 / record.rate_hz
    if "speed" in record.names:
        speed = record["speed"]
        angle = record["angle"] if "angle" in record.names else _integrated(speed, period)
    else:
        angle = record["angle"]
        speed = np.gradient(np.unwrap(angle), period)
    top = float(np.nanmax(np.abs(speed), initial=0.0))
    if top == 0.0:
        return None
    if top * period > np.pi:
        raise EstimationError(
            f"the speed reaches {top:.4g} rad/s, more than half a turn a sample at {record.rate_hz:g} Hz."
            " Check its unit"
        )
    if "speed" in record.names and "angle" in record.names:
        _check_agreement(speed, angle, period)
    middle = angle + 0.5 * period * speed
    size = (speed / top) ** 2
    return Forcing(columns=np.column_stack([size * np.cos(middle), size * np.sin(middle)]), top_speed=top)


def _integrated(speed: Array, period: float) -> Array:
    """Angle from the speed by the trapezium rule, 0 at the first sample."""
    known = np.nan_to_num(speed)  # after a gap the phase is lost; the recursion finds it anew
    return np.concatenate([[0.0], np.cumsum(0.5 * (known[1:] + known[:-1]) * period)])


def _check_agreement(speed: Array, angle: Array, period: float) -> None:
    """Refuse a speed that is not the derivative of the angle; a unit that is wrong is off by a factor."""
    expected = 0.5 * (speed[1:] + speed[:-1]) * period
    turned = np.mod(np.diff(angle) + np.pi, 2.0 * np.pi) - np.pi  # an angle may be wrapped
    known = np.isfinite(expected) & np.isfinite(turned)
    expected, turned = expected[known], turned[known]
    way = np.cumsum(np.abs(expected))
    parts = 0 if way.size == 0 else min(_PARTS, int(way[-1] / _PART_RAD))
    if parts == 0:
        return
    ends = np.searchsorted(way, way[-1] * np.arange(1, parts) / parts)
    begins = np.concatenate([[0], ends])
    along = np.add.reduceat(turned * np.sign(expected), begins)
    ratio = float(np.median(along / np.add.reduceat(np.abs(expected), begins)))  # gaps spoil few of the parts
    if abs(ratio - 1.0) > _AGREE:
        raise EstimationError(
            f"the angle turns at {ratio:.4g} times the speed; they have to agree within {_AGREE:.0%}. Check the units"
            " of both (rpm or rad/s, deg or rad) and their signs, or leave one of them out"
        )


def amplitude_and_phase(a: float, b: float, covariance: Array) -> tuple[float, float, float, float]:
    """Return the unbalance as amplitude and phase.

    `a`, `b`: m e cos(phase) and -m e sin(phase), kg m; `covariance`: (2, 2), of a and b. Returns `amplitude,
    amplitude_sd`: kg m; `phase, phase_sd`: rad; the standard deviation is pi where the amplitude is within its own of
    zero.
    """
    size = float(np.hypot(a, b))
    if size == 0.0:
        return 0.0, float(np.sqrt(covariance.trace() / 2)), 0.0, float(np.pi)
    along, across = np.array([a, b]) / size, np.array([b, -a]) / size
    sd, turned = float(np.sqrt(along @ covariance @ along)), float(np.sqrt(across @ covariance @ across)) / size
    return size, sd, float(np.arctan2(-b, a)), min(turned, float(np.pi))
