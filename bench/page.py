"""The measurements as a page of the documentation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from table import Table
from timing import Line, quantity, shown

INTRODUCTION = """# Benchmarks

Made by `make bench` (`bench/run.py`), which also writes every number to `bench/results/latest.json`. Physical
identification is timed beside a straightforward implementation of the same job with SciPy (`bench/scipy_*.py`), the
black-box estimators beside other packages, each in its best setting (`bench/peer_*.py`, in an environment of their
own), all in the same run and in turn. Medians, with minima in brackets; the ratio is that of the medians, above 1 where
ambid takes less. Everything is warm (compiled, files cached) where nothing else is said, and runs on one thread:
`OPENBLAS_NUM_THREADS`, `OMP_NUM_THREADS`, `MKL_NUM_THREADS` and `NUMBA_NUM_THREADS` are 1 for all, because threads only
cost time on matrices of this size.
"""


def page(parts: Sequence[Mapping[str, Any]]) -> str:
    """Write the page in Markdown; `parts` are those of the file of results."""
    written = [INTRODUCTION]
    told = ""
    for part in parts:
        on = _measured_on(part["machine"])
        written += [on, ""] if on != told else []
        told = on
        written += [Table.from_json(x).as_markdown() for x in part["items"] if "columns" in x]
        written += _groups([Line.from_json(x) for x in part["items"] if "columns" not in x])
    return "\n".join(written).rstrip() + "\n"


def _measured_on(machine: Mapping[str, Any]) -> str:
    peers = ", ".join(f"{name} {version}" for name, version in machine["peers"].items())
    return (
        f"Measured on: {machine['processor']}, {machine['cores']} cores; Python {machine['python']},"
        f" NumPy {machine['numpy']}, SciPy {machine['scipy']}, Numba {machine['numba']}; peers: {peers};"
        f" {machine['date'].split()[0]}."
    )


def _groups(lines: Sequence[Line]) -> Iterator[str]:
    for group in dict.fromkeys(line.group for line in lines):
        members = [line for line in lines if line.group == group]
        yield from (f"## {group}", "", "| job | ambid | beside it | takes | ratio |", "|---|---|---|---|---|")
        yield from (_row(line) for line in members)
        yield ""
        yield from _remarks(members)


def _row(line: Line) -> str:
    ratios = line.ratios()
    other = "–" if line.other is None else shown(line.other, line.unit)
    ratio = "–" if ratios is None else f"{ratios['of_medians']:.3g}"
    return f"| {line.job} | {shown(line.ambid, line.unit)} | {line.beside or '–'} | {other} | {ratio} |"


def _remarks(lines: Sequence[Line]) -> Iterator[str]:
    """Say below a table what its columns cannot."""
    seen: list[object] = []
    for line in lines:
        notes: dict[str, Any] = line.notes
        if "relative_error_of_differences" in notes:
            error, physical, worst = (
                notes[key] for key in ("relative_error_of_differences", "worst_physical_column", "worst_column")
            )
            yield (
                f"- {line.job}, {line.beside}: both residuals agree within"
                f" {notes['largest_difference_of_residuals_sd']:.1g} standard deviations. The forward differences are"
                f" off the exact Jacobian by up to {error[physical]:.1g} of a column's norm in the physical parameters"
                f" ({physical}), {error[worst]:.1g} in all ({worst})."
            )
        if "steps_per_second" in notes:
            apart = notes["largest_difference"]
            yield (
                f"- {notes['steps_per_second']:.3g} steps a second; {line.beside}:"
                f" {notes['other_steps_per_second']:.3g}, measured over {notes['other_steps_run']} steps."
                f" Without noise the two differ by at most {apart['position_m']:.1g} m and {apart['current_A']:.1g} A."
            )
        if "accuracy" in notes and notes["accuracy"] not in seen:
            seen.append(notes["accuracy"])
            yield from _accuracy(line, notes)
        if "scipy_wall_s" in notes:
            yield (
                f"- The million samples took {quantity(notes['wall_s'], 's')} from start to exit; one residual and"
                f" Jacobian with SciPy {quantity(notes['scipy_wall_s'], 's')}."
            )
    yield ""


def _accuracy(line: Line, notes: Mapping[str, Any]) -> Iterator[str]:
    yield ""
    yield f"What came out ({line.job.split(':')[0]}; SciPy took {notes['scipy_evaluations']} steps):"
    yield ""
    yield "| | truth | ambid | sd | error | SciPy | error |"
    yield "|---|---|---|---|---|---|---|"
    for name, a in notes["accuracy"].items():
        ours, theirs = a["ambid"] / a["truth"] - 1, a["scipy"] / a["truth"] - 1
        yield (
            f"| {name} | {a['truth']:.5g} | {a['ambid']:.5g} | {a['ambid_sd']:.2g} | {ours:.3%} | {a['scipy']:.5g} |"
            f" {theirs:.3%} |"
        )
