"""Lost samples: which they are, and a CSV file that lacks them, as a bad acquisition leaves it."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambid.errors import RecordError
from ambid.record import Record, write_record

_MEAN_BURST = 8  # samples


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """One burst of lost samples.

    Attributes
    ----------
    first, stop : int
        Samples ``first`` to ``stop - 1`` are lost.
    kind : {"cells", "rows", "skipped"}
        One channel's cells are empty; all cells but the time are; or the rows are missing, so that time jumps.
    column : int
        Which channel, for ``"cells"``; any number, to be taken modulo the number of channels.
    """

    first: int
    stop: int
    kind: str
    column: int


_KINDS = ("cells", "rows", "skipped")


def losses(n_samples: int, share: float, seed: int, *, first: int = 0) -> tuple[Loss, ...]:
    """Return which samples are lost: bursts of some samples each, of all kinds in turn, apart from each other.

    Parameters
    ----------
    n_samples : int
        Length of the record.
    share : float
        Of the samples from `first` on that is lost, above 0 and at most 0.5.
    seed : int
        Equal seeds give equal losses.
    first : int
        No sample before this one is lost; nor are the record's first and last eight.

    Returns
    -------
    tuple of Loss
        In order; at least one of each kind where there is room.

    Raises
    ------
    RecordError
        If the share is out of range, or the record too short.
    """
    begin, end = max(first, 8), n_samples - 8
    if not 0.0 < share <= 0.5:
        raise RecordError(f"the share of lost samples is {share}; it is above 0 and at most 0.5. Correct it")
    if end - begin < 64:
        raise RecordError(
            f"{max(0, end - begin)} samples can be lost from sample {first} on; losses need 64. Record for longer"
        )
    rng = np.random.default_rng([seed, 0x1055])
    count = max(3, round(share * (end - begin) / _MEAN_BURST))
    cell = (end - begin) / count
    lengths = np.minimum(rng.geometric(1.0 / _MEAN_BURST, count), int(cell) - 2)
    starts = begin + np.floor(np.arange(count) * cell + rng.random(count) * (cell - lengths - 2)).astype(np.int64)
    columns = rng.integers(0, 1000, count)
    return tuple(
        Loss(first=int(a), stop=int(a + n), kind=_KINDS[j % 3], column=int(columns[j]))
        for j, (a, n) in enumerate(zip(starts, lengths, strict=True))
    )


def damage(
    record: Record, path: str | Path, *, share: float, seed: int, first: int = 0, comments: Sequence[str] = ()
) -> tuple[Loss, ...]:
    """Write a record as a CSV file in which samples are lost.

    Parameters
    ----------
    record : Record
        The whole record; it stays as it is. Channels whose names begin with ``true_`` lose no cells.
    path : str or Path
        ``.csv`` or ``.csv.gz``.
    share, seed, first
        As in `losses`.
    comments : sequence of str
        Comment lines on top.

    Returns
    -------
    tuple of Loss
        What is lost.

    Raises
    ------
    RecordError
        If the file is no CSV file, cannot be written, or the record is too short.
    """
    path = Path(path)
    if not path.name.lower().endswith((".csv", ".csv.gz")):
        raise RecordError(f"{path}: lost samples can be written as CSV only. Write .csv or .csv.gz")
    lost = losses(record.n_samples, share, seed, first=first)
    write_record(record, path, comments=comments)
    packed = path.suffix.lower() == ".gz"
    data = path.read_bytes()
    lines = (gzip.decompress(data) if packed else data).decode().split("\n")
    top = next(k for k, line in enumerate(lines) if not line.startswith("#")) + 1
    measured = [j + 1 for j, c in enumerate(record.channels) if not c.name.startswith("true_")]
    for loss in lost:
        empty = [measured[loss.column % len(measured)]] if loss.kind == "cells" else measured
        for k in range(loss.first + top, loss.stop + top):
            cells = lines[k].split(",")
            for j in empty:
                cells[j] = ""
            lines[k] = "" if loss.kind == "skipped" else ",".join(cells)
    text = "\n".join(line for line in lines if line) + "\n"
    path.write_bytes(gzip.compress(text.encode(), compresslevel=6, mtime=0) if packed else text.encode())
    return lost
