"""How good is what comes in: judged block by block while it comes, in constant memory.

Noise is told from signal by the periods of the excitation where one plays: what repeats is signal, the rest is noise.
Else by third differences, which let fast noise through and slow motion hardly: the noise is then at most that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.acquire._quality_sums import Differences, Moments, Periods, Rate
from ambid.acquire._verdict import verdict
from ambid.acquire.device import DeviceInfo, Program
from ambid.acquire.playing import period_ticks
from ambid.arrays import Array
from ambid.track.blocks import Frame

_LONGEST_PERIOD = 1 << 17  # ticks that are folded: 1 MB a column
_FREEDOM = 30  # degrees of freedom under which the periods do not tell the noise,
_FREE_SHARE = 0.5  # and part of a period that has to have come again: noise of neighbouring samples is often the same


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnQuality:
    """How good one column is."""

    name: str  # as the device has it
    role: str
    unit: str
    mean: float  # in `unit`; NaN without samples
    sd: float
    rms: float
    least: float  # extremes, in `unit`
    most: float
    saturated: float  # share of the samples at an end of the column's span, 0 to 1
    used: float | None  # share of the span between the extremes; None where the span is not known
    # what the excitation makes of it and what it does not, in `unit`. By differences the noise is an upper bound.
    signal_sd: float
    noise_sd: float
    snr_db: float | None  # signal over noise, dB; infinite without noise, None where nothing moves
    noise_by: Literal["periods", "differences"]  # how the noise was told from the signal
    still_s: float  # longest time for which the value did not change, s of the device's clock


@dataclass(frozen=True, slots=True, kw_only=True)
class QualityReport:
    """How good a stream is so far."""

    samples: int  # judged
    lost: int  # samples that never came, and the gaps that they make
    gaps: int
    repeated: int  # samples that came under a number that was there already; they are left out
    damaged: int  # samples with a value that is no number; they are left out
    seconds: float  # of the device's clock, from the first to the last sample
    rate_hz: float  # as the device says
    measured_hz: float  # by the times of arrival, with its standard deviation, Hz; NaN while unknown
    measured_sd: float
    excited: bool  # whether an excitation plays
    columns: tuple[ColumnQuality, ...]  # in the device's order
    verdict: tuple[str, ...] = ()  # what is not good enough, one line each with its remedy; empty where all is well


class Quality:
    """Judges a stream as it comes.

    `info`: of the opened device; `program`: the excitation that begins with the stream; None: none.
    """

    def __init__(self, info: DeviceInfo, program: Program | None = None) -> None:
        self._info, width = info, len(info.columns)
        self._moments, self._differences, self._rate = Moments(info.columns), Differences(width), Rate()
        period = period_ticks(program) if program is not None else 0
        self._excited = period > 0
        self._periods = Periods(width, period) if 0 < period <= _LONGEST_PERIOD else None
        self._ends = period * program.cycles if program is not None and program.cycles else math.inf
        self._first: int | None = None
        self._next = 0
        self._whole = False  # whether the sample before the next one was there, and sound
        self._lost = self._gaps = self._repeated = self._damaged = 0

    def add(self, frame: Frame) -> None:
        """Take the next block.

        `frame`: values of shape (n_samples, n_columns), in the device's units.
        """
        with np.errstate(all="ignore"):  # what is too large for sums makes them no number: the verdict says so
            self._add(frame)

    def _add(self, frame: Frame) -> None:
        first, x = frame.block.first, frame.block.values
        if self._first is None:
            self._first = self._next = first
        if first > self._next:
            self._gaps += 1
            self._lost += first - self._next
            self._whole = False
        elif first < self._next:
            twice = min(self._next - first, len(x))
            self._repeated += twice
            first, x = first + twice, x[twice:]
        if len(x) == 0:
            return
        self._next = first + len(x)
        self._rate.add(frame.arrived_s, self._next)
        sound: NDArray[np.bool_] = np.asarray(np.isfinite(x).all(axis=1))
        if sound.all():
            self._take(first, x)
            return
        self._damaged += int(len(x) - np.count_nonzero(sound))
        for begin, end in _stretches(sound):
            self._whole = self._whole and begin == 0
            self._take(first + begin, x[begin:end])
        self._whole = bool(sound[-1])

    def report(self) -> QualityReport:
        """Return how good the stream is so far.

        Returns with what is not good enough, in words.
        """
        with np.errstate(all="ignore"):
            return self._report()

    def _report(self) -> QualityReport:
        measured, sd = self._rate.slope()
        made = QualityReport(
            samples=self._moments.count,
            lost=self._lost,
            gaps=self._gaps,
            repeated=self._repeated,
            damaged=self._damaged,
            seconds=0.0 if self._first is None else (self._next - self._first) / self._info.rate_hz,
            rate_hz=self._info.rate_hz,
            measured_hz=measured,
            measured_sd=sd,
            excited=self._excited,
            columns=self._columns(),
        )
        return replace(made, verdict=verdict(made, self._info))

    def _take(self, first: int, x: Array) -> None:
        """Take sound consecutive samples."""
        self._moments.add(x)
        self._differences.add(x, joined=self._whole)
        self._whole = True
        if self._periods is None or self._first is None:
            return
        # The excitation begins some ticks after the stream, and what it meets first has to settle: a period later.
        begin = max(self._first + self._periods.period - first, 0)
        end = min(self._first + self._ends - first, len(x))
        if begin < end:
            self._periods.add(x[begin : int(end)], first + begin)

    def _columns(self) -> tuple[ColumnQuality, ...]:
        m = self._moments
        if m.count == 0:
            return tuple(_empty(c.name, c.role, c.unit) for c in self._info.columns)
        by: Literal["periods", "differences"] = "differences"
        noise = np.minimum(self._differences.variance, m.variance)
        signal = m.variance - noise
        periods = self._periods
        if periods is not None and periods.freedom >= max(_FREEDOM, _FREE_SHARE * periods.period):
            by = "periods"
            signal, noise = periods.variances()
        return tuple(
            ColumnQuality(
                name=c.name,
                role=c.role,
                unit=c.unit,
                mean=float(m.mean[k]),
                sd=math.sqrt(m.variance[k]),
                rms=math.sqrt(m.variance[k] + m.mean[k] ** 2),
                least=float(m.least[k]),
                most=float(m.most[k]),
                saturated=float(m.saturated[k] / m.count),
                used=None if c.span is None else float((m.most[k] - m.least[k]) / (c.span[1] - c.span[0])),
                signal_sd=math.sqrt(signal[k]),
                noise_sd=math.sqrt(noise[k]),
                snr_db=_decibels(float(signal[k]), float(noise[k])),
                noise_by=by,
                still_s=float(m.longest[k] / self._info.rate_hz),
            )
            for k, c in enumerate(self._info.columns)
        )


def _stretches(sound: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return begin and end of each run of sound samples."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], sound, [False])).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _decibels(signal: float, noise: float) -> float | None:
    if signal <= 0.0:
        return None
    return math.inf if noise <= 0.0 else 10.0 * math.log10(signal / noise)


def _empty(name: str, role: str, unit: str) -> ColumnQuality:
    nan = math.nan
    return ColumnQuality(
        name=name,
        role=role,
        unit=unit,
        mean=nan,
        sd=nan,
        rms=nan,
        least=nan,
        most=nan,
        saturated=0.0,
        used=None,
        signal_sd=nan,
        noise_sd=nan,
        snr_db=None,
        noise_by="differences",
        still_s=0.0,
    )
