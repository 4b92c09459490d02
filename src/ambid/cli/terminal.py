"""The terminal: colour where there is one, letters that it can show, and progress on standard error."""

from __future__ import annotations

import codecs
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from math import exp
from threading import Event, Thread
from typing import TYPE_CHECKING, NamedTuple, TextIO

import typer

from ambid.estimation.progress import Tick, silent

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import TaskID

    from ambid.report.text import Paint, Style

_PLAIN = {"±": "+-", "…": "..", "✓": "ok", "✗": "FAILED", "–": "-", "→": "->", "°": "deg", "µ": "u", "√": "sqrt"}
_COLOURS = {"good": {"fg": "green"}, "bad": {"fg": "red", "bold": True}, "dim": {"dim": True}, "strong": {"bold": True}}
_QUIET_S = 1.0  # a job that is done sooner shows no progress
_MEMORY = 0.3  # of the time so far: what came before counts little in the pace
_SETTLES_S = 1.5  # in which what is shown follows what is expected
_LEAST_S = 0.3  # of work before anything is said
_HELD = 0.5  # of what was expected at the last word is left while no other comes
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


def _bar(width: int, text: str) -> Bar:
    """Make a bar on standard error between what is done and a text; it is taken away at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=width), TextColumn(text))
    return Progress(*columns, console=Console(stderr=True), transient=True)


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
        with _bar(40, "{task.fields[elapsed]:.0f} s{task.fields[left]}") as bar:
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


class _Word(NamedTuple):
    """The last that was said: when, and how long the rest takes at the pace until then."""

    at: float
    rest: float

    def expected(self, now: float) -> float:
        return max(self.rest - (now - self.at), _HELD * self.rest)


class TimeLeft:
    """Time left of a job, told from shares that come in unevenly and at a pace that changes.

    The pace is that of the recent past, which grows with the time taken: a job's stages differ, and the last one says
    more of the next than the first. Between two words time runs down, at most to half of what was expected; when a word
    changes what is expected, what is shown follows in a second or two instead of jumping.
    """

    def __init__(self, now: float) -> None:
        """Begin.

        `now`: on any clock that runs evenly.
        """
        self._begin = now
        self._last: tuple[float, float] | None = None  # when, share
        self._time = self._gain = 0.0
        self._word: _Word | None = None
        self._shown: tuple[float, _Word, float] | None = None  # when, by which word, how far from what it says

    @property
    def share(self) -> float | None:
        """Share that is over, 0 to 1; None before the first word."""
        return None if self._last is None else self._last[1]

    def take(self, share: float, now: float) -> None:
        """Take a word on how much is over.

        `share`: 0 to 1; one below an earlier one changes nothing.
        """
        share = min(max(share, 0.0), 1.0)
        if self._last is None:
            self._last = now, share
            return
        since, before = now - self._last[0], self._last[1]
        if share <= before or since <= 0:
            return  # time runs on until something has been done in it
        memory = exp(-since / max(_MEMORY * (now - self._begin), 1e-9))
        self._time, self._gain = memory * self._time + since, memory * self._gain + share - before
        self._last = now, share
        self._word = _Word(at=now, rest=(1.0 - share) * self._time / self._gain)

    def left(self, now: float) -> float | None:
        """Return how long it still takes.

        Returns none as long as too little has been done to tell.
        """
        word = self._word
        if word is None or now - self._begin < _LEAST_S:
            return None
        expected, apart = word.expected(now), 0.0
        if self._shown is not None:
            at, before, was = self._shown
            apart = was * exp(-(now - at) / _SETTLES_S) + before.expected(now) - expected
        self._shown = now, word, apart
        return max(expected + apart, 0.0)


def in_words(seconds: float) -> str:
    """Say how long something still takes.

    Returns such as ``"about 12 s left"``; minutes from 100 s on.
    """
    if seconds < 1.0:
        return "nearly done"
    return f"about {seconds:.0f} s left" if seconds < 100.0 else f"about {seconds / 60.0:.0f} min left"


class Watch:
    """Shows a bar and a text on standard error; silent where that is no terminal. Made by `watching`."""

    def __init__(self) -> None:
        """Show nothing yet."""
        self._bar: Bar | None = None
        self._task: TaskID | None = None

    def show(self, title: str, part: float, text: str) -> None:
        """Show how far it is.

        `title`: what is done; `part`: 0 to 1; `text`: what is to be seen of it, short.
        """
        if not sys.stderr.isatty():
            return
        if self._bar is None:
            self._bar = _bar(20, "{task.fields[text]}")
            self._bar.start()
            self._task = self._bar.add_task(title, total=1.0, text=text)
        assert self._task is not None
        self._bar.update(self._task, completed=part, description=title, text=text)

    def clear(self) -> None:
        """Take the line away, so that something else can be written."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = self._task = None


@contextmanager
def watching() -> Iterator[Watch]:
    """Show a line while something runs.

    Returns to be told how far it is; taken away at the end, whatever happens.
    """
    watch = Watch()
    try:
        yield watch
    finally:
        watch.clear()
