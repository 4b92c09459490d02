"""Columns of long files, read piece by piece, so that memory holds their values once: what readers of TDMS, MDF and
Arrow share, with one line for whatever a library raises about a damaged file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError, choices
from ambid.record.clock import seconds
from ambid.record.frames import numbers
from ambid.record.record import Channel, Record, Step, readable
from ambid.record.sampling import GapPolicy, Table, agreed_rate, refuse_gaps, sample_uniformly
from ambid.record.words import symbol, unit_or_none
from ambid.settings.caller import setting
from ambid.units import UNKNOWN, Unit

PIECE = 1 << 18  # samples that are read at once
_MOST_PACKED = 1032  # values a byte of a file can stand for: the most that deflate packs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stream:
    """A column of a file, still to be read."""

    name: str
    units: frozenset[str] = frozenset()  # all that the file says, as it says it
    size: int
    pieces: Callable[[], Iterable[np.ndarray]]  # together `size` values
    time: bool = False
    rate_hz: float | None = None
    start: tuple[float, str] = (0.0, "")  # time of the first sample in s, and its date


@contextmanager
def library(path: Path, what: str, magic: Sequence[bytes]) -> Iterator[str]:
    """Open a file that begins with one of `magic` and yield its SHA-256; what a library raises about it becomes one
    line.
    """
    with readable(path) as file:
        head = file.read(max(map(len, magic)))
        if not head:
            raise RecordError(f"record {path} is empty (0 bytes). Export or copy it again")
        if not head.startswith(tuple(magic)):
            raise RecordError(
                f"record {path} is no {what} file: it begins with {head!r}. Copy it again, or name its real format"
            )
        file.seek(0)
        digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    with one_line(path, f"damaged, or no {what} file", "Copy or export it again"):
        yield digest


@contextmanager
def one_line(path: Path, what: str, remedy: str) -> Iterator[None]:
    """Turn whatever a parser raises about a damaged file into one line."""
    try:
        yield
    except RecordError:
        raise
    except Exception as failure:
        detail = " ".join(str(failure).split())[:120]
        raise RecordError(f"record {path} is {what} ({type(failure).__name__}: {detail}). {remedy}") from None


def chosen_group(path: Path, groups: Mapping[str, Sequence[str]], wanted: str | None) -> str:
    """Return the group that is wanted, or the only one; several are asked back by the names of their channels."""
    if not groups:
        raise RecordError(f"record {path} holds no samples. Record again")
    if wanted is None and len(groups) > 1:
        listed = "; ".join(
            ", ".join(f"{group}/{name}" for name in names[:6]) + (", …" if len(names) > 6 else "")
            for group, names in list(groups.items())[:8]
        )
        raise RecordError(
            f"record {path} has {len(groups)} groups ({listed}). Say which: "
            f"{setting('layout', f'group={next(iter(groups))!r}')}, or "
            "record.layout in the rig"
        )
    if wanted is not None and wanted not in groups:
        raise RecordError(
            f"record {path} has no group {wanted!r}; it has {choices(wanted, groups)} Correct layout group"
        )
    return next(iter(groups)) if wanted is None else wanted


def record_of(
    path: Path, provenance: Mapping[str, str], streams: Sequence[Stream], settings: Mapping[str, object],
    layout: Mapping[str, str], rate_hz: float | None, gaps: GapPolicy,
) -> Record:  # fmt: skip
    """Read the columns of a file that are wanted, by default all, into a record."""
    streams = _wanted(path, streams, layout)
    for what, numbers_of in (
        ("length", {s.name: f"{s.size}" for s in streams}),
        ("rate", {s.name: f"{s.rate_hz:.10g} Hz" if s.rate_hz else "none" for s in streams if not s.time}),
        ("start", {s.name: " ".join(map(str, s.start)) for s in streams if not s.time}),
    ):
        if len(set(numbers_of.values())) > 1:
            listed = ", ".join(f"{name} {text}" for name, text in list(numbers_of.items())[:8])
            raise RecordError(
                f"record {path}: channels differ in {what} ({listed}); all must have the same. Choose some: "
                f"{setting('layout', f'channels={streams[0].name},…')}"
            )
    n = streams[0].size
    refuse_claim(path, n, len(streams), path.stat().st_size)
    data = [s for s in streams if not s.time]
    if not data:
        raise RecordError(f"record {path} has a time column and nothing else; a record needs a channel. Add a column")
    start_s, date = data[0].start
    rate = data[0].rate_hz and agreed_rate(f"record {path}", data[0].rate_hz, rate_hz)
    for clock in (s for s in streams if s.time):
        stamps, date = _stamps(clock, path)
        table = Table(where=str(path), names=(clock.name,), values=stamps[:, None], first_row=1, time=0)
        if gaps == "error":
            refuse_gaps(table)
            sampled = sample_uniformly(table, rate or rate_hz, gaps)
            rate, start_s = sampled.rate_hz, sampled.start_s
            del stamps, table, sampled  # before the channels take their room
        else:
            data.append(Stream(name=clock.name, units=frozenset("s"), size=n, pieces=lambda x=stamps: (x,), time=True))  # type: ignore[misc]
    units = [_unit_of(s, path) for s in data]
    columns = [_column(stream, unit, path) for stream, (unit, _) in zip(data, units, strict=True)]
    table = Table(
        where=str(path), names=tuple(s.name for s in data), values=columns[0][:, None], first_row=1, time=None
    )
    steps: tuple[Step, ...] = ()
    if gaps == "error":  # columns stay where they are
        for stream, x in zip(data, columns, strict=True):
            refuse_gaps(replace(table, names=(stream.name,), values=x[:, None]))
        end = sample_uniformly(table, rate_hz if rate is None else rate, gaps)
    else:
        clocked = next((j for j, s in enumerate(data) if s.time), None)
        table = replace(table, values=np.column_stack(columns), time=clocked)
        end = sample_uniformly(table, rate_hz if rate is None else rate, gaps)
        columns, steps = list(end.values.T), end.steps
    channels = tuple(
        Channel(name=s.name, unit=unit.si if unit else UNKNOWN, values=x, source_unit=text)
        for s, x, (unit, text) in zip(data, columns, units, strict=True)
        if not s.time
    )
    read = Step(
        name="read", settings=MappingProxyType({**settings, "rows": n} | ({"layout": dict(layout)} if layout else {}))
    )
    return Record(
        rate_hz=end.rate_hz, start_s=start_s + end.start_s, channels=channels, history=(read, *steps),
        provenance=MappingProxyType({**provenance, "taken_at": date}) if date else provenance,
    )  # fmt: skip


def refuse_claim(path: Path, n: int, width: int, size: int) -> None:
    """Refuse `n` rows of `width` values or bytes that no file of `size` bytes can hold, before room is made."""
    if n * width > _MOST_PACKED * size:
        raise RecordError(f"record {path} claims {n} samples in {size} bytes: it is damaged. Copy or export it again")


def _wanted(path: Path, streams: Sequence[Stream], layout: Mapping[str, str]) -> list[Stream]:
    """Keep the channels that the layout names, and time."""
    if "channels" not in layout:
        wanted = list(streams)
    else:
        names, all_names = [x.strip() for x in layout["channels"].split(",")], [s.name for s in streams]
        for name in names:
            if name not in all_names:
                raise RecordError(
                    f"record {path} has no channel {name!r}; it has {choices(name, all_names)} Correct layout channels"
                )
        wanted = [s for s in streams if s.name in names or s.time]
    clocks = [s.name for s in wanted if s.time]
    if not wanted or len(clocks) > 1:
        what = f"two time columns ({', '.join(clocks)})" if clocks else "no channel of numbers"
        raise RecordError(
            f"record {path} has {what}; it needs one time, and a channel. Choose: {setting('layout', 'channels=…')}"
        )
    return wanted


def _unit_of(stream: Stream, path: Path) -> tuple[Unit | None, str]:
    """Return the unit, None where it is missing or not known, and how the file writes it."""
    texts = {symbol(text) for text in stream.units}
    if len(texts) > 1:
        raise RecordError(
            f"record {path}: channel {stream.name!r} is in {' and in '.join(f'[{x}]' for x in sorted(texts))}; it has "
            "one unit. Correct its properties, or export it again"
        )
    text = next(iter(texts), UNKNOWN)
    unit = unit_or_none(text)
    gravity = text == "g"  # of instruments, rather than gram
    return (None, text) if unit is None or gravity else (unit, unit.symbol)


def _column(stream: Stream, unit: Unit | None, path: Path) -> Array:
    """Read a column, read-only, in SI where the unit is known; one that is so already is not copied."""
    out, at = np.empty(0), 0
    for piece in stream.pieces():
        values = numbers(f"record {path}", stream.name, piece, time=False)
        values = values if unit is None else unit.to_si(values)
        if values.size == stream.size and not at:
            out, at = np.ascontiguousarray(values), values.size
            continue
        out = np.empty(stream.size) if not at else out
        part = out[at : at + values.size]
        part[:] = values[: part.size]
        at += values.size
    if at != stream.size:
        raise RecordError(
            f"record {path}: channel {stream.name!r} has {at} of the {stream.size} samples that the file announces: it "
            "is cut off or damaged. Copy it again"
        )
    out.flags.writeable = False
    return out


def _stamps(clock: Stream, path: Path) -> tuple[Array, str]:
    """Return time in s, and the date of the first stamp where they are dates."""
    parts = [np.asarray(x) for x in clock.pieces()]
    raw = parts[0] if len(parts) == 1 else np.concatenate(parts)
    if raw.size != clock.size:
        raise RecordError(
            f"record {path}: {clock.name!r} has {raw.size} of the {clock.size} samples that the file announces: it is "
            "cut off or damaged. Copy it again"
        )
    stamps = numbers(f"record {path}", clock.name, raw, time=True)
    if raw.dtype.kind in "mM":
        return stamps, str(raw[0]) if raw.dtype.kind == "M" else ""
    _, text = _unit_of(clock, path)
    return seconds(stamps, clock.name, None if text == UNKNOWN else text, f"record {path}"), clock.start[1]
