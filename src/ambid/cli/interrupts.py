"""Ctrl-C, the signal to terminate and that of a closed terminal: runs end in an orderly way, and are not torn off."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ambid.estimation.progress import Tick

INTERRUPTED = 130  # exit code


def heed_interrupts() -> None:
    """Let Ctrl-C reach a command that was started with it ignored: a shell without job control does that to whatever it
    puts into the background (``nohup ... &``), and ``kill -INT`` is then the only way to end a run in order.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def signals(take: Callable[[int], None]) -> Iterator[None]:
    """Give Ctrl-C, the signal to terminate and that of a closed terminal to a function; as before afterwards.

    A closed terminal that is ignored stays so: a program under ``nohup`` outlives it.

    Returns while signals are taken.
    """
    if current_thread() is not main_thread():
        yield
        return

    def handler(number: int, frame: FrameType | None) -> None:
        del frame
        take(number)

    numbers = [signal.SIGINT, signal.SIGTERM]
    closed = getattr(signal, "SIGHUP", None)  # not every system has terminals that close
    if closed is not None and signal.getsignal(closed) is not signal.SIG_IGN:
        numbers.append(closed)
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old if old is not None else signal.SIG_DFL)


def interrupts(error: BaseException) -> bool:
    """Whether an error is an interruption, perhaps one that compiled code turned into an error of its own."""
    return any(isinstance(e, KeyboardInterrupt) for e in (error, error.__cause__, error.__context__))


class Stop:
    """Takes the first signal as a wish to end; the second one interrupts at once; more change nothing.

    Whoever presses Ctrl-C again and again would otherwise tear off the very steps that switch the output off, close
    the device and keep what was recorded.

    `number`: of the signal; None as long as there was none.
    """

    def __init__(self) -> None:
        """Nothing has been requested."""
        self.number: int | None = None
        self._torn = False

    def take(self, number: int) -> None:
        """Take a signal."""
        if self.number is None:
            self.number = number
        elif not self._torn:
            self._torn = True
            raise KeyboardInterrupt

    def wished(self) -> bool:
        """Return whether the run is to end.

        Returns true after a signal.
        """
        return self.number is not None

    def torn(self) -> None:
        """Interrupt at once if there was a second signal: a search may have taken its interruption for the first
        one's.
        """
        if self._torn:
            raise KeyboardInterrupt

    @property
    def code(self) -> int:
        """Exit code: 0 without a signal, else 128 and its number."""
        return 0 if self.number is None else 128 + self.number


def interruptible(show: Tick, stop: Stop) -> Tick:
    """Return a tick that interrupts a search once where that is requested; what judges its result afterwards goes on.

    `show`: shows the progress; `stop`: whether the user wishes to end. Returns raises KeyboardInterrupt at the first
    call after the wish, but not in the stage ``"check"``; after a second signal, at every call.
    """
    told = False

    def tick(stage: str, done: float | None = None, /) -> None:
        nonlocal told
        show(stage, done)
        stop.torn()
        if stop.wished() and not told and stage != "check":
            told = True
            raise KeyboardInterrupt

    return tick
