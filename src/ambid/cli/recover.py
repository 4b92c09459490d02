"""``ambid recover``: the record of a recording that could not finish."""

from __future__ import annotations

from pathlib import Path

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import AmbidError, DeviceError


@verb("recover")
def command(v: Values) -> None:
    """Recover a recording that was killed, or lost its power, from the journal that it left.

    Every block that the recorder had acknowledged comes back. Damaged or missing samples are counted and become empty
    rows; the other verbs treat these by --gaps. An existing record is left as it is.
    """
    for name, one in {"-o": v.out, "--json": v.json, "--plot": v.plot, "--report": v.report}.items():
        if one is not None and len(v.journals) > 1:
            raise AmbidError(
                f"{name} {one} is one file for {len(v.journals)} journals. Recover them one by one, or without {name}"
            )
    refused: list[AmbidError] = []
    sound = True
    for journal in v.journals:
        try:
            outputs = Outputs(journal, **v.outputs)
            sound &= _recover(journal, v.out, outputs, delete=v.delete, force=v.force, quiet=v.json == "-")
        except AmbidError as failure:
            refused.append(failure)
    for other in refused[1:]:
        typer.echo(f"ambid: {other}", err=True)
    if refused:
        raise refused[0]
    end(failed=v.strict and not sound)


def _recover(journal: Path, output: Path | None, outputs: Outputs, *, delete: bool, force: bool, quiet: bool) -> bool:
    """Make the record of one journal, say what was found, and return whether nothing of it was damaged or is missing.

    `quiet`: standard output is for the result alone.
    """
    from ambid.acquisition.recorder import JournalReader, record_path, recorded_already, recorded_from
    from ambid.acquisition.recorder.journal import sync_folder

    if not journal.name:
        raise AmbidError(f"journal {str(journal)!r} is a folder; it must be a file. Name the file inside it")
    path = record_path(journal) if output is None else output
    outputs.claim(path, "out", force=True)
    with JournalReader.open(journal) as reader, progress("recover"), outputs:
        there = recorded_already(reader, path) if path.exists() and not force else None
        made = there or recorded_from(reader, path, force=force)
        if made is None:
            raise DeviceError(f"journal {journal} holds no intact block. Remove it")
        outputs.give(made)
        gone = delete and not made.keep_journal
        if gone:
            journal.unlink()
            sync_folder(journal)
    outputs.show(made)
    done = "written" if there is None else "holds that already: nothing to do"
    typer.echo(f"{path} {done}.{_fate(journal, delete=delete, gone=gone)}", err=quiet)
    return made.passed


def _fate(journal: Path, *, delete: bool, gone: bool) -> str:
    if gone:
        return f" {journal.name} removed"
    if delete:
        return f" {journal.name} is kept: the record does not hold all of it"
    return f" {journal.name} is kept; --delete removes it"
