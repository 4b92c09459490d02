"""The identification of physical parameters beside straightforward SciPy, and the whole processes about it."""

from __future__ import annotations

from collections.abc import Iterator

from cases import all_cases
from computing import identification_lines, residual_lines, simulation_lines
from processes import large_lines, process_lines
from timing import Line, quantity


def physical_lines() -> Iterator[Line]:
    """All lines, each printed as soon as it is there."""
    cases = all_cases()
    bearing = cases[-1]
    sources = [
        *(residual_lines(case) for case in cases),
        *(identification_lines(case) for case in cases),
        simulation_lines(),
        process_lines(bearing),
        large_lines(bearing),
    ]
    for source in sources:
        for line in source:
            _print(line)
            yield line


def _print(line: Line) -> None:
    ratios = line.ratios()
    print(f"{quantity(line.ambid.median, line.unit):>10}  {line.job}", flush=True)
    if line.other is not None and ratios is not None:
        other = quantity(line.other.median, line.unit)
        print(f"{other:>10}  {line.beside}; ratio {ratios['of_medians']:.3g}", flush=True)
    if "largest_difference_of_residuals_sd" in line.notes:
        print(f"{'':12}residuals differ by at most {line.notes['largest_difference_of_residuals_sd']:.1g} sd")
