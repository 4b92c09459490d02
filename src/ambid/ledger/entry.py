"""What a ledger keeps of one estimate, and the key by which the same one is known again."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.estimation.estimate import EstimatedParameter
from ambid.rig import Rig, rig_text


@dataclass(frozen=True, slots=True, kw_only=True)
class Note:
    """Something that happened to a bearing."""

    at: float  # s since 1970, UTC
    kind: str  # as the events of a track, or the user's own word
    text: str
    parameter: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entry:
    """One estimate as a ledger keeps it; plain values, so that processes can hand it on.

    Attributes
    ----------
    bearing : str
        Name of the bearing, or of the machine where the rig is a rotor's.
    taken_at : float
        When the record was taken, s since 1970, UTC.
    sha, rig_sha : str
        SHA-256 of record and rig, `sha_of` and `rig_sha_of`.
    settings : str
        What was asked for beside them, `settings_text`.
    version : str
        Of ambid.
    job : str
        The verb.
    record : str
        Name of the record's file.
    status, verdict, model : str
        As the result has them.
    failed : tuple of str
        Names of the checks that speak against it.
    parameters : tuple of EstimatedParameter
    covariance_names : tuple of str
        Order of `covariance`.
    covariance : ndarray, shape (n, n), SI, or None
    document : str
        The result's JSON; empty: not kept.
    rig_name, rig : str
        Name and text of the rig.
    events : tuple of Note
    """

    bearing: str
    taken_at: float
    sha: str
    rig_sha: str
    settings: str
    version: str
    job: str
    record: str = ""
    status: str
    verdict: str
    model: str
    failed: tuple[str, ...] = ()
    parameters: tuple[EstimatedParameter, ...]
    covariance_names: tuple[str, ...] = ()
    covariance: Array | None = None
    document: str = ""
    rig_name: str = ""
    rig: str = ""
    events: tuple[Note, ...] = ()

    @property
    def key(self) -> str:
        """What is the same for the same record, rig, settings and version, and for no other."""
        return key_of(self.sha, self.rig_sha, self.settings, self.version)


def entry_of(
    result: Any,
    *,
    bearing: str,
    taken_at: float,
    sha: str,
    rig: Rig,
    settings: str,
    job: str = "identify",
    document: str = "",
    events: Sequence[Note] = (),
) -> Entry:
    """Return what a ledger keeps of a result.

    Parameters
    ----------
    result : Estimate, RotorEstimate, NonlinearBearingEstimate, Margins, BlackBoxFit or NonlinearFit
    bearing : str
        Its name; of a rotor the machine's.
    taken_at : float
        When the record was taken, s since 1970, UTC.
    sha : str
        SHA-256 of the record.
    rig : Rig
        Through which it was read.
    settings : str
        As `settings_text` writes them.
    job : str, optional
        The verb.
    document : str, optional
        The result's JSON.
    events : sequence of Note, optional

    Returns
    -------
    Entry

    Raises
    ------
    AmbidError
        If bearing or time is missing.
    """
    if not bearing.strip():
        raise AmbidError("the bearing has no name. Give --bearing NAME, or a name in the rig")
    if not math.isfinite(taken_at):
        raise AmbidError(f"the record's time is {taken_at}; it must be a number of seconds since 1970. Correct it")
    about: Mapping[str, object] = getattr(result, "record", None) or (getattr(result, "records", None) or ({},))[0]
    return Entry(
        bearing=" ".join(bearing.split()), taken_at=taken_at, sha=sha, rig_sha=rig_sha_of(rig), settings=settings,
        version=installed("ambid"), job=job, record=str(about.get("file") or ""),
        status=getattr(result, "status", "converged"), verdict=result.verdict.word,
        model=getattr(result, "model", "") if isinstance(getattr(result, "model", ""), str) else result.structure,
        failed=tuple(dict.fromkeys(r.check for r in result.verdict.reasons)), parameters=_parameters(result),
        covariance_names=getattr(result, "covariance_names", ()), covariance=getattr(result, "covariance", None),
        document=document, rig_name=rig.name, rig=_rig_text(rig), events=tuple(events),
    )  # fmt: skip


def _parameters(result: Any) -> tuple[EstimatedParameter, ...]:
    """Return the numbers of a result: its parameters, bending modes, and the peak of the sensitivity by axis."""
    found = [*getattr(result, "parameters", ()), *getattr(result, "mode_parameters", ())]
    for axis, s in (getattr(result, "sensitivity", None) or {}).items():
        peak = s["peak_db"] if isinstance(s, Mapping) else s.peak_db
        number = peak if isinstance(peak, Mapping) else {n: getattr(peak, n) for n in peak.__slots__}
        found.append(EstimatedParameter(name=f"{axis}.sensitivity", unit="dB", role="free", **number))
    return tuple(found)


def key_of(sha: str, rig_sha: str, settings: str, version: str | None = None) -> str:
    """Return what is the same for the same record, rig, settings and version (default: this one), 64 digits."""
    parts = [sha, rig_sha, settings, installed("ambid") if version is None else version]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def sha_of(*records: Path) -> str:
    """Return the SHA-256 of a record's file as it lies there; of several that of theirs, in their order."""
    found = list[str]()
    for path in records:
        try:
            with path.open("rb") as file:
                found.append(hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as failure:
            raise AmbidError(f"record {path} cannot be read: {failure.strerror or failure}. Check the path") from None
    return found[0] if len(found) == 1 else hashlib.sha256(" ".join(found).encode()).hexdigest()


def rig_sha_of(rig: Rig) -> str:
    """Return the SHA-256 of what a rig says, its calibration tables included; comments and layout do not count."""
    tables = [c.calibration.sha256 for c in rig.channels if c.calibration is not None]
    return hashlib.sha256("\n".join([_rig_text(rig), *tables]).encode()).hexdigest()


def _rig_text(rig: Rig) -> str:
    return rig_text(rig, Path.cwd() if rig.source is None else rig.source.resolve().parent)


def settings_text(job: str, **settings: object) -> str:
    """Return a job and its options as text; what was not given (None, False, nothing) does not count."""
    given = {name: x for name, x in settings.items() if x is not None and x is not False and x not in ((), [], {})}
    return json.dumps({"job": job, **given}, sort_keys=True, default=str, separators=(",", ":"))


def moment(text: str, option: str = "--taken-at") -> float:
    """Read a date, or a date and time, as ISO 8601 has it; without an offset it is UTC. Returns s since 1970, UTC."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise AmbidError(
            f"{option} is {text!r:.40}; it must be a date and time such as 2026-03-01T14:30 (UTC, or with an offset). "
            "Correct it"
        ) from None
    return (found if found.tzinfo is not None else found.replace(tzinfo=UTC)).timestamp()
