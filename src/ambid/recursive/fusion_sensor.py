"""A position sensor as fusion sees it: what its datasheet says of gain, noise, range, resolution and drift.

y = offset + gain x (+ warmth · temperature) + drift + noise, x positive in one direction for all sensors: of a pair on
opposite sides of the rotor one has a negative gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erf, inf, isfinite, log, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.lines import Event, EventKind

_CONTINUOUS = 3.0  # equal values in succession that a signal without steps does not give
_SECONDS = 2.0  # the longest run of equal values worth waiting for


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedSensor:
    """One sensor; [u] is the unit of what it gives.

    Attributes
    ----------
    name : str
        Of its channel.
    gain : float
        [u]/m at the middle of its range; negative for one that looks from the other side.
    noise_sd : float
        Standard deviation of one value, [u], without rounding to `resolution`.
    resolution : float
        Smallest step of the values, [u]; 0 where they are continuous. A value that stands still is a fault only if
        rounding does not explain it.
    offset : float
        What it gives at x = 0, [u].
    offset_sd : float
        What is not known of `offset` when fusion begins, [u].
    drift_rate : float
        The offset walks: standard deviation after one second, [u]/√s.
    warmth : float
        [u]/K: what a temperature that all sensors share adds. For drift of a pair that their sum shows.
    curve : tuple of float
        (c2, c3), 1/m and 1/m²: x = w + c2 w² + c3 w³ with w = (y - offset)/gain, for a sensor that is not straight.
    limits : tuple of float
        Rails, [u]: a value at or beyond one of them is no measurement.
    """

    name: str
    gain: float
    noise_sd: float
    resolution: float
    offset: float = 0.0
    offset_sd: float = 0.0
    drift_rate: float = 0.0
    warmth: float = 0.0
    curve: tuple[float, float] = (0.0, 0.0)
    limits: tuple[float, float] = (-inf, inf)

    def __post_init__(self) -> None:
        """Refuse numbers that make no sensor."""
        for name in ("gain", "noise_sd", "resolution", "offset", "offset_sd", "drift_rate", "warmth"):
            value = getattr(self, name)
            least = {"gain": -inf, "offset": -inf, "warmth": -inf}.get(name, 0.0)
            wrong = not isfinite(value) or value < least or (value == 0.0 and name in ("gain", "noise_sd"))
            if wrong:
                raise EstimationError(f"sensor {self.name!r}: {name} is {value}; it must be {_RULES[name]}. Mend it")
        if not (len(self.curve) == 2 and all(isfinite(c) for c in self.curve)):
            raise EstimationError(f"sensor {self.name!r}: curve is {self.curve}; give (c2, c3), both finite")
        if not (len(self.limits) == 2 and self.limits[0] < self.limits[1]):
            raise EstimationError(f"sensor {self.name!r}: limits {self.limits}; give (low, high) with low < high")


_RULES = {
    "gain": "finite and not 0",
    "noise_sd": "positive",
    "resolution": "at least 0",
    "offset": "finite",
    "offset_sd": "at least 0",
    "drift_rate": "at least 0",
    "warmth": "finite",
}


def sensor_table(sensors: tuple[FusedSensor, ...], rate_hz: float, quiet_samples: float) -> Array:
    """Return the sensors as the compiled recursion takes them, in metres.

    `quiet_samples`: samples in which one false alarm is allowed. Returns (n_sensors, 10), columns as `_watch_kernels`
    names them.
    """
    rows = [
        (
            1.0 / s.gain,
            s.offset,
            *s.curve,
            (s.noise_sd**2 + s.resolution**2 / 12.0) / s.gain**2,
            (s.drift_rate / s.gain) ** 2 / rate_hz,
            s.warmth / s.gain,
            *s.limits,
            still_samples(s, rate_hz, quiet_samples),
        )
        for s in sensors
    ]
    return np.array(rows, dtype=np.float64)


def still_samples(sensor: FusedSensor, rate_hz: float, quiet_samples: float) -> float:
    """Return how many values have to equal the one before them until that is a fault.

    A sound sensor at rest gives the same step again with probability p of at most erf(step/(2 √2 noise)), wherever in
    the step it stands; p^n is brought below one in `quiet_samples`.

    Returns 0 where the steps are so coarse that standing still says nothing within two seconds.
    """
    if sensor.resolution == 0.0:
        return _CONTINUOUS
    p = erf(sensor.resolution / (2.0 * sqrt(2.0) * sensor.noise_sd))
    if p >= 1.0:
        return 0.0
    n = np.ceil(max(_CONTINUOUS, log(quiet_samples) / -log(p)))
    return float(n) if n <= _SECONDS * rate_hz else 0.0


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
