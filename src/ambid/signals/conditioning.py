"""Steps on a record before it is used: replace samples, remove a trend, resample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RecordError, counted
from ambid.record.record import Record, Step

_MEAN = np.array([251.0, 646.0, -264.0, 106.0, -19.0]) / 720.0  # of the next sample, this one, and those before


def chosen(record: Record, names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the channels meant by `names` (all of them for None), each looked up."""
    if names is None:
        return record.names
    listed = (names,) if isinstance(names, str) else tuple(names)
    if not listed:
        raise RecordError("the list of channels is empty; a step works on at least one. Name a channel, or pass None")
    return tuple(record.channel(n).name for n in listed)


def finite(record: Record, name: str) -> Array:
    """Return the channel's values, refusing NaN and infinity: every filter would spread them over the record."""
    values = record[name].values
    bad = ~np.isfinite(values)
    if bad.any():
        first = int(np.argmax(bad))
        raise RecordError(
            f"channel {name!r} is not finite at sample {first} ({values[first]}), "
            f"{counted(int(bad.sum()), 'sample')} in all. Repair them with replace_samples, or cut them off"
        )
    return values


def mapped(record: Record, names: Sequence[str], step: Step, function: Callable[[Array], Array]) -> Record:
    """Return the record with `function` applied to the named channels, and `step` in its history."""
    channels = tuple(
        replace(c, values=function(finite(record, c.name))) if c.name in names else c for c in record.channels
    )
    return record.with_step(step, channels=channels)


def mean_to_next(record: Record, name: str) -> Record:
    """Replace a measured channel by its mean from each sample to the next, as an input acts that is held: that of the
    polynomial through both and the three before (Adams and Moulton; Hairer, Norsett and Wanner 1993, sec. III.1), as
    later ones hold what noise of the sample that is predicted feeds back.
    """
    x = record[name].values  # of a damaged record with its gaps
    before, after = x[0] - np.arange(_MEAN.size - 2, 0, -1) * (x[1] - x[0]), 2.0 * x[-1] - x[-2]
    mean = np.convolve(np.concatenate([before, x, [after]]), _MEAN, "valid")
    channels = tuple(replace(c, values=mean) if c.name == name else c for c in record.channels)
    return record.with_step(Step(name="mean_to_next", settings={"channels": (name,)}), channels=channels)


def runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and lengths of the runs of True in a boolean array, shape (n_runs,) each."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]


def equal_runs(values: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and lengths of the runs of exactly equal samples that make up `values`."""
    starts = np.concatenate(([0], np.flatnonzero(np.diff(values)) + 1))
    return starts, np.diff(np.concatenate((starts, [values.size])))


def replace_samples(record: Record, name: str, indices: Sequence[int] | NDArray[np.intp]) -> Record:
    """Replace samples by linear interpolation between the nearest samples that are kept; the ends hold the nearest one.

    Nothing calls this by itself: finding a bad sample and replacing it are separate decisions.

    Parameters
    ----------
    record : Record
    name : str, a channel
    indices : sequence of int
        Samples to replace, e.g. ``find_outliers(record, name).indices``; none leaves the record as it is.

    Returns
    -------
    Record, a new one
        Its history names the channel, the number of samples and the first one.

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
    others = np.setdiff1d(np.arange(old.values.size), which, assume_unique=True)
    if others.size == 0:
        raise RecordError(
            f"all samples of channel {name!r} would be replaced; none is left to interpolate from. Drop it"
        )
    if not np.isfinite(old.values[others]).all():
        bad = int(others[~np.isfinite(old.values[others])][0])
        raise RecordError(f"sample {bad} of channel {name!r} is kept but not finite; add it to the samples to replace")
    values = old.values.copy()
    values[which] = np.interp(which, others, old.values[others])
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


def remove_trend(record: Record, names: str | Sequence[str] | None = None, *, degree: int = 1) -> Record:
    """Remove a low-frequency trend: a polynomial in time, from input and output of an identification alike.

    Parameters
    ----------
    record : Record
    names : str or sequence of str, optional
        Channels; all of them by default.
    degree : int
        Of the least-squares polynomial; 1: a straight line, with the offset.

    Returns
    -------
    Record, a new one with the step in its history

    Raises
    ------
    RecordError
        If the degree is out of range, or a channel cannot be used.
    """
    which = chosen(record, names)
    if not 0 <= degree < min(20, record.n_samples):
        raise RecordError(
            f"remove_trend got degree {degree} for {record.n_samples} samples; it must be 0 to 19 and under the "
            f"number of samples. Give a lower degree"
        )
    step = Step(name="remove_trend", settings={"channels": list(which), "degree": degree})
    return mapped(record, which, step, lambda x: x - polynomial_trend(x, degree))


def polynomial_trend(x: Array, degree: int) -> Array:
    """Return the least-squares polynomial through equally spaced samples (n_samples,), at their instants."""
    # Legendre polynomials on [-1, 1]: nearly orthogonal, so that the problem stays well conditioned at any length.
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, x.size), degree)
    coefficients = np.linalg.lstsq(basis, x, rcond=None)[0]
    trend: Array = basis @ coefficients
    return trend


def resample(record: Record, rate_hz: float) -> Record:
    """Lower the sampling rate of the whole record by a rational factor, with an anti-alias filter.

    Polyphase linear-phase FIR (Kaiser window), compensated for its delay. A held input (steps, PRBS) is smeared over
    the edges by the filter: identify at the measured rate where that matters.

    Parameters
    ----------
    record : Record
    rate_hz : float
        New rate in Hz; its ratio to the present one must be a fraction with terms up to 1000.

    Returns
    -------
    Record, a new one with the step in its history

    Raises
    ------
    RecordError
        If the rate is not positive, higher (that adds samples but no information), or not a rational multiple.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise RecordError(f"resample to {rate_hz} Hz; the rate must be a positive number of Hz. Give another rate")
    if rate_hz > record.rate_hz:
        raise RecordError(
            f"resample from {record.rate_hz:g} to {rate_hz:g} Hz adds samples but no information. Give a lower rate"
        )
    ratio = Fraction(rate_hz / record.rate_hz).limit_denominator(1000)
    if ratio == 0 or ratio.numerator > 1000 or abs(float(ratio) * record.rate_hz / rate_hz - 1.0) > 1e-9:
        raise RecordError(
            f"resample from {record.rate_hz:g} to {rate_hz:g} Hz is not a fraction with terms up to 1000. Give "
            f"{float(ratio) * record.rate_hz:.10g} Hz or another multiple"
        )
    if record.n_samples * ratio < 2:
        raise RecordError(f"resample to {rate_hz:g} Hz leaves less than two samples. Give a higher rate")
    channels = tuple(replace(c, values=_resampled(finite(record, c.name), ratio)) for c in record.channels)
    step = Step(name="resample", settings={"from_hz": record.rate_hz, "to_hz": float(rate_hz), "ratio": str(ratio)})
    return record.with_step(step, channels=channels, rate_hz=float(rate_hz))


def _resampled(x: Array, ratio: Fraction) -> Array:
    """Return samples (ceil(n_samples * ratio),) at a new rate, `ratio` times the old one, by a polyphase anti-alias
    filter; the first is at the same instant.
    """
    from scipy.signal import resample_poly

    # Without the line through its ends the signal starts and ends at 0, as the filter assumes; and the line passes
    # exactly.
    slope = (x[-1] - x[0]) / max(x.size - 1, 1)
    rest = resample_poly(x - (x[0] + slope * np.arange(x.size)), ratio.numerator, ratio.denominator)
    values: Array = rest + x[0] + slope * np.arange(rest.size) / float(ratio)
    return values
