"""The terminal: colour where there is one, letters that it can show, and progress on standard error."""

from __future__ import annotations

import codecs
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TYPE_CHECKING, TextIO

import typer

from ambid.estimation.progress import Tick, guessed, silent

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

    from ambid.report.text import Paint, Style

_PLAIN = {"±": "+-", "…": "..", "✓": "ok", "✗": "FAILED", "–": "-", "→": "->", "°": "deg", "µ": "u", "√": "sqrt"}
_COLOURS = {
    "good": {"fg": "green"},
    "doubt": {"fg": "yellow", "bold": True},
    "bad": {"fg": "red", "bold": True},
    "dim": {"dim": True},
    "strong": {"bold": True},
}
_QUIET_S = 1.0  # a job that is done sooner shows no progress
_FEWEST = 3  # evaluations before anything is guessed from their number
_EXPECTED = 30  # evaluations of a whole identification; its checks refit, which takes about as long


def plain_where_needed(stream: TextIO) -> None:
    """Write ± … ✓ ✗ in plain letters on a stream whose encoding has none of them, instead of failing.

    `stream`: standard output or error; left alone where it cannot be reconfigured.
    """
    codecs.register_error("ambid-plain", _in_plain_letters)
    if hasattr(stream, "reconfigure"):
        stream.reconfigure(errors="ambid-plain")


def _in_plain_letters(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(c, "?") for c in error.object[error.start : error.end]), error.end


def say_note(line: str) -> None:
    """Say something on standard error."""
    typer.echo(f"ambid: note: {line}", err=True)


def painter() -> Paint:
    """Return the way of painting that standard output can show: colour on a terminal, nothing elsewhere.

    Returns takes a text and a style.
    """
    from ambid.report.text import plain

    if not sys.stdout.isatty() or os.environ.get("NO_COLOR"):
        return plain

    def paint(text: str, style: Style) -> str:
        return typer.style(text, **_COLOURS[style])  # type: ignore[arg-type]

    return paint


@contextmanager
def progress(title: str) -> Iterator[Tick]:
    """Show that a job goes on, how long it has taken, and about how long it still will.

    A job that says what share of it is over shows that too. Nothing is shown in the first second, nor where standard
    error is no terminal.

    `title`: what is done. Returns to be called with the name of the stage at each evaluation, and the share that is
    over where it is known.
    """
    if not sys.stderr.isatty():
        yield silent
        return
    display = _Display(title)
    try:
        yield display.tick
    finally:
        display.stop()


class _Display:
    """A line of progress, drawn by a thread of its own so that it also lives while loops are compiled.

    Of a job that says no shares, such as ``identify``, the share is guessed from the number of its evaluations.
    """

    def __init__(self, title: str) -> None:
        self._begin = time.monotonic()
        self._stage, self._count, self._share, self._told = title, 0, 0.0, False
        self._done = Event()
        self._thread = Thread(target=self._show, daemon=True)
        self._thread.start()

    def tick(self, stage: str, done: float | None = None, /) -> None:
        self._stage, self._count = stage, self._count + 1 if stage == self._stage else 1
        if done is not None:
            self._told, self._share = True, min(max(done, 0.0), 1.0)
        elif self._count >= _FEWEST and not self._told:
            self._share = max(self._share, guessed(self._count, _EXPECTED))

    def stop(self) -> None:
        self._done.set()
        self._thread.join()

    def _show(self) -> None:
        if self._done.wait(_QUIET_S):
            return
        with watching(40) as watch:
            while not self._done.wait(0.1):
                elapsed, share = time.monotonic() - self._begin, self._share
                text = f"{elapsed:.0f} s" + (f", {100 * share:.0f} %" if self._told else "")
                if share and not self._stage.endswith(" left"):  # it tells that itself
                    text += f", {in_words(elapsed * (1.0 - share) / share)}"
                watch.show(self._stage, share or None, text)


def in_words(seconds: float) -> str:
    """Say how long something still takes, such as ``"about 12 s left"``; minutes from 100 s on."""
    if seconds <= 1.0:
        return "nearly done"
    return f"about {seconds:.0f} s left" if seconds < 100.0 else f"about {seconds / 60.0:.0f} min left"


class Watch:
    """Shows a bar and a text on standard error; silent where that is no terminal. Made by `watching`."""

    def __init__(self, width: int) -> None:
        """Show nothing yet."""
        self._width = width
        self._bar: Bar | None = None
        self._task: TaskID | None = None

    def show(self, title: str, part: float | None, text: str) -> None:
        """Show how far it is.

        `title`: what is done; `part`: 0 to 1, None: not known; `text`: what is to be seen of it, short.
        """
        if not sys.stderr.isatty():
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            bar = BarColumn(bar_width=self._width)
            columns = (TextColumn("{task.description}"), bar, TextColumn("{task.fields[text]}"))
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
            self._task = self._bar.add_task(title, total=None, text=text)
        assert self._task is not None
        total = None if part is None else 1.0
        self._bar.update(self._task, total=total, completed=part or 0.0, description=title, text=text)

    def clear(self) -> None:
        """Take the line away, so that something else can be written."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = self._task = None


@contextmanager
def watching(width: int = 20) -> Iterator[Watch]:
    """Show a line while something runs, with a bar of some letters.

    Returns to be told how far it is; taken away at the end, whatever happens.
    """
    watch = Watch(width)
    try:
        yield watch
    finally:
        watch.clear()
