"""One position from two or more sensors that look at the same displacement, by a Kalman filter that knows faults.

State: motion, a slowly walking offset of each sensor, perhaps a temperature that all share. Each sensor is tested
against the others at every sample; a faulty one is left out, its influence since the fault is taken back, and it is
used again once it has agreed with the others long enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from math import isfinite, log
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import as_block, check_channels
from ambid.recursive.fusion.motion import Motion
from ambid.recursive.fusion.reasons import reason
from ambid.recursive.fusion.sensor import FusedSensor, sensor_table
from ambid.recursive.lines import Event

_TESTS = 4.0  # cumulative sums of each sensor
_LOSS = 0.2  # part of the gain whose loss is looked for
_STRIDE = 16.0
_SPAN = 64  # samples between two states that are kept to go back to
_GONE = 10.0  # values in succession that are missing or at a rail until a sensor is excluded
_MOST_EVENTS = 1000


class SensorFusion:
    """Kalman filter of several position sensors with detection and exclusion of faulty ones.

    **What cannot be seen.** If the position rises and all sensors' readings of it fall by the same, nothing changes:
    the offset that all have in common (along `unobservable`) is known from calibration only (`offset_sd`) and from
    then on grows as the sensors' drift allows. `sd` holds it; `relative_sd` is without it: of the position against the
    mean of the working sensors' zeros. For a pair on opposite sides with equal `warmth` the shared temperature *is*
    seen, in the sum of both, and its drift does not reach the position.

    **Faults.** With three or more working sensors they are compared with each other alone, so that no shock to the
    rotor accuses one: log-likelihood CUSUMs for a step, more noise and a loss of gain of each sensor, plus missing
    values, rails and values that stand still. With two, the motion model takes part; where it does not decide, the
    event says "one of", both are used, and the standard deviation covers either being right until they agree. One that
    is alone is only excluded if it gives nothing, stands at a rail or stands still. A single value beyond 4 standard
    deviations is not used. A fault that is slower than the sensor's drift is taken for drift.

    **False alarms.** Each sum alarms in the mean no sooner than after e^h quiet samples; h follows from
    `false_alarms_per_hour`. That needs noise that is white and no larger than stated; look at `levels`.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    sensors : sequence of FusedSensor
        Two or more, with distinct names.
    motion : Motion
        See `free_motion`, `levitated_motion`.
    temperature_rate : float
        The shared temperature walks: K/√s; used where a sensor has `warmth`.
    false_alarms_per_hour : float
        Of all sensors together, at most.
    restore_s : float
        Time for which an excluded sensor has to agree; doubled each time it fails soon again, up to 64 fold.
    give : {"filtered", "instant"}
        The filtered position, or that of each instant's values alone, less the offsets: noisier, and without any
        dynamics of the filter. NaN with infinite standard deviation where no value of that instant can be used.

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
        motion: Motion,
        temperature_rate: float = 0.0,
        false_alarms_per_hour: float = 0.1,
        restore_s: float = 0.25,
        give: Literal["filtered", "instant"] = "filtered",
        start_s: float = 0.0,
    ) -> None:
        from ambid.recursive.fusion._kernels import fuse_scan

        check_channels("sensor fusion", rate_hz, len(sensors))
        self.rate_hz, self.start_s, self.sensors, self.motion = rate_hz, start_s, tuple(sensors), motion
        self.names = tuple(s.name for s in self.sensors)
        _check(self.names, false_alarms_per_hour, restore_s, temperature_rate, give)
        m, n, n_u = len(self.sensors), motion.state.A.shape[0], motion.state.B.shape[1]
        warm = any(s.warmth for s in self.sensors) and temperature_rate > 0.0
        self._n, self._m, self._n_u, self._first = n, m, n_u, n + warm  # first: row of the first offset
        size = n + warm + m
        quiet = rate_hz * 3600.0 / false_alarms_per_hour * m
        self._table = sensor_table(self.sensors, rate_hz, quiet)
        state = motion.state
        self._model = np.hstack([state.A, state.B, _root(state.Q)])
        self._settings = np.array(
            [log(quiet * _TESTS), float(give == "instant"), max(1.0, restore_s * rate_hz),
             0.0, rate_hz, _GONE, _LOSS, _SPAN, self._stride()]
        )  # fmt: skip
        self._memory = np.zeros((size, size + 1))
        self._memory[:n, size] = motion.start
        offsets = [max(abs(s.offset_sd / s.gain), 1e-6 * s.noise_sd / abs(s.gain)) ** 2 for s in self.sensors]
        start_temperature = [max(temperature_rate**2 / rate_hz, 1e-12)] if warm else []
        np.fill_diagonal(self._memory, [*motion.start_sd**2, *start_temperature, *offsets])
        self._seen = np.zeros((m + 2, size))
        self._seen[: m + 1, :n] = state.C[0]
        self._seen[:m, n:] = np.hstack([self._table[:, 6:7], np.eye(m)]) if warm else np.eye(m)
        walks = [*([temperature_rate**2 / rate_hz] if warm else []), *self._table[:, 5]]
        self._walk = np.array(walks) * self._settings[8]
        self._watch = np.zeros((m, 37))
        self._watch[:, 1] = np.nan  # no value before the first
        self._clock = np.zeros(10)
        self._clock[3] = 1.0  # states to go back to begin with the first sample
        self._ring = np.full((2 * _SPAN, 2 * m + n_u), np.nan)
        self._kept = np.zeros((2, size, size + 1))
        self._work = np.zeros((10 + 3 * m + n, max(2 * n, size)))
        self._notes = np.zeros((2 * m + 2, 5))
        self._scan = fuse_scan
        self._none = np.empty((1, 0))
        self._one = (np.empty((1, m)), np.empty((1, 2)))
        self._events: deque[Event] = deque(maxlen=_MOST_EVENTS)
        self.n_events = 0

    def update(self, measurement: ArrayLike, inputs: ArrayLike | None = None) -> Array:
        """Take in one sample or a block; splitting a stream in another way changes no number.

        Parameters
        ----------
        measurement : array_like, shape (n_sensors,), or (n_samples, n_sensors) for a block
            Raw values in each sensor's unit. NaN where one is missing.
        inputs : array_like, shape (n_inputs,) or (n_samples, n_inputs), optional
            Wanted where the motion has inputs: the current in A, held from each sample to the next.

        Returns
        -------
        ndarray, shape (2,), or (n_samples, 2) for a block
            Position and its standard deviation, m.

        Raises
        ------
        EstimationError
            If shapes do not fit, or an input is missing or not finite.
        """
        given = np.asarray(measurement, dtype=np.float64)
        if given.ndim == 1 and given.size == self._m and inputs is None and self._n_u == 0:
            y, out = self._one
            y[0] = given
            self._run(y, self._none, out)
            return np.array(out[0])
        y = as_block(given, self._m, "sensor fusion")
        out = np.empty((y.shape[0], 2))
        self._run(y, self._inputs(inputs, y.shape[0]), out)
        return out[0] if given.ndim == 1 else out

    def _stride(self) -> float:
        """Samples in one step of the walking offsets: more than one where that is far below the noise."""
        return _STRIDE if (self._table[:, 5] * _STRIDE <= 0.01 * self._table[:, 4]).all() else 1.0

    def _run(self, y: Array, u: Array, out: Array) -> None:
        done = 0
        while done < y.shape[0]:
            done = self._scan(
                done, y, u, out, self._model, self._seen, self._walk, self._table, self._settings, self._memory,
                self._watch, self._clock, self._ring, self._kept, self._work, self._notes,
            )  # fmt: skip
            for row in self._notes[: int(self._clock[6])]:
                self._events.append(reason(row, self.sensors, self.working, self.rate_hz, self.start_s))
                self.n_events += 1

    @property
    def n_samples(self) -> int:  # noqa: D102
        return int(self._clock[0])

    @property
    def events(self) -> tuple[Event, ...]:
        """The last events: ``excluded``, ``restored`` and ``disturbed``, with time from `start_s` on."""
        return tuple(self._events)

    def take_events(self) -> tuple[Event, ...]:
        """Return the events since the last call and forget them.

        Returns
        -------
        tuple of Event
        """
        events = tuple(self._events)
        self._events.clear()
        return events

    @property
    def working(self) -> tuple[str, ...]:
        """Names of the sensors that are used."""
        return tuple(name for name, w in zip(self.names, self._watch, strict=True) if w[0] == 0.0)

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Names of the sensors one of which is at fault without it being known which."""
        return tuple(name for name, w in zip(self.names, self._watch, strict=True) if w[32] > 0.0)

    @property
    def levels(self) -> Array:
        """Root mean square of each sensor's residual against the others, shape (n_sensors,): 1 if its noise is right.

        Since the first sample, while it was used; NaN before.
        """
        tested = np.where(self._watch[:, 30] > 0.0, self._watch[:, 30], np.nan)
        return np.asarray(np.sqrt(self._watch[:, 31] / tested))

    @property
    def n_gated(self) -> Array:
        """Single values of each working sensor that were not used because they did not fit, shape (n_sensors,)."""
        return self._watch[:, 29].copy()

    @property
    def state(self) -> Array:
        """Predicted state at the next sample: motion, temperature in K if modelled, offsets in m, shape (n_states,)."""
        return self._memory[:, -1].copy()

    @property
    def covariance(self) -> Array:
        """Covariance of the error of `state`, shape (n_states, n_states)."""
        F = self._memory[:, :-1]
        U = np.triu(F, 1) + np.eye(F.shape[0])
        P = (U * np.diag(F)) @ U.T
        return np.asarray((P + P.T) / 2.0)

    @property
    def offsets(self) -> Array:
        """How far each sensor's zero has walked and how sure that is, in its unit, shape (n_sensors, 2)."""
        gains = np.array([s.gain for s in self.sensors])
        sd = np.sqrt(np.diag(self.covariance)[self._first :]) * np.abs(gains)
        return np.column_stack([self._memory[self._first :, -1] * gains, sd])

    @property
    def temperature(self) -> tuple[float, float]:
        """Shared temperature since the start and its standard deviation, K; NaN where it is not modelled."""
        if self._first == self._n:
            return float("nan"), float("nan")
        return float(self._memory[self._n, -1]), float(np.sqrt(self.covariance[self._n, self._n]))

    @property
    def unobservable(self) -> Array:
        """Direction of the state that no sensor shows, shape (n_states,): the position up, all offsets down.

        Without a motion that knows where the position is; with `levitated_motion` its slow force balances it.
        """
        c = self.motion.state.C[0]
        out = np.zeros(self._memory.shape[0])
        out[: self._n] = np.linalg.lstsq(np.vstack([self.motion.state.A - np.eye(self._n), c]), _last(self._n), None)[0]
        out[self._first :] = -(c @ out[: self._n])
        return out

    @property
    def relative_sd(self) -> float:
        """Standard deviation of the next predicted position against the mean of the working sensors' zeros, m."""
        h = np.zeros(self._memory.shape[0])
        h[: self._n] = self.motion.state.C[0]
        at_work = self._watch[:, 0] == 0.0
        if at_work.any():
            h[self._first :] = at_work / at_work.sum()
            if self._first > self._n:
                h[self._n] = float(self._table[at_work, 6].mean())
        return float(np.sqrt(h @ self.covariance @ h))

    def restore(self, name: str, *, offset_sd: float | None = None) -> None:
        """Use a sensor again at once, as an operator may who has mended it.

        Parameters
        ----------
        name : str
        offset_sd : float, optional
            What is not known of its zero now, in its unit, where it was moved; added to what was not known before.

        Raises
        ------
        EstimationError
            If there is no such sensor, or `offset_sd` is negative.
        """
        from ambid.recursive.fusion._kernels import put_back

        if name not in self.names or not (offset_sd is None or 0.0 <= offset_sd < np.inf):
            raise EstimationError(
                f"sensor fusion: restore({name!r}, offset_sd={offset_sd}); sensors are {', '.join(self.names)}, and "
                "offset_sd is at least 0. Mend the call"
            )
        i = self.names.index(name)
        variance = ((offset_sd or 0.0) / self.sensors[i].gain) ** 2
        put_back(i, self._memory, self._watch, self._clock, variance, self._work[0], self._notes)
        self._events.append(
            Event(
                kind="restored",
                t=self.start_s + self.n_samples / self.rate_hz,
                why="ordered by the operator",
                parameter=name,
            )
        )
        self.n_events += 1

    def copy(self) -> Self:
        """Return an independent fusion in the same state.

        Returns
        -------
        SensorFusion
        """
        other = copy(self)
        for name in ("_memory", "_seen", "_watch", "_clock", "_ring", "_kept", "_work", "_notes"):
            setattr(other, name, getattr(self, name).copy())
        other._one = (self._one[0].copy(), self._one[1].copy())
        other._events = self._events.copy()
        return other

    def _inputs(self, inputs: ArrayLike | None, n: int) -> Array:
        given = np.asarray([] if inputs is None else inputs, dtype=np.float64)
        if given.size != n * self._n_u or not np.isfinite(given).all():
            raise EstimationError(
                f"sensor fusion: inputs of shape {given.shape}; {n} samples of {self._n_u} finite inputs are wanted. "
                "Give all of them, or fuse with free_motion, which needs none"
            )
        return np.ascontiguousarray(given.reshape(n, self._n_u))


def _root(Q: Array) -> Array:
    values, vectors = np.linalg.eigh(Q)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _last(n: int) -> Array:
    out = np.zeros(n + 1)
    out[n] = 1.0
    return out


def _check(names: tuple[str, ...], alarms: float, restore_s: float, temperature_rate: float, give: str) -> None:
    if len(names) < 2 or len(set(names)) < len(names):
        raise EstimationError(
            f"sensor fusion: sensors {names}; it wants two or more with distinct names. Mend the list"
        )
    if not (0.0 < alarms < np.inf and isfinite(restore_s) and restore_s > 0.0 and 0.0 <= temperature_rate < np.inf):
        raise EstimationError(
            f"sensor fusion: false_alarms_per_hour {alarms}, restore_s {restore_s}, temperature_rate "
            f"{temperature_rate}; the first two must be positive, the last at least 0. Mend them"
        )
    if give not in ("filtered", "instant"):
        raise EstimationError(f"sensor fusion: give {give!r}; it is 'filtered' or 'instant'. Choose one of them")
