"""From a journal to a record: in two passes, first to see what is there, then to write it, piece by piece.

Time stays uniform: samples that are missing become rows of NaN, counted in the record's history, so that whoever reads
the record says how to treat them. Rows whose numbers were there before are not written a second time; they are counted,
and the journal is kept for their sake. The record is put in its place only when it was read back.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.recorder.disk import sync_folder
from ambid.acquisition.recorder.layout import JournalHeader
from ambid.acquisition.recorder.reader import JournalReader, Survey, survey
from ambid.arrays import Array
from ambid.errors import DeviceError, RecordError, counted
from ambid.estimation.result import Reason, Result
from ambid.record.chunks import check_chunks, write_chunks
from ambid.record.csv_format import head_lines
from ambid.record.record import Channel, Record, Step
from ambid.tracking.blocks import Block
from ambid.units import UNKNOWN, parse_unit

FORMATS = (".h5", ".hdf5", ".csv", ".csv.gz")
_ROWS = 1 << 16  # that are held at once
_GAP_ROWS = 10_000_000  # of NaN, that are always allowed
_GAP_SHARE = 10  # and so many times the samples


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Recorded(Result):
    """A record that was made from a journal, file schema ``ambid.recovery/1``."""

    path: Path  # of the record
    rate_hz: float
    survey: Survey  # what the journal held, and what it lacked

    @property
    def keep_journal(self) -> bool:
        """Whether the journal holds, or may hold, what is not in the record."""
        return bool(self.survey.misplaced or self.survey.damage.frames or self.survey.damage.places)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What was damaged, and what is missing."""
        found, damage, said = self.survey, self.survey.damage, list[Reason]()
        if damage.frames or damage.places:
            others = damage.frames - damage.blocks
            what = [counted(damage.blocks, "block")] if damage.blocks else []
            if others:
                what.append(f"{others} {'other ' if what else ''}{'entry' if others == 1 else 'entries'}")
            where = counted(max(damage.places, 1), "place")
            text = f"{' and '.join(what)} damaged, in {where}" if what else f"bytes damaged in {where}"
            said.append(Reason(check="journal", text=f"{text}. Keep it, and look at the disk"))
        if found.gap_samples:
            text = f"{counted(found.gap_samples, 'sample')} missing in {counted(found.gaps, 'place')}"
            said.append(Reason(check="samples", text=f"{text}. Read the record with --gaps"))
        if found.misplaced:
            text = f"{counted(found.misplaced, 'sample')} left out whose number had occurred before. Keep the journal"
            said.append(Reason(check="order", text=text))
        return tuple(said)


def check_target(path: Path, header: JournalHeader, *, force: bool) -> None:
    """Refuse a record that could not be written, before anything is recorded.

    `path`: the record to be; `force`: whether it may exist.
    """
    if not path.name.lower().endswith(FORMATS):
        raise DeviceError(f"{path}: a recording is written as {', '.join(FORMATS)}. Name it so")
    if path.is_dir():
        raise DeviceError(f"{path} is a folder; it must be a file. Name a file inside it")
    if not path.parent.is_dir():
        raise DeviceError(f"{path}: there is no folder {path.parent}. Make it first, or correct the path")
    if path.exists() and not force:
        raise DeviceError(f"{path} already exists. Choose another name, remove it, or give --force")
    if ".csv" in path.name.lower():
        try:
            head_lines(_record(header, Survey(), {}))
        except RecordError as failure:
            raise DeviceError(str(failure)) from None


def recorded_from(
    reader: JournalReader,
    path: Path,
    *,
    force: bool = False,
    extra: Mapping[str, object] = MappingProxyType({}),
) -> Recorded | None:
    """Make the record of a journal, read it back, and put it in its place.

    `path`: ``.h5``, ``.hdf5``, ``.csv`` or ``.csv.gz``; `force`: whether a file that is there may be replaced; `extra`:
    what else its history is to say. Returns none if there is no sample
    in the journal.
    """
    found = survey(reader)
    if not found.samples:
        return None
    _check_gaps(found, reader.path)
    check_target(path, reader.header, force=force)
    record = _record(reader.header, found, extra)
    # Named after the journal, which is locked: what a killed conversion leaves is written over by the next one.
    beside = path.with_name(f".{reader.path.name}-{path.name}")
    try:
        rows = _rows(reader, found)
        check = write_chunks(record, found.rows, rows, beside, _texts(reader.header, found))
        _sync_file(beside)
        check()
        _put_in_place(beside, path, force=force)
    except (RecordError, OSError) as failure:
        said = str(failure).replace(str(beside), str(path))
        raise DeviceError(f"{said.rstrip('.')}. The journal {reader.path} is kept; then: ambid recover {reader.path}"
                          ) from None  # fmt: skip
    finally:
        beside.unlink(missing_ok=True)
    return Recorded(path=path, rate_hz=reader.header.rate_hz, survey=found)


def recorded_already(reader: JournalReader, path: Path) -> Recorded | None:
    """Hold a record that is there against a journal: the power may have gone after the one and before the other's
    end.

    `path`: of the record. Returns none unless the record reads back as every value, column and event that the journal
    gives.
    """
    found = survey(reader)
    if not found.samples or not path.is_file() or not path.name.lower().endswith(FORMATS):
        return None
    try:
        _check_gaps(found, reader.path)
        record = _record(reader.header, found, {})
        check_chunks(record, found.rows, _rows(reader, found), path, _texts(reader.header, found))
    except (RecordError, DeviceError):
        return None
    return Recorded(path=path, rate_hz=reader.header.rate_hz, survey=found)


def read_acquisition(path: str | Path) -> tuple[JournalHeader, tuple[DeviceEvent, ...]]:
    """Read what a recorded HDF5 file holds beside its record.

    Parameters
    ----------
    path : str or Path
        ``.h5`` or ``.hdf5`` that a recorder or ``ambid recover`` wrote.

    Returns
    -------
    header : JournalHeader
        Device, columns with their roles, text of the rig.
    events : tuple of DeviceEvent
        In their order.

    Raises
    ------
    DeviceError
        If the file is of another kind.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            found = json.loads(file["acquisition"].asstr()[()])
    except (OSError, KeyError, ValueError) as failure:
        raise DeviceError(f"{path} holds no acquisition ({failure}). Name a file that a recorder wrote") from None
    return JournalHeader.from_json(found["header"]), tuple(DeviceEvent(**e) for e in found["events"])


def _texts(header: JournalHeader, found: Survey) -> dict[str, str]:
    """What a recorded HDF5 file holds beside its record."""
    return {"acquisition": json.dumps({"header": header.as_json(), "events": [asdict(e) for e in found.events]})}


def _record(header: JournalHeader, found: Survey, extra: Mapping[str, object]) -> Record:
    """Everything of the record but its values."""
    settings: dict[str, object] = {
        "device": header.device.get("kind", ""),
        "port": header.device.get("port", ""),
        "started": header.started,
        "samples": found.samples,
        "events": len(found.events),
    }
    if found.stamp_error_s * header.rate_hz > 1:
        settings["stamp_error_s"] = found.stamp_error_s
    steps = [Step(name="acquire", settings=settings | dict(extra))]
    lacking = {
        "lost_samples": found.gap_samples,
        "places": found.gaps,
        "misplaced_samples": found.misplaced,
        "damaged_blocks": found.damage.blocks,
    }
    if any(lacking.values()):
        steps.append(Step(name="gaps", settings={k: v for k, v in lacking.items() if v}))
    none = np.empty(0)
    provenance = {k: str(v) for k, v in header.device.items() if k in ("kind", "port")}
    provenance |= {"started": header.started, "recorder": f"ambid {header.version}"}
    if header.rig:
        provenance["rig_sha256"] = header.rig_sha256
    return Record(
        rate_hz=header.rate_hz,
        start_s=found.start_s,
        channels=tuple(
            Channel(name=c.name, unit=_unit(c.unit), values=none, source_unit=c.unit) for c in header.columns
        ),
        history=tuple(steps),
        provenance=MappingProxyType(provenance),
    )


def _unit(text: str) -> str:
    return text if text == UNKNOWN else parse_unit(text).si


def _check_gaps(found: Survey, path: Path) -> None:
    """Refuse numbers that no recording has: the record would be nothing but rows of NaN."""
    if found.gap_samples > _GAP_ROWS + _GAP_SHARE * found.samples:
        raise DeviceError(
            f"journal {path}: {found.gap_samples} samples are missing between the {found.samples} that are there; the"
            " numbers of the device cannot be right. The journal is kept; read it with JournalReader"
        )


def _rows(reader: JournalReader, found: Survey) -> Iterator[Array]:
    """Rows in the order of their numbers, NaN where there are none, in pieces of the same length."""
    held = np.empty((_ROWS, len(reader.header.columns)))
    n = 0
    for values in _in_order(reader, found):
        at = 0
        while at < len(values):
            taken = min(len(values) - at, _ROWS - n)
            held[n : n + taken] = values[at : at + taken]
            n, at = n + taken, at + taken
            if n == _ROWS:
                yield held
                n = 0
    if n:
        yield held[:n]


def _in_order(reader: JournalReader, found: Survey) -> Iterator[Array]:
    end = found.first
    nothing = np.full((_ROWS, len(reader.header.columns)), np.nan)
    for item in reader.items():
        if not isinstance(item, Block):
            continue
        while item.first > end:
            taken = min(item.first - end, _ROWS)
            yield nothing[:taken]
            end += taken
        if item.first + len(item.values) > end:
            yield item.values[end - item.first :]
            end = item.first + len(item.values)


def _sync_file(path: Path) -> None:
    fd = os.open(path, os.O_RDWR)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _put_in_place(beside: Path, path: Path, *, force: bool) -> None:
    """Give a file its name; one that came into being meanwhile is not replaced without `force`."""
    if force:
        os.replace(beside, path)
    else:
        try:
            os.link(beside, path)
        except FileExistsError:
            raise DeviceError(f"{path} came into being while it was recorded. Give another name with -o") from None
        except OSError:  # a file system without links
            if path.exists():
                raise DeviceError(f"{path} came into being while it was recorded. Give another name with -o") from None
            os.replace(beside, path)
    sync_folder(path)
