"""What is wrong with samples: drop-outs, outliers, saturation, coarse quantisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RecordError, counted
from ambid.record.record import Record
from ambid.signals.conditioning import equal_runs, finite, runs
from ambid.signals.delay import lagged_triangle

_FALSE_ALARM = 1e-4  # probability of a drop-out in a whole record without one
_ZERO_JUMP = 8.0  # robust sd of the sample-to-sample change that a fall to zero has to exceed, going and coming


@dataclass(frozen=True, slots=True, kw_only=True)
class Dropouts:
    """Stretches in which a channel stood still or fell to zero."""

    channel: str  # channel looked at
    spans: tuple[tuple[int, int], ...]  # first sample and number of samples of each stretch
    n_samples: int  # samples of the channel
    first_s: float | None  # time of the first one in s
    shortest: int  # number of equal samples in a row from which on quantisation and chance no longer explain them

    @property
    def count(self) -> int:
        """Number of samples in all stretches."""
        return sum(length for _, length in self.spans)

    @property
    def first_index(self) -> int | None:
        """First sample of the first stretch, or None."""
        return self.spans[0][0] if self.spans else None

    @property
    def fraction(self) -> float:
        """Part of the channel's samples, 0 to 1."""
        return self.count / self.n_samples

    @property
    def indices(self) -> np.ndarray:
        """All samples concerned, for `replace_samples`, shape (count,)."""
        return np.concatenate([np.arange(s, s + n) for s, n in self.spans] or [np.zeros(0, dtype=np.intp)])

    def __str__(self) -> str:
        if not self.spans:
            return f"{self.channel}: no drop-outs"
        if self.count == self.n_samples:
            return f"{self.channel}: never changes over its {self.n_samples} samples (dead or unused)"
        return (
            f"{self.channel}: {counted(self.count, 'sample')} ({100 * self.fraction:.2g} %) in "
            f"{counted(len(self.spans), 'drop-out')}, the first at sample {self.first_index} ({self.first_s:.6g} "
            f"s), the longest {counted(max(n for _, n in self.spans), 'sample')}"
        )


def find_dropouts(record: Record, name: str, *, saturation: Saturation | None = None) -> Dropouts:
    """Find stretches in which a channel stands still or falls to zero; nothing is replaced (see `replace_samples`).

    One record in 10000 without drop-outs gives one, if repeated samples come by chance as often as in this record.
    Steps and PRBS, which hold their levels all the time, therefore pass.

    Parameters
    ----------
    record : Record
    name : str, a channel
    saturation : Saturation, optional
        What `find_saturation` found in this channel, where that is known already: it sorts the whole channel.

    Returns
    -------
    Dropouts
        Without those at a limit that `find_saturation` reports; all samples in one for a channel that never changes. In
        a channel that moves without any noise (a simulated one) equal samples are taken as rest.

    Raises
    ------
    RecordError
        If the channel cannot be used.
    """
    x = finite(record, name)
    shortest = longest_chance_run(x) + 1
    starts, lengths = equal_runs(x)
    saturation = find_saturation(record, name) if saturation is None else saturation
    limits = [limit.value for limit in (saturation.lower, saturation.upper) if limit]
    still = _stands_still(x, starts, lengths, shortest) & ~np.isin(x[starts], limits)
    marked = still | _falls_to_zero(x, starts)
    spans = tuple((int(s), int(n)) for s, n in zip(starts[marked], lengths[marked], strict=True))
    first = record.start_s + spans[0][0] / record.rate_hz if spans else None
    return Dropouts(channel=name, spans=spans, n_samples=x.size, first_s=first, shortest=shortest)


def longest_chance_run(x: Array) -> int:
    """Return the longest run of equal samples that chance explains, at least 3 and at most n_samples - 1, so that a
    channel that never changes is one run too long.

    With p the probability that a sample repeats the one before it, a run of r begins at a given place with probability
    p^(r-1); over n places it stays under 1e-4 for r > 1 + log(1e-4/n)/log(p).
    """
    p = 1.0 - equal_runs(x)[0].size / x.size
    if p == 0.0 or x.size < 5:
        return 3
    return int(np.clip(np.ceil(1.0 + np.log(_FALSE_ALARM / x.size) / np.log(p)), 3, x.size - 1))


def _stands_still(x: Array, starts: np.ndarray, lengths: np.ndarray, shortest: int) -> np.ndarray:
    """Runs too long for chance that are not the slow turning point of a quantised channel, nor rest without noise."""
    if starts.size == 1:
        return np.ones(1, dtype=bool)
    if not np.any(lengths >= shortest):
        return np.zeros(starts.size, dtype=bool)
    # a channel that moves smoothly, as only a simulated one does, has no noise: then equal samples are rest
    fourth, moving = np.abs(np.diff(x, 4)), np.diff(x)[:-3] != 0.0
    if moving.any() and np.median(fourth[moving]) < 1e-4 * np.std(x):
        return np.zeros(starts.size, dtype=bool)
    changes = np.abs(np.diff(x[starts]))
    jump = np.maximum(np.concatenate((changes, [0.0])), np.concatenate(([0.0], changes)))
    # A turning point is entered and left by one quantum, and its neighbouring levels are held long as well.
    padded = np.concatenate((np.full(2, np.nan), lengths.astype(np.float64), np.full(2, np.nan)))
    around = np.nanmean(np.stack([padded[k : k + lengths.size] for k in (0, 1, 3, 4)]), axis=0)
    abrupt = (jump > 1.5 * level_spacing(x)) | (lengths > 10.0 * around)
    return np.asarray((lengths >= shortest) & abrupt)


def _falls_to_zero(x: Array, starts: np.ndarray) -> np.ndarray:
    """Runs of exact zeros of any length that are entered and left by a jump far beyond the channel's usual change."""
    levels = x[starts]
    zero = levels == 0.0
    zero[[0, -1]] = False  # an end has no other side to jump back to
    changes = np.abs(np.diff(x))
    usual = 1.4826 * float(np.median(changes))
    rare = 0 < np.count_nonzero(x == 0.0) < 0.05 * x.size
    if usual == 0.0 or not rare or not zero.any():
        return np.zeros(starts.size, dtype=bool)
    at = np.flatnonzero(zero)
    jumps = np.minimum(np.abs(levels[at - 1]), np.abs(levels[at + 1]))
    zero[at] = jumps > _ZERO_JUMP * usual
    return np.asarray(zero)


_ORDER = 4  # of the local predictor: enough for two sines, short enough to look past an outlier
_BLOCK = 100  # samples over which the scale of the innovations is taken as constant
_MAD_TO_SD = 1.4826  # of a Gaussian


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outliers:
    """Samples that neither their past nor their future predicts."""

    channel: str  # channel looked at
    indices: NDArray[np.intp]  # (count,): The samples
    first_s: float | None  # time of the first one in s
    largest_sd: float  # largest prediction error among them, in robust standard deviations of the innovations

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
            f"{self.channel}: {counted(self.count, 'outlier')}, the first at sample {self.first_index} "
            f"({self.first_s:.6g} s), up to {self.largest_sd:.3g} sd of the innovations"
        )


def find_outliers(record: Record, name: str, *, threshold: float = 6.0) -> Outliers:
    """Find outliers of a channel; nothing is replaced (see `replace_samples`).

    Parameters
    ----------
    record : Record
    name : str, a channel
    threshold : float
        Prediction error that makes an outlier, in local robust standard deviations of the innovations (Hampel
        identifier: median absolute value times 1.4826). At 6, Gaussian noise gives less than one in 1e8 samples.

    Returns
    -------
    Outliers
        In order. The first and last few samples, which have no past or future, are not judged.

    Raises
    ------
    RecordError
        If the channel cannot be used, the threshold is out of range, or the record has under 50 samples.
    """
    x = finite(record, name)
    if not threshold >= 3.0:
        raise RecordError(f"find_outliers got threshold {threshold:g}; it must be at least 3. Give another")
    if x.size < 50:
        raise RecordError(
            f"channel {name!r} has {counted(x.size, 'sample')}; outliers need at least 50. Use a longer record"
        )
    sizes = outlier_sizes(x, threshold)
    indices = np.flatnonzero(sizes)
    first = record.start_s + int(indices[0]) / record.rate_hz if indices.size else None
    return Outliers(channel=name, indices=indices, first_s=first, largest_sd=float(sizes.max()))


def outlier_sizes(x: Array, threshold: float = 6.0) -> Array:
    """Return for samples (n_samples,) the prediction error of each outlier in local robust standard deviations, 0 for
    samples that are none.
    """
    spread = float(np.std(x))
    if spread == 0.0:
        return np.zeros(x.size)
    repeated = 1.0 - equal_runs(x)[0].size / x.size
    common = np.zeros(x.size, dtype=bool)
    if repeated > 0.5:  # a held signal (steps, PRBS): a level that it visits often is no outlier
        _, inverse, counts = np.unique(x, return_inverse=True, return_counts=True)
        common = counts[inverse] >= max(3, 0.001 * x.size)
    clean, sizes = x, np.zeros(x.size)
    # An outlier spoils the predictor and the prediction of its neighbours: repeat with the found ones bridged.
    for _ in range(5):
        ahead, behind = _predictors(clean)
        forward = _errors(x, clean, ahead, spread)
        backward = _errors(x[::-1], clean[::-1], behind, spread)[::-1]
        marks = _stand_out(x, forward, backward, threshold)
        marks[common] = 0.0
        if np.array_equal(marks > 0, sizes > 0):
            return marks
        sizes = marks
        good = np.flatnonzero(sizes == 0)
        clean = np.interp(np.arange(x.size), good, x[good])
    return sizes


def _predictors(clean: Array) -> tuple[Array, Array]:
    """Weights of samples before and after, nearest first, then the constant, that predict a sample best; both from the
    triangle of the same windows.
    """
    size, one = float(np.linalg.norm(clean)) or 1.0, 1.0 / np.sqrt(clean.size - _ORDER)
    scaled = clean / size
    windows = [(scaled, lag) for lag in range(_ORDER + 1)]
    triangle = lagged_triangle([*windows, (np.full(clean.size, one), 0)], _ORDER)
    predictors = list[Array]()
    for own, past in ((0, range(1, _ORDER + 1)), (_ORDER, range(_ORDER - 1, -1, -1))):
        # a record without noise makes the samples dependent: the smallest weights among all predict as well
        weights = np.asarray(
            np.linalg.lstsq(triangle[:, [*past, _ORDER + 1]], triangle[:, own], rcond=1e-12)[0], dtype=np.float64
        )
        weights[-1] *= one * size
        predictors.append(weights)
    return predictors[0], predictors[1]


def _errors(x: Array, clean: Array, weights: Array, spread: float) -> Array:
    """Errors of the one-step predictions of x from the clean past, in local robust sd."""
    padded = np.concatenate((np.full(_ORDER, clean[0]), clean[:-1]))
    error = x - (np.convolve(padded, weights[:_ORDER], mode="valid") + weights[-1])
    n_blocks = max(1, error.size // _BLOCK)
    length, longer = divmod(error.size, n_blocks)  # the first blocks are longer by one sample
    cut, size = longer * (length + 1), np.abs(error)
    blocks = np.concatenate(
        [
            np.median(size[:cut].reshape(longer, length + 1), axis=1),
            np.median(size[cut:].reshape(n_blocks - longer, length), axis=1),
        ]
    )
    wide = np.concatenate((blocks[:1], blocks, blocks[-1:]))
    widest = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    lengths = np.full(n_blocks, length)
    lengths[:longer] += 1
    # The floor keeps round-off of a noise-free record from being its own measure.
    scale: Array = np.repeat(np.maximum(_MAD_TO_SD * widest, 1e-6 * spread), lengths)
    return np.asarray(error / scale)


def _stand_out(x: Array, forward: Array, backward: Array, threshold: float) -> Array:
    """Sizes of the samples that stand out from both sides in the same direction, 0 for the others."""
    sizes, inner = np.zeros(x.size), slice(_ORDER + 1, x.size - _ORDER - 1)
    before, after = x[_ORDER : x.size - _ORDER - 2], x[_ORDER + 2 : x.size - _ORDER]
    for sign in (1.0, -1.0):
        error = np.minimum(sign * forward[inner], sign * backward[inner])
        marked = (error > threshold) & (sign * x[inner] > np.maximum(sign * before, sign * after))
        sizes[inner] = np.where(marked, error, sizes[inner])
    return sizes


_FEWEST = 5  # samples at a limit that count as evidence
_PILE = 3.0  # how many times the fullest of the neighbouring levels a limit has to hold
_ROUND_OFF = 1e-9  # of the range: levels that only this keeps apart are one
_NEIGHBOURS = 10  # levels beside the limit that tell how many samples a level holds there


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """One limit at which samples pile up."""

    value: float  # the limit in the channel's unit
    count: int  # samples at it, and those of the longest run
    longest: int
    first_index: int  # first sample at it


@dataclass(frozen=True, slots=True, kw_only=True)
class Saturation:
    """Saturation of a channel."""

    channel: str  # channel looked at and its unit
    unit: str
    lower: Limit | None  # the limits that were reached
    upper: Limit | None
    n_samples: int  # samples of the channel
    first_s: float | None  # time of the first saturated sample in s

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


def find_saturation(record: Record, name: str) -> Saturation:
    """Find samples held at a limit of the channel's range.

    An extreme value is a limit where it holds at least 5 samples and over 3 times as many as any of the 10 levels next
    to it. A quantised sine holds at most 2.4 times as many (its peaks dwell); steps and PRBS hold all their levels. Not
    reported, because the samples alone do not tell it from design or rest: an input of two levels, and an extreme value
    held only from the start of the record (see `find_dropouts`); nor a sensor whose curve flattens without an exact
    limit.

    Parameters
    ----------
    record : Record
    name : str, a channel

    Returns
    -------
    Saturation
        The limits reached, with counts.

    Raises
    ------
    RecordError
        If the channel cannot be used.
    """
    x = finite(record, name)
    lower = upper = None
    if _may_pile(x):
        values, counts = np.unique(x, return_counts=True)
        lower, upper = _pile(x, values, counts), _pile(-x, -values[::-1], counts[::-1])
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


def _may_pile(x: Array) -> bool:
    """Whether as many samples as a limit holds at least lie together at an end: most channels need no sorting."""
    if x.size < 2 * _FEWEST:
        return True
    parted = np.partition(x, (_FEWEST - 1, x.size - _FEWEST))
    ends = (np.sort(parted[:_FEWEST]), np.sort(parted[-_FEWEST:]))
    return any(bool(np.all(np.diff(end) <= _ROUND_OFF * (ends[1][-1] - ends[0][0]))) for end in ends)


def _pile(x: Array, values: Array, counts: NDArray[np.int64]) -> Limit | None:
    """Return the lower extreme of `x` as a limit if samples pile up at it; `values`: its levels, in order."""
    # Levels that only round-off keeps apart are one, as in a computed sine with a whole number of samples per period.
    apart = np.diff(values) > _ROUND_OFF * (values[-1] - values[0])
    level_of = np.concatenate(([0], np.cumsum(apart)))
    samples_at = np.bincount(level_of, weights=counts)
    if samples_at.size < 3 or samples_at[0] < max(_FEWEST, 1 + _PILE * samples_at[1 : 1 + _NEIGHBOURS].max()):
        return None
    at = x <= values[np.flatnonzero(level_of == 0)[-1]]
    starts, lengths = runs(at)
    entered = starts[starts > 0]
    # Rest before the first motion has no way in, and a transient that settles creeps in: neither is a limit.
    if not np.any(x[entered - 1] - x[entered] > 1e-7 * (values[-1] - values[0])):
        return None
    # Nor is a level of a signal that holds its inner levels about as long, as a staircase does by design.
    levels, dwells = equal_runs(x)
    inside = (x[levels] > np.min(x)) & (x[levels] < np.max(x))
    if inside.any() and np.mean(dwells[inside]) > max(3.0, 0.3 * float(np.mean(lengths))):
        return None
    return Limit(
        value=float(values[0]), count=int(lengths.sum()), longest=int(lengths.max()), first_index=int(starts[0])
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Resolution:
    """Quantisation of a channel."""

    channel: str  # channel looked at
    unit: str  # its unit
    step: float  # typical smallest spacing of neighbouring levels, in `unit`; 0 for a channel with one level
    n_levels: int  # number of different values
    n_samples: int  # number of samples
    # part of the spacings that are whole multiples of `step` within 5 %; near 1 for a linear converter, less behind
    # a calibration curve
    uniform: float

    @property
    def quantised(self) -> bool:
        """Whether values repeat enough (on average at least twice) for `step` to be a property of the converter."""
        return 2 * self.n_levels <= self.n_samples

    @property
    def noise_sd(self) -> float:
        """Standard deviation of rounding to `step`, step/√12, in `unit`; 0 if not quantised."""
        return self.step / float(np.sqrt(12.0)) if self.quantised else 0.0

    def __str__(self) -> str:
        if self.n_levels == 1:
            return f"{self.channel}: constant"
        if not self.quantised:
            return f"{self.channel}: not quantised ({self.n_levels} values in {self.n_samples} samples)"
        shape = "" if self.uniform > 0.9 else ", unevenly spaced"
        return f"{self.channel}: quantised in steps of {self.step:.3g} {self.unit} ({self.n_levels} levels{shape})"


def resolution(record: Record, name: str) -> Resolution:
    """Find the quantisation step of a channel.

    Parameters
    ----------
    record : Record
    name : str, a channel

    Returns
    -------
    Resolution
        Spacing and number of levels.

    Raises
    ------
    RecordError
        If the channel cannot be used.
    """
    x = finite(record, name)
    spacings = _spacings(x)
    step = level_spacing(x)
    multiples = spacings / step if step else spacings
    on_grid = float(np.mean(np.abs(multiples - np.round(multiples)) < 0.05)) if spacings.size else 1.0
    return Resolution(
        channel=name,
        unit=record.channel(name).unit,
        step=step,
        n_levels=spacings.size + 1,
        n_samples=x.size,
        uniform=on_grid,
    )


def level_spacing(x: Array) -> float:
    """Return the typical smallest spacing between neighbouring levels, 0 if all samples are equal: the median of the
    spacings up to 1.5 times their 10 % quantile, which neither odd pairs of levels (calibration, clipping) nor missing
    ones move.
    """
    spacings = _spacings(x)
    if not spacings.size:
        return 0.0
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, 0.1)]))


def _spacings(x: Array) -> Array:
    """Differences of neighbouring levels, without those that are only round-off of one level."""
    spacings: Array = np.diff(np.unique(x))
    return spacings[spacings > 1e-12 * max(float(np.max(np.abs(x))), 1e-300)]
