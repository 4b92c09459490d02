"""``--ledger``: where a verb keeps its result; asked for what it needs before the work begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from ambid.cli.options import option
from ambid.settings.caller import refuse_given

LedgerPlace = Annotated[
    str | None, option("--ledger FILE.db|URL", "Keep the result in this ledger: file of SQLite, or URL of PostgreSQL.")
]
Bearing = Annotated[str | None, option("--bearing NAME", "With --ledger: which bearing this is.", "name of the rig")]
TakenAt = Annotated[
    str | None,
    option(
        "--taken-at TIME|file",
        "With --ledger: when the record was taken, such as 2026-03-01T14:30, of UTC; file: as its file says.",
        "as the record says",
    ),
]


@contextmanager
def keeping(
    ledger: str | None,
    records: Sequence[Path],
    rig: Path | None,
    *,
    bearing: str | None,
    taken_at: str | None = None,
    job: str,
    taken_now: bool = False,
    **settings: object,
) -> Iterator[Callable[[Any], None]]:
    """Open the ledger that is named, and give what keeps a result there; without one that does nothing.

    `taken_now`: the records are yet to be taken; `settings`: as the job's function has them, a file as a path.
    """
    if ledger is None:
        refuse_given({"bearing": bearing, "taken_at": taken_at}, "{} is for --ledger. Give that too, or omit {}")
        yield lambda _: None
        return
    from ambid.job.data import known_rig
    from ambid.job.keeping import bearing_of, keep, time_of
    from ambid.ledger import open_ledger
    from ambid.ledger.entry import settings_text, sha_of

    bench = known_rig(rig)
    name = bearing_of(None if rig is None else bench, bearing)
    at = None if taken_now else time_of(taken_at, records[0])
    given = {key: sha_of(x) if isinstance(x, Path) else x for key, x in settings.items()}
    new = "://" not in ledger and not Path(ledger).exists()
    used = False

    def store(result: Any) -> None:
        nonlocal used
        words = settings_text(job, **given)
        said = keep(place, result, records, bench, bearing=name, taken_at=at, job=job, settings=words)
        used = True
        typer.echo(said, err=True)

    try:
        with open_ledger(ledger) as place:
            yield store
    finally:
        if new and not used:  # a job that failed leaves no empty ledger
            Path(ledger).unlink(missing_ok=True)
