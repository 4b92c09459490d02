"""From columns and time stamps to a record: units, rate, gaps. Time is uniform if every interval is within 1 % of the
period, or lies between stamps that near a uniform grid (jitter of a stamp shows twice beside it).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RecordError, counted
from ambid.record.record import Channel, Record, Step, check_rate
from ambid.record.words import unit_or_none
from ambid.settings.caller import setting
from ambid.units import UNKNOWN

GapPolicy = Literal["error", "interpolate", "cut"]
GAP_POLICIES: tuple[GapPolicy, ...] = ("error", "interpolate", "cut")
MIN_SAMPLES = 8
JITTER = 0.01  # of a sampling period


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Columns as read from a file or taken from memory, not yet known to be uniform."""

    where: str  # the file, for messages
    names: tuple[str, ...]  # column names
    values: Array  # (n_rows, n_columns), in file units; NaN where a value is missing
    first_row: int  # line of the file in which the first row stands, counted from 1
    time: int | None  # which column is time (in seconds); None if there is none
    unit_texts: tuple[str | None, ...] = ()  # units as the columns give them
    provenance: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    settings: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))  # of the reading, for history


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """A record of rows as they stand in the file: missing values, gaps and jumps of time are kept, not refused.

    Attributes
    ----------
    record : Record
        The rows in the order of the file; NaN where a value is missing. Its rate is that of the usual interval; its
        own time, which is uniform, is not that of the rows unless `time_s` is None.
    time_s : ndarray, shape (n_rows,), or None
        The time column, s; NaN where a stamp is missing. None if the file has none.
    """

    record: Record
    time_s: Array | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampled:
    """A table on a uniform grid."""

    values: Array  # (n_samples, n_columns), finite throughout; the time column is still there
    rate_hz: float  # sampling rate in Hz and time of the first sample in s
    start_s: float
    steps: tuple[Step, ...]  # what was done about gaps


def uniform_record(table: Table, rate_hz: float | None, gaps: GapPolicy) -> Record:
    """Return the columns on a uniform grid; all values are finite if `gaps` is ``"error"``."""
    sampled = sample_uniformly(table, rate_hz, gaps)
    return _record(table, sampled.values, sampled.rate_hz, sampled.start_s, sampled.steps)


def checked(record: Record, where: str, rate_hz: float | None, gaps: GapPolicy) -> Record:
    """Return a record under the rules of every source: one rate (`rate_hz` agrees), and finite values unless gaps are
    treated.
    """
    check_gap_policy(gaps)
    agreed_rate(where, record.rate_hz, rate_hz)
    values = np.column_stack([c.values for c in record.channels])
    table = Table(where=where, names=record.names, values=values, first_row=0, time=None)
    if gaps == "error":
        refuse_gaps(table)
    sampled = sample_uniformly(table, record.rate_hz, gaps)
    if not sampled.steps:
        return record
    channels = tuple(replace(c, values=sampled.values[:, j]) for j, c in enumerate(record.channels))
    start_s = record.start_s + sampled.start_s
    return replace(record, channels=channels, start_s=start_s, history=(*record.history, *sampled.steps))


def agreed_rate(where: str, found_hz: float, rate_hz: float | None) -> float:
    """Return the rate that a source says in Hz, unless another one was given."""
    if rate_hz is not None and not abs(check_rate(rate_hz) / found_hz - 1) <= JITTER:
        raise RecordError(
            f"{where} was sampled at {found_hz:g} Hz but {setting('rate_hz')} says {rate_hz:g} Hz. Omit it"
        )
    return found_hz


def record_of_rows(table: Table, rate_hz: float | None) -> Rows:
    """Return the rows as they stand; the rate is that of the usual interval."""
    rate, start_s = usual_rate(table, rate_hz)
    time = None if table.time is None else table.values[:, table.time].copy()
    return Rows(record=_record(table, table.values, rate, start_s, ()), time_s=time)


def _record(table: Table, values: Array, rate_hz: float, start_s: float, steps: tuple[Step, ...]) -> Record:
    """Make the record of all columns but time."""
    channels = tuple(
        column_channel(name, text, values[:, j])
        for j, (name, text) in enumerate(zip(table.names, table.unit_texts, strict=True))
        if j != table.time
    )
    if not channels:
        raise RecordError(f"{table.where} has a time column and nothing else; a record needs a channel. Add a column")
    return Record(
        rate_hz=rate_hz,
        start_s=start_s,
        channels=channels,
        history=(Step(name="read", settings=MappingProxyType(dict(table.settings))), *steps),
        provenance=MappingProxyType(table.provenance) if isinstance(table.provenance, dict) else table.provenance,
    )


def column_channel(name: str, unit_text: str | None, raw: Array) -> Channel:
    """Make a channel in SI from raw values (n_samples,) in the file's unit; of a missing or unknown one they stay, in
    ``"?"``.
    """
    unit = unit_or_none(unit_text)
    if unit is None:
        return Channel(name=name, unit=UNKNOWN, values=raw, source_unit=unit_text or UNKNOWN)
    return Channel(name=name, unit=unit.si, values=unit.to_si(raw), source_unit=unit.symbol)


def refuse_gaps(table: Table) -> None:
    """Refuse values that are not finite, naming the first."""
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # a sum takes no room; where it is not finite each value is looked at
        if all(np.isfinite(column.sum()) or np.isfinite(column).all() for column in table.values.T):
            return
    row, j = np.argwhere(~np.isfinite(table.values))[0]
    raise RecordError(
        f"{table.where}, row {table.first_row + row}, column {table.names[j]!r}: {table.values[row, j]} is not a"
        f" finite number; every value must be one. Correct it, or give {setting('gaps', 'interpolate')} or"
        f" {setting('gaps', 'cut')}"
    )


def sample_uniformly(table: Table, rate_hz: float | None, gaps: GapPolicy) -> Sampled:
    """Find the rate and treat the gaps (none if `gaps` is ``"error"``) of at least 8 samples."""
    check_gap_policy(gaps)
    _check_rate(table, rate_hz)
    _enough(table.values.shape[0], table.where, "row")
    steps: list[Step] = []
    values, first = table.values, 0
    if gaps == "interpolate":
        values = _interpolated(table, steps)
    elif gaps == "cut":
        first, values = _longest_stretch(table, steps)
    if table.time is None:
        assert rate_hz is not None
        return Sampled(values=values, rate_hz=float(rate_hz), start_s=first / rate_hz, steps=tuple(steps))
    time = values[:, table.time]
    first_row = table.first_row if gaps == "error" else None
    _check_uniform(time, table.where, table.names[table.time], first_row)
    rate = _agreed(table, (time.size - 1) / (time[-1] - time[0]), rate_hz)
    return Sampled(values=values, rate_hz=rate, start_s=float(time[0]), steps=tuple(steps))


def usual_rate(table: Table, rate_hz: float | None) -> tuple[float, float]:
    """Return the rate in Hz of rows that need not be uniform, of their usual interval, and the first stamp in s, 0
    without.
    """
    _check_rate(table, rate_hz)
    if table.time is None:
        assert rate_hz is not None
        return float(rate_hz), 0.0
    time = table.values[:, table.time]
    period = _period_of(time, table.where)
    return _agreed(table, 1.0 / period, rate_hz), float(time[np.isfinite(time)][0])


def _check_rate(table: Table, rate_hz: float | None) -> None:
    if rate_hz is not None:
        check_rate(rate_hz)
    if table.time is None and rate_hz is None:
        names = [*table.names[:12], *(["…"] if len(table.names) > 12 else [])]
        raise RecordError(
            f"{table.where} has no column 'time [s]' (columns: {', '.join(names)}) and no rate is given."
            f" Add the column, name the one that is time with {setting('layout', 'time=NAME')}, or give "
            f"{setting('rate_hz')}"
        )


def _agreed(table: Table, found_hz: float, rate_hz: float | None) -> float:
    """Return the rate that the time column says, unless another one was given."""
    rate = float(f"{found_hz:.10g}")  # stamps carry no more than 10 digits of a rate
    if rate_hz is not None and abs(rate_hz / rate - 1) > JITTER:
        raise RecordError(
            f"{table.where}: its time column says {rate:g} Hz but {setting('rate_hz')} says {rate_hz:g} Hz; they must "
            "agree. Give one of them only"
        )
    return rate


def check_gap_policy(gaps: str) -> None:
    """Refuse a gap policy that does not exist."""
    if gaps not in GAP_POLICIES:
        raise RecordError(f"gaps = {gaps!r} is not known. Choose one of {', '.join(GAP_POLICIES)}")


def _enough(n: int, where: str, what: str, more: str = "") -> None:
    if n < MIN_SAMPLES:
        raise RecordError(
            f"{where} has {counted(n, what)} of data{more}; a record needs at least {MIN_SAMPLES}. Record for longer"
        )


def _check_uniform(time: Array, where: str, name: str, first_row: int | None) -> None:
    """Refuse time that does not advance by one period per sample, naming the first bad row."""
    steps = np.diff(time)
    mean = (time[-1] - time[0]) / steps.size
    if mean > 0 and max(mean - steps.min(), steps.max() - mean) <= JITTER * mean:
        return  # what follows would say the same, and take more room
    period = _usual_interval(steps)

    def refuse(k: int, what: str, remedy: str) -> RecordError:
        place = f"row {first_row + k}" if first_row is not None else f"sample {k} after treating gaps"
        return RecordError(f"{where}, {place}: {name} {what} (from {time[k - 1]:.9g} s to {time[k]:.9g} s). {remedy}")

    if not np.all(steps > 0):
        k = int(np.argmax(steps <= 0)) + 1
        what = "stands still" if steps[k - 1] == 0 else "runs backwards"
        raise refuse(k, what, "Time must increase: remove the row, or print time with more digits")
    bad = _irregular(time, period)
    if bad.any():
        k = int(np.argmax(bad)) + 1
        raise refuse(
            k,
            f"advances by {steps[k - 1] / period:.4g} samples instead of 1 within 1 %",
            "Uniform sampling is required: print time with more digits, resample before, treat drop-outs with"
            f" {setting('gaps', 'interpolate')} or {setting('gaps', 'cut')}, or remove the time column and give "
            f"{setting('rate_hz')}",
        )


def _usual_interval(intervals: Array) -> float:
    """Return the mean of those intervals that are within 5 % of the median: neither jumps nor rounding move it."""
    median = float(np.median(intervals))
    usual = intervals[np.abs(intervals - median) <= 0.05 * abs(median)]
    return float(usual.mean()) if usual.size else median


def _irregular(time: Array, period: float) -> NDArray[np.bool_]:
    """Tell for every interval whether it breaks the 1 % rule, shape (n_samples - 1,)."""
    intervals_ok: NDArray[np.bool_] = np.abs(np.diff(time) / period - 1) <= JITTER
    if intervals_ok.all():
        return np.zeros(intervals_ok.size, dtype=np.bool_)
    k = np.arange(time.size) - (time.size - 1) / 2
    slope = float(k @ (time - time.mean()) / (k @ k))
    on_grid = np.abs(time - time.mean() - slope * k) <= JITTER * slope
    irregular: NDArray[np.bool_] = ~(intervals_ok | (on_grid[:-1] & on_grid[1:]))
    return irregular


def _period_of(time: Array, where: str) -> float:
    """Return the usual interval of a time column that has gaps (NaN)."""
    stamps = time[np.isfinite(time)]
    _enough(stamps.size, where, "usable row")
    period = _usual_interval(np.diff(stamps))
    if not period > 0:
        raise RecordError(f"{where}: time does not increase from row to row; sort the rows, or remove the time column")
    return period


def _interpolated(table: Table, steps: list[Step]) -> Array:
    """Insert the rows that the time column skips, then fill every gap linearly."""
    values = _with_skipped_rows(table, steps)
    filled, samples, longest = values.copy(), 0, 0
    for j, name in enumerate(table.names):
        missing = ~np.isfinite(values[:, j])
        if not missing.any():
            continue
        if missing[0] or missing[-1]:
            end = "first" if missing[0] else "last"
            raise RecordError(
                f"{table.where}, column {name!r}: the {end} value is missing; interpolation needs one on both"
                f" sides. Remove the rows at that end, or use {setting('gaps', 'cut')}"
            )
        at = np.arange(values.shape[0])
        filled[missing, j] = np.interp(at[missing], at[~missing], values[~missing, j])
        samples += int(missing.sum())
        longest = max(longest, *(stop - start for start, stop in _runs(missing)))
    if samples:
        steps.append(Step(name="gaps_interpolated", settings={"values": samples, "longest": longest}))
    return filled


def _with_skipped_rows(table: Table, steps: list[Step]) -> Array:
    """Return the values with a row of NaN (and its time) for each sample that the time column jumps over."""
    if table.time is None:
        return table.values
    time = table.values[:, table.time]
    if not np.isfinite(time).all():
        return table.values
    period = _period_of(time, table.where)
    advance = np.diff(time) / period
    whole = np.rint(advance)
    skips = whole > 1
    if not skips.any():
        return table.values
    # A jump counts as skipped samples only if it is a whole number of periods: else the clock itself is at fault.
    wrong = skips & (np.abs(advance - whole) > JITTER * whole)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise RecordError(
            f"{table.where}, row {table.first_row + k + 1}: time jumps by {advance[k]:.4g} samples, not by a whole"
            f" number: samples cannot be inserted. Use {setting('gaps', 'cut')}, or resample before"
        )
    n_new = int(whole[skips].sum()) - int(skips.sum())
    if n_new > time.size:
        raise RecordError(
            f"{table.where}: time skips {n_new} samples but only {time.size} were recorded; that is too much to"
            f" interpolate. Use {setting('gaps', 'cut')}"
        )
    at = np.concatenate([[0], np.cumsum(np.where(skips, whole, 1))]).astype(np.int64)
    values = np.full((int(at[-1]) + 1, table.values.shape[1]), np.nan)
    values[at] = table.values
    steps.append(Step(name="gaps_inserted", settings={"rows": n_new, "places": int(skips.sum())}))
    return values


def _longest_stretch(table: Table, steps: list[Step]) -> tuple[int, Array]:
    """Keep the longest run of rows without a missing value or a jump in time; return where it begins, and it."""
    values = table.values
    good: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(values), axis=1)
    broken = np.zeros(values.shape[0] - 1, dtype=bool)  # between row k and k + 1
    if table.time is not None:
        time = values[:, table.time]
        period = _period_of(time, table.where)
        with np.errstate(invalid="ignore"):
            broken = ~(np.abs(np.diff(time) / period - 1) <= JITTER)
        if good.all() and broken.any() and not _irregular(time, period).any():
            broken[:] = False
    starts = np.flatnonzero(good & np.concatenate([[True], ~good[:-1] | broken]))
    stops = np.flatnonzero(good & np.concatenate([~good[1:] | broken, [True]])) + 1
    if starts.size == 0:
        raise RecordError(f"{table.where} has no row without a missing value. Check what was recorded")
    best = int(np.argmax(stops - starts))
    start, stop = int(starts[best]), int(stops[best])
    _enough(stop - start, table.where, "row", " in its longest stretch without a gap")
    if stop - start < values.shape[0]:
        settings = {"first": start, "kept": stop - start, "dropped": values.shape[0] - (stop - start)}
        steps.append(Step(name="gaps_cut", settings=settings))
    return start, values[start:stop]


def _runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (start, stop) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
