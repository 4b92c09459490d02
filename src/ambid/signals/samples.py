"""Steps on samples and values: cut, scale, and the replacement of samples that someone asked to have replaced."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.errors import RecordError
from ambid.record.record import Record, Step

# Sampling instants that are given as decimals (2.0 s at 1 kHz) miss the grid by round-off; a thousandth of a sample is
# none.
_GRID_TOLERANCE = 1e-3


def cut(record: Record, from_s: float | None = None, to_s: float | None = None) -> Record:
    """Keep the samples with from_s <= t < to_s, on the record's own time axis.

    Parameters
    ----------
    record : Record
        The record to cut.
    from_s, to_s : float, optional
        Ends in s; the record's own by default.

    Returns
    -------
    Record
        A new record, whose `start_s` is the time of its first sample, with the step in its history.

    Raises
    ------
    RecordError
        If an end lies outside the record, or nothing would be left.
    """
    begin, end = record.start_s, record.start_s + record.duration_s
    first_s = begin if from_s is None else float(from_s)
    last_s = end if to_s is None else float(to_s)
    slack = _GRID_TOLERANCE / record.rate_hz
    for label, t in (("from", first_s), ("to", last_s)):
        if not begin - slack <= t <= end + slack:
            raise RecordError(f"cut {label} {t:g} s; the record spans {begin:g} to {end:g} s. Give a time inside it")
    first = math.ceil((first_s - begin) * record.rate_hz - _GRID_TOLERANCE)
    last = math.ceil((last_s - begin) * record.rate_hz - _GRID_TOLERANCE)
    if last <= first:
        raise RecordError(
            f"cut from {first_s:g} to {last_s:g} s keeps no sample; from must lie before to. Swap or widen them"
        )
    first, last = max(first, 0), min(last, record.n_samples)
    channels = tuple(replace(c, values=c.values[first:last].copy()) for c in record.channels)
    step = Step(name="cut", settings={"from_s": first_s, "to_s": last_s, "samples": last - first})
    return record.with_step(step, channels=channels, start_s=begin + first / record.rate_hz)


def scale(record: Record, name: str, gain: float, *, offset: float = 0.0, unit: str | None = None) -> Record:
    """Replace a channel's values by gain·values + offset.

    Parameters
    ----------
    record : Record
        The record to condition.
    name : str
        Channel.
    gain : float
        Factor, in new unit per old unit; not zero.
    offset : float
        Added after the factor, in the new unit.
    unit : str, optional
        SI unit of the result; unchanged by default.

    Returns
    -------
    Record
        A new record with the step in its history.

    Raises
    ------
    RecordError
        If the channel does not exist, or gain or offset is not a usable number.
    """
    old = record.channel(name)
    if not (math.isfinite(gain) and gain != 0.0 and math.isfinite(offset)):
        raise RecordError(
            f"scale of channel {name!r} by gain {gain} and offset {offset}; both must be finite and the gain not "
            f"0. Give other numbers"
        )
    new = replace(old, values=gain * old.values + offset, unit=old.unit if unit is None else unit)
    settings = {"channel": name, "gain": float(gain), "offset": float(offset), "unit": new.unit}
    return record.with_step(
        Step(name="scale", settings=settings), channels=tuple(new if c is old else c for c in record.channels)
    )


def replace_samples(record: Record, name: str, indices: Sequence[int] | NDArray[np.intp]) -> Record:
    """Replace samples by linear interpolation between the nearest samples that are kept; the ends hold the nearest one.

    Nothing calls this by itself: finding a bad sample and replacing it are separate decisions.

    Parameters
    ----------
    record : Record
        The record to condition.
    name : str
        Channel.
    indices : sequence of int
        Samples to replace, 0 to n_samples - 1, e.g. ``find_outliers(record, name).indices``. None of them leaves the
        record as it is.

    Returns
    -------
    Record
        A new record; its history names the channel, the number of samples and the first one.

    Raises
    ------
    RecordError
        If an index is outside the record, all samples would be replaced, or a kept one is not finite.
    """
    old = record.channel(name)
    which = np.unique(np.asarray(indices, dtype=np.intp))
    if which.size == 0:
        return record
    if which[0] < 0 or which[-1] >= old.values.size:
        outside = int(which[0] if which[0] < 0 else which[-1])
        raise RecordError(
            f"replace sample {outside} of channel {name!r}; samples run from 0 to {old.values.size - 1}. Give "
            f"indices inside"
        )
    kept = np.setdiff1d(np.arange(old.values.size), which, assume_unique=True)
    if kept.size == 0:
        raise RecordError(
            f"all samples of channel {name!r} would be replaced; none is left to interpolate from. Drop it"
        )
    if not np.isfinite(old.values[kept]).all():
        bad = int(kept[~np.isfinite(old.values[kept])][0])
        raise RecordError(f"sample {bad} of channel {name!r} is kept but not finite; add it to the samples to replace")
    values = old.values.copy()
    values[which] = np.interp(which, kept, old.values[kept])
    settings = {
        "channel": name,
        "samples": int(which.size),
        "first_s": record.start_s + int(which[0]) / record.rate_hz,
        "method": "linear",
    }
    return record.with_step(
        Step(name="replace_samples", settings=settings),
        channels=tuple(replace(c, values=values) if c is old else c for c in record.channels),
    )
