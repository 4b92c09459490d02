"""Results put into a ledger, and asked for: which bearing, which record, taken when."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError
from ambid.ledger import Ledger, entry_of, open_ledger
from ambid.ledger.entry import moment, sha_of
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from ambid.ledger import History
    from ambid.rig import Rig

_FILE = "file"  # the word for the time of the record's file


def history(bearing: str, *, ledger: str | Path) -> History:
    """Return what is known of a bearing over time.

    Parameters
    ----------
    bearing : str
        Its name; of a rotor the machine's.
    ledger : str or Path
        File of SQLite, or URL of PostgreSQL.

    Returns
    -------
    History

    Raises
    ------
    AmbidError
        If there is no such ledger, or no such bearing in it.
    """
    with open_ledger(ledger, write=False) as found:
        return found.history(bearing)


def bearing_of(rig: Rig | None, given: str | None) -> str:
    """Return the name of the bearing: what is given, else the rig's name."""
    name = given if given is not None else "" if rig is None else rig.name
    if not name.strip():
        raise AmbidError(
            f"the ledger has to know which bearing this is. Give {setting('bearing', 'NAME')}, or a rig that has a name"
        )
    return name


def time_of(given: str | None, record: Path) -> float | None:
    """Return when a record was taken as its setting says; None: as the record says itself, which CSV cannot."""
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


def keep(
    ledger: Ledger, result: Any, records: Sequence[Path], rig: Rig, *, bearing: str, taken_at: float | None, job: str,
    settings: str,
) -> str:  # fmt: skip
    """Put a result into a ledger, and say so; nothing is added where the same one is there."""
    from ambid.job.presentation import document
    from ambid.report.history import day

    made = entry_of(
        result, bearing=bearing, sha=sha_of(*records), rig=rig, settings=settings, job=job, taken_at=taken_at,
        document=document(result),
    )  # fmt: skip
    if ledger.add([made]):
        return f"stored in {ledger.shown}: {made.bearing}, record of {day(made.taken_at)} UTC"
    return f"{ledger.shown} has this already (same record, rig, settings and version); nothing was added"
