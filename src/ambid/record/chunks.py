"""Records longer than memory, written and read back in pieces: the files that `write_record` makes, rows of NaN where
samples were lost, and further texts in HDF5.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast
from zlib import crc32
from zlib import error as ZlibError

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.csv_format import head_lines
from ambid.record.hdf5_format import add_channel, new_hdf5, write_head
from ambid.record.record import Record

_PIECE = 1 << 17  # bytes, or values, that are read back at once


def write_chunks(
    record: Record, n_samples: int, chunks: Iterable[Array], path: str | Path, texts: Mapping[str, str]
) -> Callable[[], None]:
    """Write a record, its head alone, whose `n_samples` values come in pieces (n, n_channels), over a file that exists.
    What is returned reads it back, and raises RecordError if a value differs. `texts`: further datasets by name, HDF5
    only.
    """
    path = Path(path)
    write = _write_csv if path.name.lower().endswith((".csv", ".csv.gz")) else _write_hdf5
    try:
        return write(record, n_samples, _counted(chunks, n_samples), path, texts)
    except (OSError, RuntimeError) as failure:  # HDF5 raises both
        why = getattr(failure, "strerror", None) or str(failure)
        raise RecordError(f"{path} cannot be written: {why}. Check folder and disk") from failure


def check_chunks(
    record: Record, n_samples: int, chunks: Iterable[Array], path: str | Path, texts: Mapping[str, str]
) -> None:
    """Hold a file against a record whose values come in pieces: whether `write_chunks` would write it, history and
    provenance aside.
    """
    path = Path(path)
    pieces = _counted(chunks, n_samples)
    if path.name.lower().endswith((".csv", ".csv.gz")):
        count = 0
        for text in _csv_texts(record, pieces):
            count = crc32(text, count)
        _check_csv(path, count)
        return
    _check_hdf5_head(path, record, texts)
    sums = [0] * len(record.channels)
    for values in pieces:
        for k in range(len(sums)):
            sums[k] = crc32(np.ascontiguousarray(values[:, k]).tobytes(), sums[k])
    _check_hdf5(path, n_samples, sums)


def _counted(chunks: Iterable[Array], n_samples: int) -> Iterator[Array]:
    """Pass on what comes, and refuse more or fewer samples than announced."""
    got = 0
    for values in chunks:
        got += len(values)
        if got > n_samples:
            break
        yield values
    if got != n_samples:
        raise RecordError(f"{n_samples} samples were announced and another number came. Write the record again")


def _write_hdf5(
    record: Record, n_samples: int, chunks: Iterable[Array], path: Path, texts: Mapping[str, str]
) -> Callable[[], None]:
    sums = [0] * len(record.channels)
    with new_hdf5(path) as (file, check):
        write_head(file, record)
        for name, text in texts.items():
            file[name] = text
        datasets = [
            add_channel(file, k, c, shape=(n_samples,), dtype=np.float64) for k, c in enumerate(record.channels)
        ]
        at = 0
        for values in chunks:
            for k, dataset in enumerate(datasets):
                column = np.ascontiguousarray(values[:, k])
                dataset[at : at + len(column)] = column
                sums[k] = crc32(column.tobytes(), sums[k])
            at += len(values)
            check()
    return lambda: _check_hdf5(path, n_samples, sums)


def _check_hdf5(path: Path, n_samples: int, sums: list[int]) -> None:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            for k, wanted in enumerate(sums):
                dataset, count = file["channels"][str(k)], 0
                for at in range(0, n_samples, _PIECE):
                    count = crc32(dataset[at : at + _PIECE].tobytes(), count)
                if count != wanted or dataset.shape != (n_samples,):
                    raise _unlike(path)
    except (OSError, KeyError, RuntimeError, ValueError) as failure:
        raise _unlike(path) from failure


def _check_hdf5_head(path: Path, record: Record, texts: Mapping[str, str]) -> None:
    import h5py

    wanted = [(c.name, c.unit, c.source_unit) for c in record.channels]
    try:
        with h5py.File(path, "r") as file:
            channels = [file["channels"][str(k)].attrs for k in range(len(file["channels"]))]
            heads = [(a["name"], a["unit"], a["source_unit"]) for a in channels]
            same = heads == wanted and (file.attrs["rate_hz"], file.attrs["start_s"]) == (
                record.rate_hz,
                record.start_s,
            )
            same = same and all(file[name].asstr()[()] == text for name, text in texts.items())
    except (OSError, KeyError, RuntimeError, ValueError, TypeError) as failure:
        raise _unlike(path) from failure
    if not same:
        raise _unlike(path)


def _write_csv(
    record: Record, n_samples: int, chunks: Iterable[Array], path: Path, texts: Mapping[str, str]
) -> Callable[[], None]:
    del n_samples, texts
    count = 0
    with _text_file(path, "w") as file:
        for data in _csv_texts(record, chunks):
            file.write(data)
            count = crc32(data, count)
    return lambda: _check_csv(path, count)


def _csv_texts(record: Record, chunks: Iterable[Array]) -> Iterator[bytes]:
    """Yield the text of a CSV file, piece by piece."""
    yield _lines(head_lines(record))
    at = 0
    for values in chunks:
        time = record.start_s + np.arange(at, at + len(values)) / record.rate_hz
        rows = zip(time.tolist(), values.tolist(), strict=True)
        yield _lines([",".join((repr(t), *("" if x != x else repr(x) for x in row))) for t, row in rows])
        at += len(values)


def _lines(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def _check_csv(path: Path, wanted: int) -> None:
    count = 0
    try:
        with _text_file(path, "r") as file:
            while data := file.read(_PIECE):
                count = crc32(data, count)
    except (OSError, EOFError, ZlibError) as failure:
        raise _unlike(path) from failure
    if count != wanted:
        raise _unlike(path)


@contextmanager
def _text_file(path: Path, mode: str) -> Iterator[BinaryIO]:
    with open(path, f"{mode}b") as plain:
        if path.suffix.lower() != ".gz":
            yield cast(BinaryIO, plain)
            return
        options: dict[str, Any] = {} if mode == "r" else {"compresslevel": 6, "mtime": 0}
        with gzip.GzipFile(filename="", mode=f"{mode}b", fileobj=plain, **options) as packed:
            yield cast(BinaryIO, packed)


def _unlike(path: Path) -> RecordError:
    return RecordError(f"{path} does not read back as it was written. Check the disk, and write it again")
