"""How a number goes on in time: lines between knots, with jumps.

All times are seconds of the record; a jump or a corner happens at the sample nearest to its time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError

_PER_TIME_CONSTANT = 50  # corners of a warm-up: the lines leave the exponential by 5e-5 of its rise at most


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """A piecewise linear function of time, constant before its first and after its last knot.

    Attributes
    ----------
    times_s : tuple of float
        Knots in s, not falling; the same time twice is a jump, at which the later value holds.
    values : tuple of float
        One for each knot, in the unit of what is scheduled.
    """

    times_s: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        t, v = np.asarray(self.times_s, dtype=np.float64), np.asarray(self.values, dtype=np.float64)
        if t.size == 0 or t.shape != v.shape or not (np.isfinite(t).all() and np.isfinite(v).all()):
            raise ModelError(
                f"a schedule has {t.size} times and {v.size} values; it wants as many finite numbers of each, at least"
                " one. Correct them"
            )
        if (np.diff(t) < 0.0).any():
            raise ModelError("the times of a schedule fall; they must rise or stay (a jump). Sort them")

    @classmethod
    def constant(cls, value: float) -> Self:
        """Return the schedule that is `value` always."""
        return cls(times_s=(0.0,), values=(value,))

    @classmethod
    def step(cls, before: float, after: float, at_s: float) -> Self:
        """Return a jump.

        Parameters
        ----------
        before, after : float
            Values before and from `at_s` on.
        at_s : float
            In s.

        Returns
        -------
        Schedule
            With two knots.
        """
        return cls(times_s=(at_s, at_s), values=(before, after))

    @classmethod
    def ramp(cls, before: float, after: float, from_s: float, to_s: float) -> Self:
        """Return a straight line between two levels.

        Parameters
        ----------
        before, after : float
            Values until `from_s` and after `to_s`.
        from_s, to_s : float
            In s.

        Returns
        -------
        Schedule
            With two knots.
        """
        return cls(times_s=(from_s, to_s), values=(before, after))

    @classmethod
    def warm_up(cls, before: float, after: float, from_s: float, time_constant_s: float) -> Self:
        """Return before + (after - before) (1 - exp(-(t - from)/tau)), as a body heats up.

        Parameters
        ----------
        before, after : float
            Value until `from_s`, and where it goes.
        from_s, time_constant_s : float
            In s.

        Returns
        -------
        Schedule
            Lines between 50 points of the exponential in each time constant, for ten of them.

        Raises
        ------
        ModelError
            If the time constant is not positive.
        """
        if not time_constant_s > 0.0:
            raise ModelError(f"the time constant of a warm-up is {time_constant_s} s; it must be positive. Correct it")
        t = np.arange(10 * _PER_TIME_CONSTANT + 1) / _PER_TIME_CONSTANT
        values = before + (after - before) * -np.expm1(-t)
        return cls(times_s=tuple((from_s + time_constant_s * t).tolist()), values=tuple(values.tolist()))

    def knots(self, rate_hz: float) -> Array:
        """Return the knots in whole samples at `rate_hz` in Hz, shape (n_knots,)."""
        return np.rint(np.asarray(self.times_s) * rate_hz)

    def at(self, samples: Array, rate_hz: float, *, before: bool = False) -> Array:
        """Return the values at sample numbers, fractions allowed; at a jump the later value.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Sample numbers since the record began.
        rate_hz : float
            Sampling rate in Hz.
        before : bool
            At a jump the earlier value instead.

        Returns
        -------
        ndarray, shape (n,), in the unit of the schedule
            The values.
        """
        knots, values = self.knots(rate_hz), np.asarray(self.values)
        if values.size == 1:
            return np.full(samples.shape, values[0])
        after = _segments(knots, samples, "left" if before else "right")
        start, length = knots[after - 1], knots[after] - knots[after - 1]
        # Beyond the ends, and at a jump that is the last knot, the clip holds the end value.
        jumped = samples > start if before else samples >= start
        part = np.where(length > 0.0, (samples - start) / np.where(length > 0.0, length, 1.0), jumped)
        part = np.clip(part, 0.0, 1.0)
        return np.asarray(values[after - 1] + part * (values[after] - values[after - 1]))

    def integral(self, samples: Array, rate_hz: float) -> Array:
        """Return the integral from the record's beginning, exactly.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Sample numbers since the record began, zero or positive, fractions allowed.
        rate_hz : float
            Sampling rate in Hz.

        Returns
        -------
        ndarray, shape (n,), unit of the schedule times s
            The angle, for a schedule of a speed.
        """
        inside = self.knots(rate_hz)
        edges = np.concatenate(([0.0], np.unique(inside[inside > 0.0])))
        # A line is integrated exactly by its middle: strictly inside a stretch there is no jump.
        ends = np.append(edges[1:], edges[-1] + 2.0)
        area = np.concatenate(([0.0], np.cumsum((ends - edges) * self.at(0.5 * (edges + ends), rate_hz))[:-1]))
        k = _segments(np.append(edges, np.inf), samples, "right") - 1
        return np.asarray((area[k] + (samples - edges[k]) * self.at(0.5 * (edges[k] + samples), rate_hz)) / rate_hz)


def _segments(knots: Array, samples: Array, side: Literal["left", "right"]) -> NDArray[np.intp]:
    """Return the knot that ends the segment of each sample, shape (n,), or (1,) where all lie in one segment."""
    found = np.searchsorted(knots, [samples.min(), samples.max()] if samples.size else samples, side=side)
    if samples.size and found[0] != found[1]:  # else all lie in one segment: nothing to look up for each sample
        found = np.searchsorted(knots, samples, side=side)
    elif samples.size:
        found = found[:1]
    return np.asarray(np.clip(found, 1, knots.size - 1), dtype=np.intp)
