"""The command ``ambid``: one file per verb or two, each of which parses, calls and prints."""

from __future__ import annotations

import errno
import gc
import io
import os
import re
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import NoReturn, TextIO

from ambid.cli.interrupts import INTERRUPTED, heed_interrupts, interrupts
from ambid.compiled import THREADS

BROKEN_PIPE = 141
_GARBAGE = 100_000  # new objects after which garbage is collected


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command and leave the program.

    Exit codes: 0 done; 2 input refused; 3 done, but a check failed under ``--strict``; 1 a defect of the program;
    130 interrupted; 141 nobody read the output to its end.

    `arguments`: words after ``ambid``; by default those of the command line.
    """
    # Matrices here are small: threads of the linear algebra libraries only cost time. They look at this when they are
    # first imported, which is later.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for them in every installed package
    # The libraries make some hundred thousand objects that stay to the end: looking through them again and again for
    # garbage takes a tenth of a short command's time.
    gc.set_threshold(_GARBAGE, 50, 100)
    if not sys.warnoptions:
        # Warnings of numerical libraries speak to programmers; what concerns the user is said in results and errors.
        warnings.simplefilter("ignore")
    heed_interrupts()
    _hold_standard_files()
    if sys.stderr is not None:
        sys.stderr = _BestEffort.of(sys.stderr)
    code = run(sys.argv[1:] if arguments is None else arguments)
    gc.freeze()  # what is left goes with the process
    sys.exit(code)


def _hold_standard_files() -> None:
    """Let no file that is opened later become what others take for standard output or error.

    Where one of the three was closed before the program began, the next file that is opened gets its number: a record
    or a port, into which a library then writes its complaints.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number: this one
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 - stays open to the end


class _BestEffort(io.TextIOWrapper):
    """Standard error of which nothing depends: a recording goes on where nobody reads what is said of it."""

    _before: TextIO

    @classmethod
    def of(cls, stream: TextIO) -> TextIO:
        """Return a stream's stand-in; the stream itself where it is of another kind."""
        buffer = getattr(stream, "buffer", None)
        if buffer is None:
            return stream
        told = cls(buffer, encoding=stream.encoding, errors=stream.errors, line_buffering=True)
        told._before = stream  # which would close the file when nobody holds it any more
        return told

    def write(self, text: str) -> int:
        with suppress(OSError):
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            super().flush()


def run(arguments: Sequence[str]) -> int:
    """Run the command and turn whatever happens into an exit code and at most one line of error.

    `arguments`: words after ``ambid``. ``--traceback`` anywhere among them shows where an error arose. Returns the exit
    code.
    """
    if sys.stdout is None:  # it was closed before the program began
        sys.stdout = _ClosedOutput()
    words, trace = [w for w in arguments if w != "--traceback"], "--traceback" in arguments
    try:
        from ambid.cli.app import run_verb
        from ambid.settings.caller import speaking

        with speaking("shell"):
            code = run_verb(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return _refuse("interrupted; nothing was written", INTERRUPTED, trace=False)
    except BrokenPipeError:
        # The interpreter flushes standard output once more when it ends: give it somewhere to go.
        if not isinstance(sys.stdout, _ClosedOutput):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        from ambid.cli.app import refusal
        from ambid.errors import AmbidError

        if interrupts(error):
            return _refuse("interrupted; nothing was written", INTERRUPTED, trace=False)
        said = str(error) if isinstance(error, AmbidError) else refusal(error)
        if said is not None:
            return _refuse(said, 2, trace=trace)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
            return _refuse(
                f"the output cannot be written: {error.strerror}. Make room, or write elsewhere", 2, trace=trace
            )
        if isinstance(error, MemoryError):
            return _refuse("out of memory. Close other programs, or use a shorter record", 2, trace=trace)
        where = f"{type(error).__name__}: {' '.join(str(error).split())}"
        advice = "" if trace else ". Run with --traceback, and report it"
        return _refuse(f"a defect of ambid: {where}{advice}", 1, trace=trace)


class _ClosedOutput(io.TextIOBase):
    """A standard output that nobody reads, as a pipe whose reader has gone."""

    def write(self, text: str) -> int:
        if text:
            raise BrokenPipeError
        return 0


def _refuse(line: str, code: int, *, trace: bool) -> int:
    """Print one line on standard error, after the traceback if it is wanted; what would end it is shown by its code."""
    line = re.sub(r"[\x00-\x1f\x7f-\x9f]", lambda x: repr(x[0])[1:-1], line)
    if trace:
        import traceback

        traceback.print_exc()
    if sys.stderr is not None:
        print(f"ambid: {line}", file=sys.stderr, flush=True)
    return code
