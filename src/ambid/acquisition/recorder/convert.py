"""From a journal, sound or not, to a record: each whole frame comes back, missing samples are rows of NaN, repeated
rows left out; all is counted. After damage the next sync word is sought. The record is put in place once read back.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Self

import numpy as np

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.recorder.journal import (
    BLOCK,
    CLOSE,
    EVENT,
    HEAD_SIZE,
    HEADER,
    PREAMBLE_SIZE,
    SYNC,
    VERSION,
    Head,
    JournalHeader,
    event_of,
    head_of,
    is_whole,
    lock,
    sync_folder,
    unpacked_values,
    version_of,
)
from ambid.arrays import Array
from ambid.errors import DeviceError, RecordError, counted
from ambid.estimation.result import Reason, Result
from ambid.record.chunks import check_chunks, write_chunks
from ambid.record.csv_format import head_lines
from ambid.record.record import Channel, Record, Step
from ambid.settings.caller import setting
from ambid.tracking.blocks import Block
from ambid.units import UNKNOWN, parse_unit

_WINDOW = 1 << 20  # bytes that are read at once
_SECTOR = 4096


@dataclass(slots=True, kw_only=True)
class Damage:
    """What a journal lacks. Counted while it is read."""

    blocks: int = 0  # blocks that are missing or damaged between sound ones
    frames: int = 0  # frames of any kind, those blocks included
    places: int = 0  # stretches of bytes that are no sound frame, the end not counted
    discarded_bytes: int = 0  # bytes of these stretches
    repeated: int = 0  # frames that came a second time and were passed over
    tail_bytes: int = 0  # bytes behind the last sound frame: what was being written when the recording was cut off
    closed: bool = False  # whether the recorder itself ended the journal


class JournalReader:
    """A journal read from its beginning as often as wanted: `read` gives bytes by place and number, `size` is the
    file's. `damage` is of the last reading that came to its end.
    """

    def __init__(self, read: Callable[[int, int], bytes], size: int, path: Path) -> None:
        self.path, self._size = path, size
        self._window = _Window(read, size)
        self._fd = -1
        self.damage = Damage()
        self._journal, self.header = self._identity()

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Open a journal, and keep recorders and other readers away until it is closed."""
        path = Path(path)
        try:
            fd = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
        except OSError as failure:
            raise DeviceError(f"journal {path} cannot be read: {failure.strerror}. Check the path") from None
        lock(fd, path)
        try:
            if path.is_dir():
                raise DeviceError(f"journal {path} is a folder; it must be a file. Name the file inside it")
            reader = cls(lambda at, n: os.pread(fd, n, at), os.fstat(fd).st_size, path)
        except BaseException:
            os.close(fd)
            raise
        reader._fd = fd
        return reader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def items(self) -> Iterator[Block | DeviceEvent]:
        """Read in the order of writing; `damage` is complete once the last item was taken."""
        damage, number, block = Damage(), 0, 0
        end = PREAMBLE_SIZE  # of what is accounted for
        for at, head, data in self._frames(self._journal):
            if at > end:
                damage.places += 1
                damage.discarded_bytes += at - end
            end = at + head.size
            if head.frame < number:
                damage.repeated += 1
                continue
            damage.frames += head.frame - number
            damage.blocks += max(head.block - block, 0)
            number, block = head.frame + 1, head.block + (head.kind == BLOCK)
            damage.closed = head.kind == CLOSE
            yield from _item(head, data)
        damage.tail_bytes = max(self._size - end, 0)
        self.damage = damage

    def _identity(self) -> tuple[int, JournalHeader]:
        """Find a sound header, the first of which is right behind the preamble."""
        version = version_of(self._window.take(0, PREAMBLE_SIZE))
        if version not in (None, VERSION):
            raise DeviceError(
                f"journal {self.path} is of version {version}; this program reads {VERSION}."
                " Recover it with the version that recorded it"
            )
        blocks = 0
        for _, head, data in self._frames(None):
            blocks += head.kind == BLOCK
            if head.kind == HEADER:
                return head.journal, JournalHeader.from_json(json.loads(_payload(head, data)))
        if not self._size:
            raise DeviceError(f"journal {self.path} is empty: it was cut off before anything was recorded. Remove it")
        if version is None:
            raise DeviceError(f"{self.path} is not a journal of ambid. Name a file that ends in .journal")
        if blocks:
            raise DeviceError(
                f"journal {self.path} holds {blocks} sound blocks, but every header, which says what they are, is"
                " damaged. Keep it, and copy it once more from where it was recorded"
            )
        raise DeviceError(
            f"journal {self.path} holds no intact header: it was cut off before anything was acknowledged, or is "
            "damaged throughout. There is nothing to recover: remove it"
        )

    def _frames(self, journal: int | None) -> Iterator[tuple[int, Head, bytes]]:
        """Yield place, head and bytes of every sound frame, of one journal if its number is given."""
        at = PREAMBLE_SIZE if self._size > PREAMBLE_SIZE else 0
        while True:
            head = head_of(self._window.take(at, HEAD_SIZE))
            sound = head is not None and journal in (None, head.journal)
            if sound and head is not None:
                data = self._window.take(at, head.size)
                if is_whole(data, head):
                    yield at, head, data
                    at += head.size
                    continue
                if self._window.take(at + head.size, len(SYNC)) == SYNC:  # its length is checked: only values are bad
                    at += head.size
                    continue
            place = self._window.find(SYNC, at + 1)
            if place < 0:
                return
            at = place


def _item(head: Head, data: bytes) -> Iterator[Block | DeviceEvent]:
    if head.kind == BLOCK:
        yield Block(first=head.first, time_s=head.time_s, values=unpacked_values(_payload(head, data), head))
    elif head.kind == EVENT:
        yield event_of(_payload(head, data))


def _payload(head: Head, data: bytes) -> bytes:
    return data[HEAD_SIZE : HEAD_SIZE + head.length]


class _Window:
    """A file read in large pieces; what the disk cannot give reads as zeros, which no check value passes."""

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read, self._size = read, size
        self._at, self._data = 0, b""

    def take(self, at: int, n: int) -> bytes:
        """Return `n` bytes from a place on; fewer at the end."""
        n = min(n, self._size - at)
        if n <= 0:
            return b""
        begin = at - self._at
        if begin < 0 or begin + n > len(self._data):
            self._at, self._data = at, self._piece(at, max(n, _WINDOW))
            begin = 0
        return self._data[begin : begin + n]

    def find(self, word: bytes, at: int) -> int:
        """Return the next place of a word; -1 if there is none."""
        while at + len(word) <= self._size:
            self.take(at, len(word))
            place = self._data.find(word, at - self._at)
            if place >= 0:
                return self._at + place
            at = self._at + len(self._data) - len(word) + 1
        return -1

    def _piece(self, at: int, n: int) -> bytes:
        end = min(at + n, self._size)
        try:
            return self._whole(at, n).ljust(end - at, b"\0")  # a file that somebody cut off meanwhile
        except OSError:
            return b"".join(self._sector(k, min(_SECTOR - k % _SECTOR, end - k)) for k in _sectors(at, end))

    def _whole(self, at: int, n: int) -> bytes:
        parts: list[bytes] = []
        while n > 0 and (part := self._read(at, n)):
            parts.append(part)
            at, n = at + len(part), n - len(part)
        return b"".join(parts)

    def _sector(self, at: int, n: int) -> bytes:
        try:
            return self._whole(at, n).ljust(n, b"\0")
        except OSError:
            return bytes(n)


def _sectors(at: int, end: int) -> Iterator[int]:
    while at < end:
        yield at
        at += _SECTOR - at % _SECTOR


@dataclass(slots=True, kw_only=True)
class Survey:
    """What a journal holds."""

    blocks: int = 0  # blocks, and rows of them that have a place in the record
    samples: int = 0
    first: int = 0  # number of the first sample, and of the one behind the last
    end: int = 0
    start_s: float = 0.0  # time of the first sample, s
    gaps: int = 0  # places where samples are missing, and how many
    gap_samples: int = 0
    misplaced: int = 0  # rows whose numbers were there before
    # largest difference between a block's time and that of its number at the rate of the header, s
    stamp_error_s: float = 0.0
    events: list[DeviceEvent] = field(default_factory=list)
    damage: Damage = field(default_factory=Damage)

    @property
    def rows(self) -> int:
        """Rows of the record, those of NaN included."""
        return self.end - self.first


def survey(reader: JournalReader) -> Survey:
    """Look through a journal."""
    content = Survey()
    rate = reader.header.rate_hz
    for item in reader.items():
        if isinstance(item, DeviceEvent):
            content.events.append(item)
            continue
        n = len(item.values)
        if content.blocks == 0:
            content.first = content.end = item.first
            content.start_s = item.time_s if np.isfinite(item.time_s) else item.first / rate
        content.blocks += 1
        if item.first > content.end:
            content.gaps += 1
            content.gap_samples += item.first - content.end
        old = min(max(content.end - item.first, 0), n)
        content.misplaced += old
        content.samples += n - old
        content.end = max(content.end, item.first + n)
        if not old and np.isfinite(item.time_s):
            due = content.start_s + (item.first - content.first) / rate
            content.stamp_error_s = max(content.stamp_error_s, abs(item.time_s - due))
    content.damage = reader.damage
    return content


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
        content, damage, reasons = self.survey, self.survey.damage, list[Reason]()
        if damage.frames or damage.places:
            others = damage.frames - damage.blocks
            what = [counted(damage.blocks, "block")] if damage.blocks else []
            if others:
                what.append(f"{others} {'other ' if what else ''}{'entry' if others == 1 else 'entries'}")
            where = counted(max(damage.places, 1), "place")
            text = f"{' and '.join(what)} damaged, in {where}" if what else f"bytes damaged in {where}"
            reasons.append(Reason(check="journal", text=f"{text}. Keep it, and look at the disk"))
        if content.gap_samples:
            text = f"{counted(content.gap_samples, 'sample')} missing in {counted(content.gaps, 'place')}"
            reasons.append(Reason(check="samples", text=f"{text}. Read the record with {setting('gaps')}"))
        if content.misplaced:
            text = f"{counted(content.misplaced, 'sample')} left out whose number had occurred before. Keep the journal"
            reasons.append(Reason(check="order", text=text))
        return tuple(reasons)


def check_target(path: Path, header: JournalHeader, *, force: bool) -> None:
    """Refuse a record that could not be written (or exists, without `force`), before anything is recorded."""
    if not path.name.lower().endswith(FORMATS):
        raise DeviceError(f"{path}: a recording is written as {', '.join(FORMATS)}. Name it so")
    if path.is_dir():
        raise DeviceError(f"{path} is a folder; it must be a file. Name a file inside it")
    if not path.parent.is_dir():
        raise DeviceError(f"{path}: there is no folder {path.parent}. Make it first, or correct the path")
    if path.exists() and not force:
        raise DeviceError(f"{path} already exists. Choose another name, remove it, or give {setting('force', True)}")
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
    """Make a journal's record (.h5, .hdf5, .csv, .csv.gz), read it back, put it in place, over another with `force`;
    None if there is no sample. `extra`: what else its history is to say.
    """
    content = survey(reader)
    if not content.samples:
        return None
    _check_gaps(content, reader.path)
    check_target(path, reader.header, force=force)
    record = _record(reader.header, content, extra)
    # Named after the journal, which is locked: what a killed conversion leaves is written over by the next one.
    temporary = path.with_name(f".{reader.path.name}-{path.name}")
    try:
        rows = _rows(reader, content)
        check = write_chunks(record, content.rows, rows, temporary, _texts(reader.header, content))
        _sync_file(temporary)
        check()
        _put_in_place(temporary, path, force=force)
    except (RecordError, OSError) as failure:
        text = str(failure).replace(str(temporary), str(path))
        raise DeviceError(f"{text.rstrip('.')}. The journal {reader.path} is kept; then: ambid recover {reader.path}"
                          ) from None  # fmt: skip
    finally:
        temporary.unlink(missing_ok=True)
    return Recorded(path=path, rate_hz=reader.header.rate_hz, survey=content)


def recorded_already(reader: JournalReader, path: Path) -> Recorded | None:
    """Hold an existing record against a journal, which a power cut may have left: None unless it reads back as every
    value, column and event that the journal gives.
    """
    content = survey(reader)
    if not content.samples or not path.is_file() or not path.name.lower().endswith(FORMATS):
        return None
    try:
        _check_gaps(content, reader.path)
        record = _record(reader.header, content, {})
        check_chunks(record, content.rows, _rows(reader, content), path, _texts(reader.header, content))
    except (RecordError, DeviceError):
        return None
    return Recorded(path=path, rate_hz=reader.header.rate_hz, survey=content)


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
            content = json.loads(file["acquisition"].asstr()[()])
    except (OSError, KeyError, ValueError) as failure:
        raise DeviceError(f"{path} holds no acquisition ({failure}). Name a file that a recorder wrote") from None
    return JournalHeader.from_json(content["header"]), tuple(DeviceEvent(**e) for e in content["events"])


def _texts(header: JournalHeader, content: Survey) -> dict[str, str]:
    """What a recorded HDF5 file holds beside its record."""
    return {"acquisition": json.dumps({"header": header.as_json(), "events": [asdict(e) for e in content.events]})}


def _record(header: JournalHeader, content: Survey, extra: Mapping[str, object]) -> Record:
    """Everything of the record but its values."""
    settings: dict[str, object] = {
        "device": header.device.get("kind", ""),
        "port": header.device.get("port", ""),
        "started": header.started,
        "samples": content.samples,
        "events": len(content.events),
    }
    if content.stamp_error_s * header.rate_hz > 1:
        settings["stamp_error_s"] = content.stamp_error_s
    steps = [Step(name="acquire", settings=settings | dict(extra))]
    lacking = {
        "lost_samples": content.gap_samples,
        "places": content.gaps,
        "misplaced_samples": content.misplaced,
        "damaged_blocks": content.damage.blocks,
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
        start_s=content.start_s,
        channels=tuple(
            Channel(name=c.name, unit=_unit(c.unit), values=none, source_unit=c.unit) for c in header.columns
        ),
        history=tuple(steps),
        provenance=MappingProxyType(provenance),
    )


def _unit(text: str) -> str:
    return text if text == UNKNOWN else parse_unit(text).si


def _check_gaps(content: Survey, path: Path) -> None:
    """Refuse numbers that no recording has: the record would be nothing but rows of NaN."""
    if content.gap_samples > _GAP_ROWS + _GAP_SHARE * content.samples:
        raise DeviceError(
            f"journal {path}: {content.gap_samples} samples are missing between the {content.samples} that are there;"
            " the numbers of the device cannot be right. The journal is kept; read it with JournalReader"
        )


def _rows(reader: JournalReader, content: Survey) -> Iterator[Array]:
    """Rows in the order of their numbers, NaN where there are none, in pieces of the same length."""
    rows = np.empty((_ROWS, len(reader.header.columns)))
    n = 0
    for values in _in_order(reader, content):
        at = 0
        while at < len(values):
            count = min(len(values) - at, _ROWS - n)
            rows[n : n + count] = values[at : at + count]
            n, at = n + count, at + count
            if n == _ROWS:
                yield rows
                n = 0
    if n:
        yield rows[:n]


def _in_order(reader: JournalReader, content: Survey) -> Iterator[Array]:
    end = content.first
    nothing = np.full((_ROWS, len(reader.header.columns)), np.nan)
    for item in reader.items():
        if not isinstance(item, Block):
            continue
        while item.first > end:
            count = min(item.first - end, _ROWS)
            yield nothing[:count]
            end += count
        if item.first + len(item.values) > end:
            yield item.values[end - item.first :]
            end = item.first + len(item.values)


def _sync_file(path: Path) -> None:
    fd = os.open(path, os.O_RDWR)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _put_in_place(temporary: Path, path: Path, *, force: bool) -> None:
    """Give a file its name; one that came into being meanwhile is not replaced without `force`."""
    if force:
        os.replace(temporary, path)
    else:
        try:
            os.link(temporary, path)
        except FileExistsError:
            raise DeviceError(f"{path} came into being while it was recorded. Give another name with -o") from None
        except OSError:  # a file system without links
            if path.exists():
                raise DeviceError(f"{path} came into being while it was recorded. Give another name with -o") from None
            os.replace(temporary, path)
    sync_folder(path)
