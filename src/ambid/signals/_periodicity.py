"""Periodic experiments, found from the data: period, excited lines, experiments of a record, transients."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.signals._channels import runs
from ambid.signals.frf import Complex

Lines = NDArray[np.intp]
_LARGEST_GAP_FROM = 1e-3  # of the largest line: no line under it counts as excited


def find_period(x: Array) -> int:
    """Find the period of an excitation: the smallest shift under which it comes back.

    The mean square difference d(τ) between the signal and itself τ later, over that of unrelated stretches, is 0 at
    the period (noise over total power with noise). The first local minimum that is nearly as deep as the deepest,
    after d has once risen over a half, is taken.

    Parameters
    ----------
    x : ndarray, shape (n_samples,) or (n_samples, n_channels), any unit
        Excitation, at least a period and a thirty-second of one.

    Returns
    -------
    int
        Period in samples.

    Raises
    ------
    EstimationError
        If nothing comes back.
    """
    x = x[:, None] if x.ndim == 1 else x
    d = np.mean([_differences(column) for column in x.T], axis=0)
    risen = int(np.argmax(d > 0.5)) if np.any(d > 0.5) else d.size
    low = np.flatnonzero((d[1:-1] <= d[:-2]) & (d[1:-1] <= d[2:])) + 1 if d.size > 2 else np.zeros(0, dtype=np.intp)
    low = low[low > risen]
    if not low.size or d[low].min() > 0.3:
        raise EstimationError(
            f"no period found in {x.shape[0]} samples of the excitation; a period and a part of the next must be in "
            "it. Give the period, or use the local or the random method (--method)"
        )
    deepest = float(d[low].min())
    # A multiple of the period is as deep but for noise: the first that is not clearly shallower is the period.
    return int(low[np.argmax(d[low] <= 2.0 * deepest + 1e-3)])


def find_experiments(x: Array, *, quiet: int = 50, margin: int = 0) -> tuple[slice, ...]:
    """Find the experiments of a record: stretches of excitation between rests, at least as long as a rest.

    A rest is a stretch in which no channel leaves a band of 2 % of its largest deviation.

    Parameters
    ----------
    x : ndarray, shape (n_samples,) or (n_samples, n_channels), any unit
        Excitation.
    quiet : int
        Least samples of a rest.
    margin : int
        Samples left out at the end of each experiment, where the excitation fades through its filter and is no longer
        periodic.

    Returns
    -------
    tuple of slice
        Samples of each experiment, in order.

    Raises
    ------
    EstimationError
        If the signal rests all the time.
    """
    x = x[:, None] if x.ndim == 1 else x
    level = np.median(x, axis=0)
    for _ in range(2):  # the median of an excitation is not its rest: refine on the quiet samples
        size = np.max(np.abs(x - level), axis=0)
        calm = np.all(np.abs(x - level) <= 0.02 * size, axis=1)
        starts, lengths = runs(calm)
        rests = [(s, s + n) for s, n in zip(starts, lengths, strict=True) if n >= quiet]
        if rests:
            level = np.median(np.concatenate([x[a:b] for a, b in rests]), axis=0)
    if not np.all(size > 0) or sum(b - a for a, b in rests) == x.shape[0]:
        raise EstimationError("the excitation rests all the time; there is no experiment in it. Pass the driven signal")
    edges = [0, *(edge for rest in rests for edge in rest), x.shape[0]]
    both = zip(edges[::2], edges[1::2], strict=True)
    return tuple(slice(int(a), int(b) - margin) for a, b in both if b - a >= quiet + margin)


def excited_lines(mean: Complex, noise: Array | None) -> tuple[Lines, bool]:
    """Return the excited lines of spectra `mean` (n_experiments, n_lines, n_channels), and whether a gap shows them.

    The lines are those over the largest gap in the sorted amplitudes, of 12 dB at least; without such a gap all that
    are within 60 dB of the largest and 10 dB over their own noise power `noise` (n_lines,).
    """
    power = np.sum(np.abs(mean) ** 2, axis=(0, 2))
    if not np.any(power > 0):
        raise EstimationError("the excitation has no power at any line of the period. Check the period")
    level = np.log(np.maximum(power, np.finfo(float).tiny))
    order = np.argsort(level)[::-1]
    high = int(np.sum(power > power.max() * _LARGEST_GAP_FROM**2))
    falls = level[order[:-1]] - level[order[1:]]
    last = int(np.argmax(falls[:high])) if falls.size else 0
    clear = bool(falls.size and falls[:high].max() > np.log(10.0**1.2))
    lines = np.sort(order[: last + 1]) if clear else np.sort(order[:high])
    if not clear and noise is not None:
        lines = lines[power[lines] > 10.0 * noise[lines]]
        if not lines.size:
            raise EstimationError("no line of the excitation stands 10 dB above its noise. Average more periods")
    return lines, clear


def without_strays(lines: Lines) -> tuple[Lines, Lines]:
    """Return excited lines and strays: even lines among an odd excitation (under 5 % of all), such as mains hum."""
    odd = (lines + 1) % 2 == 1
    if 0 < np.sum(~odd) < 0.05 * lines.size:
        return lines[odd], lines[~odd]
    return lines, lines[:0]


def transient_ratio(periods: Array) -> float:
    """Return how many standard deviations the first of P >= 3 periods (P, n, n_z) differs more than noise allows.

    Its mean square distance from the mean of the others is compared with theirs; the number of independent samples is
    that of the noise spectrum, (Σ S)²/Σ S². The worst channel counts.
    """
    count = periods.shape[0]
    rest = periods[1:]
    noise = np.fft.rfft(rest - rest.mean(axis=0), axis=1)[:, 1:]
    S = np.mean(np.abs(noise) ** 2, axis=0) * (count - 1) / (count - 2)
    first = np.fft.rfft(periods[0] - rest.mean(axis=0), axis=0)[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.sum(np.abs(first) ** 2, axis=0) / np.sum(S, axis=0) / (1.0 + 1.0 / (count - 1))
        lines = np.sum(S, axis=0) ** 2 / np.sum(S**2, axis=0)
        sd = np.sqrt((1.0 + 1.0 / (count - 2)) / np.maximum(lines, 1.0))
    # Without noise, round-off is not a transient.
    size = np.sqrt(np.mean(np.square(periods), axis=(0, 1)))
    exact = np.sqrt(np.mean(np.square(periods[0] - rest.mean(axis=0)), axis=0)) < 1e-9 * size
    return float(np.max(np.where(exact | ~np.isfinite(found), 0.0, (found - 1.0) / sd)))


def _differences(x: Array) -> Array:
    """Return d(τ), 0 for equal and 1 for unrelated stretches, 1 where too little is left to compare.

    Enough is a whole τ, or a thirty-second of it that holds 16 independent samples, (Σ S)²/Σ S² in the whole record.
    """
    x = x - x.mean()
    n = x.size
    size = 1 << (2 * n - 1).bit_length()
    F = np.fft.rfft(x, size)
    products = np.fft.irfft(np.abs(F) ** 2, size)[:n]
    energy = np.concatenate(([0.0], np.cumsum(x**2)))
    shifts = np.arange(n)
    both = energy[n - shifts] + energy[n] - energy[shifts]
    d = np.divide(both - 2.0 * products, both, out=np.ones(n), where=both > 1e-12 * energy[n])
    S = np.abs(F[1:]) ** 2
    independent = float(np.sum(S) ** 2 / np.sum(S**2)) * 2.0 / size
    left = n - shifts
    enough = (left >= shifts) | ((left >= shifts / 32) & (left * independent >= 16))
    return np.asarray(np.where(enough, d, 1.0))
