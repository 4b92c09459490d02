"""Which column is time, and in what unit: by its name, its unit, and how it rises; else a rate beside the data."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError, choices
from ambid.record.words import is_time, quantities, rate_of, symbol, unit_or_none, unit_within
from ambid.settings.caller import setting
from ambid.units import nearest_unit

TIME_NAMES = ("time", "t")
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SLOW, _USUAL, _FAST = 50.0, 500.0, 2e6  # Hz: below the first no bearing is sampled, above the second all are
_EVEN = 0.05  # part of an interval by which those of a column differ that is time though nothing says so
_LOOKED = 4096  # rows
_DAY = 86_400.0  # s
_STAMP = re.compile(
    r"^[ \t]*(\d{1,4}/\d{1,2}/\d{1,4}|\d{1,2}\.\d{1,2}\.\d{2,4}|\d{1,2}-\d{1,2}-\d{2,4}|\d+ days?)[T ,]{1,2}"
    r"(\d{1,2}):(\d\d):(\d\d(?:[.,]\d+)?) ?([AaPp][Mm])?[ \t]*$", re.MULTILINE,
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """What is time in a table."""

    column: int | None = None  # None: there is none
    rate_hz: float | None = None  # beside the data
    why: str = ""  # nothing where the column is called time or t


def clock_of(
    names: Sequence[str], units: Sequence[str | None], columns: Sequence[Array], *, where: str,
    rate_hz: float | None = None, beside: Mapping[str, tuple[float, str | None]] | None = None,
    layout: Mapping[str, str] | None = None,
) -> Clock:  # fmt: skip
    """Find time; `beside`: numbers beside the data with their units, `layout`: whose word ``time`` names the column."""
    word = (layout or {}).get("time")
    if word is not None and word not in names:
        raise RecordError(f"{where} has no column {word!r}; it has {choices(word, names)} Correct layout time")
    at = None if word is None else list(names).index(word)
    called = [j for j, name in enumerate(names) if name.lower() in TIME_NAMES] if at is None else []
    rising = [j for j, x in enumerate(columns) if rises(x)]
    kinds = [unit_or_none(u if u is not None else unit_within(n)) for n, u in zip(names, units, strict=True)]
    second = [unit is not None and unit.si == "s" for unit in kinds]
    unlike = [unit is not None and unit.si != "s" for unit in kinds]
    if called and called[0] in rising and not unlike[called[0]]:
        return Clock(column=called[0])
    why = "the layout says so"
    for fits, reason in (
        ([is_time(n) and not bad for n, bad in zip(names, unlike, strict=True)], "its name says so, and it rises"),
        (second, "it is in a unit of time, and rises"),
    ):
        if at is None:
            at, why = next((j for j in rising if fits[j]), None), reason
    if at is None and called:  # what is wrong with it is told where rates are checked
        return Clock(column=called[0])
    rates = {key: rate_of(key, x, unit) for key, (x, unit) in (beside or {}).items()}
    told = [(key, found[0]) for key, found in rates.items() if found is not None]
    if at is None and rate_hz is None and told:
        key, low = min(told, key=itemgetter(1))
        if low < _USUAL and rates[key] == (low, False):
            raise RecordError(
                f"{where}: {key} has no unit; it may say {low:g} Hz or {1000 * low:g} Hz. Say which: "
                f"{setting('rate_hz')}"
            )
        if max(r for _, r in told) > 1.01 * min(r for _, r in told):
            listed = ", ".join(f"{key} says {r:g} Hz" for key, r in told)
            raise RecordError(f"{where}: {listed}. Say which is right: {setting('rate_hz')}")
        return Clock(rate_hz=told[0][1], why=f"{told[0][0]} beside the data: {told[0][1]:g} Hz")
    if at is None and rate_hz is None:
        nameless = [j for j in rising if units[j] is None and even(columns[j]) and not _counts(columns[j])]
        nameless = [j for j in nameless if names[j].lower() in ("x", *_UNITS) or not quantities(names[j])]
        if len(nameless) == 1:
            at, why = nameless[0], "it alone rises evenly"
    return Clock(column=at, why="" if at is None else f"{names[at]!r}, because {why}")


def seconds(time: Array, name: str, text: str | None, where: str, rate_hz: float | None = None) -> Array:
    """Return time stamps in s; `text`: their unit, as the column gives it; else name, steps or rate tell it."""
    text = _unit_in(name) if text is None else text
    if text is None and rate_hz is not None and _counts(time):
        return time / rate_hz
    text = _unit_of_steps(time, name, where, rate_hz) if text is None else symbol(text)
    unit = unit_or_none(text)
    if unit is None:
        raise RecordError(
            f"{where}: column {name!r} is in [{text}], which is not a known unit (nearest: {nearest_unit(text)})."
            " Time must be in [s], [ms] or [us]"
        )
    if unit.si != "s":
        raise RecordError(
            f"{where}: column {name!r} is in [{text}]; time must be in [s], [ms] or [us]. Correct the unit"
        )
    return unit.to_si(time)


def dates(texts: Sequence[str]) -> Array | None:
    """Return dates, times of day or times since the start in s from the first on; None where the texts are none.

    Of a date that is not ISO 8601 only that it changes counts: at midnight, where the time of day falls.
    """
    day = "1970-01-01T" if re.fullmatch(r"\d{1,2}:\d\d:\d\d([.,]\d+)?", texts[0]) else ""
    if not day and not re.match(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:", texts[0]):
        return _stamps(texts)
    try:
        stamps = np.array([day + x.replace(" ", "T").replace(",", ".").rstrip("Z") for x in texts], "datetime64[ns]")
    except ValueError:
        return None
    return np.asarray((stamps - stamps[0]) / np.timedelta64(1, "s"), dtype=np.float64)


def _stamps(texts: Sequence[str]) -> Array | None:
    """Return ``12/31/2025 1:02:03 PM``, ``31.12.2025 13:02:03,5`` and ``0 days 00:02:03.5`` as `dates` does."""
    found = _STAMP.findall("\n".join(texts)) if _STAMP.fullmatch(texts[0]) else []
    if len(found) != len(texts):
        return None
    days, hours, minutes, seconds, halves = zip(*found, strict=True)
    half = np.char.lower(np.array(halves))
    hour = np.array(hours).astype(np.float64)
    hour = hour if half[0] == "" else hour % 12.0 + 12.0 * (half == "pm")
    minute, second = np.array(minutes).astype(np.float64), np.char.replace(np.array(seconds), ",", ".")
    of_day = 3600.0 * hour + 60.0 * minute + second.astype(np.float64)
    falls, changes = np.diff(of_day) < -_DAY / 2.0, np.array([a != b for a, b in pairwise(days)], dtype=bool)
    if np.any((half == "") != (half[0] == "")) or of_day.max() >= _DAY or not np.array_equal(falls, changes):
        return None
    return np.asarray(np.round(of_day - of_day[0] + _DAY * np.concatenate([[0.0], np.cumsum(falls)]), 9))


def _unit_in(name: str) -> str | None:
    """Return the unit in the name of a column that is time: ``time_ms``, or ``ms`` alone."""
    return name.lower() if name.lower() in ("ms", "us", "ns") else unit_within(name)


def timed(
    time: Array, name: str, text: str | None, why: str, where: str, layout: Mapping[str, str] | None = None,
    rate_hz: float | None = None,
) -> tuple[Array, dict[str, object]]:  # fmt: skip
    """Return time stamps as `seconds`, and what is told of them: `why` they are, and their unit where none is said."""
    found, text = "", (layout or {}).get("time_unit", text)
    if text is None and rate_hz is None:
        within = _unit_in(name)
        usual = (f"in [{unit}], in which its rate is a usual one" for unit in _plausible(time))
        found = f"in [{within}] by its name" if within else next(usual, "")
    words = ", ".join(filter(None, [why, found]))
    return seconds(time, name, text, where, rate_hz), {"time": words} if words else {}


def _unit_of_steps(time: Array, name: str, where: str, rate_hz: float | None) -> str:
    fits, period = _plausible(time), _period(time)
    if rate_hz is not None and period > 0:
        fits = [unit for unit, scale in _UNITS.items() if abs(rate_hz * period * scale - 1) <= _EVEN] or fits
    if len(fits) == 1 and not _counts(time):
        return fits[0]
    listed = " or ".join(f"{unit} ({1 / (period * _UNITS[unit]):g} Hz)" for unit in fits) or "s, ms or us"
    raise RecordError(
        f"{where}: column {name!r} has no unit and rises by {period:g} a row; it may be in {listed}"
        f"{', or count samples' if _counts(time) else ''}. Write '{name} [s]' (or ms, us), or give "
        f"{setting('layout', 'time_unit=s')} or {setting('rate_hz')}"
    )


def _plausible(time: Array) -> list[str]:
    """Return the units in which a rate is that of a bearing: the usual ones, and those that cannot be ruled out."""
    period = _period(time)
    if not period > 0:
        return ["s"]  # what is wrong with it is told where rates are checked
    rates = {unit: 1.0 / (period * scale) for unit, scale in _UNITS.items()}
    usual = [unit for unit, rate in rates.items() if _USUAL <= rate <= _FAST]
    slow = [unit for unit, rate in rates.items() if (1.0 - _EVEN) * _SLOW < rate < _USUAL]
    if period >= 1.0:  # no seconds: of milliseconds or microseconds, and of nanoseconds alone
        return [unit for unit in (*slow, *usual) if unit != "ns"] or usual
    return [*slow, *usual[:1]] if usual else slow


def _period(time: Array) -> float:
    head = time[:_LOOKED]
    steps = np.diff(head[np.isfinite(head)])
    return float(np.median(steps)) if steps.size else 0.0


def _counts(x: Array) -> bool:
    """Whether a column counts rows."""
    head = x[:_LOOKED]
    return bool(_period(head) == 1.0 and np.all(np.mod(head[np.isfinite(head)], 1.0) == 0))


def rises(x: Array) -> bool:
    """Whether a column rises nearly everywhere."""
    head = x[:_LOOKED]
    steps = np.diff(head[np.isfinite(head)])
    return bool(steps.size and np.median(steps) > 0 and np.mean(steps > 0) > 0.98)


def even(x: Array) -> bool:
    """Whether a column rises by equal steps."""
    steps = np.diff(x[:_LOOKED])
    return bool(np.all(np.abs(steps - np.median(steps)) <= _EVEN * abs(np.median(steps))))
