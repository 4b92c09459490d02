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

from ambid.cli.time_left import TimeLeft, in_words
from ambid.estimation.progress import Tick, silent

if TYPE_CHECKING:
    from ambid.report.text import Paint, Style

_PLAIN = {"±": "+-", "…": "..", "✓": "ok", "✗": "FAILED", "–": "-", "→": "->", "°": "deg", "µ": "u", "√": "sqrt"}
_COLOURS = {"good": {"fg": "green"}, "bad": {"fg": "red", "bold": True}, "dim": {"dim": True}, "strong": {"bold": True}}
_QUIET_S = 1.0  # a job that is done sooner shows no progress
_EXPECTED = 30  # evaluations of a whole identification, from which the time left is judged


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
    """A line of progress, drawn by a thread of its own so that it also lives while loops are compiled."""

    def __init__(self, title: str) -> None:
        self._begin = self._stage_begin = time.monotonic()
        self._stage, self._count, self._fit_s = title, 0, 0.0
        self._told = TimeLeft(self._begin)
        self._done = Event()
        self._thread = Thread(target=self._show, daemon=True)
        self._thread.start()

    def tick(self, stage: str, done: float | None = None, /) -> None:
        now = time.monotonic()
        if done is not None:
            self._told.take(done, now)
        if stage != self._stage or self._count == 0:
            self._fit_s = now - self._stage_begin if self._count else 0.0
            self._stage, self._stage_begin, self._count = stage, now, 0
        self._count += 1

    def stop(self) -> None:
        self._done.set()
        self._thread.join()

    def _show(self) -> None:
        if self._done.wait(_QUIET_S):
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        shown = [
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[elapsed]:.0f} s{task.fields[left]}"),
        ]
        with Progress(*shown, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(self._stage, total=None, elapsed=0.0, left="")
            while not self._done.wait(0.1):
                now = time.monotonic()
                share, elapsed = self._told.share, now - self._begin
                left = self._left_s() if share is None else self._told.left(now)
                if left is None:
                    bar.update(task, total=None, description=self._stage, elapsed=elapsed, left="")
                    continue
                part = elapsed / (elapsed + left) if share is None else share
                words = ", " + in_words(left) if share is None else f", {100 * share:.0f} %, {in_words(left)}"
                bar.update(task, total=1.0, completed=part, description=self._stage, elapsed=elapsed, left=words)

    def _left_s(self) -> float | None:
        """Time left in s of a job that says no shares, such as ``identify``, or None where nothing can be said.

        Evaluations come at an even pace, their number is known roughly; the checks refit, which takes about as long.
        """
        count, taken = self._count, time.monotonic() - self._stage_begin
        if self._fit_s:
            return max(self._fit_s - taken, 0.0)
        if count < 3:
            return None
        expected = max(_EXPECTED, 1.25 * count)
        return taken / count * (2 * expected - count)
