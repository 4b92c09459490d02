"""How ``ambid acquire`` ends: what was recorded, what was kept and why, what ended it early, the exit code."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ambid.cli.options import FAILED_CHECK
from ambid.cli.terminal import painter
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.recorder import Recorded
    from ambid.cli.acquire_wish import Wish
    from ambid.cli.interrupts import Stop
    from ambid.job.acquire import Acquired


def tell(done: Acquired, wish: Wish, stop: Stop, *, table: bool) -> None:
    """Say what was recorded; where standard output is of the track, only what is not good of it.

    `table`: whether standard output is for it.
    """
    if done.recorded is None:
        return
    if table:
        from ambid.report.device_text import acquired_text

        try:
            said = acquired_text(
                wish.record, done.info, done.run, done.quality, done.counters, not_stored=done.not_stored,
                paint=painter(),
            )  # fmt: skip
            typer.echo(said)
        except OSError:
            if stop.number is None:
                raise
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - nobody reads: it stays open to the end
    else:
        for line in done.quality.verdict:
            typer.echo(f"ambid: note: {line}", err=True)
    if done.recorded.keep_journal:
        typer.echo(f"ambid: note: {_kept(done.recorded, wish.record)}", err=True)


def finish(done: Acquired, wish: Wish, stop: Stop, *, strict: bool) -> None:
    """Tell what ended the run early, and end with the exit code.

    `stop`: with the signal that ended it, if one did; `strict`: whether what is not good enough is a failed check.
    """
    stored = done.run.samples - done.not_stored - done.quality.repeated
    kept = f"{wish.record} holds the {stored} samples before it" if done.recorded else "nothing was recorded"
    if done.run.fault is not None:
        from ambid.acquire.causes import fault_words
        from ambid.rig.rig import Daq

        rate_hz = done.info.rate_hz
        daq = wish.rig.daq or Daq(rate_hz=rate_hz)
        why = fault_words(done.run.fault, rate_hz=rate_hz, lift_ms=daq.lift_ms)
        raise AmbidError(f"{wish.port}: the controller went to its safe state: {why}; {kept}")
    if done.not_stored:
        raise AmbidError(_not_stored(done, wish.record))
    if stop.number is not None:
        typer.echo(f"ambid: interrupted; {kept}", err=True)
        raise typer.Exit(stop.code)
    if done.recorded is None:
        raise AmbidError(_nothing(done, wish))
    if not done.run.complete and not done.run.lost:
        typer.echo(f"ambid: note: {wish.port} ended after {done.run.samples} of {done.run.wanted} samples", err=True)
    if strict and (not done.run.complete or done.quality.verdict):
        raise typer.Exit(FAILED_CHECK)


def left(record: Path, changed: bool) -> str:
    """Say where what was recorded is, after a second signal tore the run off.

    `changed`: whether it is another file than before. Returns what goes on after the word that it was interrupted.
    """
    from ambid.acquire.recorder.header import journal_path

    journal = journal_path(record)
    if changed:
        return f"; {record} holds what came before it"
    return f"; get what came with 'ambid recover {journal}'" if journal.exists() else "; nothing was recorded"


def _kept(recorded: Recorded, record: Path) -> str:
    """Say why there is a journal beside the record, and what to do with it."""
    from ambid.acquire.recorder.header import journal_path

    journal, again = journal_path(record), recorded.survey.misplaced
    if again:
        what = f"holds {again} samples that are not in {record}, as their numbers had come before"
    else:
        what = f"was damaged while it was written, and {record} lacks what could not be read"
    return f"{journal} is kept: it {what}. Look at it with 'ambid recover {journal} -o NAME', or remove it"


def _not_stored(done: Acquired, record: Path) -> str:
    """Say what is not in the record, and where the rest is; why was told when it happened."""
    from ambid.acquire.recorder.header import journal_path

    journal = journal_path(record)
    text = f"{done.not_stored} samples are not in {record}"
    if done.recorded is None:
        return f"{text}: nothing could be written. Make room, and record again"
    stored = done.run.samples - done.not_stored
    if not journal.exists():
        return f"{text}, which holds {stored}, with gaps. End what else uses the disk, and record again"
    return f"{text}, which holds {stored}; {journal} is kept: 'ambid recover {journal} -o NAME' makes the record again"


def _nothing(done: Acquired, wish: Wish) -> str:
    """Say why there is no record at all."""
    if done.counters.samples:
        return (
            f"{wish.port} ended after {done.counters.samples / done.info.rate_hz:.4g} s, within the {wish.settle_s:g} s"
            " of --settle: nothing was recorded. Give a smaller --settle"
        )
    return f"{wish.port}: no sample came. Look at cable and supply"
