"""Measure ambid beside straightforward SciPy: ``make bench``.

Writes bench/results/latest.json and docs/benchmarks.md; ends within about three minutes.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results" / "latest.json"
PAGE = HERE.parent / "docs" / "benchmarks.md"
ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def main() -> None:
    # The libraries look at this once, when they are first imported; all imports are below for that reason.
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    from cases import all_cases
    from computing import identification_lines, residual_lines, simulation_lines
    from machine import description
    from page import page, quantity
    from processes import large_lines, process_lines

    print(f"one thread for both sides: {', '.join(ONE_THREAD)} = 1", flush=True)
    before, machine = time.perf_counter(), description()
    cases = all_cases()
    bearing = cases[-1]
    sources = [
        *(residual_lines(case) for case in cases),
        *(identification_lines(case) for case in cases),
        simulation_lines(),
        process_lines(bearing),
        large_lines(bearing),
    ]
    lines = []
    for source in sources:
        for line in source:
            lines.append(line)
            ratios = line.ratios()
            print(f"{quantity(line.ambid.median, line.unit):>10}  {line.job}", flush=True)
            if line.other is not None and ratios is not None:
                other = quantity(line.other.median, line.unit)
                print(f"{other:>10}  {line.beside}; ratio {ratios['of_medians']:.3g}", flush=True)
            if "largest_difference_of_residuals_sd" in line.notes:
                print(f"{'':12}residuals differ by at most {line.notes['largest_difference_of_residuals_sd']:.1g} sd")
    machine["took_s"] = time.perf_counter() - before
    RESULTS.parent.mkdir(exist_ok=True)
    result = {"schema": "ambid.bench/1", "machine": machine, "lines": [line.as_json() for line in lines]}
    RESULTS.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(machine, lines), encoding="utf-8")
    print(f"{quantity(machine['took_s'], 's')} in all; {RESULTS.relative_to(HERE.parent)} and docs/{PAGE.name} written")


if __name__ == "__main__":
    main()
