"""One position from several sensors of one displacement, by a Kalman filter of motion, walking offsets, perhaps a
shared temperature, which tests each sensor against the others at every sample and leaves out faulty ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import erf, inf, isfinite, log, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, as_block, check_channels, covariance_of, kernels, root_of
from ambid.recursive.kalman import constant_velocity
from ambid.recursive.lines import Event, EventKind

_CONTINUOUS = 3.0  # equal values in succession that a signal without steps does not give
_SECONDS = 2.0  # the longest run of equal values worth waiting for
_TESTS = 4.0  # cumulative sums of each sensor
_STRIDE = 16.0
_JUMPING = 0.3  # share of squared changes in squared residuals: a step 3 samples ago; 2 for white noise
_MOST_EVENTS = 1000


_RULES = {
    "gain": "finite and not 0",
    "noise_sd": "positive",
    "resolution": "at least 0",
    "offset": "finite",
    "offset_sd": "at least 0",
    "drift_rate": "at least 0",
    "warmth": "finite",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedSensor:
    """One sensor: offset + gain x (+ warmth · temperature) + drift + noise, x positive in one direction for all; [u] is
    the unit of what it gives.

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
    offset, offset_sd : float
        What it gives at x = 0, [u], and what is not known of that when fusion begins.
    drift_rate : float
        The offset walks: standard deviation after one second, [u]/√s.
    warmth : float
        [u]/K: what a temperature that all sensors share adds. For drift of a pair that their sum shows.
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
    limits: tuple[float, float] = (-inf, inf)

    def __post_init__(self) -> None:
        """Refuse numbers that make no sensor."""
        for name, rule in _RULES.items():
            value = getattr(self, name)
            wrong = value <= 0.0 if rule == "positive" else value < 0.0 if rule == "at least 0" else False
            if not isfinite(value) or wrong or (name == "gain" and value == 0.0):
                raise EstimationError(f"sensor {self.name!r}: {name} is {value}; it must be {rule}. Correct it")
        if not (len(self.limits) == 2 and self.limits[0] < self.limits[1]):
            raise EstimationError(f"sensor {self.name!r}: limits {self.limits}; give (low, high) with low < high")


def still_samples(sensor: FusedSensor, rate_hz: float, quiet_samples: float) -> float:
    """Return how many values have to equal the one before until that is a fault, 0 where steps are so coarse that
    standing still says nothing within two seconds. A sound sensor at rest repeats a step with probability p of at most
    erf(step/(2 √2 noise)), wherever in the step it stands; p^n is brought below one in `quiet_samples`.
    """
    if sensor.resolution == 0.0:
        return _CONTINUOUS
    p = erf(sensor.resolution / (2.0 * sqrt(2.0) * sensor.noise_sd))
    if p >= 1.0:
        return 0.0
    n = np.ceil(max(_CONTINUOUS, log(quiet_samples) / -log(p)))
    return float(n) if n <= _SECONDS * rate_hz else 0.0


class SensorFusion(Copied):
    """Kalman filter of several position sensors with detection and exclusion of faulty ones.

    **What cannot be seen.** If the position rises and all sensors' readings of it fall by the same, nothing changes:
    the offset that all have in common (along `unobservable`) is known from calibration only (`offset_sd`) and then
    grows as the sensors' drift allows. `sd` holds it; `relative_sd` is without it: of the position against the mean of
    the working sensors' zeros. For a pair on opposite sides with equal `warmth` the shared temperature *is* seen, in
    the sum of both, and its drift does not reach the position.

    **Faults.** Three or more working sensors are compared with each other alone, so that no shock to the rotor accuses
    one: log-likelihood CUSUMs for a step, more noise and a loss of gain, plus missing values, rails and values that
    stand still. With two, the motion model takes part; where it does not decide, the event says "one of", both are
    used, and the standard deviation covers either being right until they agree. One that is alone is only excluded if
    it gives nothing, stands at a rail or stands still. A single value beyond 4 standard deviations is not used; a
    fault's influence is taken back; a fault slower than the sensor's drift is taken for drift.

    **False alarms.** Each sum alarms in the mean no sooner than after e^h quiet samples; h follows from
    `false_alarms_per_hour`. That needs noise that is white and no larger than stated; look at `levels`.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    sensors : sequence of FusedSensor
        Two or more, with distinct names.
    q : float
        Of the motion: intensity of a white acceleration, (m/s²)²s. A motion of amplitude a and angular frequency ω
        needs about a² ω³.
    start_sd : tuple of float
        What is not known of position and velocity, both about 0, when fusion begins: m and m/s.
    temperature_rate : float
        The shared temperature walks: K/√s; used where a sensor has `warmth`.
    false_alarms_per_hour : float
        Of all sensors together, at most.
    restore_s : float
        Time for which an excluded sensor has to agree; doubled each time it fails soon again, up to 64 fold.
    start_s : float
        Time of the first sample, for events.

    Attributes
    ----------
    names : tuple of str
        Of the sensors.
    n_samples, n_events : int
        Taken in; events so far, of which the last 1000 are kept.

    Raises
    ------
    EstimationError
        If a setting does not fit.
    """

    def __init__(
        self,
        rate_hz: float,
        sensors: Sequence[FusedSensor],
        *,
        q: float,
        start_sd: tuple[float, float] = (1e-3, 1.0),
        temperature_rate: float = 0.0,
        false_alarms_per_hour: float = 0.1,
        restore_s: float = 0.25,
        start_s: float = 0.0,
    ) -> None:
        check_channels("sensor fusion", rate_hz, len(sensors))
        self.rate_hz, self.start_s, self.sensors = rate_hz, start_s, tuple(sensors)
        motion = constant_velocity(rate_hz, q=q, r=1.0)
        self.names = tuple(s.name for s in self.sensors)
        if len(self.names) < 2 or len(set(self.names)) < len(self.names):
            raise EstimationError(
                f"sensor fusion: sensors {self.names}; two or more with distinct names are needed. Correct the list"
            )
        for name, value, least in (
            ("false_alarms_per_hour", false_alarms_per_hour, 1e-300),
            ("restore_s", restore_s, 1e-300),
            ("temperature_rate", temperature_rate, 0.0),
        ):
            if not least <= value < inf:
                rule = "positive" if least else "at least 0"
                raise EstimationError(f"sensor fusion: {name} is {value}; it must be {rule}. Correct it")
        if len(start_sd) != 2 or not all(0.0 < sd < np.inf for sd in start_sd):
            raise EstimationError(f"sensor fusion: start_sd {start_sd}; give two positive numbers, in m and m/s")
        at, m, n = self._at, len(self.sensors), motion.A.shape[0]
        warm = any(s.warmth for s in self.sensors) and temperature_rate > 0.0
        self._n, self._m, self._first = n, m, n + warm  # first: row of the first offset
        size = n + warm + m
        gain, noise, step, drift, offset, warmth = np.array(
            [(s.gain, s.noise_sd, s.resolution, s.drift_rate, s.offset_sd, s.warmth) for s in self.sensors]
        ).T
        variance = (noise**2 + step**2 / 12.0) / gain**2
        quiet = rate_hz * 3600.0 / false_alarms_per_hour * m
        still = [still_samples(s, rate_hz, quiet) for s in self.sensors]
        rails = np.array([s.limits for s in self.sensors]).T
        self._table = np.column_stack([1.0 / gain, [s.offset for s in self.sensors], variance, *rails, still])
        walks = np.append(np.full(int(warm), temperature_rate**2), (drift / gain) ** 2) / rate_hz
        # the walking offsets go in steps of several samples where they are far below the noise
        stride = _STRIDE if (walks[-m:] * _STRIDE <= 0.01 * variance).all() else 1.0
        self._walk = np.append(np.zeros(n), walks * stride)
        self._settings = np.array([log(quiet * _TESTS), max(1.0, restore_s * rate_hz), stride])
        self._A, self._G = motion.A, root_of(motion.Q)
        offsets = np.maximum(np.abs(offset / gain), 1e-6 * noise / np.abs(gain)) ** 2
        begin = np.full(int(warm), max(temperature_rate**2 / rate_hz, 1e-12))
        self._memory = np.zeros((size + 1, size))
        np.fill_diagonal(self._memory, [*np.square(start_sd), *begin, *offsets])
        self._H = np.zeros((m + 1, size))
        self._H[:, 0] = 1.0
        self._H[:m, n:] = np.hstack([(warmth / gain)[:, None], np.eye(m)]) if warm else np.eye(m)
        self._watch, self._clock = np.zeros((m, at.COLUMNS)), np.zeros(10)
        self._watch[:, at.LAST] = np.nan  # no value before the first
        self._clock[at.FRESH] = 1.0  # states to go back to begin with the first sample
        self._ring, self._kept = np.full((2 * at.SPAN, m), np.nan), np.zeros((2, size + 1, size))
        self._now, self._one = np.zeros((5 + m, m)), (np.empty((1, m)), np.empty((1, 2)))
        self._held = 0.0  # sample until which a disturbance is not told again
        self._events: deque[Event] = deque(maxlen=_MOST_EVENTS)
        self.n_events = 0

    @property
    def _at(self) -> Any:
        """The compiled loops, which also know where the numbers lie."""
        return kernels("fusion")

    def update(self, measurement: ArrayLike) -> Array:
        """Take in one sample or a block; splitting a stream in another way changes no number.

        Parameters
        ----------
        measurement : array_like, shape (n_sensors,), or (n_samples, n_sensors) for a block
            Raw values in each sensor's unit. NaN where one is missing.

        Returns
        -------
        ndarray, shape (2,), or (n_samples, 2) for a block
            Position and its standard deviation, m.

        Raises
        ------
        EstimationError
            If shapes do not fit.
        """
        given = np.asarray(measurement, dtype=np.float64)
        if given.ndim == 1 and given.size == self._m:
            y, out = self._one
            y[0] = given
            self._run(y, out)
            return np.array(out[0])
        y = as_block(given, self._m, "sensor fusion")
        out = np.empty((y.shape[0], 2))
        self._run(y, out)
        return out[0] if given.ndim == 1 else out

    def _run(self, y: Array, out: Array) -> None:
        """Run the compiled scan, and decide where it stops."""
        at, clock, done = self._at, self._clock, 0
        while done < y.shape[0]:
            done = at.fuse_scan(
                done, y, out, self._A, self._G, self._H, self._walk, self._table, self._settings, self._memory,
                self._watch, clock, self._ring, self._kept, self._now,
            )  # fmt: skip
            stage = clock.item(at.STAGE)
            if stage == at.TEST:
                self._test_alone()
            elif stage == at.TAKE:
                self._judge()
            elif stage == at.RETURN:
                self._take_back()

    def _test_alone(self) -> None:
        """Exclude sensors that give nothing, stand at a rail or stand still."""
        at, watch, now = self._at, self._watch, self.n_samples
        faults: list[tuple[int, float, str, str, dict[str, float]]] = []
        for i in map(int, np.flatnonzero(watch[:, at.OUT] == 0.0)):
            gone, railed, same = watch[i, [at.GONE, at.RAILED, at.SAME]]
            value = {"value": float(watch[i, at.LAST])}
            if gone >= at.GONE_N:
                faults.append((i, now - gone + 1.0, "its values are missing", "missing", {}))
            elif railed >= at.GONE_N:
                faults.append((i, now - railed + 1.0, f"at its rail, {value['value']:.4g}", "rail", value))
            elif same >= self._table[i, at.STUCK] > 0.0:
                faults.append((i, now - same, f"is constant at {value['value']:.4g}", "stuck", value))
        for i, onset, *_ in faults:
            self._exclude(i, onset)
        for i, onset, why, cause, values in faults:
            self._tell("excluded", onset, why + self._left(), cause, self.names[i], **values)

    def _judge(self) -> None:
        """Exclude the sensor that an alarm points at, or say that one of several is at fault, or that the rotor is."""
        at, watch, clock, high = self._at, self._watch, self._clock, self._settings[0]
        now, used = self.n_samples, watch[:, at.OUT] == 0.0
        apart, disputed = used.sum() > 2, clock[at.DISPUTED] > 0.0
        sums = watch[:, at.UP : at.LOSS + 1]
        alarm = sums.max(axis=1)
        points = np.where(used, np.maximum(alarm, watch[:, at.EVIDENCE]), -inf)
        worst = int(np.argmax(np.where(alarm > high, points, -inf)))
        most, second = points[worst], max(0.0, *np.delete(points, worst))
        onset, shift = watch[worst, at.UP_0 + np.argmax(sums[worst])], float(watch[worst, at.MEAN_R])
        moved = clock[at.COMPARED] < 2.0 or (not apart and clock[at.COMMON] > most - at.MARGIN)
        # of two sensors the motion can only name one that jumps: a slow difference draws the filter after it first
        shown = apart or watch[worst, at.JUMPS] > _JUMPING * watch[worst, at.SUM_TT]
        if not (disputed or moved) and shown and second < most - at.MARGIN * (1.0 if apart else 2.0):
            cause, why, values = self._looks(worst, shift)
            self._exclude(worst, onset)
            self._tell("excluded", onset, why + self._left(), cause, self.names[worst], **values)
            return
        if apart and most < 3.0 * high:
            return
        if now >= self._held and (moved or not disputed):
            both = self.working
            if moved:
                why = f"the motion contradicts the motion model, or {' and '.join(both)} are faulty together"
            else:
                why = f"one of {', '.join(both)} is faulty, which one is unknown: both are used, and sd covers either"
            self._tell("disturbed", onset, why, "motion" if moved else "one_of", shift=shift)
            self._held = now + self.rate_hz
        if not (moved or disputed):
            clock[at.DISPUTED], clock[at.AGREED] = 1.0, 0.0
            able = used & (points >= most - 3.0 * at.MARGIN)  # those that could have done it
            watch[able, at.DOUBT], watch[able, at.BETWEEN] = 1.0, watch[able, at.SQUARE_R]
            watch[:, at.ZERO] = self._H[: self._m, self._n :] @ self._kept[0, -1, self._n :]
        self._begin_tests(now)

    def _looks(self, i: int, shift: float) -> tuple[str, str, dict[str, float]]:
        """Return what says most of the sums that are near the highest: a name, words and numbers."""
        at, w = self._at, self._watch[i]
        step = max(w[at.UP], w[at.DOWN])
        cause = "noise"
        if w[at.LOSS] >= max(step, w[at.LOUD]):
            cause = "gain"
        elif step >= w[at.LOUD] or abs(w[at.SUM_T]) > 0.9 * w[at.SUM_ABS]:
            cause = "step"
        if cause == "noise":
            return cause, "noisier than it should be", {}
        x, words = float(self._H[self._m] @ self._memory[-1]), "it stepped" if cause == "step" else "its gain fell"
        why = f"{words}: {shift * 1e6:+.3g} um from the others at {x * 1e6:.3g} um"
        return cause, why, {"shift": shift, "position": x}

    def _exclude(self, i: int, onset: float) -> None:
        """Leave sensor i out, from its fault on as far as the filter can go back; the sooner after its return, the
        longer.
        """
        at, w, clock, now = self._at, self._watch[i], self._clock, self.n_samples
        again = w[at.NEED] > 0.0 and now - w[at.SINCE] < 10.0 * w[at.NEED]
        need = self._settings[at.RESTORE_N]
        w[at.NEED] = min(2.0 * w[at.NEED], 64.0 * need) if again else need
        w[at.OUT], w[at.SINCE], w[at.DOUBT], w[at.COUNT : at.XX + 1] = 1.0, now, 0.0, 0.0
        self._now[at.USED, i] = min(self._now[at.USED, i], 0.0)
        self._begin_tests(now)
        late = int(clock[at.NEW] <= onset)
        self._memory[:] = self._kept[late]
        n, size = self._n, self._memory.shape[1]
        M, b, f = np.empty((n, 2 * n)), np.empty(max(2 * n, size)), np.empty(size)
        out = self._watch[:, at.OUT] > 0.0
        for k in range(int(clock[at.NEW if late else at.OLD]), now):
            z = np.where(out, np.nan, self._ring[k % len(self._ring)])
            at.absorb(z, self._table, self._memory, self._H, f, b)
            at.advance(self._memory, self._A, self._G, self._walk, int(self._settings[at.STRIDE]), k, M, b)
        clock[at.FRESH] = 1.0

    def _take_back(self) -> None:
        """Use the sensors again that have agreed long enough, and end a doubt when all do."""
        at, watch, clock, now = self._at, self._watch, self._clock, self.n_samples - 1
        clock[at.STAGE] = at.READ
        for i in map(int, np.flatnonzero(watch[:, at.BACK])):
            out_s = (now - watch[i, at.SINCE]) / self.rate_hz
            watch[i, at.OUT], watch[i, at.BACK], watch[i, at.SINCE] = 0.0, 0.0, now
            self._begin_tests(now)
            if (watch[:, at.OUT] == 0.0).sum() > 2:
                watch[:, at.DOUBT] = clock[at.DISPUTED] = 0.0
            clock[at.FRESH] = 1.0
            why = f"agrees with the others again, after {out_s:.3g} s"
            self._tell("restored", now, why, "restored", self.names[i], out_s=out_s)
        need = self._settings[at.RESTORE_N]
        if clock[at.DISPUTED] > 0.0 and clock[at.AGREED] >= need:
            watch[:, at.DOUBT] = clock[at.DISPUTED] = 0.0
            why = f"{', '.join(self.working)} agree again, for {need / self.rate_hz:.3g} s"
            self._tell("restored", now, why, "agreement")

    def _begin_tests(self, now: int) -> None:
        """Begin the tests of all sensors again."""
        at = self._at
        self._watch[:, at.UP : at.EVIDENCE + 1] = 0.0
        self._watch[:, at.UP_0 : at.LOSS_0 + 1] = now
        self._watch[:, at.SUM_T : at.JUMPS + 1] = 0.0
        self._clock[at.COMMON] = 0.0

    def _left(self) -> str:
        if not self.working:
            return "; no sensor is left, the position is predicted only"
        return f"; left: {', '.join(self.working)}"

    def _tell(
        self, kind: EventKind, sample: float, why: str, cause: str, who: str | None = None, **values: float
    ) -> None:
        t = self.start_s + sample / self.rate_hz
        named = {f"cause_{cause}": 1.0, **values} if cause else values
        self._events.append(Event(kind=kind, t=t, why=why, parameter=who, values=named))
        self.n_events += 1

    def _named(self, which: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(name for name, this in zip(self.names, which, strict=True) if this)

    @property
    def n_samples(self) -> int:  # noqa: D102
        return int(self._clock[self._at.NOW])

    @property
    def events(self) -> tuple[Event, ...]:
        """The last events: ``excluded``, ``restored`` and ``disturbed``, with time from `start_s` on."""
        return tuple(self._events)

    @property
    def working(self) -> tuple[str, ...]:
        """Names of the sensors that are used."""
        return self._named(self._watch[:, self._at.OUT] == 0.0)

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Names of the sensors one of which is at fault without it being known which."""
        return self._named(self._watch[:, self._at.DOUBT] > 0.0)

    @property
    def levels(self) -> Array:
        """Root mean square of each sensor's residual against the others, shape (n_sensors,): 1 if its noise is right.

        Since the first sample, while it was used; NaN before.
        """
        tested, squares = self._watch[:, self._at.TESTED], self._watch[:, self._at.SQUARES]
        return np.sqrt(squares / np.where(tested > 0.0, tested, np.nan))

    @property
    def n_gated(self) -> Array:
        """Single values of each working sensor that were not used because they did not fit, shape (n_sensors,)."""
        return self._watch[:, self._at.GATED].copy()

    @property
    def state(self) -> Array:
        """Predicted state at the next sample: motion, temperature in K if modelled, offsets in m, shape (n_states,)."""
        return np.array(self._memory[-1])

    @property
    def covariance(self) -> Array:
        """Covariance of the error of `state`, shape (n_states, n_states)."""
        return covariance_of(self._memory[:-1])

    @property
    def temperature(self) -> tuple[float, float]:
        """Shared temperature since the start and its standard deviation, K; NaN where it is not modelled."""
        if self._first == self._n:
            return float("nan"), float("nan")
        return float(self._memory[-1, self._n]), float(np.sqrt(self.covariance[self._n, self._n]))

    @property
    def relative_sd(self) -> float:
        """Standard deviation of the next predicted position against the mean of the working sensors' zeros, m."""
        h = np.zeros(self._memory.shape[1])
        h[0] = 1.0
        at_work = self._watch[:, self._at.OUT] == 0.0
        if at_work.any():
            h[self._first :] = at_work / at_work.sum()
            if self._first > self._n:
                h[self._n] = float(self._H[: self._m, self._n][at_work].mean())
        return float(np.sqrt(h @ self.covariance @ h))
