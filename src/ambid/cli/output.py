"""What a verb gives: files, put in place together; text or JSON; an exit code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.terminal import painter
from ambid.estimation.progress import silent
from ambid.job.files import FIGURE_ENDINGS, PAGE_ENDINGS, Files

if TYPE_CHECKING:
    from ambid.estimation.progress import Tick
    from ambid.estimation.result import Result

FAILED_CHECK = 3


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
