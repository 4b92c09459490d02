"""What a setting and a job are: options, checks, forms and the reference are made from their one declaration."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal

from ambid.errors import AmbidError, nearest
from ambid.settings.caller import LARGEST, by_name, check_band, flag, setting

Kind = Literal[
    "path", "text", "number", "positive", "from_zero", "share", "percent", "whole", "switch", "band", "words", "loop"
]
"""How a value is checked and read. Numbers: any, above 0, of at least 0, from 0 to below 1, one that a shell may write
in per cent. Words: NAME=VALUE by name; loop: open or closed in a shell, False or True in Python."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One thing that a job may be told. Its help names other settings as ``@name``."""

    name: str  # in Python
    kind: Kind
    metavar: str
    help: str
    default: Any = None
    shown: str = ""  # how the default reads where it is no value
    choices: tuple[str, ...] = ()
    least: int = 0  # of a whole number
    most: float = math.inf
    many: bool = False
    required: bool = False
    argument: bool = False  # given by its place
    long: str = ""  # its word in a shell where that is not made from the name, without dashes
    short: str = ""  # another word for it in a shell, without dashes

    @property
    def flag(self) -> str:
        """Its word in a shell."""
        return f"--{self.long}" if self.long else flag(self.name)

    @property
    def about(self) -> str:
        """The help for a shell."""
        return _in_a_shell(self.help)

    @property
    def default_words(self) -> str | bool:
        """How a shell reads the default: in words, as the value that it is, or not at all."""
        return _in_a_shell(self.shown) or self.default is not None

    def check(self, value: Any) -> None:
        """Refuse a value that is out of range, under the name that the caller gives it; None was not given."""
        if value is None:
            return
        if self.kind == "band":
            check_band(value, name=self.name)
        elif self.kind == "words":
            by_name(value, self.name)
        elif self.choices and self.kind == "text" and value not in self.choices:
            known = ", ".join(self.choices)
            raise AmbidError(
                f"{setting(self.name)} is {value!r:.40}; it must be one of {known}.{nearest(value, self.choices)} "
                "Correct it"
            )
        rule, kind, fits = self.rule
        if rule and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool) or not fits(value)):
            shown = f"{float(value):g}" if isinstance(value, Real) and not isinstance(value, bool) else f"{value!r:.40}"
            raise AmbidError(f"{setting(self.name)} is {shown}; it must be {rule}. Correct it")

    @property
    def rule(self) -> tuple[str, type, Callable[[Any], bool]]:
        """What a value must be in words, its type, and a test of its range; no words where anything may be given."""
        if self.kind == "whole":
            ends = f"of at least {self.least}" if self.most == math.inf else f"from {self.least} to {self.most:g}"
            return f"a whole number {ends}", Integral, lambda x: self.least <= x <= self.most
        return {
            "number": ("a number", Real, math.isfinite),
            "positive": (f"a positive number, up to {LARGEST:g}", Real, lambda x: 0 < x <= LARGEST),
            "percent": (f"a positive number, up to {LARGEST:g}", Real, lambda x: 0 < x <= LARGEST),
            "from_zero": (f"a number, 0 to {LARGEST:g}", Real, lambda x: 0 <= x <= LARGEST),
            "share": ("a number, 0 to below 1", Real, lambda x: 0 <= x < 1),
            "switch": ("True or False", bool, lambda _: True),
            "loop": ("True or False", bool, lambda _: True),
        }.get(self.kind, ("", object, bool))


@dataclass(frozen=True, slots=True)
class Job:
    """A verb of the command: its settings in the order in which its help shows them."""

    name: str
    settings: tuple[Setting, ...]

    def __getitem__(self, name: str) -> Setting:
        """Return a setting by its name in Python."""
        return next(s for s in self.settings if s.name == name)

    def check(self, values: Iterable[tuple[str, Any]]) -> None:
        """Refuse the first value that is out of the range of its setting; names without one are passed over."""
        ranges = {s.name: s for s in self.settings}
        for name, value in values:
            if name in ranges:
                for one in value if ranges[name].many and isinstance(value, (list, tuple)) else (value,):
                    ranges[name].check(one)


def _in_a_shell(text: str) -> str:
    return re.sub(r"@(\w+)", lambda m: flag(m[1]), text)
