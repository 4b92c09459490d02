"""A minute at the promised rate, and the highest rate at which nothing is lost."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from table import Table
from tests.bars.host import prototype
from tests.bars.rates import COUNTED, Run, run, stream_of

MINUTE_S = float(os.environ.get("ACQUISITION_MINUTE_S", "60"))
SECONDS = float(os.environ.get("ACQUISITION_RATE_S", "10"))
GROUP = "Acquisition: the line at 1 Mbaud (emulated)"
COLUMNS = (
    "mode", "inputs", "values of a sample", "rate", "commands a second", "time", "samples", "lost", "damaged frames",
    "late bytes", *COUNTED, "longest work of a tick", "load of the line",
)  # fmt: skip
PERIODS = {"sample": (8, 6, 5, 4), "levitate": (10, 8, 7)}


def line_tables() -> Iterator[Table]:
    """One table: the minute first, then rates upwards."""
    rows: list[tuple[str, ...]] = []
    remarks: list[str] = []
    data: dict[str, object] = {}

    def add(mode: str, inputs: int, period: int, seconds: float, commands: int, extra: tuple[str, ...] = ()) -> bool:
        names = (*(f"analog_{k}" for k in range(inputs)), "duty", *extra)
        with tempfile.TemporaryDirectory() as folder:
            found = run(
                prototype(), Path(folder), seconds=seconds, stream=stream_of(*names), period=period, mode=mode,
                commands=commands,
            )  # fmt: skip
        key = f"{mode}, {inputs} inputs, {len(names)} values, {20_000 / period:.5g} Hz, {commands} commands/s"
        if found is None:
            remarks.append(f"{key}: refused by the controller.")
            return False
        rows.append(_row(mode, inputs, len(names), seconds, commands, found))
        data[key] = asdict(found) | {"clean": found.clean}
        print("; ".join(rows[-1]), flush=True)
        return found.clean

    add("levitate", 3, 10, MINUTE_S, 0)
    for mode, periods in PERIODS.items():
        for inputs in (2, 3):
            for commands in (0, 200):
                clean = [p for p in periods if add(mode, inputs, p, SECONDS, commands)]
                highest = f"{20_000 / min(clean):.5g} Hz" if clean else "none"
                remarks.append(f"Highest clean rate, {mode}, {inputs} inputs, {commands} commands a second: {highest}.")
    before = (
        "Samples of two or three analog inputs and the pulse width, with pings each 25 ms and, where said, set points."
        " Clean: no gap in the sample numbers, no frame of wrong CRC, no command sent twice, no byte that a receiver"
        " with a buffer of two would have lost, and none of the controller's own counters (overruns, dropped,"
        " rx_errors, rx_lost) moved. A byte takes ten bit times, as on hardware; libsimavr alone would count eleven."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=tuple(remarks), data=data)


def _row(mode: str, inputs: int, values: int, seconds: float, commands: int, found: Run) -> tuple[str, ...]:
    told: dict[str, Any] = found.controller
    return (
        mode, str(inputs), str(values), f"{found.rate_hz:.5g} Hz", str(commands), f"{seconds:g} s", str(found.samples),
        str(found.lost), str(found.damaged), str(found.late), *(str(told[c]) for c in COUNTED),
        f"{told['busy_us']} us of {1e6 / found.rate_hz:.0f}", f"{found.bytes_per_sample * found.rate_hz / 1e5:.0%}",
    )  # fmt: skip
