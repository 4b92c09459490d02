"""When alarms are raised, and the TOML that says it."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ambid.errors import AmbidError, choices, nearest
from ambid.ledger.entry import moment

DAY_S = 86400.0
_TABLES = ("alarm", "records")
_UNITS_S = {"h": 3600.0, "d": DAY_S}


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


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordRule:
    """What is expected of the records of a bearing.

    Attributes
    ----------
    bearing : str
        Its name; "": of every bearing that has no rule of its own.
    every_s : float or None
        Usual time between two records, s; None: as the bearing's history shows it.
    late : float
        Usual times after which a record is overdue.
    unusable : int or None
        Records in succession that were not usable, from which that is told; None: as many as chance does not give.
    """

    bearing: str = ""
    every_s: float | None = None
    late: float = 4.5
    unusable: int | None = None

    def __str__(self) -> str:
        every = "" if self.every_s is None else f", one every {self.every_s / DAY_S:.3g} days"
        return f"records{f' of {self.bearing}' if self.bearing else ''}{every}"


_USUAL = (("k_i", -0.05), ("k_x", -0.15), ("k_x", 0.15), ("R", 0.1), ("L", -0.1), ("m", 0.05), ("m", -0.05))
BUILT_IN: tuple[Rule | RecordRule, ...] = (
    *(Rule(parameter=name, change=change) for name, change in _USUAL), RecordRule()
)  # fmt: skip
"""Rules where none are given."""


def read_rules(path: str | Path) -> tuple[Rule | RecordRule, ...]:
    """Read alarm rules: tables ``[[alarm]]`` with parameter, change, and perhaps confidence and since; ``[[records]]``
    with bearing, every, late and unusable.

    Parameters
    ----------
    path : str or Path
        TOML.

    Returns
    -------
    tuple of Rule or RecordRule
        Records are always watched: where no table says of which bearing, as the built-in rule does.

    Raises
    ------
    AmbidError
        If the file cannot be read, or a rule is not one.
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as failure:
        raise AmbidError(f"alarm rules {path} cannot be read: {failure}. Correct the file") from None
    other = [key for key in content if key not in _TABLES]
    tables = [content.get(key, []) for key in _TABLES]
    if other or not any(tables) or not all(isinstance(t, list) and all(isinstance(r, dict) for r in t) for t in tables):
        why = f"{other[0]!r} is unknown.{nearest(other[0], _TABLES)} " if other else ""
        raise AmbidError(
            f"alarm rules {path}: {why}It must hold tables [[alarm]] and [[records]], nothing else. Correct it"
        )
    rules: list[Rule | RecordRule] = [_rule(r, f"alarm rules {path}, rule {k}") for k, r in enumerate(tables[0], 1)]
    records = [_record_rule(r, f"alarm rules {path}, records {k}") for k, r in enumerate(tables[1], 1)]
    if len(set(rules)) < len(rules) or len({r.bearing for r in records}) < len(records):
        raise AmbidError(f"alarm rules {path} say the same thing twice. Remove one of the two")
    everyone = [] if any(not r.bearing for r in records) else [RecordRule()]
    return (*rules, *records, *everyone)


def _known_keys(entry: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in entry:
        if key not in keys:
            raise AmbidError(f"{where}: {key!r} is unknown; known: {choices(key, keys)} Correct it")


def _record_rule(entry: Mapping[str, Any], where: str) -> RecordRule:
    _known_keys(entry, ("bearing", "every", "late", "unusable"), where)
    bearing, every, late, unusable = (entry.get(k) for k in ("bearing", "every", "late", "unusable"))
    number, _, unit = every.partition(" ") if isinstance(every, str) else ("", "", "")
    try:
        every_s = float(number) * _UNITS_S[unit.strip()] if every is not None else None
    except (ValueError, KeyError):
        every_s = math.nan
    if every_s is not None and not 0.0 < every_s < math.inf:
        raise AmbidError(f'{where}: every is {every!r}; it must be a time such as "7 d" or "6 h". Correct it')
    if bearing is not None and (not isinstance(bearing, str) or not bearing):
        raise AmbidError(f"{where}: bearing is {bearing!r}; it must be a name. Correct it")
    for name, x, least, kinds in (("late", late, 1, (int, float)), ("unusable", unusable, 1, (int,))):
        if x is not None and (isinstance(x, bool) or not isinstance(x, kinds) or not least <= x < math.inf):
            raise AmbidError(f"{where}: {name} is {x!r}; it must be a number from {least}. Correct it")
    return RecordRule(
        bearing=bearing or "", every_s=every_s, late=4.5 if late is None else float(late), unusable=unusable
    )


def _rule(entry: Mapping[str, Any], where: str) -> Rule:
    _known_keys(entry, ("parameter", "change", "confidence", "since"), where)
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
