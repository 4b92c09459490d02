"""Messages in the caller's language: a name in Python, an option in a shell, a field's label in the console.

A message names a setting through `setting` and a job through `command` or `saved`; `speaking` says who reads it. The
checks refuse a value under that name.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal

from ambid.errors import AmbidError, EstimationError

Language = Literal["python", "shell", "console"]
_language: Language = "python"
_words: Mapping[str, str] = {}  # what the caller calls some settings, by name

# Names whose flag is not made by leaving out the unit.
_FLAGS = {
    "closed": "loop", "goals": "goal", "limits": "limit",
    "speeds_rpm": "speeds", "identify_nonlinear": "nonlinear",
}  # fmt: skip
_IN_PYTHON = ("units", "samples", "path")  # what the command has no option for
_UNITS = ("_s", "_hz", "_rpm")
# What a setting of the command is in Python, where it is no argument.
_PYTHON = {"json": "save()", "plot": "plot()", "report": "report()", "identify_nonlinear": "ambid.identify_nonlinear"}
_BY_WORD = ("column", "layout", "limits", "spread")  # settings that hold values by a word, such as group=NAME
# Jobs whose command or call is not the job's own name: words and switches; function.
_COMMANDS = {
    "identify_nonlinear": ("identify", "identify_nonlinear"), "alarms": ("history", "alarms"),
    "design_experiment": ("design experiment",), "design_controller": ("design controller",),
    "fleet_run": ("fleet run",),
}  # fmt: skip
_CALLS = {
    "alarms": "ambid.ledger.watch", "fleet_run": "ambid.fleet.run.run_fleet", "recover": "",
}  # fmt: skip


def language() -> Language:
    """Return who reads messages at present."""
    return _language


@contextmanager
def speaking(caller: Language, words: Mapping[str, str] | None = None) -> Iterator[None]:
    """Name settings as this caller does, some of them by `words` of its own, for as long as the context lasts."""
    global _language, _words
    before, _language, _words = (_language, _words), caller, words or {}
    try:
        yield
    finally:
        _language, _words = before


def flag(name: str) -> str:
    """Return the option of a setting in the shell."""
    if _language == "shell" and name in _words:
        return _words[name]
    unit = next((u for u in _UNITS if name.endswith(u)), "")
    return "-o" if name == "out" else "--" + _FLAGS.get(name, name.removesuffix(unit)).replace("_", "-")


def setting(name: str, value: object = None) -> str:
    """Name a setting, or one with its value, in the caller's language; `name` as in Python.

    A value in capitals stands for one that the caller chooses.
    """
    if name in _IN_PYTHON:
        return name
    if _language == "shell":
        if name == "closed" and value is not None:
            value = "closed" if value else "open"
        value = shlex.quote(str(value)) if name == "column" and value is not None else value
        return flag(name) if value in (None, True) else f"{flag(name)} {value}"
    if _language == "console":
        label = _words.get(name) or f"{flag(name)} of the command"
        return label if value in (None, True) else f"{label} = {value}"
    name = _PYTHON.get(name, name)
    if value is None or not name.isidentifier():
        return name
    if name in _BY_WORD and "=" in str(value):
        words = [str(value)] if name == "column" else str(value).split()
        return f"{name}={{{', '.join(map(_entry, words))}}}"
    return f"{name}={value}" if str(value).isupper() else f"{name}={value!r}"


def _entry(word: str) -> str:
    """Write NAME=VALUE as an entry of a dict; a number has no unit there."""
    name, _, text = word.partition("=")
    number = re.fullmatch(r"([-+]?[\d.]+(?:e[-+]?\d+)?)[\w/]*", text)
    return f"{name!r}: {number[1] if number else repr(text.strip(chr(39)))}"


def command(job: str, *arguments: object, **settings: object) -> str:
    """Return the call of a job in the caller's language, in the console its button; what has no function in Python, or
    no button, is always a command.
    """
    if _language == "console" and job in _words:
        return _words[job]
    function = _CALLS.get(job, f"ambid.{job}")
    if _language == "python" and function:
        methods = [(_PYTHON[name], settings.pop(name)) for name in ("json", "plot", "report") if name in settings]
        words = [f"{x!r}" for x in arguments] + [setting(name, x) for name, x in settings.items()]
        call = f"{function}({', '.join(words) or '...'})" if words or methods else function
        return call + "".join(f".{m[:-1]}{'...' if x is True else repr(x)})" for m, x in methods)
    verb, *switches = _COMMANDS.get(job, (job,))
    words = [flag(name) + ("" if x is True else f" {x}") for name, x in settings.items()]
    return " ".join(["ambid", verb, *map(str, arguments), *map(flag, switches), *words])


def saved(job: str) -> str:
    """Say what keeps the result of a job, for messages such as "Give what ... wrote"."""
    quote = "" if _language == "python" else "'"
    return f"what {quote}{command(job, json=True)}{quote} wrote"


def refuse_given(given: Mapping[str, object], refusal: str) -> None:
    """Refuse the first setting that was given although it has no use; its name replaces ``{}`` in the refusal.

    `given`: by name; None, False and what is empty were not given.
    """
    for name, value in given.items():
        if not (value is None or value is False or (isinstance(value, (Sequence, Mapping)) and not value)):
            raise EstimationError(refusal.replace("{}", setting(name)))


LARGEST = 1e9
"""What a time in s or an amplitude may be at most: beyond it is a slip, and numbers of samples would overflow."""


def check_positive(given: Mapping[str, object]) -> None:
    """Refuse by name what is not a number, not positive, not finite or absurd; None was not given."""
    _check(given, Real, lambda x: 0 < x <= LARGEST, f"a positive number, up to {LARGEST:g}")


def check_whole(given: Mapping[str, object], least: int = 0, most: float = math.inf) -> None:
    """Refuse by name what is no whole number from `least` to `most`."""
    ends = f"of at least {least}" if most == math.inf else f"from {least} to {most:g}"
    _check(given, Integral, lambda x: least <= x <= most, f"a whole number {ends}", required=True)


def check_number(given: Mapping[str, object]) -> None:
    """Refuse by name what is no finite number; None was not given."""
    _check(given, Real, math.isfinite, "a number")


def check_share(given: Mapping[str, object]) -> None:
    """Refuse by name what is not a number from 0 to below 1."""
    _check(given, Real, lambda x: 0 <= x < 1, "a number, 0 to below 1", required=True)


def check_band(band: object, text: object = None, name: str = "band") -> None:
    """Refuse what is no band: two numbers, the lower first; None was not given. `text`: how it was written."""
    ends = tuple(band) if isinstance(band, Iterable) else ()
    if band is not None and not (
        len(ends) == 2 and all(isinstance(x, Real) for x in ends) and 0.0 <= ends[0] < ends[1] < math.inf
    ):
        shown = f"{band if text is None else text!r:.40}"
        of = "speeds in rpm" if name == "speeds_rpm" else "frequencies in Hz"
        rule, example = (
            (f"two {of} with a colon between", "1:2000")
            if _language == "shell"
            else (f"two {of}, the lower first", (1, 2000))
        )
        raise AmbidError(f"{setting(name)} is {shown}; it must be {rule}. Give {setting(name, example)}, for example")


def check_switch(given: Mapping[str, object]) -> None:
    """Refuse by name what is neither True nor False; None was not given."""
    _check(given, object, lambda x: x in (True, False), "True or False")


def by_name(given: Any, name: str) -> Mapping[str, Any]:
    """Return what is given by name, and nothing where None is; `name`: of the setting."""
    if given is not None and not isinstance(given, Mapping):
        raise AmbidError(f"{setting(name)} is {given!r:.40}; it must be values by name, such as a dict. Correct it")
    return given or {}


def path_of(given: object, what: str) -> Path:
    """Return the path that a word stands for; `what`: what the file is, for messages."""
    if not isinstance(given, (str, Path)):
        raise AmbidError(f"{what} is {given!r:.40}; it must be a file's path. Correct it")
    return Path(given)


def _check(
    given: Mapping[str, object], kind: type, fits: Callable[[Any], bool], rule: str, *, required: bool = False
) -> None:
    for name, x in given.items():
        if x is None and not required:
            continue
        if not isinstance(x, kind) or (isinstance(x, bool) and kind is not object) or not fits(x):
            shown = f"{float(x):g}" if isinstance(x, Real) and not isinstance(x, bool) else f"{x!r:.40}"
            raise AmbidError(f"{setting(name)} is {shown}; it must be {rule}. Correct it")
