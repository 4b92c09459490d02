"""What a verb gives: files, put in place together; text or JSON; an exit code."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.options import Values
from ambid.cli.terminal import painter
from ambid.errors import AmbidError
from ambid.estimation.progress import silent
from ambid.job.files import FIGURE_ENDINGS, PAGE_ENDINGS, Files
from ambid.settings.caller import refuse_given, setting

if TYPE_CHECKING:
    from ambid.estimation.progress import Tick
    from ambid.estimation.result import Result
    from ambid.ledger import Ledger
    from ambid.rig import Rig

FAILED_CHECK = 3
NOTHING = 4  # of many, none succeeded
_FILE = "file"  # the word for the time of the record's file


def json_path(json: str | None) -> Path | None:
    """Return the file that ``--json`` names; None where there is none, or standard output is meant."""
    return None if json in (None, "-") else Path(str(json))


def end(*, failed: bool) -> None:
    """End the verb with exit code 3 where a check failed and that is to be told."""
    if failed:
        raise typer.Exit(FAILED_CHECK)


class Outputs(Files):
    """The files that a verb is going to write, and what it prints.

    `inputs`: files that are read; none of them may be written over; `json`, `plot`, `report`: as given.
    """

    def __init__(
        self, *inputs: Path | None, json: str | None = None, plot: Path | None = None, report: Path | None = None
    ) -> None:
        """Check that what is asked for can be written."""
        super().__init__(*inputs)
        self._json, self._plot, self._report, self._document = json, plot, report, ""
        self.claim(json_path(json), "json")
        self.claim(plot, "plot", FIGURE_ENDINGS)
        self.claim(report, "report", PAGE_ENDINGS)

    def replaced(self, path: Path) -> None:
        """Tell that a file is going to be replaced."""
        typer.echo(f"{path.name} is replaced", err=True)

    def give(self, result: Result, tick: Tick = silent) -> None:
        """Write what is asked for of a result: its figure, its page, its JSON; `show` prints it."""
        from ambid.job import presentation

        self.draw(self._plot, result.plot, tick)
        if self._report is not None:
            presentation.stage_page(self, self._report, result)
        self._document = presentation.document(result)
        path = json_path(self._json)
        if path is not None:
            self.stage_text(path, self._document)

    def draw(self, path: Path | None, figure: Callable[[], Any], tick: Callable[[str], object]) -> None:
        """Draw a figure, or several, where a file is named for it."""
        if path is not None:
            from ambid.report.drawing import save

            tick("draw")
            pages = figure()
            self.stage(path, lambda beside: save(pages, beside))

    def show(self, result: Result, *, strict: bool = False) -> None:
        """Print a result, once the files are in place: its JSON after ``--json -``, else its text.

        `strict`: end the verb with exit code 3 unless it is usable.
        """
        from ambid.job import presentation

        if self._json == "-":
            typer.echo(self._document, nl=False)
        else:
            typer.echo(presentation.text(result, paint=painter()))
        end(failed=strict and not result.passed)


@contextmanager
def keeping(
    v: Values, job: str, records: Sequence[Path], *, taken_now: bool = False, **settings: object
) -> Iterator[Callable[[Any], None]]:
    """Open the ledger that is named, and give what keeps a result there; without one that does nothing.

    `taken_now`: the records are yet to be taken; `settings`: as the job's function has them, a file as a path.
    """
    ledger, taken_at = v.ledger, v.get("taken_at")
    if ledger is None:
        refuse_given({"bearing": v.bearing, "taken_at": taken_at}, "{} is for --ledger. Give that too, or omit {}")
        yield lambda _: None
        return
    from ambid.job.data import known_rig
    from ambid.ledger import open_ledger
    from ambid.ledger.entry import settings_text, sha_of

    bench = known_rig(v.rig)
    name = _bearing_of(None if v.rig is None else bench, v.bearing)
    at = None if taken_now else _time_of(taken_at, records[0])
    given = {key: sha_of(x) if isinstance(x, Path) else x for key, x in settings.items()}
    new = "://" not in ledger and not Path(ledger).exists()
    used = False

    def store(result: Any) -> None:
        nonlocal used
        words = settings_text(job, **given)
        said = _keep(place, result, records, bench, bearing=name, taken_at=at, job=job, settings=words)
        used = True
        typer.echo(said, err=True)

    try:
        with open_ledger(ledger) as place:
            yield store
    finally:
        if new and not used:  # a job that failed leaves no empty ledger
            Path(ledger).unlink(missing_ok=True)


def _bearing_of(rig: Rig | None, given: str | None) -> str:
    """Return the name of the bearing: what is given, else the rig's name."""
    name = given if given is not None else "" if rig is None else rig.name
    if not name.strip():
        raise AmbidError(
            f"the ledger has to know which bearing this is. Give {setting('bearing', 'NAME')}, or a rig that has a name"
        )
    return name


def _time_of(given: str | None, record: Path) -> float | None:
    """Return when a record was taken as its setting says; None: as the record says itself, which CSV cannot."""
    from ambid.ledger.entry import moment

    if given == _FILE:
        return record.stat().st_mtime
    if given is not None:
        return moment(given)
    if record.name.lower().endswith((".csv", ".csv.gz")):
        raise AmbidError(
            f"{record} does not say when it was taken, and the ledger has to know. Give "
            f"{setting('taken_at', 'TIME')}, or "
            f"{setting('taken_at', 'file')} for the time of its file"
        )
    return None


def _keep(
    ledger: Ledger, result: Any, records: Sequence[Path], rig: Rig, *, bearing: str, taken_at: float | None, job: str,
    settings: str,
) -> str:  # fmt: skip
    """Put a result into a ledger, and say so; nothing is added where the same one is there."""
    from ambid.job.presentation import document
    from ambid.ledger.entry import REMOVED, day, entry_of, sha_of

    made = entry_of(
        result, bearing=bearing, sha=sha_of(*records), rig=rig, settings=settings, job=job, taken_at=taken_at,
        document=document(result),
    )  # fmt: skip
    new = ledger.add([made])
    there = ledger.stored([made.key])[made.key]
    place = f"{there.bearing}, record of {day(there.taken_at)} UTC"
    if there.bearing == REMOVED:
        place = f"what was removed, record of {day(there.taken_at)} UTC; 'ambid history --undo N' brings it back"
    if new:
        return f"stored in {ledger.shown}: {place}"
    return f"{ledger.shown} has this already (same record, rig, settings and version): {place}; nothing was added"
