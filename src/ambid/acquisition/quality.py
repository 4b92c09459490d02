"""How good is what comes in, judged by block in constant memory. Where an excitation plays, what repeats with its
period is signal, the rest noise; else noise is at most what third differences let through, slow motion hardly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.device import AxesProgram, Column, DeviceInfo, Program
from ambid.acquisition.program import period_ticks
from ambid.arrays import Array
from ambid.errors import counted
from ambid.estimation.result import Reason
from ambid.settings.caller import setting
from ambid.tracking.blocks import Frame

_DIFFERENCES = np.array([1.0, -3.0, 3.0, -1.0])
_GAIN = float(np.sum(_DIFFERENCES**2))  # of white noise through a third difference: 20
_LONGEST_PERIOD = 1 << 17  # ticks that are folded: 1 MB a column
_FREEDOM = 30  # degrees of freedom under which the periods do not tell the noise,
_FREE_SHARE = 0.5  # and part of a period that has to have come again: noise of neighbouring samples is often the same
MEASURED = ("position", "current", "extra")
"""Roles that a sensor gives; the others are what the controller orders."""
_FEWEST = 100  # samples from which on anything is said
_SATURATED = 1e-4  # of a sensor's samples
_LIMITED = 0.01  # of the samples of the voltage: the loop is not linear there
_USED = 0.05  # of the converter's range
_STILL_S = 0.5
_SNR_DB = 10.0
_RATE = 0.01
_SURE = 5.0  # standard deviations
_TOGETHER_S = 0.1  # of samples that are judged at once


class Moments:
    """Mean, spread, extremes, saturation and standstill of each column."""

    def __init__(self, columns: tuple[Column, ...]) -> None:
        width = len(columns)
        spans = [c.span if c.span is not None else (-np.inf, np.inf) for c in columns]
        self._low, self._high = np.array(spans, dtype=np.float64).reshape(width, 2).T
        self.count = 0
        self.mean, self._squares = np.zeros(width), np.zeros(width)
        self.least, self.most = np.full(width, np.inf), np.full(width, -np.inf)
        self.saturated = np.zeros(width, dtype=np.int64)
        self.longest = np.zeros(width, dtype=np.int64)
        self._held = np.zeros(width, dtype=np.int64)  # samples for which the last value has stood
        self._last = np.full(width, np.nan)

    @property
    def variance(self) -> Array:
        """About the mean, shape (n_columns,)."""
        return np.asarray(self._squares / max(self.count, 1))

    def add(self, x: Array) -> None:
        """Take consecutive samples, shape (n_samples, n_columns)."""
        n, mean = len(x), x.mean(axis=0)
        total, step = self.count + n, mean - self.mean
        self._squares += np.square(x - mean).sum(axis=0) + step**2 * (self.count * n / total)
        self.mean += step * (n / total)
        self.count = total
        np.minimum(self.least, x.min(axis=0), out=self.least)
        np.maximum(self.most, x.max(axis=0), out=self.most)
        self.saturated += ((x <= self._low) | (x >= self._high)).sum(axis=0)
        self._stand(x)

    def _stand(self, x: Array) -> None:
        """Follow how long each value has stood, over the ends of blocks."""
        n = len(x)
        moved = np.vstack((x[:1] != self._last, x[1:] != x[:-1]))
        number = np.arange(n)[:, None]
        since = np.maximum.accumulate(np.where(moved, number, -1), axis=0)
        runs = np.where(since >= 0, number - since + 1, number + 1 + self._held)
        np.maximum(self.longest, runs.max(axis=0), out=self.longest)
        self._held, self._last = runs[-1], x[-1].copy()


class Differences:
    """Noise by third differences: white noise is in them twentyfold, what moves slowly hardly at all."""

    def __init__(self, width: int) -> None:
        self._tail = np.empty((0, width))
        self._sum, self.count = np.zeros(width), 0

    @property
    def variance(self) -> Array:
        """Of the noise, at most, shape (n_columns,)."""
        return np.asarray(self._sum / (_GAIN * max(self.count, 1)))

    def add(self, x: Array, *, joined: bool) -> None:
        """Take consecutive samples, shape (n_samples, n_columns); `joined` to the last ones or after a gap."""
        series = np.vstack((self._tail, x)) if joined else x
        if len(series) > 3:
            third = series[:-3] - 3.0 * series[1:-2] + 3.0 * series[2:-1] - series[3:]
            self._sum += np.square(third).sum(axis=0)
            self.count += len(third)
        self._tail = series[-3:].copy()


class Periods:
    """Signal and noise by averaging over the periods of an excitation: what repeats is signal, the rest noise."""

    def __init__(self, width: int, period: int) -> None:
        self.period = period
        self._visits = np.zeros(period, dtype=np.int64)
        self._sum, self._squares = np.zeros((period, width)), np.zeros(width)
        self._origin: Array | None = None

    def add(self, x: Array, first: int) -> None:
        """Take samples from number `first` on, shape (n_samples, n_columns)."""
        if self._origin is None:
            self._origin = x[0].copy()  # so that squares of what hardly moves stay exact
        moved = x - self._origin
        phase = (first + np.arange(len(x))) % self.period
        if len(x) <= self.period:
            self._sum[phase] += moved
            self._visits[phase] += 1
        else:
            np.add.at(self._sum, phase, moved)
            np.add.at(self._visits, phase, 1)
        self._squares += np.square(moved).sum(axis=0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the noise."""
        return int(self._visits.sum() - np.count_nonzero(self._visits))

    def variances(self) -> tuple[Array, Array]:
        """Return those of signal and noise, each shape (n_columns,); `freedom` has to be positive."""
        visited = self._visits > 0
        visits, sums = self._visits[visited, None], self._sum[visited]
        total = int(visits.sum())
        between = (sums**2 / visits).sum(axis=0)
        noise = np.maximum(self._squares - between, 0.0) / self.freedom
        means = between / total - (sums.sum(axis=0) / total) ** 2
        # the mean of a phase carries noise/visits of its own
        signal = np.maximum(means - noise * (len(visits) - 1) / total, 0.0)
        return np.asarray(signal), np.asarray(noise)


class Rate:
    """Samples in a second of the host's clock: slope of a straight line through the times of arrival."""

    def __init__(self) -> None:
        self._n = 0
        self._t = self._k = self._tt = self._tk = self._kk = 0.0

    def add(self, arrived_s: float, number: int) -> None:
        """Take the time of arrival of the sample before `number`."""
        self._n += 1
        t, k = arrived_s - self._t, number - self._k
        self._t += t / self._n
        self._k += k / self._n
        self._tt += t * (arrived_s - self._t)
        self._tk += t * (number - self._k)
        self._kk += k * (number - self._k)

    def slope(self) -> tuple[float, float]:
        """Return the rate and its standard deviation, Hz; NaN where it is not known."""
        if self._n < 3 or self._tt <= 0.0:
            return float("nan"), float("nan")
        rate = self._tk / self._tt
        rest = max(self._kk - rate * self._tk, 0.0) / (self._n - 2)
        return rate, float(np.sqrt(rest / self._tt))


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnQuality:
    """How good one column is."""

    name: str  # as the device has it
    role: str
    unit: str
    mean: float = math.nan  # in `unit`; NaN without samples
    sd: float = math.nan
    rms: float = math.nan
    least: float = math.nan  # extremes, in `unit`
    most: float = math.nan
    saturated: float = 0.0  # share of the samples at an end of the column's span, 0 to 1
    used: float | None = None  # share of the span between the extremes; None where the span is not known
    # what the excitation makes of it and what it does not, in `unit`. By differences the noise is an upper bound.
    signal_sd: float = math.nan
    noise_sd: float = math.nan
    snr_db: float | None = None  # signal over noise, dB; infinite without noise, None where nothing moves
    noise_by: Literal["periods", "differences"] = "differences"  # how the noise was told from the signal
    still_s: float = 0.0  # longest time for which the value did not change, s of the device's clock


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
    faults: tuple[Reason, ...] = ()  # what is not good enough; empty where all is well

    @property
    def verdict(self) -> tuple[str, ...]:
        """What is not good enough, one line each with its remedy."""
        return tuple(r.text for r in self.faults)


class Quality:
    """Judges a stream as it comes, of an opened device and the excitation that begins with it, if any."""

    def __init__(self, info: DeviceInfo, program: Program | AxesProgram | None = None) -> None:
        self._info, width = info, len(info.columns)
        self._moments, self._differences, self._rate = Moments(info.columns), Differences(width), Rate()
        period = period_ticks(program) if program is not None else 0
        self._excited = period > 0
        self._periods = Periods(width, period) if 0 < period <= _LONGEST_PERIOD else None
        cycles = program.cycles if isinstance(program, Program) else 0
        self._ends = period * cycles if cycles else math.inf
        self._first: int | None = None
        self._next = 0
        self._whole = False  # whether the sample before the next one was there, and sound
        self._lost = self._gaps = self._repeated = self._damaged = 0
        self._waiting: list[Array] = []  # consecutive samples, judged together: a block is short, and each costs calls

    def add(self, frame: Frame) -> None:
        """Take the next block, (n_samples, n_columns) in the device's units."""
        first, x = frame.block.first, frame.block.values
        if self._first is None:
            self._first = self._next = first
        if first > self._next:
            self._judge()
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
        self._waiting.append(x)
        if sum(map(len, self._waiting)) >= _TOGETHER_S * self._info.rate_hz:
            self._judge()

    @np.errstate(all="ignore")  # what is too large for sums makes them no number: the verdict says so
    def _judge(self) -> None:
        """Judge what waits."""
        if not self._waiting:
            return
        x, self._waiting = np.concatenate(self._waiting), []
        first = self._next - len(x)
        sound: NDArray[np.bool_] = np.asarray(np.isfinite(x).all(axis=1))
        if sound.all():
            self._take(first, x)
            return
        self._damaged += int(len(x) - np.count_nonzero(sound))
        for begin, end in _stretches(sound):
            self._whole = self._whole and begin == 0
            self._take(first + begin, x[begin:end])
        self._whole = bool(sound[-1])

    @np.errstate(all="ignore")
    def report(self) -> QualityReport:
        """Return how good the stream is so far, with what is not good enough in words."""
        self._judge()
        measured, sd = self._rate.slope()
        report = QualityReport(
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
        return replace(report, faults=faults(report, self._info))

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
            return tuple(ColumnQuality(name=c.name, role=c.role, unit=c.unit) for c in self._info.columns)
        method: Literal["periods", "differences"] = "differences"
        noise = np.minimum(self._differences.variance, m.variance)
        signal = m.variance - noise
        periods = self._periods
        if periods is not None and periods.freedom >= max(_FREEDOM, _FREE_SHARE * periods.period):
            method = "periods"
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
                noise_by=method,
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


def faults(report: QualityReport, info: DeviceInfo) -> tuple[Reason, ...]:
    """Say what is not good enough; empty where all is well, or there are too few samples to tell."""
    reasons = list(_stream(report, info))
    if report.samples >= _FEWEST:
        for column in report.columns:
            if not math.isfinite(column.rms):
                text = (
                    f"{column.name} ranges from {column.least:.4g} to {column.most:.4g}, which is too large for a mean "
                    "and standard deviation. Check its source"
                )
                reasons.append(Reason(check="size", text=text, grave=True))
                continue
            sensed = column.role.rsplit("_", 1)[-1].rstrip("0123456789") in MEASURED  # of a rotor: of any of its axes
            reasons += [*_range(column), *_content(column, report)] if sensed else _ordered(column, report.excited)
    return tuple(reasons)


def _stream(report: QualityReport, info: DeviceInfo) -> Iterator[Reason]:
    replay = info.kind == "replay"  # what was is over: nothing of it is mended at a line or a device
    if report.lost:
        share = report.lost / (report.lost + report.samples)
        yield Reason(
            check="lost",
            text=f"{counted(report.lost, 'sample')} lost in {counted(report.gaps, 'gap')} ({share:.2%}): "
            + (
                f"they are missing in the replayed record. Read it with {setting('gaps')}"
                if replay
                else "the line or the host is too slow. Lower daq.rate_hz, or free the machine"
            ),
        )
    if report.repeated:
        yield Reason(
            check="repeated",
            text=f"{counted(report.repeated, 'sample')} came twice and were omitted: "
            + (
                "the time of the replayed record runs backwards. Check its time column"
                if replay
                else "the device counts wrongly. Restart it"
            ),
        )
    if report.damaged:
        where = "replayed record" if replay else "device"
        yield Reason(
            check="damaged",
            text=f"{counted(report.damaged, 'sample')} with a value that is not a number omitted. Check the {where}",
        )
    off = abs(report.measured_hz - report.rate_hz)
    # only hardware keeps the time of this world; NaN compares false
    if info.kind == "serial" and off > _RATE * report.rate_hz and off > _SURE * report.measured_sd:
        yield Reason(
            check="rate",
            text=f"{report.measured_hz:.6g} samples arrive per second instead of {report.rate_hz:g}: the controller "
            "clock is wrong. Check its crystal, or the firmware build",
        )


def _range(column: ColumnQuality) -> Iterator[Reason]:
    """Judge how a sensor fills its converter."""
    if column.saturated > _SATURATED:
        yield Reason(
            check="saturation",
            text=f"{column.name} is at an end of the converter range in {column.saturated:.2%} of the samples, where "
            "it is not measured. Reduce the sensor gain, shift its offset, or excite less",
        )
    elif column.used is not None and 0.0 < column.used < _USED:
        yield Reason(
            check="range",
            text=f"{column.name} uses {column.used:.1%} of the converter range, so its resolution is coarse. Raise the "
            "sensor gain, or excite more",
        )


def _ordered(column: ColumnQuality, excited: bool) -> Iterator[Reason]:
    """Judge what the controller orders."""
    if column.role != "voltage":
        return
    if column.saturated > _LIMITED:
        yield Reason(
            check="limit",
            text=f"{column.name} is saturated in {column.saturated:.1%} of the samples: the loop is not linear there. "
            "Excite less, or widen daq.duty",
        )
    if excited and column.sd == 0.0:
        yield Reason(
            check="still",
            text=f"{column.name} is constant although an excitation was requested. Drive or levitate to play it",
        )


def _content(column: ColumnQuality, report: QualityReport) -> Iterator[Reason]:
    """Judge what is in a sensor's signal."""
    if column.sd == 0.0:
        yield Reason(
            check="dead",
            grave=True,  # what is recorded is not to be used
            text=f"{column.name} is constant at {column.mean:.6g}: no sensor there? Check its cable and supply",
        )
        return
    if report.excited and column.still_s > _STILL_S:
        yield Reason(
            check="still",
            text=f"{column.name} was constant for {column.still_s:.2g} s during an excitation: the rotor rests on a "
            "stop, or a cable is loose. Check both",
        )
    periodic = report.excited and column.noise_by == "periods" and column.role != "extra"
    if periodic and column.snr_db is not None and column.snr_db < _SNR_DB:
        rest = 1.0 / (1.0 + 10.0 ** (column.snr_db / 10.0))
        yield Reason(
            check="snr",
            text=f"{column.name}: the signal-to-noise ratio is {column.snr_db:.0f} dB (limit {_SNR_DB:.0f}): "
            f"{rest:.0%} of its power does not come from the excitation. Excite more, or in a band that the plant "
            "follows",
        )
