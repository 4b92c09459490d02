"""Records as the jobs take them: read through a rig or without one, cut, and divided into inputs and outputs."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from ambid.errors import EstimationError
from ambid.record import GapPolicy, Record, cut, read_record
from ambid.record import Source as Source
from ambid.rig import Rig, default_rig, load_rig, read_bench, rig_from_tables, rig_text
from ambid.settings.caller import setting
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.bearing.multistart import Signals
    from ambid.blackbox.data import IOData
    from ambid.physics.linear_model import LinearModel

Part = tuple[float | None, float | None]
"""From and to, in s; None: the record's own begin or end."""

WHOLE: Part = (None, None)


class Clock:
    """Laps in seconds of wall time."""

    def __init__(self) -> None:
        """Begin now."""
        self._last, self.laps = time.perf_counter(), dict[str, float]()

    def split(self, lap: str, part: str, seconds: float) -> None:
        """Take a part out of a lap."""
        self.laps[part] = seconds
        self.laps[lap] -= seconds

    def lap(self, name: str) -> None:
        """End a lap."""
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now


def sources_of(records: Source | Sequence[Source]) -> list[Source]:
    """Return several records as a list, and one as a list of one."""
    return list(records) if isinstance(records, (list, tuple)) else [records]  # type: ignore[list-item]


RigSource = Rig | str | Path | Mapping[str, Any]
"""A rig: itself, its file, the text of one, or its tables as a dict; a text or a dict may leave the schema out."""


def known_rig(rig: RigSource | None) -> Rig:
    """Return a rig in whatever form it is given; by default all is free and columns are named like roles."""
    if rig is None or isinstance(rig, Rig):
        return rig or default_rig()
    if isinstance(rig, str) and ("\n" in rig or ("=" in rig and not rig.lower().endswith(".toml"))):
        return rig_from_tables(rig)
    return rig_from_tables(rig) if isinstance(rig, Mapping) else load_rig(rig)


def rig_entry(rig: Rig) -> dict[str, object]:
    """Return what a result keeps of its rig, so that other records are read and judged alike."""
    folder = Path.cwd() if rig.source is None else rig.source.resolve().parent
    return {"name": rig.name, "text": rig_text(rig, folder), "folder": str(folder)}


def origin(record: Record) -> dict[str, object]:
    """Return what a result keeps of a record."""
    return {
        "samples": record.n_samples,
        "rate_hz": record.rate_hz,
        "sha256": record.provenance.get("sha256"),
        "file": record.provenance.get("file"),
        "history": [str(step) for step in record.history],
        **began(record),
    }


def began(record: Record) -> dict[str, str]:
    """Return ``started``, when a record was taken, where it says so; else nothing."""
    return {name: record.provenance[name] for name in ("started",) if name in record.provenance}


Stretch = tuple[object, float, int, float]
"""Of a file's time: sha256 of the file, time of the first sample in s, samples, rate in Hz."""


def overlap(a: Stretch, b: Stretch) -> bool:
    """Whether two records come from one file and share a stretch of its time."""
    (sha256, start, n, rate), (other, begin, m, other_rate) = a, b
    ends = start + n / rate, begin + m / other_rate
    return sha256 is not None and sha256 == other and max(start, begin) + 0.5 / rate < min(ends)


def stretch_of(record: Record) -> Stretch:
    """Return what of a file's time a record is."""
    return record.provenance.get("sha256"), record.start_s, record.n_samples, record.rate_hz


class Reading(TypedDict, total=False):
    """How files are read, and which part of a record is used."""

    # part of a record in which the rotor moves, in s; overrides the rig's, and does not apply to held ones
    from_s: float | None
    to_s: float | None
    rate_hz: float | None  # sampling rate of a file without a time column
    gaps: GapPolicy | None
    units: Mapping[str, str] | None  # of the columns of a table in memory
    layout: Mapping[str, str] | None  # of a file, beside the rig's


def load_bench(
    record: Source,
    rig: Rig,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    beside: Sequence[str] = (),
) -> Record:
    """Read a record through a rig and cut it to the part that is to be used.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
        In the rig's columns, or through a rig already.
    rig : Rig
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.
    beside : sequence of str, optional
        Columns of the file that are no role of the rig, kept under their own names.

    Returns
    -------
    Record
        Channels named by role, SI units.

    Raises
    ------
    AmbidError
        If the file, its columns or the cut break a rule.
    """
    found = read_bench(record, rig, rate_hz=rate_hz, gaps=gaps, units=units, beside=beside, layout=layout)
    return _cut_by(rig, found, (from_s, to_s))


def signals_of(record: Record, plant: LinearModel) -> Signals:
    """Take a model's inputs and outputs out of a record.

    Parameters
    ----------
    record : Record
        Channels named by role.
    plant : LinearModel

    Returns
    -------
    Signals
        u (n_samples, n_inputs), y (n_samples, n_outputs), SI.
    """
    import numpy as np

    from ambid.bearing.multistart import Signals

    return Signals(
        u=np.stack([record[r].values for r in plant.inputs], axis=1),
        y=np.stack([record[r].values for r in plant.outputs], axis=1),
        rate_hz=record.rate_hz,
    )


Names = str | Sequence[str]
"""The name of a channel, or several."""


class Columns(TypedDict, total=False):
    """Which columns of records are inputs, outputs and references, and how they are read."""

    # names of channels; with a rig its roles or columns, by default all of its model
    input: Names | None
    output: Names | None
    reference: Names | None  # channels of the loop's outer excitation, for methods that want it
    open_loop: bool  # whether no feedback was at work
    rate_hz: float | None  # sampling rate of a source without time
    gaps: GapPolicy | None
    units: Mapping[str, str] | None  # of the columns of a table in memory
    rig: RigSource | None  # names and calibrates the channels
    layout: Mapping[str, str] | None  # of a file, as `read_record` takes it


def names_of(said: Names | None) -> tuple[str, ...]:
    """Return the names of one channel, several or none."""
    names = () if said is None else (said,) if isinstance(said, str) or not isinstance(said, Iterable) else tuple(said)
    if not all(isinstance(name, str) for name in names):
        raise EstimationError(f"{said!r:.40} names no channels. Give the name of a column, or several in a list")
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class Channels:
    """Inputs, outputs and references of records, and how these are read: `Columns`, with the rig loaded."""

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    open_loop: bool = False
    rate_hz: float | None = None
    gaps: GapPolicy | None = None
    units: Mapping[str, str] | None = None
    rig: Rig | None = None
    layout: Mapping[str, str] | None = None

    @classmethod
    def of(cls, **columns: Unpack[Columns]) -> Channels:
        """Take them from what a caller says."""
        said: dict[str, Any] = dict(columns)
        named: dict[str, Any] = {f"{x}s": names_of(said.pop(x, None)) for x in ("input", "output", "reference")}
        rig = said.pop("rig", None)
        return cls(**named, **said, rig=None if rig is None else known_rig(rig))

    def read(self, record: Source, part: Part = WHOLE) -> IOData:
        """Read a record, cut it and take the columns, with a rig by role or as in the file, calibrated, by default all
        of its model; a reference may be any column of the file.
        """
        from ambid.blackbox.data import io_data

        if self.rig is not None:
            return self._through(self.rig, record, part)
        found = read_record(
            record, rate_hz=self.rate_hz, gaps=self.gaps or "error", units=self.units, layout=self.layout
        )
        if part != WHOLE:
            found = cut(found, *part)
        return io_data(found, self.inputs, self.outputs, references=self.references, open_loop=self.open_loop)

    def _through(self, rig: Rig, record: Source, part: Part) -> IOData:
        from ambid.blackbox.data import io_data

        plant = rig.plant
        bench = read_bench(
            record, rig, rate_hz=self.rate_hz, gaps=self.gaps, units=self.units, beside=self.references,
            layout=self.layout,
        )  # fmt: skip
        bench = _cut_by(rig, bench, part)
        inputs = [_role(x, rig, plant.inputs, "input") for x in self.inputs] or list(plant.inputs)
        outputs = [_role(x, rig, plant.outputs, "output") for x in self.outputs] or list(plant.outputs)
        open_loop = self.open_loop or rig.open_loop
        looped = rig.loop is not None and rig.loop.closed
        return io_data(bench, inputs, outputs, references=self.references, open_loop=open_loop, looped=looped)


def _cut_by(rig: Rig, bench: Record, part: Part) -> Record:
    """Cut a record to a part, or where that is left open to the rig's."""
    first = rig.record.from_s if part[0] is None else part[0]
    last = rig.record.to_s if part[1] is None else part[1]
    return bench if first is None and last is None else cut(bench, first, last)


def _role(name: str, rig: Rig, roles: tuple[str, ...], what: str) -> str:
    found = next((c.role for c in rig.channels if name in (c.role, c.column) and c.role in roles), None)
    if found is None:
        raise EstimationError(
            f"{setting(what, name)}: the rig's {what}s are {', '.join(roles)}. Name one of them or its column, or omit "
            f"{setting(what)} for all"
        )
    return found


def read_data(record: Source, *, part: Part = WHOLE, **columns: Unpack[Columns]) -> IOData:
    """Read a record, cut it and take inputs and outputs out of it.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
    part : (float or None, float or None), optional
        From and to, in s.
    **columns
        ``input``, ``output``, ``reference``, ``open_loop``, ``rate_hz``, ``gaps``, ``units`` and ``rig``, see
        `Columns`.

    Returns
    -------
    IOData

    Raises
    ------
    AmbidError
        If the file, its columns or the cut break a rule.
    """
    return Channels.of(**columns).read(record, part)


def check_same_bench(units: Mapping[str, str], dt: float, second: IOData) -> None:
    """Refuse a second record whose rate (interval `dt` in s) or units are not those of the first."""
    if abs(second.dt / dt - 1) > 1e-6:
        raise EstimationError(
            f"the second record is sampled at {1 / second.dt:g} Hz, the first at {1 / dt:g} Hz; the rates must "
            "agree. Resample one of them"
        )
    for name in (*second.inputs, *second.outputs):
        one, other = units.get(name, UNKNOWN), second.units[name]
        if one != other and UNKNOWN not in (one, other):
            raise EstimationError(
                f"channel {name!r} is in {other} in the second record, in {one} in the first; the units must "
                "agree. Check that it is the same channel, and its unit"
            )
