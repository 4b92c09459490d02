"""A position sensor as fusion sees it: what its datasheet says of gain, noise, range, resolution and drift.

y = offset + gain x (+ warmth · temperature) + drift + noise, x positive in one direction for all sensors: of a pair on
opposite sides of the rotor one has a negative gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, inf, isfinite, log, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError

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
