"""What one parameter of a bearing did over time: a drift, a step and when (interval of Bai 1997, Review of Economics
and Statistics 79(4), 551-563), or nothing that stands out of its wander.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.estimation.result import NORMAL_95
from ambid.ledger.history import History, Series
from ambid.ledger.rules import Rule
from ambid.ledger.wander import beyond_wander

MONTH_S = 365.25 / 12 * 86400.0
FEW = 3  # values below which nothing is compared
WINDOW = 5  # values whose median is a level
_FAR = 5.0  # standard deviations of the first level from zero, from which changes are relative to it
_BAI = 11.0  # 95 % of the date's error in samples, times (step / spread)^2
_PLAIN = 25.0  # chi-squared above that of a level from which a trend is looked at
_BEYOND = {"line": 15.0, "bend": 19.0, "step": 22.0}  # of `beyond_wander`, by trend: dates are chosen among many
_STEEP = 8.0  # standard deviations of a slope that fixes the date of a drift


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """What one parameter of a bearing did.

    Attributes
    ----------
    bearing, parameter, unit : str
    kind : str
        "none", "drift" or "step".
    values : int
        That count.
    per_month, per_month_sd : float or None
        Of a drift, relative.
    step, step_sd, at, at_from, at_to : float or None
        Of a step: relative, the first record after it, s since 1970, and its 95 % interval.
    limits : Mapping of str to tuple of float
        By rule, the 95 % interval of the date on which a drift reaches it, s since 1970; left out where that is
        unbounded or further ahead than the history is long.
    """

    bearing: str
    parameter: str
    unit: str
    kind: Literal["none", "drift", "step"]
    values: int
    per_month: float | None = None
    per_month_sd: float | None = None
    step: float | None = None
    step_sd: float | None = None
    at: float | None = None
    at_from: float | None = None
    at_to: float | None = None
    limits: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Values:
    """Values that count, of one parameter since some time; `sd` enlarged by `scatter`, that of the whole."""

    t: Array
    y: Array
    sd: Array
    scatter: float = 1.0

    def __getitem__(self, part: slice) -> Values:
        return Values(self.t[part], self.y[part], self.sd[part], self.scatter)

    @property
    def first(self) -> int:
        """Number of values that make the first level."""
        return min(WINDOW, self.t.size // 2)

    def then(self) -> Array:
        """Return what the scatter was at each value, from those before it: as it was known when that came."""
        jumps = np.abs(np.diff(self.y)) / np.hypot(self.sd[1:], self.sd[:-1]) * self.scatter
        ends = [n for n in 2 ** np.arange(2, 40) if n < self.t.size]  # anew whenever the history has doubled
        scatters = [1.0, *(_enlarged(jumps[: n - 1]) for n in ends)]
        return np.asarray(np.repeat(scatters, np.diff([0, *ends, self.t.size])), dtype=float)


def values_of(h: History, s: Series, since: str | float = "start") -> Values:
    """Return the values of a parameter that count, since some time."""
    begin = -math.inf
    if since == "rig":
        begin = max((e.at for e in h.events if e.kind == "rig"), default=begin)
    elif isinstance(since, (int, float)):
        begin = since
    counts = np.isfinite(s.value) & np.isfinite(s.sd) & (s.sd > 0) & (s.taken_at >= begin)
    t, y, sd = s.taken_at[counts], s.value[counts], s.sd[counts]
    scatter = _enlarged(np.abs(np.diff(y)) / np.hypot(sd[1:], sd[:-1])) if t.size > FEW else 1.0
    return Values(t, y, sd * scatter, scatter)


def _enlarged(jumps: Array) -> float:
    """Return by what differences of successive values exceed their standard deviations, at least 1."""
    return max(1.0, float(np.median(jumps)) / 0.6744897501960817)


def level_of(v: Values) -> tuple[float, float]:
    """Return the median of values and its standard deviation."""
    return float(np.median(v.y)), 1.2533 * float(np.sqrt(np.mean(v.sd**2) / v.y.size))


def comparable(v: Values) -> bool:
    """Whether there are values enough, over some time, whose first level is far enough from zero for a ratio."""
    if v.t.size < 2 * FEW or not np.ptp(v.t):
        return False
    base, sd = first_level(v)
    return abs(base) > _FAR * sd


def first_level(v: Values) -> tuple[float, float]:
    """Return the first level and its standard deviation."""
    return level_of(v[slice(0, v.first)])


@dataclass(frozen=True, slots=True)
class _Fits:
    """A level, a line, a bend and a step through relative values, by weighted least squares."""

    x: Array  # months
    y: Array  # relative to the first level
    w: Array
    chi: Mapping[str, float]
    after: int  # index of the first value after the step
    bend: float  # where the bend is, months
    course: Mapping[str, Array]  # of line, bend and step: the shape of the change, without its size
    scale: float  # variance of what is left, at least 1

    def best(self, *kinds: str) -> str:
        """Return which of these fits best, its number of parameters counted (BIC)."""
        count = {"level": 1, "line": 2, "bend": 4, "step": 4}  # their dates are chosen among many
        return min(kinds, key=lambda k: self.chi[k] / self.scale + count[k] * math.log(self.y.size))


def _fits(v: Values) -> _Fits:
    base, _ = first_level(v)
    x, y, sd = (v.t - v.t[0]) / MONTH_S, v.y / base - 1.0, v.sd / abs(base)
    # values that lie far from those around them are drawn to four standard deviations
    half = WINDOW // 2
    padded = np.pad(y, half, mode="edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, WINDOW), axis=1)
    y = around + np.clip(y - around, -4.0 * sd, 4.0 * sd)
    w = 1.0 / sd**2
    W, Y, Q = (np.cumsum(a) for a in (w, w * y, w * y * y))
    split = Q[-1] - Y[:-1] ** 2 / W[:-1] - (Y[-1] - Y[:-1]) ** 2 / (W[-1] - W[:-1])
    inner = split[1:-1] if split.size > 2 else split
    after = int(np.argmin(inner)) + (2 if split.size > 2 else 1)
    bends = np.unique(np.quantile(x, np.linspace(0.02, 0.9, 60)))
    chis = _bent(np.maximum(x - bends[:, None], 0.0), y, w)
    chi = {
        "level": float(Q[-1] - Y[-1] ** 2 / W[-1]), "line": _line(x, y, w)[2], "bend": float(np.min(chis)),
        "step": float(np.min(inner)),
    }  # fmt: skip
    bend = float(bends[int(np.argmin(chis))])
    course = {"line": x, "bend": np.maximum(x - bend, 0.0), "step": (np.arange(x.size) >= after).astype(float)}
    best = course[min(course, key=lambda k: chi[k])]
    (a, b), *_ = _line(best, y, w)
    e = (y - a - b * best) / sd
    follow = min(max(float(e[1:] @ e[:-1] / (e @ e)), 0.0), 0.95) if e @ e > 0 else 0.0
    scale = max(1.0, float(e @ e) / max(e.size - 3, 1)) * (1.0 + follow) / (1.0 - follow)
    return _Fits(x=x, y=y, w=w, chi=chi, after=after, bend=bend, course=course, scale=scale)


def _bent(x: Array, y: Array, w: Array) -> Array:
    """Return chi-squared of lines through many courses, each a row of `x`."""
    total = w.sum()
    x = x - (x @ w / total)[:, None]
    own, with_y = x**2 @ w, x @ (w * (y - (w @ y) / total))
    level = float(w @ (y - (w @ y) / total) ** 2)
    return np.asarray(level - np.divide(with_y**2, own, out=np.zeros_like(own), where=own > 0.0), dtype=float)


def _line(x: Array, y: Array, w: Array) -> tuple[Array, Array, float]:
    """Return intercept and slope, their covariance, and chi-squared."""
    A = np.column_stack([np.ones_like(x), x])
    inverse: Any = np.linalg.pinv((A * w[:, None]).T @ A)
    theta: Any = inverse @ (A.T @ (w * y))
    e = y - A @ theta
    return theta, inverse, float(e @ (w * e))


def _step(v: Values, f: _Fits) -> tuple[float, float, float, float, float]:
    """Return size of a step, its standard deviation, its date and the date's 95 % interval."""
    k = f.after
    before, after = (np.average(f.y[p], weights=f.w[p]) for p in (slice(0, k), slice(k, None)))
    sd = math.sqrt(f.scale * (1.0 / f.w[:k].sum() + 1.0 / f.w[k:].sum()))
    size = float(after - before)
    slack = _BAI * f.scale / float(np.median(f.w)) / size**2 if size else math.inf
    m = int(min(slack, v.t.size))
    return size, sd, float(v.t[k]), float(v.t[max(k - 1 - m, 0)]), float(v.t[min(k + m, v.t.size - 1)])


def date_of(v: Values, rule: Rule) -> tuple[Literal["drift", "step"], float, float, float]:
    """Return what raised an alarm, when, and the 95 % interval."""
    f = _fits(v)
    if f.best("line", "bend", "step") == "step":
        _, _, at, begin, to = _step(v, f)
        return "step", at, begin, to
    past = math.copysign(1.0, rule.change) * (f.y - rule.change) > 0
    k = int(np.argmin(np.cumsum(np.where(past, 1, -1))))  # before which fewest are past the limit, and most after
    for half in (10, 20, 40, 80, 160, 320, v.t.size):
        near = slice(max(0, k + 1 - half), k + 1 + half)
        (a, b), cov, chi = _line(f.x[near], f.y[near], f.w[near])
        cov = cov * max(1.0, chi / max(f.x[near].size - 2, 1))
        if (b and abs(b) > _STEEP * math.sqrt(cov[1, 1])) or half >= v.t.size:
            break
    if not b:  # nothing leads to the limit
        return "drift", float(v.t[k]), float(v.t[0]), float(v.t[-1])
    base, base_sd = first_level(v)
    at = (rule.change - a) / b
    row = np.array([1.0, at])
    sd = math.sqrt(row @ cov @ row + ((1.0 + rule.change) * base_sd / base) ** 2) / abs(b)
    when = [float(v.t[0] + MONTH_S * x) for x in (at, at - NORMAL_95 * sd, at + NORMAL_95 * sd)]
    low, high = float(v.t[0]), float(v.t[-1])
    return "drift", *(float(min(max(x, low), high)) for x in when)  # type: ignore[return-value]


def trend_of(h: History, s: Series, rules: Sequence[Rule]) -> Iterable[Trend]:
    """Yield what a parameter did; nothing of one that was seldom seen."""
    v = values_of(h, s)
    if not comparable(v):
        return
    f = _fits(v)
    kind = f.best("line", "bend", "step")
    beyond = 0.0
    if f.chi["level"] - f.chi[kind] > _PLAIN:
        beyond, scale = beyond_wander(f.x, f.y, f.w, f.course[kind])
        f = replace(f, scale=scale)
    if beyond < _BEYOND[kind]:
        kind = "level"
    about: dict[str, Any] = {"bearing": h.bearing, "parameter": s.name, "unit": s.unit, "values": int(v.t.size)}
    if kind == "step":
        size, sd, at, begin, to = _step(v, f)
        yield Trend(**about, kind="step", step=size, step_sd=sd, at=at, at_from=begin, at_to=to, limits={})
    elif kind == "level":
        yield Trend(**about, kind="none", limits={})
    else:
        moving = f.x >= f.bend if kind == "bend" else f.x >= 0
        (a, b), cov, _ = _line(f.x[moving], f.y[moving], f.w[moving])
        cov = cov * f.scale
        yield Trend(
            **about, kind="drift", per_month=float(b), per_month_sd=math.sqrt(cov[1, 1]),
            limits={str(r): when for r in rules if (when := _ahead(v, f, a, b, cov, r))},
        )  # fmt: skip


def _ahead(v: Values, f: _Fits, a: float, b: float, cov: Array, rule: Rule) -> tuple[float, float] | None:
    """Return the 95 % interval of the date on which a line reaches a limit; None where it is not worth telling."""
    now = float(f.x[-1])
    ahead = np.linspace(now, 2.0 * now, 400)
    sign = math.copysign(1.0, rule.change)
    line = a + b * ahead
    band = NORMAL_95 * np.sqrt(cov[0, 0] + 2.0 * cov[0, 1] * ahead + cov[1, 1] * ahead**2)
    if sign * line[0] >= abs(rule.change) or sign * b <= NORMAL_95 * math.sqrt(cov[1, 1]):
        return None  # it is there, or does not go there
    early, late = (np.flatnonzero(sign * line + d >= abs(rule.change)) for d in (band, -band))
    if not late.size:
        return None
    return float(v.t[0] + MONTH_S * ahead[early[0]]), float(v.t[0] + MONTH_S * ahead[late[0]])
