"""Options of the verbs, made from what `ambid.settings` declares, and how their words are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ambid.errors import AmbidError
from ambid.settings.caller import check_band, setting, speaking
from ambid.settings.jobs import JOBS
from ambid.settings.schema import Setting

_TYPES: Mapping[str, type] = {
    "path": Path, "number": float, "positive": float, "from_zero": float, "share": float, "whole": int, "switch": bool,
}  # fmt: skip


class Values(dict[str, Any]):
    """What a verb was given, by the names of the settings in Python; also as attributes."""

    def __getattr__(self, name: str) -> Any:
        """Return a value."""
        return self[name]

    @property
    def outputs(self) -> dict[str, Any]:
        """What a result is written to."""
        return self.only("json plot report")

    def only(self, names: str) -> dict[str, Any]:
        """Return some values by name."""
        return {name: self[name] for name in names.split()}


def verb(job: str) -> Callable[[Callable[[Values], None]], Callable[..., None]]:
    """Make a verb of a function that takes the values of a job's settings: they are read and checked before."""
    settings = JOBS[job].settings

    def make(function: Callable[[Values], None]) -> Callable[..., None]:
        def command(**words: Any) -> None:
            with speaking("shell", {s.name: s.flag for s in settings if s.long}):
                values = Values({s.name: _read(s, words[s.name]) for s in settings})
                JOBS[job].check(values.items())
                function(values)

        parameters = [_parameter(s) for s in settings]
        command.__doc__ = function.__doc__
        command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        return command

    return make


def _parameter(s: Setting) -> Parameter:
    """Return a setting as a parameter that Typer reads: its type, words, help and default."""
    of: Any = Literal[s.choices] if s.choices else _TYPES.get(s.kind, str)
    of = list[of] if s.many else of
    default = (False if s.kind == "switch" else s.default) if not s.required else Parameter.empty
    about: dict[str, Any] = {"help": s.about, "metavar": s.metavar or None}
    if s.argument:
        info = typer.Argument(show_default=s.default is not None, **about)
    else:
        long = "--out" if s.name == "out" else s.flag
        flags = (long, f"{'-' if len(s.short) == 1 else '--'}{s.short}") if s.short else (long,)
        info = typer.Option(*flags, show_default=s.default_words or s.kind == "switch", **about)
    kind = of if s.required or default is not None else of | None
    return Parameter(s.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _read(s: Setting, value: Any) -> Any:
    """Return a value as the job takes it, from the words of a shell."""
    if value is None or s.argument:
        return value
    words_of = layout_of if s.name == "layout" else partial(layout_of, name=s.name, example="voltage=NAME")
    readers: dict[str, Callable[[Any], Any]] = {
        "band": lambda x: _band(x, s.name), "words": words_of, "loop": lambda x: x == "closed", "percent": _share,
    }  # fmt: skip
    return readers.get(s.kind, lambda x: x)(value)


def _band(text: str, name: str) -> tuple[float, float]:
    """Read two numbers with a colon between."""
    low, _, high = text.partition(":")
    try:
        band = (float(low), float(high))
    except ValueError:
        band = (0.0, 0.0)
    check_band(band, text, name)
    return band


def layout_of(words: Sequence[str], name: str = "layout", example: str = "decimal=comma") -> dict[str, str]:
    """Read words of a file's layout, or of another setting, each with its value."""
    layout = dict[str, str]()
    for text in words:
        word, sign, value = text.partition("=")
        if not (sign and value) or word in layout:
            raise AmbidError(
                f"{setting(name)} {text!r}: it must be a word and its value, once. Give {setting(name, example)}"
            )
        layout[word] = value
    return layout


def _share(text: str) -> float:
    """Read a share: a number, or one with a percent sign."""
    number, percent = text.strip().removesuffix("%"), text.strip().endswith("%")
    try:
        return float(number) / (100.0 if percent else 1.0)
    except ValueError:
        raise AmbidError(
            f"{setting('target')} is {text!r}; it must be a share such as 0.01 or 1%. Correct it"
        ) from None


def refuse_twice(records: Sequence[Path]) -> None:
    """Refuse to count data twice: standard deviations would come out too small."""
    seen = set[Path]()
    for path in records:
        if path.resolve() in seen:
            raise AmbidError(f"record {path} is given twice and would count twice. Omit one")
        seen.add(path.resolve())
