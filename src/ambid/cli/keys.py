"""Single keys from the terminal, without Enter, and the terminal as it was afterwards whatever happens."""

from __future__ import annotations

import os
import sys
import time
from types import TracebackType
from typing import Any, Self


class Keys:
    """Standard input read key by key, where it is a terminal in whose foreground this program runs.

    Ctrl-C stays what it is. Elsewhere (a pipe, the background, a system without such terminals) there are no keys.

    `fd`: file descriptor of the terminal; standard input by default.
    """

    def __init__(self, fd: int | None = None) -> None:
        """Look whether there is a terminal; nothing is changed yet."""
        self._fd = _standard_input() if fd is None else fd
        self._before: list[Any] | None = None

    @property
    def available(self) -> bool:
        """Whether keys can be read now."""
        return self._before is not None

    def __enter__(self) -> Self:
        if self._fd is None or not _foreground(self._fd):
            return self
        import termios
        import tty

        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None and self._fd is not None:
            import termios

            before, self._before = self._before, None
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def read(self, wait_s: float) -> str:
        """Wait for a key.

        `wait_s`: longest time to wait, s. Returns what was pressed, several keys perhaps; empty where nothing was.
        """
        if self._before is None or self._fd is None:
            time.sleep(wait_s)
            return ""
        import select

        ready, _, _ = select.select([self._fd], [], [], wait_s)
        if not ready:
            return ""
        data = os.read(self._fd, 64)
        if not data:  # the terminal has gone: waiting for it again would return at once
            time.sleep(wait_s)
        return data.decode("ascii", "ignore")


def _standard_input() -> int | None:
    try:
        fd = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None
    return fd if os.isatty(fd) else None


def _foreground(fd: int) -> bool:
    """Say whether the terminal's settings may be changed: a program in the background would be stopped for it."""
    try:
        import termios

        termios.tcgetattr(fd)
        return os.tcgetpgrp(fd) == os.getpgrp()
    except (ImportError, OSError, AttributeError):
        return False
    except termios.error:
        return False
