"""Outliers: samples that neither the past nor the future of a channel predicts.

A step is predicted from its future and the last sample before it from its past, and a sine peak from both, so none of
them is an outlier.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record
from ambid.signals._channels import equal_runs, finite
from ambid.signals._regression import fit_arx

_ORDER = 4  # of the local predictor: enough for two sines, short enough to look past an outlier
_BLOCK = 100  # samples over which the scale of the innovations is taken as constant
_MAD_TO_SD = 1.4826  # of a Gaussian


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outliers:
    """Samples that neither their past nor their future predicts.

    Attributes
    ----------
    channel : str
        Channel looked at.
    indices : ndarray of int, shape (count,)
        The samples.
    first_s : float or None
        Time of the first one in s.
    largest_sd : float
        Largest prediction error among them, in robust standard deviations of the innovations.
    """

    channel: str
    indices: NDArray[np.intp]
    first_s: float | None
    largest_sd: float

    @property
    def count(self) -> int:
        """Number of outliers."""
        return int(self.indices.size)

    @property
    def first_index(self) -> int | None:
        """First outlier, or None."""
        return int(self.indices[0]) if self.indices.size else None

    def __str__(self) -> str:
        if not self.count:
            return f"{self.channel}: no outliers"
        return (
            f"{self.channel}: {self.count} outlier{'s' if self.count > 1 else ''}, the first at sample "
            f"{self.first_index} "
            f"({self.first_s:.6g} s), up to {self.largest_sd:.3g} sd of the innovations"
        )


def find_outliers(record: Record, name: str, *, threshold: float = 6.0, width: int = 1) -> Outliers:
    """Find outliers of a channel; nothing is replaced (see `replace_samples`).

    Parameters
    ----------
    record : Record
        The record to look at.
    name : str
        Channel.
    threshold : float
        Prediction error that makes an outlier, in local robust standard deviations of the innovations (Hampel
        identifier: median absolute value times 1.4826). At 6, Gaussian noise gives less than one in 1e8 samples.
    width : int
        Longest group of neighbouring outliers that is looked for, 1 to 5 samples. Over 1, pulses of a real input
        of that length are found too.

    Returns
    -------
    Outliers
        Their indices, in order. The first and last few samples, which have no past or future, are not judged.

    Raises
    ------
    RecordError
        If the channel cannot be used, threshold or width is out of range, or the record has under 50 samples.
    """
    x = finite(record, name)
    if not (threshold >= 3.0 and 1 <= width <= 5):
        raise RecordError(
            f"find_outliers got threshold {threshold:g} and width {width}; threshold is at least 3 and width 1 to "
            f"5. Give others"
        )
    if x.size < 50:
        raise RecordError(f"channel {name!r} has {x.size} samples; outliers need at least 50. Use a longer record")
    sizes = outlier_sizes(x, threshold, width)
    indices = np.flatnonzero(sizes)
    first = record.start_s + int(indices[0]) / record.rate_hz if indices.size else None
    return Outliers(channel=name, indices=indices, first_s=first, largest_sd=float(sizes.max()))


def outlier_sizes(x: Array, threshold: float = 6.0, width: int = 1) -> Array:
    """Return the prediction error of each outlier in robust standard deviations, 0 for samples that are none.

    `x`: (n_samples,), any unit, samples, finite; `threshold`: error that makes an outlier, in local robust standard
    deviations; `width`: longest group of outliers in samples. Returns (n_samples,), dimensionless, sizes; 0 where there
    is no outlier.
    """
    spread = float(np.std(x))
    if spread == 0.0:
        return np.zeros(x.size)
    repeated = 1.0 - equal_runs(x)[0].size / x.size
    common = _common_levels(x) if repeated > 0.5 else np.zeros(x.size, dtype=bool)
    clean, sizes = x, np.zeros(x.size)
    # An outlier spoils the predictor and the prediction of its neighbours: repeat with the found ones bridged.
    for _ in range(5):
        forward = _errors(x, clean, width, spread)
        backward = [e[::-1] for e in _errors(x[::-1], clean[::-1], width, spread)]
        found = _groups(x, forward, backward, threshold, width)
        found[common] = 0.0
        if np.array_equal(found > 0, sizes > 0):
            return found
        sizes = found
        good = np.flatnonzero(sizes == 0)
        clean = np.interp(np.arange(x.size), good, x[good])
    return sizes


def _common_levels(x: Array) -> NDArray[np.bool_]:
    """Samples of a held signal (steps, PRBS) at a level that it visits often: a level is no outlier."""
    _, inverse, counts = np.unique(x, return_inverse=True, return_counts=True)
    common: NDArray[np.bool_] = counts[inverse] >= max(3, 0.001 * x.size)
    return common


def _errors(x: Array, clean: Array, width: int, spread: float) -> list[Array]:
    """Errors of the 1 to `width` step predictions of x from the clean past, in local robust sd."""
    weights = fit_arx(clean, (), _ORDER, ()).coefficients
    errors = []
    lagged = [np.concatenate((np.full(lag, clean[0]), clean[:-lag])) for lag in range(1, _ORDER + width)]
    for horizon in range(1, width + 1):
        past = lagged[horizon - 1 :]  # newest first: samples up to t - horizon, then the predictions on the way to t
        for _ in range(horizon):
            terms = zip(weights[:_ORDER], past, strict=False)
            past = [sum((w * p for w, p in terms), np.full(x.size, weights[-1])), *past]
        error = x - past[0]
        errors.append(error / _local_scale(error, spread))
    return errors


def _local_scale(error: Array, spread: float) -> Array:
    """Robust sd of errors around each sample: the largest of its own and the two neighbouring blocks."""
    n_blocks = max(1, error.size // _BLOCK)
    blocks = np.array([np.median(np.abs(b)) for b in np.array_split(error, n_blocks)])
    wide = np.concatenate((blocks[:1], blocks, blocks[-1:]))
    widest = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    lengths = [b.size for b in np.array_split(error, n_blocks)]
    # The floor keeps round-off of a noise-free record from being its own measure.
    scale: Array = np.repeat(np.maximum(_MAD_TO_SD * widest, 1e-6 * spread), lengths)
    return scale


def _groups(x: Array, forward: list[Array], backward: list[Array], threshold: float, width: int) -> Array:
    """Mark groups of up to `width` samples, all of which stand out from both sides and in the same direction."""
    sizes = np.zeros(x.size)
    reach = _ORDER + width
    for length in range(1, width + 1):
        starts = np.arange(reach, x.size - reach - length + 1)
        for sign in (1.0, -1.0):
            marked = np.ones(starts.size, dtype=bool)
            least = np.full(starts.size, np.inf)
            edge = np.maximum(sign * x[starts - 1], sign * x[starts + length])
            for j in range(length):
                error = np.minimum(sign * forward[j][starts + j], sign * backward[length - 1 - j][starts + j])
                marked &= (error > threshold) & (sign * x[starts + j] > edge)
                least = np.minimum(least, error)
            for j in range(length):
                at = starts[marked] + j
                sizes[at] = np.maximum(sizes[at], least[marked])
    return sizes
