"""One position from two or more sensors that look at the same displacement, by a Kalman filter that knows faults.

State: motion, a slowly walking offset of each sensor, perhaps a temperature that all share. Each sensor is tested
against the others at every sample; a faulty one is left out, its influence since the fault is taken back, and it is
used again once it has agreed with the others long enough.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from math import isfinite, log
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.physics.discretise import zero_order_hold
from ambid.recursive.estimator import as_block, check_channels
from ambid.recursive.fusion_sensor import FusedSensor, reason, sensor_table
from ambid.recursive.kalman import LinearState, constant_velocity, linear_state
from ambid.recursive.lines import Event
from ambid.recursive.square_root import covariance_of, factors_of, root_of

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
        from ambid.recursive.fusion_kernels import fuse_scan

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
        self._model = np.concatenate([state.A.ravel(), state.B.ravel(), root_of(state.Q).ravel()])
        self._settings = np.array(
            [log(quiet * _TESTS), float(give == "instant"), max(1.0, restore_s * rate_hz),
             n, rate_hz, _GONE, _LOSS, _SPAN, self._stride()]
        )  # fmt: skip
        self._memory = np.zeros((size + 1, size))
        self._memory[size, :n] = motion.start
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
        self._kept = np.zeros((2, size + 1, size))
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
                self._watch, self._clock, self._ring, self._kept, self._notes,
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
        return np.asarray(self._memory[-1].copy())

    @property
    def covariance(self) -> Array:
        """Covariance of the error of `state`, shape (n_states, n_states)."""
        return covariance_of(self._memory[:-1])

    @property
    def offsets(self) -> Array:
        """How far each sensor's zero has walked and how sure that is, in its unit, shape (n_sensors, 2)."""
        gains = np.array([s.gain for s in self.sensors])
        sd = np.sqrt(np.diag(self.covariance)[self._first :]) * np.abs(gains)
        return np.column_stack([self._memory[-1, self._first :] * gains, sd])

    @property
    def temperature(self) -> tuple[float, float]:
        """Shared temperature since the start and its standard deviation, K; NaN where it is not modelled."""
        if self._first == self._n:
            return float("nan"), float("nan")
        return float(self._memory[-1, self._n]), float(np.sqrt(self.covariance[self._n, self._n]))

    @property
    def unobservable(self) -> Array:
        """Direction of the state that no sensor shows, shape (n_states,): the position up, all offsets down.

        Without a motion that knows where the position is; with `levitated_motion` its slow force balances it.
        """
        c = self.motion.state.C[0]
        out = np.zeros(self._memory.shape[1])
        out[: self._n] = np.linalg.lstsq(np.vstack([self.motion.state.A - np.eye(self._n), c]), _last(self._n), None)[0]
        out[self._first :] = -(c @ out[: self._n])
        return out

    @property
    def relative_sd(self) -> float:
        """Standard deviation of the next predicted position against the mean of the working sensors' zeros, m."""
        h = np.zeros(self._memory.shape[1])
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
        from ambid.recursive.fusion_watch_kernels import back

        if name not in self.names or not (offset_sd is None or 0.0 <= offset_sd < np.inf):
            raise EstimationError(
                f"sensor fusion: restore({name!r}, offset_sd={offset_sd}); sensors are {', '.join(self.names)}, and "
                "offset_sd is at least 0. Mend the call"
            )
        i = self.names.index(name)
        P = self.covariance
        P[self._first + i, self._first + i] += ((offset_sd or 0.0) / self.sensors[i].gain) ** 2
        self._memory[:-1] = factors_of(P)
        back(i, self._watch, self._clock, self._notes)
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
        for name in ("_memory", "_seen", "_watch", "_clock", "_ring", "_kept", "_notes"):
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """A sampled linear motion with one position, and what is known of it when fusion begins.

    Attributes
    ----------
    state : LinearState
        Its one output is the position in m; R is not used. Inputs, if any, are measured signals.
    start : ndarray, shape (n_states,)
    start_sd : ndarray, shape (n_states,)
        All positive.
    """

    state: LinearState
    start: Array
    start_sd: Array

    def __post_init__(self) -> None:
        """Refuse what fusion cannot start from."""
        n = self.state.A.shape[0]
        start, sd = np.array(self.start, dtype=np.float64), np.array(self.start_sd, dtype=np.float64)
        if self.state.C.shape[0] != 1:
            raise EstimationError(f"motion: {self.state.C.shape[0]} outputs; fusion wants one, the position. Give one")
        if start.shape != (n,) or sd.shape != (n,) or not (np.isfinite(start).all() and np.isfinite(sd).all()):
            raise EstimationError(
                f"motion: start and start_sd must be {n} finite numbers each. Give one for each state"
            )
        if not (sd > 0.0).all():
            raise EstimationError("motion: start_sd must be positive. Give what is not known of each state")
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "start_sd", sd)


def free_motion(
    rate_hz: float, *, q: float, start_sd: ArrayLike = (1e-3, 1.0), start: ArrayLike = (0.0, 0.0)
) -> Motion:
    """Return position and velocity under white acceleration.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    q : float
        Intensity of the acceleration, (m/s²)²s. A motion of amplitude a and angular frequency ω needs about a² ω³.
    start_sd : array_like, shape (2,)
        In m and m/s.
    start : array_like, shape (2,)

    Returns
    -------
    Motion

    Raises
    ------
    EstimationError
        If a number is not positive.
    """
    state = constant_velocity(rate_hz, q=q, r=1.0)
    return Motion(state=state, start=np.asarray(start), start_sd=np.asarray(start_sd))


def levitated_motion(
    rate_hz: float,
    *,
    m: float,
    k_i: float,
    k_x: float,
    c: float = 0.0,
    force: float,
    force_walk: float,
    start_sd: ArrayLike = (1e-3, 1.0, 100.0),
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Motion:
    """Return the bench's own motion with the measured current as input, exactly sampled (held from sample to sample).

    The third state is a slow force per mass, m/s²: gravity, the bias of the current, a load. Without it the model
    would take the offset that all sensors share for an unbalanced force.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    m, k_i, k_x, c : float
        Mass kg, N/A, N/m (negative for an attracting magnet), N s/m.
    force : float
        Density of the white force that the model does not know, N/√Hz (two-sided), from inaccurate parameters too.
    force_walk : float
        The slow force walks: standard deviation after one second, N/√s; over 0.
    start_sd, start : array_like, shape (3,)
        In m, m/s, m/s².

    Returns
    -------
    Motion

    Raises
    ------
    EstimationError
        If a number is not finite, or mass or noise not positive.
    """
    numbers = np.array([rate_hz, m, k_i, k_x, c, force, force_walk])
    if not (np.isfinite(numbers).all() and min(rate_hz, m, force, force_walk) > 0.0):
        raise EstimationError(
            "levitated motion: rate, m, force and force_walk must be positive, k_i, k_x and c finite. Mend them"
        )
    F = np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, 1.0], [0.0, 0.0, 0.0]])
    A, B, Q = _sampled(F, np.array([[0.0], [k_i / m], [0.0]]), np.diag([0.0, force**2, force_walk**2]) / m**2, rate_hz)
    state = linear_state(A, [[1.0, 0.0, 0.0]], Q, [[1.0]], B=B)
    return Motion(state=state, start=np.asarray(start), start_sd=np.asarray(start_sd))


def _sampled(F: Array, G: Array, intensity: Array, rate_hz: float) -> tuple[Array, Array, Array]:
    """Exact step, held input and noise covariance (Van Loan 1978)."""
    from scipy.linalg import expm

    n = F.shape[0]
    A, B = zero_order_hold(F, G, 1.0 / rate_hz)
    both = expm(np.block([[-F, intensity], [np.zeros((n, n)), F.T]]) / rate_hz)
    Q = A @ both[:n, n:]
    return A, B, (Q + Q.T) / 2.0
