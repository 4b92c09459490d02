"""Saturation: samples that pile up at an extreme value of a channel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record
from ambid.signals._channels import equal_runs, finite, runs

_FEWEST = 5  # samples at a limit that count as evidence
_PILE = 3.0  # how many times the fullest of the neighbouring levels a limit has to hold
_NEIGHBOURS = 10  # levels beside the limit that tell how many samples a level holds there


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """One limit at which samples pile up.

    Attributes
    ----------
    value : float
        The limit in the channel's unit.
    count, n_runs, longest : int
        Samples at it, runs that they form, and samples of the longest run.
    first_index : int
        First sample at it.
    """

    value: float
    count: int
    n_runs: int
    longest: int
    first_index: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Saturation:
    """Saturation of a channel.

    Attributes
    ----------
    channel, unit : str
        Channel looked at and its unit.
    lower, upper : Limit or None
        The limits that were reached.
    n_samples : int
        Samples of the channel.
    first_s : float or None
        Time of the first saturated sample in s.
    """

    channel: str
    unit: str
    lower: Limit | None
    upper: Limit | None
    n_samples: int
    first_s: float | None

    @property
    def count(self) -> int:
        """Number of saturated samples."""
        return sum(limit.count for limit in (self.lower, self.upper) if limit)

    @property
    def first_index(self) -> int | None:
        """First saturated sample, or None."""
        return min((limit.first_index for limit in (self.lower, self.upper) if limit), default=None)

    @property
    def fraction(self) -> float:
        """Part of the channel's samples, 0 to 1."""
        return self.count / self.n_samples

    def __str__(self) -> str:
        if not self.count:
            return f"{self.channel}: no saturation"
        parts = [f"{limit.count} at {limit.value:.6g} {self.unit}" for limit in (self.lower, self.upper) if limit]
        return (
            f"{self.channel}: {100 * self.fraction:.2g} % of the samples saturated ({' and '.join(parts)}), "
            f"the first at sample {self.first_index} ({self.first_s:.6g} s)"
        )


def find_saturation(record: Record, name: str, *, limits: tuple[float, float] | None = None) -> Saturation:
    """Find samples held at a limit of the channel's range.

    Without `limits`, an extreme value is a limit where it holds at least 5 samples and over 3 times as many as any of
    the 10 levels next to it. A quantised sine holds at most 2.4 times as many (its peaks dwell); steps and PRBS hold
    all their levels. Not reported, because the samples alone do not tell it from design or rest: an input of two
    levels, and an extreme value held only from the very start of the record (see `find_dropouts`). A sensor whose curve
    flattens without an exact limit is not found either.

    Parameters
    ----------
    record : Record
        The record to look at.
    name : str
        Channel.
    limits : (float, float), optional
        Known lower and upper limit in the channel's unit; samples at or beyond them are then counted, whatever the
        signal.

    Returns
    -------
    Saturation
        The limits reached, with counts.

    Raises
    ------
    RecordError
        If the channel cannot be used, or the lower limit is not under the upper one.
    """
    x = finite(record, name)
    if limits is not None:
        if not limits[0] < limits[1]:
            raise RecordError(f"limits {limits} of channel {name!r}; the lower must be under the upper one. Swap them")
        lower, upper = (_limit(limits[0], x <= limits[0]), _limit(limits[1], x >= limits[1]))
    else:
        lower, upper = _pile(x), _pile(-x)
        upper = replace(upper, value=-upper.value) if upper else None
    firsts = [limit.first_index for limit in (lower, upper) if limit]
    return Saturation(
        channel=name,
        unit=record.channel(name).unit,
        lower=lower,
        upper=upper,
        n_samples=x.size,
        first_s=record.start_s + min(firsts) / record.rate_hz if firsts else None,
    )


def _limit(value: float, at: np.ndarray) -> Limit | None:
    if not at.any():
        return None
    starts, lengths = runs(at)
    return Limit(
        value=value,
        count=int(lengths.sum()),
        n_runs=int(starts.size),
        longest=int(lengths.max()),
        first_index=int(starts[0]),
    )


def _pile(x: Array) -> Limit | None:
    """Return the lower extreme of `x` as a limit if samples pile up at it."""
    values, counts = np.unique(x, return_counts=True)
    # Levels that only round-off keeps apart are one, as in a computed sine with a whole number of samples per period.
    apart = np.diff(values) > 1e-9 * (values[-1] - values[0])
    level_of = np.concatenate(([0], np.cumsum(apart)))
    held = np.bincount(level_of, weights=counts)
    if held.size < 3 or held[0] < max(_FEWEST, 1 + _PILE * held[1 : 1 + _NEIGHBOURS].max()):
        return None
    at = x <= values[np.flatnonzero(level_of == 0)[-1]]
    starts, lengths = runs(at)
    entered = starts[starts > 0]
    # Rest before the first motion has no way in, and a transient that settles creeps in: neither is a limit.
    if not np.any(x[entered - 1] - x[entered] > 1e-7 * (values[-1] - values[0])):
        return None
    if _held(x, float(np.mean(lengths))):
        return None
    return _limit(float(values[0]), at)


def _held(x: Array, dwell: float) -> bool:
    """Whether the signal holds its inner levels about as long as its extreme, as a staircase does by design."""
    starts, lengths = equal_runs(x)
    inside = (x[starts] > np.min(x)) & (x[starts] < np.max(x))
    return bool(inside.any() and np.mean(lengths[inside]) > max(3.0, 0.3 * dwell))
