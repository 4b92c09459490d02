"""Bearings watched over time: what drifts, what stepped and when (interval of Bai 1997, Review of Economics and
Statistics 79(4), 551-563), which alarms stand, and their cause. Only usable estimates and identifiable values count.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError, choices, counted, nearest
from ambid.estimation.result import NORMAL_95, Reason, Result
from ambid.ledger.entry import moment
from ambid.ledger.history import History, Series
from ambid.physics.linear_model import model
from ambid.physics.sensor_errors import CHANNELS, unit_powers

SCHEMA = "ambid.alarms/1"
MONTH_S = 365.25 / 12 * 86400.0
_FEW = 3  # values below which nothing is compared
_WINDOW = 5  # values whose median is a level
_BESIDE = 15  # values on each side of a change, from which its cause is judged
_FAR = 5.0  # standard deviations of the first level from zero, from which changes are relative to it
_BACK = 0.8  # of the limit, below which an alarm is cleared
_CLEAR = 6.0  # by which chi-squared a cause must be likelier than the next
_BAI = 11.0  # 95 % of the date's error in samples, times (step / spread)^2
_PLAIN = 25.0  # chi-squared above chance from which a trend is told: slow wander looks like small ones
_STEEP = 8.0  # standard deviations of a slope that fixes the date of a drift

_NAMES = ("m", "k_x", "k_i", "R", "L")
_CAUSES: Mapping[str, tuple[str, str]] = {  # what is said of a step and of a drift
    "coil": ("the coil's resistance stepped: look at contacts", "the coil warms or corrodes"),
    "flux": ("the magnet's bias flux stepped: cracked or demagnetised", "the magnet ages: bias flux"),
    "gap": ("the air gap stepped: rotor or stator moved", "the air gap changes: wear or growth"),
    "position": ("the position sensor's gain stepped: exchanged or damaged", "the position sensor's gain drifts"),
    "current": ("the current sensor's gain stepped: exchanged or damaged", "the current sensor's gain drifts"),
    "voltage": ("the voltage's scale stepped: supply or amplifier", "the voltage's scale drifts"),
    "mass": ("the rotor's mass stepped: a part was exchanged or lost", "the rotor's mass changes"),
}
_BENCH = {  # powers of `_NAMES` with which parameters follow what changes on the bench (docs/monitoring.md)
    "coil": (0, 0, 0, 1, 0),
    "flux": (0, 2, 1, 0, 0),
    "gap": (0, -3, -2, 0, -1),
    "mass": (1, 0, 0, 0, 0),
}
_LIKE = 0.15  # of a change, to which a pattern holds
_CALM = (0.01, 0.01, 0.01, 0.03, 0.01)  # relative changes that tell nothing; R follows the weather


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """When an alarm is raised.

    Attributes
    ----------
    parameter : str
        Its name; of a rotor without the axis for all axes, ``"k_i"``, or with it, ``"xL.k_i"``.
    change : float
        Relative: -0.05 where it is down 5 %.
    confidence : float
        With which the change has to be beyond that.
    since : str or float
        "start" of the history; "rig": its latest change, the start where there was none; or a time, s since 1970.
    """

    parameter: str
    change: float
    confidence: float = 0.99
    since: str | float = "start"

    def __str__(self) -> str:
        sure = "" if self.confidence == 0.99 else f" at {100 * self.confidence:.6g} %"
        since = self.since if isinstance(self.since, str) else datetime.fromtimestamp(self.since, UTC).isoformat()[:16]
        return f"{self.parameter} {100 * self.change:+.3g} %{sure}{'' if since == 'start' else f' since {since}'}"

    def of(self, name: str) -> bool:
        """Whether it is about a parameter.

        Parameters
        ----------
        name : str
            Of the parameter, with its axis where it has one.

        Returns
        -------
        bool
        """
        return self.parameter in (name, name.rpartition(".")[2])


_USUAL = (("k_i", -0.05), ("k_x", -0.15), ("k_x", 0.15), ("R", 0.1), ("L", -0.1), ("m", 0.05), ("m", -0.05))
BUILT_IN = tuple(Rule(parameter=name, change=change) for name, change in _USUAL)
"""Rules where none are given."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm that a rule raised.

    Attributes
    ----------
    bearing, parameter, rule : str
    raised : float
        Record that raised it, s since 1970.
    cleared : float or None
        Record that cleared it; None while it stands.
    change, change_sd : float
        Relative, at the end or before it was cleared.
    limit : float
        What the rule makes of the first level, SI.
    kind : str
        "drift" or "step".
    at, at_from, at_to : float
        When the step was, or a drift crossed the limit, and the 95 % interval, s since 1970.
    cause : str
        What the changes of all parameters together speak for, or that they leave it open.
    """

    bearing: str
    parameter: str
    rule: str
    raised: float
    cleared: float | None
    change: float
    change_sd: float
    limit: float
    kind: Literal["drift", "step"]
    at: float
    at_from: float
    at_to: float
    cause: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Watched(Result):
    """Bearings watched over time.

    Attributes
    ----------
    ledger : str
        Where their histories are from.
    bearings : tuple of str
        That were watched.
    rules : tuple of Rule
    alarms : tuple of Alarm
        Standing ones first, by date.
    trends : tuple of Trend
        One for each parameter that was measured often enough.
    """

    ledger: str
    bearings: tuple[str, ...]
    rules: tuple[Rule, ...]
    alarms: tuple[Alarm, ...]
    trends: tuple[Trend, ...]

    @property
    def standing(self) -> tuple[Alarm, ...]:
        """Alarms that are not cleared."""
        return tuple(a for a in self.alarms if a.cleared is None)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The alarms that stand."""
        n = len(self.standing)
        if not n:
            return ()
        where = sorted({a.bearing for a in self.standing})
        text = f"{counted(n, 'alarm')} stand{'s' if n == 1 else ''} on {counted(len(where), 'bearing')}: "
        return (Reason(check="alarms", text=text + ", ".join(where[:5]) + (" …" if len(where) > 5 else "")),)


def read_rules(path: str | Path) -> tuple[Rule, ...]:
    """Read alarm rules: tables ``[[alarm]]`` with parameter, change, and perhaps confidence and since.

    Parameters
    ----------
    path : str or Path
        TOML.

    Returns
    -------
    tuple of Rule

    Raises
    ------
    AmbidError
        If the file cannot be read, or a rule is not one.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as failure:
        raise AmbidError(f"alarm rules {path} cannot be read: {failure}. Correct the file") from None
    rules = content.get("alarm")
    other = [key for key in content if key != "alarm"]
    if other or not isinstance(rules, list) or not rules or not all(isinstance(r, dict) for r in rules):
        why = f"{other[0]!r} is unknown.{nearest(other[0], ['alarm'])} " if other else ""
        raise AmbidError(f"alarm rules {path}: {why}It must hold tables [[alarm]] and nothing else. Correct it")
    found = tuple(_rule(r, f"alarm rules {path}, rule {k}") for k, r in enumerate(rules, 1))
    if len(set(found)) < len(found):
        raise AmbidError(f"alarm rules {path} say the same thing twice. Remove one of the two")
    return found


def _rule(entry: Mapping[str, Any], where: str) -> Rule:
    keys = ("parameter", "change", "confidence", "since")
    for key in entry:
        if key not in keys:
            raise AmbidError(f"{where}: {key!r} is unknown; known: {choices(key, keys)} Correct it")
    name, change = entry.get("parameter"), entry.get("change")
    if not isinstance(name, str) or not name:
        raise AmbidError(f'{where}: parameter must be a name such as "k_i". Give it')
    text = change.replace(" ", "").removesuffix("%") if isinstance(change, str) and "%" in change else ""
    try:
        share = float(text) / 100.0 if text[:1] in ("+", "-") else math.nan
    except ValueError:
        share = math.nan
    if not -1.0 < share < 100.0 or share == 0.0:
        raise AmbidError(f'{where}: change is {change!r}; it must be signed and in percent, such as "-5 %". Correct it')
    confidence = entry.get("confidence", 0.99)
    if isinstance(confidence, bool) or not isinstance(confidence, (int, float)) or not 0.5 < confidence < 1.0:
        raise AmbidError(
            f"{where}: confidence is {confidence!r}; it must be between 0.5 and 1, such as 0.99. Correct it"
        )
    since: Any = entry.get("since", "start")
    if since not in ("start", "rig"):
        try:
            since = moment(since if isinstance(since, str) else since.isoformat())
        except (AmbidError, AttributeError):
            raise AmbidError(f'{where}: since is {since!r}; it must be "start", "rig" or a date. Correct it') from None
    return Rule(parameter=name, change=share, confidence=float(confidence), since=since)


def watch(histories: Iterable[History], rules: Sequence[Rule] = BUILT_IN) -> Watched:
    """Watch bearings over time.

    Parameters
    ----------
    histories : iterable of History
    rules : sequence of Rule, optional

    Returns
    -------
    Watched

    Raises
    ------
    AmbidError
        If no bearing has a parameter that a rule names.

    Examples
    --------
    >>> from ambid.ledger import open_ledger, watch
    >>> with open_ledger("works.db", write=False) as ledger:  # doctest: +SKIP
    ...     watched = watch(ledger.history(b.name) for b in ledger.bearings())
    """
    bearings, names = list[History](), set[str]()
    alarms, trends = list[Alarm](), list[Trend]()
    for h in histories:
        bearings.append(h)
        names |= set(h.measured)
        for s in h.measured.values():
            own = [rule for rule in rules if rule.of(s.name)]
            raised = [a for rule in own for a in _alarms(h, s, rule)]
            alarms += raised
            trends += _trend(h, s, own)
    for rule in rules if rules is not BUILT_IN and bearings else ():
        if not any(rule.of(name) for name in names):
            parameters = sorted(names | {name.rpartition(".")[2] for name in names})
            near = nearest(rule.parameter, parameters)
            raise AmbidError(f"alarm {rule}: no bearing has a parameter {rule.parameter!r}.{near} Correct it")
    ordered = sorted(alarms, key=lambda a: (a.cleared is not None, a.raised, a.bearing))
    return Watched(
        used=tuple(bearings), ledger=bearings[0].ledger if bearings else "",
        bearings=tuple(h.bearing for h in bearings),
        rules=tuple(rules), alarms=tuple(ordered), trends=tuple(trends),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Values:
    """Values that count, of one parameter since some time; `sd` enlarged by `scatter`, that of the whole."""

    t: Array
    y: Array
    sd: Array
    scatter: float = 1.0

    def __getitem__(self, part: slice) -> _Values:
        return _Values(self.t[part], self.y[part], self.sd[part], self.scatter)

    @property
    def first(self) -> int:
        """Number of values that make the first level."""
        return min(_WINDOW, self.t.size // 2)

    def then(self) -> Array:
        """Return what the scatter was at each value, from those before it: as it was known when that came."""
        jumps = np.abs(np.diff(self.y)) / np.hypot(self.sd[1:], self.sd[:-1]) * self.scatter
        ends = [n for n in 2 ** np.arange(2, 40) if n < self.t.size]  # anew whenever the history has doubled
        scatters = [1.0, *(_enlarged(jumps[: n - 1]) for n in ends)]
        return np.asarray(np.repeat(scatters, np.diff([0, *ends, self.t.size])), dtype=float)


def _values(h: History, s: Series, since: str | float = "start") -> _Values:
    begin = -math.inf
    if since == "rig":
        begin = max((e.at for e in h.events if e.kind == "rig"), default=begin)
    elif isinstance(since, (int, float)):
        begin = since
    counts = np.isfinite(s.value) & np.isfinite(s.sd) & (s.sd > 0) & (s.taken_at >= begin)
    t, y, sd = s.taken_at[counts], s.value[counts], s.sd[counts]
    scatter = _enlarged(np.abs(np.diff(y)) / np.hypot(sd[1:], sd[:-1])) if t.size > _FEW else 1.0
    return _Values(t, y, sd * scatter, scatter)


def _enlarged(jumps: Array) -> float:
    """Return by what differences of successive values exceed their standard deviations, at least 1."""
    return max(1.0, float(np.median(jumps)) / 0.6744897501960817)


def _level(v: _Values) -> tuple[float, float]:
    """Return the median of values and its standard deviation."""
    return float(np.median(v.y)), 1.2533 * float(np.sqrt(np.mean(v.sd**2) / v.y.size))


def _comparable(v: _Values) -> bool:
    """Whether there are values enough, over some time, whose first level is far enough from zero for a ratio."""
    if v.t.size < 2 * _FEW or not np.ptp(v.t):
        return False
    base, sd = _base(v)
    return abs(base) > _FAR * sd


def _base(v: _Values) -> tuple[float, float]:
    """Return the first level and its standard deviation."""
    return _level(v[slice(0, v.first)])


def _changes(v: _Values) -> tuple[Array, Array, int]:
    """Return relative changes of the level since the first values, their spreads, and the index of the first."""
    first = v.first
    base, base_sd = _base(v)
    later = v[slice(first, None)]
    level = np.array([_level(later[slice(0, k)]) for k in range(_FEW, min(_WINDOW, later.t.size + 1))]).reshape(-1, 2)
    if later.t.size >= _WINDOW:
        y, sd = (np.lib.stride_tricks.sliding_window_view(x, _WINDOW) for x in (later.y, later.sd))
        whole = np.column_stack([np.median(y, axis=1), 1.2533 * np.sqrt(np.mean(sd**2, axis=1) / _WINDOW)])
        level = np.concatenate([level, whole])
    return (
        level[:, 0] / base - 1.0, np.hypot(level[:, 1], level[:, 0] / base * base_sd) / abs(base), first + _FEW - 1,
    )  # fmt: skip


def _alarms(h: History, s: Series, rule: Rule) -> Iterable[Alarm]:
    """Yield the alarms of a rule, as the estimates came."""
    from scipy.special import ndtri

    v = _values(h, s, rule.since)
    if not _comparable(v):
        return
    change, sd, first = _changes(v)
    base, _ = _base(v)
    sd = sd / v.scatter * v.then()[first:]
    beyond = math.copysign(1.0, rule.change) * change / abs(rule.change)  # 1: at the limit
    spread, q = sd / abs(rule.change), float(ndtri(rule.confidence))
    up, down = beyond - 1.0 > q * spread, _BACK - beyond > q * spread
    at = 0
    while (raised := _twice(up, at)) is not None:
        cleared = _twice(down, raised)
        end = up.size if cleared is None else cleared
        part = v[slice(0, first + end)]
        kind, when, begin, to = _date(part, rule)
        notes = [e for e in h.events if e.kind == "rig" and begin <= e.at <= to] if kind == "step" else []
        cause = _cause(h, s.name, rule, kind, when, float(part.t[-1]))
        yield Alarm(
            bearing=h.bearing, parameter=s.name, rule=str(rule), raised=float(v.t[first + raised]),
            cleared=None if cleared is None else float(v.t[first + cleared]), change=float(change[end - 1]),
            change_sd=float(sd[end - 1]), limit=base * (1.0 + rule.change), kind=kind, at=when, at_from=begin, at_to=to,
            cause=f"the rig was changed then ({notes[0].text}); {cause}" if notes else cause,
        )  # fmt: skip
        if cleared is None:
            return
        at = cleared


def _twice(which: Any, begin: int) -> int | None:
    """Return from `begin` the first index that holds and whose predecessor holds."""
    places = np.flatnonzero(which[begin + 1 :] & which[begin:-1])
    return None if not places.size else begin + 1 + int(places[0])


# --- what happened, and when ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Fits:
    """A level, a line, a bend and a step through relative values, by weighted least squares."""

    x: Array  # months
    y: Array  # relative to the first level
    w: Array
    chi: Mapping[str, float]
    after: int  # index of the first value after the step
    bend: float  # where the bend is, months
    scale: float  # variance of what is left, at least 1

    def best(self, *kinds: str) -> str:
        """Return which of these fits best, its number of parameters counted (BIC)."""
        count = {"level": 1, "line": 2, "bend": 4, "step": 4}  # their dates are chosen among many
        return min(kinds, key=lambda k: self.chi[k] / self.scale + count[k] * math.log(self.y.size))


def _fits(v: _Values) -> _Fits:
    base, _ = _base(v)
    x, y, sd = (v.t - v.t[0]) / MONTH_S, v.y / base - 1.0, v.sd / abs(base)
    # values that lie far from those around them are drawn to four standard deviations
    half = _WINDOW // 2
    padded = np.pad(y, half, mode="edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, _WINDOW), axis=1)
    y = around + np.clip(y - around, -4.0 * sd, 4.0 * sd)
    w = 1.0 / sd**2
    W, Y, Q = (np.cumsum(a) for a in (w, w * y, w * y * y))
    split = Q[-1] - Y[:-1] ** 2 / W[:-1] - (Y[-1] - Y[:-1]) ** 2 / (W[-1] - W[:-1])
    inner = split[1:-1] if split.size > 2 else split
    after = int(np.argmin(inner)) + (2 if split.size > 2 else 1)
    bends = np.unique(np.quantile(x, np.linspace(0.02, 0.9, 60)))
    chis = [_line(np.maximum(x - b, 0.0), y, w)[2] for b in bends]
    chi = {
        "level": float(Q[-1] - Y[-1] ** 2 / W[-1]), "line": _line(x, y, w)[2], "bend": min(chis),
        "step": float(np.min(inner)),
    }  # fmt: skip
    bend = float(bends[int(np.argmin(chis))])
    left = {
        "line": y - np.polyval(_line(x, y, w)[0][::-1], x), "bend": y - _on(np.maximum(x - bend, 0.0), y, w),
        "step": y - np.where(np.arange(y.size) < after, np.average(y[:after], weights=w[:after]),
                             np.average(y[after:], weights=w[after:])),
    }  # fmt: skip
    e = left[min(left, key=lambda k: chi[k])] / sd
    follow = min(max(float(e[1:] @ e[:-1] / (e @ e)), 0.0), 0.95) if e @ e > 0 else 0.0
    scale = max(1.0, float(e @ e) / max(e.size - 3, 1)) * (1.0 + follow) / (1.0 - follow)
    return _Fits(x=x, y=y, w=w, chi=chi, after=after, bend=bend, scale=scale)


def _line(x: Array, y: Array, w: Array) -> tuple[Array, Array, float]:
    """Return intercept and slope, their covariance, and chi-squared."""
    A = np.column_stack([np.ones_like(x), x])
    inverse: Any = np.linalg.pinv((A * w[:, None]).T @ A)
    theta: Any = inverse @ (A.T @ (w * y))
    e = y - A @ theta
    return theta, inverse, float(e @ (w * e))


def _on(x: Array, y: Array, w: Array) -> Array:
    theta, *_ = _line(x, y, w)
    return np.asarray(theta[0] + theta[1] * x, dtype=float)


def _step(v: _Values, f: _Fits) -> tuple[float, float, float, float, float]:
    """Return size of a step, its standard deviation, its date and the date's 95 % interval."""
    k = f.after
    before, after = (np.average(f.y[p], weights=f.w[p]) for p in (slice(0, k), slice(k, None)))
    sd = math.sqrt(f.scale * (1.0 / f.w[:k].sum() + 1.0 / f.w[k:].sum()))
    size = float(after - before)
    slack = _BAI * f.scale / float(np.median(f.w)) / size**2 if size else math.inf
    m = int(min(slack, v.t.size))
    return size, sd, float(v.t[k]), float(v.t[max(k - 1 - m, 0)]), float(v.t[min(k + m, v.t.size - 1)])


def _date(v: _Values, rule: Rule) -> tuple[Literal["drift", "step"], float, float, float]:
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
    base, base_sd = _base(v)
    at = (rule.change - a) / b
    row = np.array([1.0, at])
    sd = math.sqrt(row @ cov @ row + ((1.0 + rule.change) * base_sd / base) ** 2) / abs(b)
    when = [float(v.t[0] + MONTH_S * x) for x in (at, at - NORMAL_95 * sd, at + NORMAL_95 * sd)]
    low, high = float(v.t[0]), float(v.t[-1])
    return "drift", *(float(min(max(x, low), high)) for x in when)  # type: ignore[return-value]


def _trend(h: History, s: Series, rules: Sequence[Rule]) -> Iterable[Trend]:
    """Yield what a parameter did; nothing of one that was seldom seen."""
    v = _values(h, s)
    if not _comparable(v):
        return
    f = _fits(v)
    kind = f.best("level", "line", "bend", "step")
    if f.chi["level"] - f.chi[kind] < _PLAIN * f.scale:
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


def _ahead(v: _Values, f: _Fits, a: float, b: float, cov: Array, rule: Rule) -> tuple[float, float] | None:
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


# --- why --------------------------------------------------------------------------------------------------------------


def _cause(h: History, name: str, rule: Rule, kind: str, at: float, end: float) -> str:
    """Say what the changes of an axis' parameters together speak for."""
    axis = name.rpartition(".")[0]
    places, change, spread = [], [], []
    for j, own in enumerate(_NAMES):
        s = h.measured.get(f"{axis}.{own}" if axis else own) or (h.measured.get(own) if own == "m" else None)
        v = None if s is None else _values(h, s, rule.since)
        if v is None:
            continue
        n = int(np.searchsorted(v.t, at if kind == "step" else math.inf))
        last = int(np.searchsorted(v.t, end, side="right"))
        before = v[slice(max(0, n - _BESIDE), n)] if kind == "step" else v[slice(0, min(_WINDOW, last // 2))]
        after = v[slice(n, min(last, n + _BESIDE))] if kind == "step" else v[slice(max(0, last - _BESIDE), last)]
        if min(before.t.size, after.t.size) < _FEW:
            continue
        (a, a_sd), (b, b_sd) = _level(before), _level(after)
        if a * b <= 0:
            return "the cause is not clear: a parameter changed its sign"
        places.append(j)
        change.append(math.log(b / a))
        spread.append(math.hypot(a_sd / a, b_sd / b))
    coil = f"{axis}.L" in h.series if axis else "L" in h.series
    return _likeliest(np.array(places, dtype=int), np.array(change), np.array(spread), kind, coil)


def _patterns(*, mass: bool, coil: bool) -> Iterator[tuple[str, Array]]:
    """Yield causes and the powers of `_NAMES` that they have.

    Where the mass is held (not `mass`), a cause that would move it moves the others, between two limits: as before
    where a coil's induced voltage fixes k_i, and as ratios to the mass where the motion does.
    """
    powers = unit_powers(model("one-axis"))
    sensors = {c: [powers[name][CHANNELS.index(c)] for name in _NAMES] for c in ("position", "current", "voltage")}
    for cause in _CAUSES:
        own = np.array({**_BENCH, **sensors}[cause], dtype=float)
        if mass or coil or not own[0]:
            yield cause, own
        if not mass and own[0]:
            yield cause, own - own[0] * np.array([1.0, 1.0, 1.0, 0.0, 0.0])


def _likeliest(places: Any, change: Array, spread: Array, kind: str, coil: bool) -> str:
    """Say which cause the logarithmic changes of the parameters at `places` of `_NAMES` speak for."""
    from scipy.stats import chi2

    if places.size < 2:
        return "the cause is not clear: too few other parameters were measured"
    misfit: dict[str, float] = {}
    for cause, powers in _patterns(mass=0 in places, coil=coil):
        v = powers[places]
        if not v.any():
            continue
        var = spread**2 + np.array(_CALM)[places] ** 2
        for _ in range(3):  # the tolerance is a share of the change
            size = (v @ (change / var)) / (v @ (v / var))
            var = spread**2 + np.array(_CALM)[places] ** 2 + (_LIKE * size * v) ** 2
        chi = float(np.sum((change - size * v) ** 2 / var))
        misfit[cause] = min(chi, misfit.get(cause, chi))
    order = sorted(misfit, key=lambda cause: misfit[cause])
    if chi2.sf(misfit[order[0]], places.size - 1) < 0.01:
        return "the cause is not clear: no single one fits the changes of all parameters"
    near = [_CAUSES[c][kind != "step"] for c in order if misfit[c] < misfit[order[0]] + _CLEAR]
    return near[0] if len(near) == 1 else f"the cause is not clear: {' or '.join(near[:3])}"
