"""A run of the tracker as it is followed: written, counted, told on a line, and stopped without losing what it found.
`Follower` takes the callbacks of the job.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ambid.cli.interrupts import INTERRUPTED, interrupts, signals
from ambid.cli.output import Outputs, end, json_path
from ambid.cli.terminal import Watch, watching
from ambid.errors import AmbidError, counted

if TYPE_CHECKING:
    from ambid.recursive.lines import Track, TrackHeader, TrackLine, TrackSummary
    from ambid.report.track_figures import TrackHistory
    from ambid.tracking.lines_file import LiveState


_TELL_S = 0.1  # how often at most it is told where the run is
_QUIET_S = 1.0  # a start that takes less shows nothing


class Follower:
    """Follows one run.

    `json`: as given: where lines are written; `keep`: keep columns for a figure; `real_time`: whether the record
    is replayed as it was taken.
    """

    def __init__(self, json: str | None, *, keep: bool, real_time: bool) -> None:
        """Begin before the run."""
        from ambid.tracking.lines_file import TrackWriter

        self.record: Path | None = None  # which may hold the truth, and its rate where it has no time
        self.rate_hz: float | None = None
        self.path, self.table = json_path(json), json != "-"
        self.state: LiveState | None = None
        self.history: TrackHistory | None = None
        self.track: Track | None = None  # what came of it
        self.code = 0
        target = self.path or (None if self.table else sys.stdout)
        self._writer = None if target is None else TrackWriter(target)
        self._live = sys.stderr.isatty() and (self.table or not sys.stdout.isatty())
        self._keep, self._real_time = keep, real_time
        self._stop: int | None = None
        self._begin_wall = self._told = time.perf_counter()
        self._watch: Watch | None = None

    def run(self, job: Callable[[], Track]) -> None:
        """Let the job, which has the callbacks of this object, run to its end or until it is stopped.

        The summary is written; it is not `complete` where the run was stopped, and None where that was before its first
        line.
        """
        from ambid.job.following import Followed
        from ambid.recursive.lines import Track

        found: TrackSummary | None = None
        with signals(self._signalled), watching() as watch:
            self._watch = watch if self._live else None
            try:
                found = job().totals
            except BaseException as error:
                if not interrupts(error):
                    self._abandon()
                    raise
                if self.state is None:
                    raise
                self.code = self._stop or INTERRUPTED
        if self.state is None:
            return
        if found is None:
            taken = float("nan") if self._real_time else time.perf_counter() - self._begin_wall
            found = self.state.tally.summary(computing_s=taken, complete=False)
        if self._writer is not None and self._writer.begun:
            self._writer.summary(found)
            self._writer.close()
        if self.state.line is not None:
            found = replace(found, unanswered=self.state.tally.open_changes, recurring=self.state.tally.recurring)
            used = Followed(record=self.record, rate_hz=self.rate_hz, history=self.history, events=self.state.events)
            self.track = Track(header=self.state.header, lines=(self.state.line,), totals=found, used=used)

    def finish(
        self,
        outputs: Outputs,
        *,
        drawn: Path | None = None,
        strict: bool = False,
        store: Callable[[Track], object] = repr,
    ) -> None:
        """Print the track, say what was interrupted, and end with the exit code.

        `drawn`: the figure of the track; `strict`: whether all but a usable one ends with exit code 3; `store`: takes a
        track that was not interrupted.
        """
        if self.track is None:
            if self.code:
                print("ambid: interrupted before the first line of the track", file=sys.stderr)
                raise typer.Exit(self.code)
            raise AmbidError(
                "the record ends before the first reporting interval. Use a longer one, or a shorter --every"
            )
        if self.table:
            outputs.show(self.track)
        end_s = self.track.lines[-1].t
        if self.code:
            names = [str(x) for x in (self.path, drawn) if x]
            holds = f"; {' and '.join(names)} hold{'s' if len(names) == 1 else ''} the track so far" if names else ""
            print(f"ambid: interrupted at {end_s:.4g} s of record{holds}", file=sys.stderr)
            raise typer.Exit(self.code)
        store(self.track)
        end(failed=strict and not self.track.passed)

    def _abandon(self) -> None:
        """After an error: leave a file that says that it is not complete, if it can still be written."""
        if self._writer is not None and self._writer.begun and self.state is not None:
            with suppress(AmbidError, OSError, ValueError):
                self._writer.summary(self.state.tally.summary(complete=False))
            with suppress(OSError, ValueError):
                self._writer.close()

    def tick(self, stage: str, done: float | None = None) -> None:
        """Take a sign of life from the job."""
        del done
        if self._stop is not None:
            raise KeyboardInterrupt
        if self.state is None and self._watch is not None and time.perf_counter() - self._begin_wall > _QUIET_S:
            self._watch.show(stage, None, "")

    def on_header(self, header: TrackHeader) -> None:
        """Take the header; the file begins with the first line, so that a refusal leaves an older one."""
        from ambid.tracking.lines_file import LiveState

        if self._keep:
            from ambid.report.track_figures import TrackHistory

            self.history = TrackHistory(header)
        self._begin_wall = time.perf_counter()
        self.state = LiveState(header)

    def on_line(self, line: TrackLine) -> None:
        """Take a line: written, counted, kept for a figure, and told."""
        assert self.state is not None
        if self._writer is not None:
            if not self._writer.begun:
                if self.path is not None and self.path.exists() and self.path.stat().st_size:
                    print(f"{self.path.name} is replaced", file=sys.stderr)
                self._writer.header(self.state.header)
            self._writer.line(line)
        self.state.add(line)
        if self.history is not None:
            self.history.add(line)
        if self._watch is not None and time.perf_counter() - self._told > _TELL_S:
            self._told = time.perf_counter()
            self._watch.show("track", *self._where(self.state, line))
        if self._stop is not None:
            raise KeyboardInterrupt

    def on_lag(self, lag_s: float) -> None:
        """Take the time from the last sample of a block to the end of its work."""
        if self.state is not None:
            self.state.lag_s = lag_s

    def _signalled(self, number: int) -> None:
        """Stop after the present line; at once where there is none yet, or when asked a second time."""
        if self.state is None or self._stop is not None:
            self.code = 128 + number
            raise KeyboardInterrupt
        self._stop = 128 + number

    def _where(self, state: LiveState, line: TrackLine) -> tuple[float | None, str]:
        """Return which part of the record is over, and in words where the run is."""
        length, behind = state.length_s, state.lag_s
        if behind is None and self._real_time:
            behind = self._told - self._begin_wall - (line.t - state.begin_s)
        words = [f"{line.t:.2f} s, {line.state}, model error {line.error:.3g} of {state.header.limit:g}"]
        if state.tally.open_changes:
            words.append(counted(len(state.tally.open_changes), "open change"))
        if behind is not None:
            words.append(f"{1e3 * max(behind, 0.0):.0f} ms behind")
        return min((line.t - state.begin_s) / length, 1.0) if length else None, ", ".join(words)
