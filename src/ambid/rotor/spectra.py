"""Period spectra of a record: what the frequency-domain estimator of a rotor sees of it.

The record is cut into whole periods of its excitation; each period's discrete Fourier transform, over the number of
samples, holds the amplitude of every line (Pintelon and Schoukens 2012, ch. 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record
from ambid.signals.periodic_response import excited_lines, find_period, transient_ratio

_TRANSIENT = 5.0  # standard deviations by which a first period may differ from the others
_LEAST_PERIODS = 2
_SYNCHRONOUS_LINES = 1.5  # lines beside a harmonic of the speed that are left out on either side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Excitation:
    """Periodic excitation of a record: its period in samples, where the first period that is used begins, how many."""

    period: int
    first: int
    count: int


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
    left_out_hz: Array  # lines near harmonics of the speed

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
        return smoothed(np.var(self.U, axis=0, ddof=1)), smoothed(np.var(self.Y, axis=0, ddof=1))

    def lines(self, keep: NDArray[np.bool_]) -> PeriodSpectra:
        """Return the spectra at some of the lines."""
        return PeriodSpectra(
            frequency_hz=self.frequency_hz[keep], U=self.U[:, keep], Y=self.Y[:, keep],
            R=None if self.R is None else self.R[keep], rate_hz=self.rate_hz, period=self.period, dropped=self.dropped,
            left_out_hz=self.left_out_hz,
        )  # fmt: skip


def joined(spectra: Sequence[PeriodSpectra]) -> PeriodSpectra:
    """Return the lines of several records one after the other, with as many periods as all have."""
    first, n = spectra[0], min(s.n_periods for s in spectra)
    if len(spectra) == 1:
        return first
    references = [s.R for s in spectra]
    logged = [r for r in references if r is not None]
    return PeriodSpectra(
        frequency_hz=np.concatenate([s.frequency_hz for s in spectra]),
        U=np.concatenate([s.U[-n:] for s in spectra], axis=1), Y=np.concatenate([s.Y[-n:] for s in spectra], axis=1),
        R=np.concatenate(logged) if len(logged) == len(references) else None, rate_hz=first.rate_hz,
        period=first.period, dropped=first.dropped, left_out_hz=np.concatenate([s.left_out_hz for s in spectra]),
    )  # fmt: skip


def smoothed(power: Array, half: int = 12) -> Array:
    """Return powers averaged over neighbouring lines, (n_lines, n)."""
    width = min(2 * half + 1, power.shape[0])
    sums = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    first = np.clip(np.arange(power.shape[0]) - width // 2, 0, power.shape[0] - width)
    return np.asarray((sums[first + width] - sums[first]) / width)


def find_excitation(record: Record, model: RotorModel) -> Excitation | None:
    """Return the periodic excitation of a record, None where it is not periodic or has less than two whole periods.

    Leading periods with a transient are left out.
    """
    roles = [f"{axis}_reference" for axis in model.axes if f"{axis}_reference" in record]
    signals = (record[role].values for role in (roles or model.inputs))
    x = np.column_stack([s for s in signals if np.ptp(s) > 0.0] or [np.zeros(record.n_samples)])
    try:
        period = find_period(x)
    except EstimationError:
        return None
    n = record.n_samples
    count = n // period
    if count < _LEAST_PERIODS or period < 64:
        return None
    first = n - count * period
    y = np.column_stack([record[role].values for role in (*model.inputs, *model.outputs)])
    while count > _LEAST_PERIODS:
        parts = y[first:].reshape(count, period, -1)
        if transient_ratio(parts) <= _TRANSIENT:
            break
        first, count = first + period, count - 1
    return Excitation(period=period, first=first, count=count)


def period_spectra(record: Record, model: RotorModel, found: Excitation, speed: float = 0.0) -> PeriodSpectra:
    """Return the spectra of a record's periods at its excited lines, those beside harmonics of the speed left out.

    `speed`: rad/s.
    """
    n, rate = found.period, record.rate_hz

    def spectra(roles: Sequence[str]) -> Complex:
        x = np.column_stack([record[role].values for role in roles])[found.first : found.first + found.count * n]
        return np.fft.rfft(x.reshape(found.count, n, -1), axis=1) / n

    U, Y = spectra(model.inputs), spectra(model.outputs)
    named = [f"{axis}_reference" for axis in model.axes]
    logged = [role for role in named if role in record]
    R = np.zeros((U.shape[1], len(named)), dtype=complex)
    if logged:
        R[:, [named.index(role) for role in logged]] = spectra(logged).mean(axis=0)
    within = slice(1, (n + 1) // 2)
    clean = (R if logged else U.mean(axis=0))[None, within]
    lines = excited_lines(clean, None if logged else np.var(U, axis=0, ddof=1)[within].sum(axis=1) / found.count)[0] + 1
    frequency: Array = np.asarray(lines * (rate / n), dtype=np.float64)
    near = beside_harmonics(frequency, speed / (2.0 * np.pi), rate / n)
    if np.count_nonzero(~near) < 20:
        raise EstimationError(
            f"the excitation of the record has {lines.size} lines, {np.count_nonzero(near)} of them beside harmonics "
            "of the speed; a rotor needs 20 others. Excite more lines: a multisine with whole periods"
        )
    keep = lines[~near]
    return PeriodSpectra(
        frequency_hz=frequency[~near], U=U[:, keep], Y=Y[:, keep], R=R[keep] if logged else None, rate_hz=rate,
        period=n, dropped=found.first, left_out_hz=frequency[near],
    )  # fmt: skip


def beside_harmonics(frequency_hz: Array, speed_hz: float, spacing_hz: float) -> NDArray[np.bool_]:
    """Return which lines stand within one and a half line spacings of a harmonic of the speed."""
    if speed_hz == 0.0:
        return np.zeros(frequency_hz.size, dtype=np.bool_)
    order = np.maximum(np.round(frequency_hz / speed_hz), 1.0)
    return np.asarray(np.abs(frequency_hz - order * speed_hz) <= _SYNCHRONOUS_LINES * spacing_hz)
