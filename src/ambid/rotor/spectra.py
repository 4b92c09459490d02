"""Period spectra of a record, as the estimator of a rotor sees them: whole periods of its excitation, whose discrete
Fourier transform, over the samples, holds each line's amplitude (Pintelon and Schoukens 2012, ch. 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.predictor import noise_floor
from ambid.physics.linear_model import LinearModel
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record, cut
from ambid.signals.periodic_response import excited_lines, find_period, transient_ratio

_TRANSIENT = 5.0  # standard deviations by which a first period may differ from the others
LEAST_PERIODS = 2
"""Whole periods of a record whose spectra are used."""
_OTHER = 0.5  # change of an excitation from period to period, over its rms, from which it is another experiment
_BROKEN = 3  # periods, half of one apart, that a break may lie in
_SAME_COURSE = 0.4  # correlation of two periods from which they are one excitation
_FIRST_LINE = 10  # of a window's spectrum: below, what leaks from the edges is not small
LEAST_LINES = 20
"""Lines of a rotor's record that are excited, at least."""
_MOST_LINES = 1200
_MOST_WINDOWS = 4000  # in which noise is looked at
_LINES_PER_UNKNOWN = 3
_FLOOR = 1e-3  # power of the reference, over its largest, from which a line is excited
_CLEAR = 25.0  # power of a position, over its noise, from which it is seen
_MOST_BETWEEN = 1600  # lines between the excited ones that are kept
_SYNCHRONOUS_LINES = 1.5  # lines beside a harmonic of the speed that are left out on either side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Excitation:
    """Periodic excitation of a record: its period in samples, where the first period that is used begins, how many."""

    period: int
    first: int
    count: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Between:
    """Spectra of the whole record between the excited lines, noise alone, scaled as those of one period: over all
    periods at once less leaks from line to line.
    """

    frequency_hz: Array  # (n_between,)
    U: Complex
    Y: Complex

    @classmethod
    def of(cls, parts: Sequence[Between]) -> Between:
        """Return those of several records one after the other."""
        return cls(
            frequency_hz=np.concatenate([x.frequency_hz for x in parts]), U=np.concatenate([x.U for x in parts]),
            Y=np.concatenate([x.Y for x in parts]),
        )  # fmt: skip

    def part(self, keep: NDArray[np.bool_]) -> Between:
        """Return some of them."""
        return Between(frequency_hz=self.frequency_hz[keep], U=self.U[keep], Y=self.Y[keep])


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodSpectra:
    """Spectra at the excited lines, by period: `U` (n_periods, n_lines, n_u), `Y` (n_periods, n_lines, n_y)."""

    frequency_hz: Array  # (n_lines,)
    U: Complex
    Y: Complex
    R: Complex | None  # (n_lines, n_axes), mean of the references; zero where an axis has none
    rate_hz: float
    period: int  # samples
    dropped: int  # samples before the first period that is used
    between: Between  # empty of windowed spectra
    # variances of a spectrum where there is no second one to show them: of inputs and outputs, (n_lines, n)
    known_scatter: tuple[Array, Array] | None = None

    @property
    def n_periods(self) -> int:
        """Number of periods."""
        return int(self.U.shape[0])

    @cached_property
    def mean_u(self) -> Complex:
        """Mean over the periods, (n_lines, n_u)."""
        return np.asarray(self.U.mean(axis=0))

    @cached_property
    def mean_y(self) -> Complex:
        """Mean over the periods, (n_lines, n_y)."""
        return np.asarray(self.Y.mean(axis=0))

    @cached_property
    def omega(self) -> Array:
        """Angular frequency of the lines, rad/s."""
        return 2.0 * np.pi * self.frequency_hz

    @cached_property
    def scatter(self) -> tuple[Array, Array]:
        """Variance of one period's spectra, smoothed over lines: of the inputs and of the outputs."""
        if self.known_scatter is not None:
            return self.known_scatter
        return smoothed(np.var(self.U, axis=0, ddof=1)), smoothed(np.var(self.Y, axis=0, ddof=1))

    def scatter_of(self, e: Complex) -> Array:
        """Return the variance of one period's residuals `e` (n_periods, n_lines, n_y), smoothed over lines."""
        return self.scatter[1] if self.known_scatter is not None else smoothed(np.var(e, axis=0, ddof=1))

    def lines(self, keep: NDArray[np.bool_]) -> PeriodSpectra:
        """Return the spectra at some of the lines."""
        return PeriodSpectra(
            frequency_hz=self.frequency_hz[keep], U=self.U[:, keep], Y=self.Y[:, keep],
            R=None if self.R is None else self.R[keep], rate_hz=self.rate_hz, period=self.period, dropped=self.dropped,
            between=self._beside(keep),
            known_scatter=None if (known := self.known_scatter) is None else (known[0][keep], known[1][keep]),
        )  # fmt: skip

    def _beside(self, keep: NDArray[np.bool_]) -> Between:
        f, spacing = self.between.frequency_hz, self.rate_hz / self.period
        low, high = self.frequency_hz[keep][[0, -1]]
        return self.between.part((f >= low - spacing) & (f <= high + spacing))


def joined(spectra: Sequence[PeriodSpectra]) -> PeriodSpectra:
    """Return the lines of several records one after the other, with as many periods as all have."""
    first, n = spectra[0], min(s.n_periods for s in spectra)
    if len(spectra) == 1:
        return first
    references, other = [s.R for s in spectra], [s.known_scatter for s in spectra if s.known_scatter is not None]
    logged = [r for r in references if r is not None]
    return PeriodSpectra(
        frequency_hz=np.concatenate([s.frequency_hz for s in spectra]),
        U=np.concatenate([s.U[-n:] for s in spectra], axis=1), Y=np.concatenate([s.Y[-n:] for s in spectra], axis=1),
        R=np.concatenate(logged) if len(logged) == len(references) else None, rate_hz=first.rate_hz,
        period=first.period, dropped=first.dropped,
        known_scatter=(np.concatenate([k[0] for k in other]), np.concatenate([k[1] for k in other])) if other else None,
        between=Between.of([s.between for s in spectra]),
    )  # fmt: skip


def smoothed(power: Array, half: int = 12) -> Array:
    """Return powers averaged over neighbouring lines, (n_lines, n)."""
    width = min(2 * half + 1, power.shape[0])
    sums = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    first = np.clip(np.arange(power.shape[0]) - width // 2, 0, power.shape[0] - width)
    return np.asarray((sums[first + width] - sums[first]) / width)


def references_of(model: LinearModel) -> list[str]:
    """Return the roles of the references of a model, one for each axis."""
    return [f"{axis}_reference" for axis in model.axes] if isinstance(model, RotorModel) else ["reference"]


def find_excitation(record: Record, model: LinearModel) -> Excitation | None:
    """Return the periodic excitation of a record, without leading periods of a transient; None if less than two are
    whole.
    """
    signals = _excitations(record, model)
    if not signals:
        return None
    try:
        period = find_period(np.column_stack(signals))
    except EstimationError:
        return None
    n = record.n_samples
    count = n // period
    if count < LEAST_PERIODS or period < 64:
        return None
    first = n - count * period
    y = np.column_stack([record[role].values for role in (*model.inputs, *model.outputs)])
    while count > LEAST_PERIODS:
        parts = y[first:].reshape(count, period, -1)
        if transient_ratio(parts) <= _TRANSIENT:
            break
        first, count = first + period, count - 1
    return Excitation(period=period, first=first, count=count)


def experiments_of(record: Record, model: LinearModel) -> tuple[Record, ...]:
    """Return the experiments of a record, cut where its periodic excitation changes for good, as an orthogonal one
    does; whole where a part would be too short.
    """
    signals = _excitations(record, model)
    try:
        period = find_period(np.column_stack(signals)) if signals else record.n_samples
    except EstimationError:
        return (record,)
    count = record.n_samples // period
    if count <= 2 * LEAST_PERIODS:
        return (record,)
    parts = np.column_stack(signals)[: count * period].reshape(count, period, -1)
    moved = np.mean((parts[1:] - parts[:-1]) ** 2, axis=(1, 2)) > _OTHER**2 * np.mean(parts**2)
    edges = [0, *(np.flatnonzero(moved) + 1).tolist(), count]
    if len(edges) == 2 or min(np.diff(edges)) <= LEAST_PERIODS:  # one period more, for its transient
        return (record,)
    at = [*(record.start_s + edge * period / record.rate_hz for edge in edges[:-1]), None]
    return tuple(cut(record, first, last) for first, last in pairwise(at))


@dataclass(frozen=True, slots=True, kw_only=True)
class Slip:
    """Where the phase of a periodic excitation jumps: samples that a log lost, negative where it holds some twice."""

    at_s: float
    samples: int  # but for whole periods, which leave the phase as it is
    period: int


def find_slip(record: Record, model: LinearModel) -> Slip | None:
    """Return the jump of phase between the first period of a record and its last, by their correlation, None without:
    up to a break it stays where it is, and from there on.

    The period is that of either half of the record: one of them holds no jump.
    """
    if not (signals := _excitations(record, model)):
        return None
    x, n, found = np.column_stack(signals), record.n_samples, dict[int, float]()
    for half in (x[: n // 2], x[n // 2 :]):
        try:
            period = find_period(half)
        except EstimationError:
            continue
        found[period] = float(np.median(np.sum((x[period:] - x[:-period]) ** 2, axis=1)))  # most samples see no jump
    if not found:
        return None
    period = min(found, key=lambda p: found[p])
    starts = [*range(0, n - period, max(1, period // 2)), n - period]
    shifts, (alike, power) = np.zeros(len(starts), dtype=int), (np.zeros(period), 0.0)
    for j, start in enumerate(starts):
        alike, power = _alike(x[:period], np.roll(x[start : start + period], start % period, axis=0))
        shifts[j] = -((int(np.argmax(alike)) + period // 2) % period - period // 2)
    k = int(shifts[-1])
    if not k or alike.max() < _SAME_COURSE * power or power - alike.max() > 0.5 * (power - alike[0]):  # as noise moves
        return None
    before, after = (int(np.argmin([*(q == s for q in part), False])) for s, part in ((0, shifts), (k, shifts[::-1])))
    if max(before, after) < 2 or before + after < len(starts) - _BROKEN:  # it drifts, or wanders
        return None
    moved = np.sum((x[period:] - x[:-period]) ** 2, axis=1)
    inside = int(np.flatnonzero(np.cumsum(moved) > 0.5 * moved.sum())[0]) + period // 2
    return Slip(at_s=inside / record.rate_hz, samples=k, period=period)


def _alike(a: Array, b: Array) -> tuple[Array, float]:
    """Return the correlation of one period with another, and what it is of one with itself."""
    first, last = (np.fft.rfft(part - part.mean(axis=0), axis=0) for part in (a, b))
    own = [np.fft.irfft(np.sum(np.abs(s) ** 2, axis=1), a.shape[0])[0] for s in (first, last)]
    return np.fft.irfft(np.sum(first.conj() * last, axis=1), a.shape[0]), float(np.sqrt(np.prod(own)))


def _excitations(record: Record, model: LinearModel) -> list[Array]:
    """Return the references that are logged and not idle, else the inputs."""
    roles = [role for role in references_of(model) if role in record]
    return [record[role].values for role in (roles or model.inputs) if np.ptp(record[role].values) > 0.0]


def period_spectra(record: Record, model: LinearModel, run: Excitation, speed: float = 0.0) -> PeriodSpectra:
    """Return the spectra of a record's periods at its excited lines, those beside harmonics of the speed (rad/s) left
    out.
    """
    n, rate = run.period, record.rate_hz

    def spectra(roles: Sequence[str]) -> Complex:
        x = np.column_stack([record[role].values for role in roles])[run.first : run.first + run.count * n]
        return np.fft.rfft(x.reshape(run.count, n, -1), axis=1) / n

    U, Y = spectra(model.inputs), spectra(model.outputs)
    references = references_of(model)
    logged = [role for role in references if role in record]
    R = np.zeros((U.shape[1], len(references)), dtype=complex)
    if logged:
        R[:, [references.index(role) for role in logged]] = spectra(logged).mean(axis=0)
    within = slice(1, (n + 1) // 2)
    clean = (R if logged else U.mean(axis=0))[None, within]
    scatter = None if logged else np.var(U, axis=0, ddof=1)[within].sum(axis=1) / run.count
    lines = excited_lines(clean, scatter, least=LEAST_LINES)[0] + 1
    frequency: Array = np.asarray(lines * (rate / n), dtype=np.float64)
    near = beside_harmonics(frequency, speed / (2.0 * np.pi), rate / n)
    if np.count_nonzero(~near) < LEAST_LINES:
        raise EstimationError(
            f"the excitation of the record has {lines.size} lines, {np.count_nonzero(near)} of them beside harmonics "
            "of the speed; a rotor needs 20 others. Excite more lines: a multisine with whole periods"
        )
    keep = lines[~near]
    return PeriodSpectra(
        frequency_hz=frequency[~near], U=U[:, keep], Y=Y[:, keep], R=R[keep] if logged else None, rate_hz=rate,
        period=n, dropped=run.first,
        between=_between(record, model, run, keep, speed / (2.0 * np.pi)),
    )  # fmt: skip


def windowed_spectra(record: Record, model: RotorModel, speed: float = 0.0) -> PeriodSpectra:
    """Return the spectra of a record under a Hann window, at lines where it moves: rough, for start values; speed in
    rad/s.
    """
    n, rate = record.n_samples, record.rate_hz
    window: Array = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)

    def spectra(roles: Sequence[str]) -> Complex:
        x = np.column_stack([record[role].values for role in roles])
        return np.fft.rfft((x - x.mean(axis=0)) * window[:, None], axis=0)[: (n + 1) // 2] / n

    U, Y = spectra(model.inputs), spectra(model.outputs)
    # where nothing but noise goes round a closed loop, inputs explain the outputs all too well: a sensor's own is there
    white = noise_floor(np.column_stack([record[role].values for role in model.outputs]))
    noise = np.maximum(_scatter(U, Y), white**2 * float(np.mean(window**2)) / n)
    frequency: Array = np.arange(U.shape[0], dtype=np.float64) * (rate / n)
    half = max(2, U.shape[0] // 2000)
    n_x = len(model.sensors)
    visible = np.max(smoothed(np.abs(Y[:, :n_x]) ** 2, half) / noise[:, :n_x], axis=1) > _CLEAR
    logged = [role for role in references_of(model) if role in record]
    if logged:
        excited = smoothed(np.abs(spectra(logged)) ** 2, half).sum(axis=1)
        visible &= excited > _FLOOR * np.max(excited[_FIRST_LINE:])
    visible = smoothed(visible[:, None].astype(np.float64), half)[:, 0] > 1.0 - 1e-9  # no edge within reach
    visible[:_FIRST_LINE] = False
    visible &= ~beside_harmonics(frequency, speed / (2.0 * np.pi), 3.0 * rate / n)
    lines = np.flatnonzero(visible)
    if lines.size < LEAST_LINES:
        raise EstimationError(
            f"the record shows motion above its noise at {lines.size} lines; a rotor needs 20. Excite more, and more "
            "frequencies, or record longer"
        )
    keep = lines[np.unique(np.linspace(0, lines.size - 1, _MOST_LINES).round().astype(int))]
    return PeriodSpectra(
        frequency_hz=frequency[keep], U=U[None, keep], Y=Y[None, keep], R=None, rate_hz=rate, period=n, dropped=0,
        known_scatter=(np.zeros((keep.size, U.shape[1])), noise[keep]),
        between=Between(frequency_hz=np.zeros(0), U=U[:0], Y=Y[:0]),
    )  # fmt: skip


def _scatter(U: Complex, Y: Complex) -> Array:
    """Return the variance of what inputs do not explain of outputs, (n_lines, n_y), by first-order local polynomials
    (Pintelon and Schoukens 2012, sec. 7.2) in bands of equal width.
    """
    n, n_u = U.shape
    width = min(_LINES_PER_UNKNOWN * 2 * (n_u + 1), n)
    starts = np.unique(np.linspace(0, n - width, min(max(2, 2 * n // width), _MOST_WINDOWS)).round().astype(int))
    at = starts[:, None] + np.arange(width)
    own = np.concatenate([U[at], np.ones((*at.shape, 1))], axis=2)
    regressors = np.concatenate([own, own * np.linspace(-1.0, 1.0, width)[:, None]], axis=2)
    Q = np.linalg.qr(regressors)[0]
    left = Y[at] - Q @ (np.conj(np.swapaxes(Q, 1, 2)) @ Y[at])
    variance = np.sum(np.abs(left) ** 2, axis=1) / (width - regressors.shape[2])
    middle = starts + 0.5 * (width - 1)
    return np.stack([np.interp(np.arange(n), middle, v) for v in variance.T], axis=1)


def _between(
    record: Record, model: LinearModel, excitation: Excitation, lines: NDArray[np.intp], speed_hz: float
) -> Between:
    """Return the spectra between the excited lines, thinned where they are many."""
    count, n = excitation.count, excitation.period
    bins = (lines[:, None] * count + np.arange(1, count)).ravel()
    bins = bins[bins <= n * count // 2]  # none above half the rate, where the highest line may be
    frequency = np.asarray(bins * (record.rate_hz / (n * count)), dtype=np.float64)
    clean = ~beside_harmonics(frequency, speed_hz, record.rate_hz / n)
    every = max(1, bins.size // _MOST_BETWEEN)
    bins, frequency = bins[clean][::every], frequency[clean][::every]

    def spectra(roles: Sequence[str]) -> Complex:
        signals = (record[role].values[excitation.first : excitation.first + count * n] for role in roles)
        stacked: Complex = np.stack([np.fft.rfft(x)[bins] for x in signals], axis=1)
        return stacked / (n * float(np.sqrt(count)))

    return Between(frequency_hz=frequency, U=spectra(model.inputs), Y=spectra(model.outputs))


def beside_harmonics(frequency_hz: Array, speed_hz: float, spacing_hz: float) -> NDArray[np.bool_]:
    """Return which lines stand within one and a half line spacings of a harmonic of the speed."""
    if speed_hz == 0.0:
        return np.zeros(frequency_hz.size, dtype=np.bool_)
    order = np.maximum(np.round(frequency_hz / speed_hz), 1.0)
    return np.asarray(np.abs(frequency_hz - order * speed_hz) <= _SYNCHRONOUS_LINES * spacing_hz)
