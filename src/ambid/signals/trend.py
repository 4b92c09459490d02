"""Removal of what the model does not describe at the low end: offset and slow drift (thesis 1.7, figs 1.11 and 5.7)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record, Step
from ambid.signals._channels import chosen, finite, mapped
from ambid.signals.filters import zero_phase


def remove_offset(record: Record, names: str | Sequence[str] | None = None) -> Record:
    """Subtract each channel's mean.

    Parameters
    ----------
    record : Record
        The record to condition.
    names : str or sequence of str, optional
        Channels; all of them by default.

    Returns
    -------
    Record
        A new record; its history holds the removed means, in each channel's unit.

    Raises
    ------
    RecordError
        If a channel does not exist or holds a value that is not finite.
    """
    which = chosen(record, names)
    means = {n: float(np.mean(finite(record, n))) for n in which}
    return mapped(record, which, Step(name="remove_offset", settings=means), lambda x: x - np.mean(x))


def remove_trend(
    record: Record,
    names: str | Sequence[str] | None = None,
    *,
    degree: int | None = None,
    highpass_hz: float | None = None,
) -> Record:
    """Remove a low-frequency trend: a polynomial in time, or everything under a high-pass corner.

    The same removal belongs on the input and the output of an identification: a high-pass on one of them only is read
    as dynamics of the plant. A high-pass also removes the low frequencies that tell the displacement stiffness k_x.

    Parameters
    ----------
    record : Record
        The record to condition.
    names : str or sequence of str, optional
        Channels; all of them by default.
    degree : int, optional
        Degree of the least-squares polynomial; 1 (a straight line, with the offset) unless `highpass_hz` is given.
    highpass_hz : float, optional
        Corner in Hz of a zero-phase high-pass (second-order Butterworth, forwards and backwards, -6 dB at the corner).

    Returns
    -------
    Record
        A new record with the step in its history.

    Raises
    ------
    RecordError
        If both ways are asked for, the degree or corner is out of range, or a channel cannot be used.
    """
    which = chosen(record, names)
    if highpass_hz is not None:
        if degree is not None:
            raise RecordError(
                "remove_trend got degree and highpass_hz; it does one of the two. Give one, or call twice"
            )
        corner = float(highpass_hz)
        step = Step(name="remove_trend", settings={"channels": list(which), "highpass_hz": corner})
        return mapped(record, which, step, lambda x: zero_phase(x, record.rate_hz, corner, kind="highpass", order=2))
    degree = 1 if degree is None else degree
    if not 0 <= degree < min(20, record.n_samples):
        raise RecordError(
            f"remove_trend got degree {degree} for {record.n_samples} samples; it must be 0 to 19 and under the "
            f"number of samples. "
            "Give a lower degree, or highpass_hz"
        )
    step = Step(name="remove_trend", settings={"channels": list(which), "degree": degree})
    return mapped(record, which, step, lambda x: x - polynomial_trend(x, degree))


def polynomial_trend(x: Array, degree: int) -> Array:
    """Return the least-squares polynomial through equally spaced samples.

    `x`: (n_samples,), any unit, samples; `degree`: degree of the polynomial. Returns (n_samples,), unit of `x`, the
    polynomial at the sampling instants.
    """
    # Legendre polynomials on [-1, 1]: nearly orthogonal, so that the problem stays well conditioned at any length.
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, x.size), degree)
    coefficients = np.linalg.lstsq(basis, x, rcond=None)[0]
    trend: Array = basis @ coefficients
    return trend
