"""A record seen through a rig, as black-box and frequency-domain methods take it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ambid.blackbox.data import IOData, io_data
from ambid.errors import EstimationError, RecordError
from ambid.physics.models import model
from ambid.record import Record, read_record
from ambid.rig import Rig, bench_record, mat_variables
from ambid.signals.conditioning import cut
from ambid.units import UNKNOWN


def bench_data(
    record: Record | str | Path,
    rig: Rig,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    references: Sequence[str] = (),
    *,
    open_loop: bool = False,
    part: tuple[float | None, float | None] = (None, None),
    rate_hz: float | None = None,
    gaps: str | None = None,
) -> IOData:
    """Take inputs and outputs by role, calibrated, and references as they stand in the file, or by role.

    `inputs`, `outputs`: roles or columns of the rig; by default all of its model; `open_loop`: beside what the rig
    says; `part`: from and to, in s; overrides the rig's.
    """
    plant = model(rig.model)
    if isinstance(record, Record):
        bench, raw = record, record
    else:
        mat = Path(record).suffix.lower() == ".mat"
        variables = {**{x: (x, UNKNOWN) for x in references}, **mat_variables(rig)} if mat else None
        raw = read_record(
            record,
            rate_hz=rate_hz if rate_hz is not None else rig.record.rate_hz,
            gaps=gaps or rig.record.gaps or "error",  # type: ignore[arg-type]
            variables=variables,
        )
        bench = bench_record(raw, rig)
    beside = []
    for name in references:
        if name not in bench.names and name not in raw.names:
            raise RecordError(
                f"the record has no column {name!r} for the reference; it has {', '.join(raw.names)}. Correct "
                "--reference"
            )
        if name not in bench.names:
            beside.append(raw.channel(name))
    bench = replace(bench, channels=(*bench.channels, *beside))
    first, last = (a if a is not None else b for a, b in zip(part, (rig.record.from_s, rig.record.to_s), strict=True))
    if first is not None or last is not None:
        bench = cut(bench, first, last)
    ins = [_role(x, rig, plant.inputs, "input") for x in inputs] or list(plant.inputs)
    outs = [_role(x, rig, plant.outputs, "output") for x in outputs] or list(plant.outputs)
    return io_data(bench, ins, outs, references=references, open_loop=open_loop or rig.open_loop)


def _role(name: str, rig: Rig, roles: tuple[str, ...], what: str) -> str:
    found = next((c.role for c in rig.channels if name in (c.role, c.column) and c.role in roles), None)
    if found is None:
        raise EstimationError(
            f"--{what} {name}: the rig's {what}s are {', '.join(roles)}. Name one of them or its column, or leave "
            f"--{what} out for all"
        )
    return found
