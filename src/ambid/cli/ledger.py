"""``ambid ledger``: a ledger checked, backed up, restored, merged with another, and thinned into an archive."""

from __future__ import annotations

import time
from pathlib import Path

import typer

from ambid.cli.options import Values, verb
from ambid.cli.output import end
from ambid.errors import AmbidError, counted
from ambid.settings.caller import command, setting

group = typer.Typer(
    rich_markup_mode=None, no_args_is_help=False, help="Check, back up, restore, merge and thin a ledger."
)


@group.command("check", short_help="check that a ledger is whole")
@verb("ledger check")
def check(v: Values) -> None:
    """Check that a ledger is whole: the database itself, and that what belongs together agrees.

    A ledger of an older version is brought to the present one. The exit code is 3 where something is wrong.
    """
    from ambid.ledger import open_ledger

    with open_ledger(v.ledger, make=False) as ledger:
        wrong = ledger.check()
        typer.echo("\n".join([f"{ledger.shown}: {text}" for text in wrong] or [f"{ledger.shown} is whole"]))
    if wrong:
        typer.echo("Restore a backup ('ambid ledger restore'), or keep the file and report this", err=True)
    end(failed=bool(wrong))


@group.command("backup", short_help="write all that a ledger holds into one file")
@verb("ledger backup")
def backup(v: Values) -> None:
    """Write all that a ledger holds into one file of SQLite, from SQLite and PostgreSQL alike, while others work.

    A file that is there is replaced once the new one is whole; one that is no ledger is refused.
    """
    from ambid.ledger import open_ledger

    with open_ledger(v.ledger, write=False) as ledger:
        before = v.out.exists()
        count = ledger.backup(v.out)
        again = " (the file was replaced)" if before else ""
        typer.echo(f"{v.out} holds {counted(count, 'estimate')} of {ledger.shown}{again}")


@group.command("restore", short_help="put a backup in place of all that a ledger holds")
@verb("ledger restore")
def restore(v: Values) -> None:
    """Put a backup in place of all that a ledger holds, as a whole or not at all.

    What it holds now is backed up first into --out, by which this is undone.
    """
    from ambid.ledger import open_ledger

    if v.out is not None and v.out.resolve() == Path(v.other).resolve():
        raise AmbidError(f"{setting('out', v.out)} is read from. Give another file")
    with open_ledger(v.other, write=False), open_ledger(v.ledger) as ledger:
        known = bool(ledger.bearings() or ledger.corrections())
        if known and v.out is None:
            raise AmbidError(
                f"ledger {ledger.shown} holds estimates, which would be replaced. Give {setting('out', 'FILE.db')}, "
                "into which they are backed up first"
            )
        if known:
            ledger.backup(v.out)
        done = ledger.restore(v.other, who=v.who or "", why=v.why or "")
        back = f" Undo: ambid ledger restore {ledger.shown} {v.out} -o FILE.db" if known else ""
        typer.echo(f"{ledger.shown}: {done.text}.{back}")


@group.command("merge", short_help="add what another ledger has")
@verb("ledger merge")
def merge(v: Values) -> None:
    """Add to a ledger what another one has and it lacks, failures, corrections and silenced alarms included.

    An estimate that both have stays as it is; the other ledger stays as it was. An archive comes back by this too.
    """
    from ambid.ledger import open_ledger

    with open_ledger(v.other, write=False), open_ledger(v.ledger) as ledger:
        done = ledger.merge(v.other, who=v.who or "", why=v.why or "")
        typer.echo(f"{ledger.shown}: {done.text}. Undo: {command('history', ledger=ledger.shown, undo=done.number)}")


@group.command("retain", short_help="move what is old into an archive")
@verb("ledger retain")
def retain(v: Values) -> None:
    """Move estimates of old records into an archive; one a month of each bearing stays, or as --keep says.

    What moves is in the archive first. A row of each estimate stays, so that a fleet does not do its record again.
    """
    from ambid.ledger import open_ledger
    from ambid.ledger.rules import DAY_S

    with open_ledger(v.ledger, make=False) as ledger:
        before = time.time() - DAY_S * v.older_than
        done = ledger.retain(v.out, before=before, keep=v.keep, who=v.who or "", why=v.why or "")
        typer.echo(f"{ledger.shown}: {done.text}. Undo: ambid ledger merge {ledger.shown} {v.out}")
