"""Drop-outs: a channel that stands still, or falls to zero, for longer than its quantisation explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record
from ambid.signals._channels import equal_runs, finite
from ambid.signals.resolution import level_spacing
from ambid.signals.saturation import find_saturation

_ZERO_JUMP = 8.0  # robust sd of the sample-to-sample change that a fall to zero has to exceed, going and coming


@dataclass(frozen=True, slots=True, kw_only=True)
class Dropouts:
    """Stretches in which a channel stood still or fell to zero.

    Attributes
    ----------
    channel : str
        Channel looked at.
    spans : tuple of (int, int)
        First sample and number of samples of each stretch.
    n_samples : int
        Samples of the channel.
    first_s : float or None
        Time of the first one in s.
    shortest : int
        Number of equal samples in a row from which on quantisation and chance no longer explain them.
    """

    channel: str
    spans: tuple[tuple[int, int], ...]
    n_samples: int
    first_s: float | None
    shortest: int

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
            f"{self.channel}: {self.count} samples ({100 * self.fraction:.2g} %) in {len(self.spans)} drop-out"
            f"{'s' if len(self.spans) > 1 else ''}, the first at sample {self.first_index} ({self.first_s:.6g} s), "
            f"the longest {max(n for _, n in self.spans)} samples"
        )


def find_dropouts(record: Record, name: str, *, false_alarm: float = 1e-4) -> Dropouts:
    """Find stretches in which a channel stands still or falls to zero; nothing is replaced (see `replace_samples`).

    Parameters
    ----------
    record : Record
        The record to look at.
    name : str
        Channel.
    false_alarm : float
        Probability that a whole record without drop-outs gives one, if repeated samples came by chance at the
        rate at which they come in this record. Steps and PRBS, which hold their levels all the time, therefore pass.

    Returns
    -------
    Dropouts
        The stretches, without those at a limit that `find_saturation` reports; all samples in one for a channel that
        never changes. In a channel that moves without any noise (a simulated one) equal samples are taken as rest.

    Raises
    ------
    RecordError
        If the channel cannot be used or `false_alarm` is not between 0 and 1.
    """
    x = finite(record, name)
    if not 0.0 < false_alarm < 1.0:
        raise RecordError(f"find_dropouts got false_alarm {false_alarm}; it must lie between 0 and 1. Give e.g. 1e-4")
    shortest = longest_chance_run(x, false_alarm) + 1
    starts, lengths = equal_runs(x)
    saturation = find_saturation(record, name)
    limits = [limit.value for limit in (saturation.lower, saturation.upper) if limit]
    still = _stands_still(x, starts, lengths, shortest) & ~np.isin(x[starts], limits)
    marked = still | _falls_to_zero(x, starts)
    spans = tuple((int(s), int(n)) for s, n in zip(starts[marked], lengths[marked], strict=True))
    first = record.start_s + spans[0][0] / record.rate_hz if spans else None
    return Dropouts(channel=name, spans=spans, n_samples=x.size, first_s=first, shortest=shortest)


def longest_chance_run(x: Array, false_alarm: float = 1e-4) -> int:
    """Return the longest run of equal samples that chance explains.

    With p the probability that a sample repeats the one before it, a run of r samples begins at a given place with
    probability p^(r-1); over n places it stays under `false_alarm` for r > 1 + log(false_alarm/n)/log(p).

    `x`: (n_samples,), any unit, samples; `false_alarm`: probability over the whole record. Returns samples, at least 3;
    n_samples - 1 at most, so that a channel that never changes is always one run too long.
    """
    p = 1.0 - equal_runs(x)[0].size / x.size
    if p == 0.0 or x.size < 5:
        return 3
    return int(np.clip(np.ceil(1.0 + np.log(false_alarm / x.size) / np.log(p)), 3, x.size - 1))


def _stands_still(x: Array, starts: np.ndarray, lengths: np.ndarray, shortest: int) -> np.ndarray:
    """Runs too long for chance that are not the slow turning point of a quantised channel, nor rest without noise."""
    if starts.size == 1:
        return np.ones(1, dtype=bool)
    if _without_noise(x):
        return np.zeros(starts.size, dtype=bool)
    changes = np.abs(np.diff(x[starts]))
    jump = np.maximum(np.concatenate((changes, [0.0])), np.concatenate(([0.0], changes)))
    # A turning point is entered and left by one quantum, and its neighbouring levels are held long as well.
    padded = np.concatenate((np.full(2, np.nan), lengths.astype(np.float64), np.full(2, np.nan)))
    around = np.nanmean(np.stack([padded[k : k + lengths.size] for k in (0, 1, 3, 4)]), axis=0)
    abrupt = (jump > 1.5 * level_spacing(x)) | (lengths > 10.0 * around)
    return np.asarray((lengths >= shortest) & abrupt)


def _without_noise(x: Array) -> bool:
    """Whether the channel moves smoothly, as only a simulated one does: then equal samples are rest."""
    fourth = np.abs(np.diff(x, 4))
    moving = np.diff(x)[:-3] != 0.0
    return bool(moving.any() and np.median(fourth[moving]) < 1e-4 * np.std(x))


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
