"""Measure ambid beside straightforward SciPy and beside peers: ``make bench``, or ``make bench BENCH="speed records"``.

Writes bench/results/latest.json and, once it holds all parts, docs/benchmarks.md; all parts take about 75
minutes, the physical one three minutes.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "latest.json"
PAGE = HERE.parent / "docs" / "benchmarks.md"
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
PARTS = (
    "physical",
    "montecarlo",
    "speed",
    "records",
    "tracking",
    "acquisition",
    "selection",
    "nonlinear",
    "rotor",
    "works",
)


def main(wanted: list[str]) -> None:
    unknown = sorted(set(wanted) - set(PARTS))
    if unknown:
        raise SystemExit(f"no part {unknown[0]!r}; there are: {' '.join(PARTS)}")
    # The libraries look at this once, when they are first imported; all imports are below for that reason.
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    from machine import description
    from page import page
    from timing import quantity

    print(f"one thread for all: {', '.join(ONE_THREAD)} = 1", flush=True)
    results = _earlier()
    for part in wanted or PARTS:
        print(f"-- {part}", flush=True)
        before, machine = time.perf_counter(), description()
        found = [item.as_json() for item in _measured(part)]
        machine["took_s"] = time.perf_counter() - before
        results[part] = {"machine": machine, "items": found}
        print(f"{quantity(machine['took_s'], 's')} for {part}", flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(
            json.dumps({"schema": "ambid.bench/2", "parts": results}, indent=1, default=_plain) + "\n", encoding="utf-8"
        )
    missing = [part for part in PARTS if part not in results]
    if missing:
        print(f"docs/{PAGE.name} not written: not measured yet: {' '.join(missing)}")
        return
    PAGE.write_text(page([results[part] for part in PARTS]), encoding="utf-8")
    print(f"{RESULTS.relative_to(HERE.parent)} and docs/{PAGE.name} written")


def _plain(value: Any) -> Any:
    """Take a number of NumPy for what it is: measurements of many minutes were lost for one."""
    return value.item()


def _earlier() -> dict[str, Any]:
    """What earlier runs measured, by part."""
    if not RESULTS.exists():
        return {}
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    return dict(found["parts"]) if found.get("schema") == "ambid.bench/2" else {}


def _measured(part: str) -> Iterator[Any]:
    """Lines and tables of one part."""
    if part == "physical":
        from physical import physical_lines

        return physical_lines()
    if part == "montecarlo":
        from montecarlo import accuracy_tables

        return accuracy_tables()
    if part == "speed":
        from speed import speed_tables

        return speed_tables()
    if part == "tracking":
        from tracking import tracking_tables

        return tracking_tables()
    if part == "acquisition":
        from acquisition import acquisition_tables

        return acquisition_tables()
    if part == "selection":
        from selection import selection_tables

        return selection_tables()
    if part == "nonlinear":
        from nonlinear import nonlinear_tables

        return nonlinear_tables()
    if part == "works":
        from works import works_tables

        return works_tables()
    if part == "rotor":
        from itertools import chain

        import rotor_montecarlo
        import rotor_ross

        return chain(rotor_ross.rotor_tables(), rotor_montecarlo.rotor_tables())
    from records import record_tables

    return record_tables()


if __name__ == "__main__":
    main(sys.argv[1:])
