"""A line on the terminal for something that runs for a known time: how far it is, and what is to be seen of it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar
    from rich.progress import TaskID


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
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), TextColumn("{task.fields[text]}"))
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
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
