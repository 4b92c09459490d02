"""What a journal says of its recording: header and events, as JSON."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from ambid.acquire.device import Column, DeviceEvent, DeviceInfo
from ambid.errors import DeviceError, UnitError
from ambid.units import UNKNOWN, parse_unit

SCHEMA = "ambid.journal/1"
SUFFIX = ".journal"


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalHeader:
    """What is recorded, from what, since when."""

    columns: tuple[Column, ...]  # in the order of a block's values
    rate_hz: float  # samples in one second
    # who gave them: ``kind``, ``port``, ``identity``
    device: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    rig: str = ""  # text of the rig file; empty where there is none
    started: str = ""  # date and time, UTC, as ISO 8601 has it
    version: str = ""  # of the program that recorded

    def __post_init__(self) -> None:
        names = [c.name for c in self.columns]
        if not names or len(set(names)) < len(names):
            raise DeviceError(f"columns {names} make no record; it needs at least one, each with its own name. Rename")
        if not 0 < self.rate_hz < float("inf"):
            raise DeviceError(f"a rate of {self.rate_hz} Hz records nothing; it must be positive. Correct it")
        for column in self.columns:
            _check_unit(column)

    @classmethod
    def of(cls, info: DeviceInfo, rig: str = "") -> Self:
        """Describe a recording that begins now.

        `info`: of the device that gives the samples; `rig`: text of the rig file.
        """
        from importlib.metadata import version

        return cls(
            columns=info.columns,
            rate_hz=info.rate_hz,
            device={"kind": info.kind, "port": info.port, "identity": dict(info.identity)},
            rig=rig,
            started=datetime.now(UTC).isoformat(timespec="milliseconds"),
            version=version("ambid"),
        )

    @property
    def rig_sha256(self) -> str:
        """SHA-256 of the rig's text in UTF-8; empty where there is no rig."""
        return hashlib.sha256(self.rig.encode()).hexdigest() if self.rig else ""

    def as_json(self) -> dict[str, object]:
        """Return it as a JSON object.

        Returns what `from_json` takes.
        """
        columns = [asdict(c) for c in self.columns]
        rest = {k: getattr(self, k) for k in ("rate_hz", "rig", "started", "version")}
        return {
            "schema": SCHEMA, "columns": columns, **rest, "device": dict(self.device), "rig_sha256": self.rig_sha256,
        }  # fmt: skip

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        if found.get("schema") != SCHEMA:
            raise DeviceError(f"the journal's schema is {found.get('schema')!r}; this program reads {SCHEMA!r}."
                              " Recover it with the version that recorded it")  # fmt: skip
        try:
            columns = tuple(
                Column(name=c["name"], role=c["role"], unit=c["unit"], span=tuple(c["span"]) if c["span"] else None)
                for c in found["columns"]
            )
            rest = {k: found[k] for k in ("rate_hz", "device", "rig", "started", "version")}
            return cls(columns=columns, **rest)
        except (KeyError, TypeError) as failure:
            raise DeviceError(f"the journal's header lacks {failure}. It was written by another version") from None


def _check_unit(column: Column) -> None:
    """Refuse a unit that a record file would scale: a recording holds values as they came."""
    if column.unit == UNKNOWN:
        return
    try:
        unit = parse_unit(column.unit)
    except UnitError as failure:
        raise DeviceError(f"column {column.name!r}: {failure}") from None
    if float(unit.to_si(1.0)) != 1.0 or float(unit.to_si(0.0)) != 0.0:
        raise DeviceError(f"column {column.name!r} is in [{column.unit}]; a recording is in SI units or counts [1]."
                          f" Give it in [{unit.si}]")  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened while samples were recorded."""

    # as `DeviceEvent` has it (``fault``, ``state``, ``lost``, ``damaged``, ``link``), or ``excitation``, ``note``
    kind: str
    what: str  # cause, state, or one line for a person
    sample: int | None = None  # number of the sample at which it happened, where that is known
    count: int = 0  # samples or frames concerned

    @classmethod
    def of(cls, told: DeviceEvent) -> Self:
        """Take over what a device told."""
        return cls(kind=told.kind, what=told.what, sample=told.sample, count=told.count)


def json_bytes(value: object) -> bytes:
    """Write a header or an event.

    `value`: JSON-able. Returns UTF-8.
    """
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode()


def event_json(event: Event) -> bytes:
    """Write an event.

    Returns UTF-8.
    """
    return json_bytes(asdict(event))


def event_of(text: bytes) -> Event:
    """Read an event.

    `text`: that `event_json` wrote.
    """
    found = json.loads(text)
    return Event(kind=found["kind"], what=found["what"], sample=found["sample"], count=found["count"])


def journal_path(path: Path) -> Path:
    """Return where the journal of a record lies.

    `path`: the record to be. Returns beside it.
    """
    return path.with_name(path.name + SUFFIX)


def record_path(journal: Path) -> Path:
    """Return the record that a journal was to become.

    Returns beside it.
    """
    name = journal.name.removesuffix(SUFFIX)
    return journal.with_name(name if name != journal.name else name + ".h5")
