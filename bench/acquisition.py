"""From microcontroller to identified parameters against the bars of its task, on the emulated bench.

All parts: ``make bench BENCH=acquisition``, ten minutes. Some: ``.venv/bin/python bench/acquisition.py safety line``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
for place in (str(HERE), str(HERE.parent)):  # the second one for what the tests have too
    if place not in sys.path:
        sys.path.insert(0, place)

from table import Table  # noqa: E402

PARTS = ("parameters", "line", "safety", "damage", "recorder", "live")


def acquisition_tables(wanted: tuple[str, ...] = PARTS) -> Iterator[Table]:
    """All tables, each as soon as it is there."""
    for part in wanted:
        print(f"- {part}", flush=True)
        yield from _part(part)()


def _part(part: str) -> Callable[[], Iterator[Table]]:
    from acquisition_damage import damage_tables
    from acquisition_line import line_tables
    from acquisition_live import live_tables
    from acquisition_parameters import parameter_tables
    from acquisition_safety import safety_tables
    from recorder import recorder_tables

    return {
        "parameters": parameter_tables,
        "line": line_tables,
        "safety": safety_tables,
        "damage": damage_tables,
        "recorder": recorder_tables,
        "live": live_tables,
    }[part]


if __name__ == "__main__":
    os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    os.environ["NUMBA_NUM_THREADS"] = "1"
    for table in acquisition_tables(tuple(sys.argv[1:]) or PARTS):
        print(table.as_markdown())
