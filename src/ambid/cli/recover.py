"""``ambid recover``: the record of a recording that could not finish."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ambid.cli.options import Force, argument, option, switch
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquisition.recorder import Recorded


def command(
    journals: Annotated[list[Path], argument("JOURNAL", "Journal of a recording that was cut off: NAME.journal.")],
    output: Annotated[
        Path | None, option("--out -o FILE", "Record to write: .h5, .hdf5, .csv or .csv.gz.", "NAME")
    ] = None,
    delete: Annotated[
        bool, switch("--delete", "Remove the journal once its record is written and nothing was damaged.")
    ] = False,
    force: Force = False,
    strict: Annotated[bool, switch("--strict", "End with exit code 3 if something was damaged.")] = False,
) -> None:
    """Recover a recording that was killed, or lost its power, from the journal that it left.

    Every block that the recorder had acknowledged comes back. Damaged or missing samples are counted and become empty
    rows; the other verbs treat these by --gaps. An existing record is left as it is.
    """
    if output is not None and len(journals) > 1:
        raise AmbidError(
            f"-o {output} is one file for {len(journals)} journals. Recover them one by one, or without -o"
        )
    refused: list[AmbidError] = []
    sound = True
    for journal in journals:
        try:
            sound &= _recover(journal, output, delete=delete, force=force)
        except AmbidError as failure:
            refused.append(failure)
    for other in refused[1:]:
        typer.echo(f"ambid: {other}", err=True)
    if refused:
        raise refused[0]
    end(failed=strict and not sound)


def _recover(journal: Path, output: Path | None, *, delete: bool, force: bool) -> bool:
    """Make the record of one journal, say what was found, and return whether nothing of it was damaged."""
    from ambid.acquisition.recorder import JournalReader, record_path, recorded_already, recorded_from
    from ambid.acquisition.recorder.disk import sync_folder
    from ambid.errors import DeviceError

    if not journal.name:
        raise AmbidError(f"journal {str(journal)!r} is a folder; it must be a file. Name the file inside it")
    path = record_path(journal) if output is None else output
    Outputs(journal).claim(path, "-o", force=True)
    with JournalReader.open(journal) as reader, progress("recover"):
        there = recorded_already(reader, path) if path.exists() and not force else None
        made = there or recorded_from(reader, path, force=force)
        if made is None:
            raise DeviceError(f"journal {journal} holds no intact block. Remove it")
        gone = delete and not made.keep_journal
        if gone:
            journal.unlink()
            sync_folder(journal)
    typer.echo(f"{journal}: {_found(made)}")
    done = f"written{_lacks(made)}" if there is None else f"holds that already{_lacks(made)}: nothing to do"
    typer.echo(f"{path} {done}.{_fate(journal, delete=delete, gone=gone)}")
    return not made.keep_journal


def _found(made: Recorded) -> str:
    found = made.survey
    text = f"{_many(found.blocks, 'block')}, {_many(found.samples, 'sample')}, {found.samples / made.rate_hz:.6g} s"
    if found.damage.closed:
        return f"{text}; complete"
    tail = (
        f"; {_many(found.damage.tail_bytes, 'byte')} at its end are not a whole block"
        if found.damage.tail_bytes
        else ""
    )
    return f"{text}; cut off while recording{tail}"


def _lacks(made: Recorded) -> str:
    """Say what is missing; nothing where all is there."""
    found, damage = made.survey, made.survey.damage
    parts = []
    if damage.frames or damage.places:
        others, places = damage.frames - damage.blocks, _many(max(damage.places, 1), "place")
        what = [_many(damage.blocks, "block")] if damage.blocks else []
        if others:
            what.append(_many(others, "other entry", "other entries") if what else _many(others, "entry", "entries"))
        parts.append(f"{' and '.join(what)} damaged, in {places}" if what else f"bytes damaged in {places}")
    if found.gap_samples:
        parts.append(
            f"{_many(found.gap_samples, 'sample')} missing in {_many(found.gaps, 'place')} (read it with --gaps)"
        )
    if found.misplaced:
        parts.append(f"{_many(found.misplaced, 'sample')} left out whose number had occurred before")
    return f" with {'; '.join(parts)}" if parts else ""


def _many(n: int, one: str, more: str = "") -> str:
    return f"{n} {one if n == 1 else more or one + 's'}"


def _fate(journal: Path, *, delete: bool, gone: bool) -> str:
    if gone:
        return f" {journal.name} removed"
    if delete:
        return f" {journal.name} is kept: the record does not hold all of it"
    return f" {journal.name} is kept; --delete removes it"
