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
