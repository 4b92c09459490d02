"""On-line identification against the bars of its task: speed beside peers, changes, false alarms, drift, latency.

All parts: ``make bench BENCH=tracking``. Some: ``.venv/bin/python bench/tracking.py change drift``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator

from table import Table

PARTS = ("speed", "change", "coverage", "quiet", "rest", "drift", "latency")


def tracking_tables(wanted: tuple[str, ...] = PARTS) -> Iterator[Table]:
    """All tables, each as soon as it is there."""
    for part in wanted:
        print(f"- {part}", flush=True)
        yield from _part(part)()


def _part(part: str) -> Callable[[], Iterator[Table]]:
    from tracking_change import change_tables
    from tracking_coverage import coverage_tables
    from tracking_drift import drift_tables
    from tracking_latency import latency_tables
    from tracking_quiet import quiet_tables
    from tracking_rest import rest_tables
    from tracking_speed import speed_tables

    return {
        "speed": speed_tables,
        "change": change_tables,
        "coverage": coverage_tables,
        "quiet": quiet_tables,
        "rest": rest_tables,
        "drift": drift_tables,
        "latency": latency_tables,
    }[part]


if __name__ == "__main__":
    os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    for table in tracking_tables(tuple(sys.argv[1:]) or PARTS):
        print(table.as_markdown())
