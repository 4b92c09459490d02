"""Zero-phase filtering and change of rate: what removes high frequencies without moving anything in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record, Step
from ambid.signals._channels import chosen, finite, mapped


def lowpass(record: Record, cutoff_hz: float, names: str | Sequence[str] | None = None, *, order: int = 4) -> Record:
    """Low-pass channels forwards and backwards, so that nothing is delayed.

    The same filter goes over all channels unless some are named. Filtering the input and the output of an
    identification differently puts the ratio of the filters into the identified plant; filtering both alike leaves the
    plant as it is and only weights the frequencies (Ljung 1999, sec. 14.4). A zero-phase filter looks ahead: it is for
    records, not for control, and an estimator that models its noise (grey-box, ARMAX) is better fed the raw record.

    Parameters
    ----------
    record : Record
        The record to condition.
    cutoff_hz : float
        Frequency in Hz where the two passes together give -6 dB.
    names : str or sequence of str, optional
        Channels; all of them by default.
    order : int
        Order of the Butterworth filter of one pass, 1 to 12.

    Returns
    -------
    Record
        A new record with the step in its history.

    Raises
    ------
    RecordError
        If the cutoff is not between 0 and half the rate, the order is out of range or the record is too short.
    """
    which = chosen(record, names)
    step = Step(name="lowpass", settings={"channels": list(which), "cutoff_hz": float(cutoff_hz), "order": order})
    return mapped(
        record, which, step, lambda x: zero_phase(x, record.rate_hz, float(cutoff_hz), kind="lowpass", order=order)
    )


def zero_phase(
    x: Array, rate_hz: float, corner_hz: float, *, kind: Literal["lowpass", "highpass"], order: int
) -> Array:
    """Filter forwards and backwards with a Butterworth filter in second-order sections.

    `x`: (n_samples,), any unit, samples; `rate_hz`: sampling rate in Hz; `corner_hz`: frequency in Hz where the two
    passes together give -6 dB; `kind`: what passes; `order`: order of one pass, 1 to 12. Returns (n_samples,), unit of
    `x`, filtered samples, not delayed.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0.0 < corner_hz < rate_hz / 2:
        raise RecordError(
            f"{kind} corner {corner_hz:g} Hz at a rate of {rate_hz:g} Hz; it must lie between 0 and half the rate "
            f"({rate_hz / 2:g} Hz). Give another corner"
        )
    if not 1 <= order <= 12:
        raise RecordError(f"{kind} order {order}; it must be 1 to 12. Give a lower order")
    # The padding covers the filter's memory (about one period of the corner), or the ends would ring.
    padding = max(6 * order, round(2 * rate_hz / corner_hz))
    if kind == "highpass":
        padding = min(padding, x.size - 1)
    if x.size <= padding:
        raise RecordError(
            f"{x.size} samples are too few for a {kind} at {corner_hz:g} Hz and {rate_hz:g} Hz rate; it needs more "
            f"than {padding}. "
            "Use a longer record, or a higher corner"
        )
    sections = butter(order, corner_hz, btype=kind, fs=rate_hz, output="sos")
    filtered: Array = np.ascontiguousarray(sosfiltfilt(sections, x, padlen=padding))
    return filtered


def resample(record: Record, rate_hz: float, *, allow_upsampling: bool = False) -> Record:
    """Change the sampling rate of the whole record by a rational factor, with an anti-alias filter.

    Polyphase linear-phase FIR (Kaiser window), compensated for its delay. A held input (steps, PRBS) is smeared over
    the edges by the filter: identify at the measured rate where that matters.

    Parameters
    ----------
    record : Record
        The record to condition.
    rate_hz : float
        New rate in Hz; its ratio to the present one must be a fraction with terms up to 1000.
    allow_upsampling : bool
        A higher rate adds samples but no information and makes residuals coloured, so it has to be allowed explicitly.

    Returns
    -------
    Record
        A new record with the step in its history.

    Raises
    ------
    RecordError
        If the rate is not positive, higher without leave, or not a rational multiple.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise RecordError(f"resample to {rate_hz} Hz; the rate must be a positive number of Hz. Give another rate")
    if rate_hz > record.rate_hz and not allow_upsampling:
        raise RecordError(
            f"resample from {record.rate_hz:g} to {rate_hz:g} Hz adds samples but no information. "
            "Give a lower rate, or allow_upsampling=True"
        )
    ratio = Fraction(rate_hz / record.rate_hz).limit_denominator(1000)
    if ratio == 0 or ratio.numerator > 1000 or abs(float(ratio) * record.rate_hz / rate_hz - 1.0) > 1e-9:
        raise RecordError(
            f"resample from {record.rate_hz:g} to {rate_hz:g} Hz is no fraction with terms up to 1000. "
            f"Give {float(ratio) * record.rate_hz:.10g} Hz or another multiple"
        )
    if record.n_samples * ratio < 2:
        raise RecordError(f"resample to {rate_hz:g} Hz leaves less than two samples. Give a higher rate")
    channels = tuple(replace(c, values=resampled(finite(record, c.name), ratio)) for c in record.channels)
    step = Step(name="resample", settings={"from_hz": record.rate_hz, "to_hz": float(rate_hz), "ratio": str(ratio)})
    return record.with_step(step, channels=channels, rate_hz=float(rate_hz))


def resampled(x: Array, ratio: Fraction) -> Array:
    """Change the rate of samples by a rational factor with a polyphase anti-alias filter.

    `x`: (n_samples,), any unit, samples; `ratio`: new rate over old rate. Returns (ceil(n_samples * ratio), ), unit of
    `x`, samples at the new rate, the first one at the same instant.
    """
    from scipy.signal import resample_poly

    # Without the line through its ends the signal starts and ends at 0, as the filter assumes; and the line passes
    # exactly.
    slope = (x[-1] - x[0]) / max(x.size - 1, 1)
    rest = resample_poly(x - (x[0] + slope * np.arange(x.size)), ratio.numerator, ratio.denominator)
    values: Array = rest + x[0] + slope * np.arange(rest.size) / float(ratio)
    return values
