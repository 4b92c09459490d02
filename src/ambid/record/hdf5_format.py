"""Records as HDF5, layout ``ambid.record/1``: nothing of a record is lost, nor any file damaged by opening."""

from __future__ import annotations

import io
import json
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import Any

import numpy as np

from ambid.errors import RecordError
from ambid.record.record import Channel, Record, Step, file_bytes, refuse_pipe, sha256_of
from ambid.record.streams import refuse_claim


@contextmanager
def new_hdf5(path: Path) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Make an HDF5 file, yield it (h5py) with a check, and close it; what the disk said is raised as OSError then, or
    by that.
    """
    import h5py

    with open(path, "w+b", buffering=0) as plain:
        file = _Unfailing(plain)
        with _no_interrupt(file), h5py.File(file, "w") as hdf5:
            yield hdf5, file.check
        file.check()


@contextmanager
def _no_interrupt(file: _Unfailing) -> Iterator[None]:
    """Take what a handler of signals raises for a failure of the file, which is raised by the next check."""
    usual: dict[int, Any] = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def take(number: int, frame: FrameType | None) -> None:
        try:
            usual[number](number, frame)
        except BaseException as failure:
            file.fail(failure)

    numbers = [number for number, handler in usual.items() if callable(handler)]
    for number in numbers:
        signal.signal(number, take)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, usual[number])


class _Unfailing:
    """A file whose writes always succeed: what the disk does not take is held in memory from then on."""

    def __init__(self, plain: io.FileIO) -> None:
        self._plain, self._at, self._size = plain, 0, 0
        self._held: list[tuple[int, bytes]] = []
        self._failure: BaseException | None = None

    def fail(self, failure: BaseException) -> None:
        """Take note of the first failure."""
        self._failure = self._failure or failure

    def check(self) -> None:
        """Raise the first failure."""
        if self._failure is not None:
            raise self._failure

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, n: int = -1) -> bytes:
        """Return the next `n` bytes, or all."""
        data = bytearray(n if n >= 0 else max(self._size - self._at, 0))
        self.readinto(data)
        return bytes(data)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        at, n = self._at, len(view)
        self._plain.seek(at)
        data = bytearray((self._plain.read(n) or b"").ljust(n, b"\0"))
        for offset, part in self._held:
            begin, end = max(offset, at), min(offset + len(part), at + n)
            if begin < end:
                data[begin - at : end - at] = part[begin - offset : end - offset]
        view[:] = data
        self._at += n
        return n

    def write(self, data: Any) -> int:
        content = bytes(data)
        if self._failure is None:
            try:
                self._plain.seek(self._at)
                rest = memoryview(content)
                while rest:  # an unbuffered file may take a part, and fails with the next one
                    rest = rest[self._plain.write(rest) or 0 :]
            except OSError as failure:
                self.fail(failure)
        if self._failure is not None:
            self._held.append((self._at, content))
        self._at += len(content)
        self._size = max(self._size, self._at)
        return len(content)

    def truncate(self, size: int) -> int:
        self._size = size
        if self._failure is None:
            try:
                self._plain.truncate(size)
            except OSError as failure:
                self.fail(failure)
        return size

    def flush(self) -> None:
        """Nothing is held back."""


SCHEMA = "ambid.record/1"


def write_hdf5(record: Record, path: str | Path) -> None:
    """Write a record with history (JSON-able settings, as `Step`), provenance and units, over a file that exists.

    /                 attributes: schema, rate_hz, start_s, history (JSON, with calibrations), provenance (JSON)
    /channels/<k>     float64 dataset, k = 0, 1, …, compressed without loss; attributes: name, unit, source_unit
    """
    path = Path(path)
    history = _history_text(record)
    try:
        with new_hdf5(path) as (file, check):
            write_head(file, record, history)
            for k, c in enumerate(record.channels):
                add_channel(file, k, c, data=c.values)
                check()
    except OSError as failure:
        raise RecordError(f"{path} cannot be written: {failure.strerror or failure}. Check the folder") from None


def write_head(file: Any, record: Record, history: str | None = None) -> None:
    """Write everything but the channels into an empty file; `history`: as JSON, if that is there already."""
    file.attrs["schema"] = SCHEMA
    file.attrs["rate_hz"] = record.rate_hz
    file.attrs["start_s"] = record.start_s
    # Text beyond 64 kB does not fit an attribute (a calibration table may be long): it is a dataset.
    file["history"] = _history_text(record) if history is None else history
    file["provenance"] = json.dumps(dict(record.provenance))
    file.create_group("channels")


def add_channel(file: Any, k: int, channel: Channel, **options: object) -> Any:
    """Make the dataset of channel `k`; `**options`: ``data``, or ``shape`` and ``dtype`` of values still to come."""
    dataset = file["channels"].create_dataset(str(k), compression="gzip", compression_opts=1, shuffle=True, **options)
    dataset.attrs["name"] = channel.name
    dataset.attrs["unit"] = channel.unit
    dataset.attrs["source_unit"] = channel.source_unit
    return dataset


def _history_text(record: Record) -> str:
    try:
        return json.dumps([{"name": s.name, "settings": s.settings} for s in record.history], default=_plain)
    except TypeError as failure:
        raise RecordError(
            f"the record's history cannot be stored: {failure}. Keep JSON-able settings in each step"
        ) from None


@contextmanager
def hdf5_of(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading (h5py), and refuse one that takes something from another file, wherever that is."""
    import h5py

    def linked(name: str | bytes, link: Any) -> str | bytes | None:
        return name if link.type == h5py.h5l.TYPE_EXTERNAL else None

    def stored(name: str, node: Any) -> str | None:
        return name if isinstance(node, h5py.Dataset) and (node.external or node.is_virtual) else None

    refuse_pipe(path)
    with h5py.File(path, "r") as file:
        if name := file.id.links.visit(linked, info=True) or file.visititems(stored):
            shown = name if isinstance(name, str) else name.decode("utf-8", "replace")
            raise RecordError(f"record {path} takes {shown!r} from another file. Copy all of it into one file")
        yield file


def is_own(path: Path) -> bool:
    """Whether a file may be one of ambid, or is none at all; an HDF5 file of another program has no schema."""
    try:
        with hdf5_of(path) as file:
            return "schema" in file.attrs or not len(file) or "channels" in file
    except (OSError, RuntimeError):
        return True


def started_of(path: Path) -> str | None:
    """Return when a file says that its record was taken; empty where it does not, None where it cannot be read."""
    try:
        with hdf5_of(path) as file:
            said = json.loads(file["provenance"].asstr()[()]) if "provenance" in file else {}
    except (RecordError, OSError, RuntimeError, ValueError, TypeError, AttributeError):
        return None
    return str(said.get("started") or "") if isinstance(said, dict) else None


def read_hdf5(path: str | Path) -> Record:
    """Read a record of layout ``ambid.record/1``, bit for bit as written; ``file`` and ``sha256`` in the provenance are
    of this file where the record had none.
    """
    import h5py

    path = Path(path)
    data = file_bytes(path)
    if not h5py.is_hdf5(path):
        raise RecordError(f"record {path} is not an HDF5 file, or is damaged. Copy it again, or name its real format")
    try:
        with hdf5_of(path) as file:
            schema = file.attrs.get("schema")
            if schema is None:
                inside = ", ".join(sorted(file)[:5]) or "nothing"
                raise RecordError(
                    f"record {path} is HDF5 but not of ambid (no schema attribute; it holds {inside})."
                    " Export it as CSV, or write it with ambid"
                )
            if schema != SCHEMA:
                raise RecordError(f"record {path} has schema {schema!r}; this program reads {SCHEMA!r}. Write it again")
            datasets = [file["channels"][str(k)] for k in range(len(file["channels"]))]
            for dataset in datasets:
                refuse_claim(path, dataset.size, dataset.dtype.itemsize, len(data))
            channels = tuple(_channel(dataset) for dataset in datasets)
            history = tuple(
                Step(name=s["name"], settings=MappingProxyType(s["settings"]))
                for s in json.loads(file["history"].asstr()[()])
            )
            provenance = {str(k): str(v) for k, v in json.loads(file["provenance"].asstr()[()]).items()}
            rate_hz, start_s = float(file.attrs["rate_hz"]), float(file.attrs["start_s"])
    except RecordError:
        raise
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as failure:
        raise RecordError(
            f"record {path} says it is {SCHEMA} but cannot be read ({type(failure).__name__}: {failure})."
            " It is damaged: write it again"
        ) from None
    if "sha256" not in provenance:
        provenance |= {"file": path.name, "sha256": sha256_of(data)}
    return Record(
        rate_hz=rate_hz, start_s=start_s, channels=channels, history=history, provenance=MappingProxyType(provenance)
    )


def _channel(dataset: Any) -> Channel:
    attributes = {key: str(dataset.attrs[key]) for key in ("name", "unit", "source_unit")}
    return Channel(values=np.asarray(dataset[()], dtype=np.float64), **attributes)


def _plain(value: object) -> object:
    """Turn what JSON does not know into what it does: mappings, NumPy numbers and arrays."""
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON-able")
