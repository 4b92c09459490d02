"""A record as it comes to an on-line job: rows seen through a rig, damage and all, and the clean part to start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.job.physical import load
from ambid.physics.linear_model import LinearModel
from ambid.physics.models import model
from ambid.record import Channel, Record, read_rows
from ambid.rig import Rig, bench_record, default_rig
from ambid.rig.load import OPTIONAL_ROLES
from ambid.rig.rig import RigChannel
from ambid.track.numbers import Forcing, forcing_of
from ambid.track.replay import Replay, blocks_of

_BLOCK_S = 0.01  # of the stream
_ROWS = (".csv", ".csv.gz", ".h5", ".hdf5")  # formats whose rows are read with their damage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BenchRows:
    """Rows of a bench's record."""

    record: Record  # channels named by role; may hold NaN
    replay: Replay  # inputs, outputs and forcing as a stream of blocks
    forcing: Forcing | None  # where the angle of the rotor is known
    t0: float  # time of sample number 0, s of record

    @property
    def duration_s(self) -> float:
        """From the first number to the last, s."""
        return (float(self.replay.numbers.max()) + 1.0) / self.replay.rate_hz

    @property
    def origin(self) -> dict[str, object]:
        """Where the record came from."""
        return {"file": self.record.provenance.get("file"), "sha256": self.record.provenance.get("sha256")}

    def clean_part(self, n: int, *, begin_anywhere: bool) -> tuple[Record, int]:
        """Return the first clean stretch, and the number of the sample after it.

        `n`: samples wanted; `begin_anywhere`: take a later stretch, or a shorter one, where the beginning is damaged.
        """
        numbers = self.replay.numbers
        sound = np.asarray(np.isfinite(self.replay.values).all(axis=1))
        if not sound.any():
            raise RecordError(
                "no row of the record holds a finite value in every channel that is tracked; tracking has to start from"
                " a clean part. Check the columns, or give an estimate"
            )
        joined = np.concatenate([[False], sound[1:] & sound[:-1] & (np.diff(numbers) == 1)])
        begins = np.flatnonzero(sound & ~joined)
        ends = np.append(begins[1:], numbers.size)
        lengths = np.array([int(sound[b:e].sum()) for b, e in zip(begins, ends, strict=True)], dtype=np.int64)
        fits = np.flatnonzero(lengths >= n)
        if fits.size and (begin_anywhere or begins[fits[0]] == 0):
            at, length = int(begins[fits[0]]), n
        elif begin_anywhere and lengths.size:
            best = int(np.argmax(lengths))
            at, length = int(begins[best]), int(lengths[best])
        else:
            raise RecordError(
                f"the first {n / self.replay.rate_hz:g} s of the record are damaged; tracking has to start from a clean"
                " part. Give a shorter one, or an estimate"
            )
        channels = tuple(replace(c, values=c.values[at : at + length].copy()) for c in self.record.channels)
        part = replace(self.record, channels=channels, start_s=self.t0 + float(numbers[at]) / self.replay.rate_hz)
        return part, int(numbers[at]) + length


def rows_of(
    record: Record | str | Path, known: Rig | None, *, from_s: float | None, to_s: float | None, rate_hz: float | None
) -> BenchRows:
    """Read the rows of a record through a rig.

    `record`: a file, or a record whose channels are named by role; `known`: none: columns named like the roles, those
    of a turning rotor with them; `from_s`, `to_s`: part to use, s of record; override the rig's.
    """
    rig = default_rig() if known is None else known
    if isinstance(record, Record) or not str(record).lower().endswith(_ROWS):
        bench, stamps = load(record, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz), None
    else:
        rows = read_rows(record, rate_hz=rate_hz if rate_hz is not None else rig.record.rate_hz)
        bench, stamps = _part(
            bench_record(rows.record, _with_rotation(rig, rows.record) if known is None else rig),
            rows.time_s,
            rig.record.from_s if from_s is None else from_s,
            rig.record.to_s if to_s is None else to_s,
        )
    plant = model(rig.model)
    forcing = forcing_of(bench) if "force" in plant.disturbances else None
    stream = _stream(bench, plant, forcing)
    replay = blocks_of(stream, max(1, round(_BLOCK_S * bench.rate_hz)), time_s=stamps)
    t0 = bench.start_s if stamps is None else float(stamps[np.isfinite(stamps)][0])
    return BenchRows(record=bench, replay=replay, forcing=forcing, t0=t0)


def _with_rotation(rig: Rig, record: Record) -> Rig:
    """Columns named speed and angle, in these units, are what they say."""
    turning = tuple(
        RigChannel(role=role, column=role)
        for role in ("speed", "angle")
        if role in record.names and record.channel(role).unit == OPTIONAL_ROLES[role]
    )
    return replace(rig, channels=(*rig.channels, *turning))


def _part(bench: Record, time_s: Array | None, from_s: float | None, to_s: float | None) -> tuple[Record, Array | None]:
    """Keep the rows stamped from_s <= t < to_s; rows without a stamp stay with the row before them."""
    if from_s is None and to_s is None:
        return bench, time_s
    stamps = bench.time_s if time_s is None else time_s
    known = np.flatnonzero(np.isfinite(stamps))
    last = known[np.maximum(np.searchsorted(known, np.arange(stamps.size), side="right") - 1, 0)]
    t = stamps[last]
    kept = (t >= (-np.inf if from_s is None else from_s)) & (t < (np.inf if to_s is None else to_s))
    if not kept.any():
        raise RecordError(
            f"the record spans {np.nanmin(stamps):g} to {np.nanmax(stamps):g} s; nothing of it is between"
            f" {from_s if from_s is not None else 'its start'} and {to_s if to_s is not None else 'its end'} s. Give"
            " times inside it"
        )
    channels = tuple(replace(c, values=c.values[kept]) for c in bench.channels)
    first = float(t[kept][0])
    return replace(bench, channels=channels, start_s=first), None if time_s is None else time_s[kept]


def _stream(bench: Record, plant: LinearModel, forcing: Forcing | None) -> Record:
    """The channels that the tracker takes, forcing last."""
    channels = [bench.channel(role) for role in (*plant.inputs, *plant.outputs)]
    if forcing is not None:
        names = ("forcing_cos", "forcing_sin")
        channels += [Channel(name=n, unit="1", values=c) for n, c in zip(names, forcing.columns.T, strict=True)]
    return replace(bench, channels=tuple(channels))
