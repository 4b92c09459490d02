"""``ambid demo``: the main job on the embedded record, beside the truth; and the recipe that makes the record.

The file in ``data/`` is what `demo_csv` gives, gzipped; a test makes it anew and compares. To write it again:
``python -m ambid.cli.demo``.
"""

from __future__ import annotations

import gzip
from importlib.resources import as_file, files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ambid.cli.options import option
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ambid.estimation.parts import EstimatedParameter
    from ambid.report.text import Paint
    from ambid.simulate import Simulation

# Truth of the thesis's simulation rig (table 4.1, corrected) and what its own identification found there (eq. 4.11).
_THESIS = {
    "m": (0.1, 0.0976), "k_x": (587.22, 608.1), "k_i": (-310.08, -320.0), "R": (1.25, 1.138), "L": (59.6e-3, 60.2e-3)
}  # fmt: skip
PRESET = "unstable-bearing"
SEED = 3
DURATION_S = 0.4
AMPLITUDE_V = 20.0
BAND_HZ = (5.0, 2000.0)

# As a data logger would: header, factor from SI, digits after the point.
_COLUMNS = (("voltage", "V", 1.0, 3), ("current", "mA", 1e3, 2), ("position", "um", 1e6, 3))
_INSIDE = 3.29  # standard deviations of a 99.9 % interval
_FILES = ("demo.csv.gz", "demo.toml")


def command(
    copy: Annotated[Path | None, option("--copy FOLDER", "Also put the record and its rig there.")] = None,
) -> None:
    """Identify the embedded record and print the estimate beside the truth.

    The record: 0.4 s of an unstable bearing, levitated by a PID, simulated with noise. Nothing is known beforehand.
    """
    from ambid.job import identify
    from ambid.physics.presets import preset
    from ambid.report.estimate_text import delay_lines, header_lines, output_rows
    from ambid.report.text import check_lines, columns

    with as_file(demo_file(_FILES[0])) as record, as_file(demo_file(_FILES[1])) as rig, Outputs() as outputs:
        if copy is not None:
            _copy((record, rig), copy, outputs)
        with progress("identify") as tick:
            estimate = identify(record, rig, tick=tick)
    paint = painter()
    truth = preset(PRESET).parameters
    typer.echo(f"{header_lines(estimate, paint=paint)[0]}\nsimulated in closed loop; nothing was known beforehand\n")
    typer.echo("\n".join(truth_lines(estimate.parameters, truth, paint)))
    typer.echo("\n" + "\n".join([*delay_lines(estimate), "", *columns(output_rows(estimate))]))
    typer.echo("\n" + "\n".join(check_lines(estimate.checks, paint=paint)))
    whole = sum(estimate.timing_s.values())
    typer.echo(f"\ntime: {whole:.2g} s from file to checked estimate; the thesis needed about 5 s")
    if copy is not None:
        typer.echo(f"\n{copy / _FILES[0]} and {copy / _FILES[1]} written. Try:")
        typer.echo(f"  ambid identify {copy / _FILES[0]} --rig {copy / _FILES[1]} --plot {copy / 'demo.png'}")


def truth_lines(found: tuple[EstimatedParameter, ...], truth: Mapping[str, float], paint: Paint) -> list[str]:
    """Write estimated parameters beside their truth.

    `found`: fixed ones are left out; `truth`: SI; `paint`: adds colour. Returns a table, and a line on how many truths
    lie inside their 99.9 % intervals.
    """
    from ambid.report.numbers import quantity
    from ambid.report.text import columns

    rows = [("", "estimate ± sd", "truth", "error", "in sd", "thesis*", "verdict")]
    inside = []
    for p in (p for p in found if p.role != "fixed"):
        true, (was, got) = truth[p.name], _THESIS[p.name]
        z = (p.value - true) / p.sd
        inside.append(abs(z) < _INSIDE)
        q = quantity(p.value, p.sd, p.unit)
        scale, decimals = p.value / float(q.value), len(q.value.partition(".")[2])
        shown = f"{true / scale:.{decimals}f} {q.unit}"
        errors = (_percent(p.value - true, true, 2), f"{z:+.1f}", _percent(got - was, was, 1))
        rows.append((p.name, q.text, shown, *errors, "identified" if p.identifiable else "NOT SHOWN"))
    mark = paint("✓", "good") if all(inside) else paint("✗", "bad")
    return [
        *columns(rows, right=(3, 4, 5)),
        "* what the thesis's own method was off by, on its simulation rig (4.10 → 4.11)",
        f"{mark} {sum(inside)} of {len(inside)} truths lie inside their 99.9 % intervals",
    ]


def _percent(error: float, of: float, decimals: int) -> str:
    return f"{100 * error / abs(of):+.{decimals}f} %"


def _copy(files: tuple[Path, ...], folder: Path, outputs: Outputs) -> None:
    for name, source in zip(_FILES, files, strict=True):
        target = folder / name
        outputs.claim(target, "--copy")
        if target.exists():
            raise AmbidError(f"--copy {target} exists already. Remove it, or choose another folder")
        content = source.read_bytes()
        outputs.stage(target, lambda path, content=content: path.write_bytes(content))  # type: ignore[misc]


def demo_file(name: str) -> Traversable:
    """Return a file of the demo.

    `name`: ``"demo.csv.gz"`` or ``"demo.toml"``. Returns in the package's data.
    """
    return files("ambid").joinpath("data", name)


def demo_simulation() -> Simulation:
    """Simulate the bench of the demo: the unstable bearing under its PID, with process and sensor noise.

    Returns its `truth` is what the demo compares with.
    """
    from ambid.physics.presets import preset
    from ambid.signals import excitation
    from ambid.simulate import simulate_preset

    bench = preset(PRESET)
    n = round(DURATION_S * bench.rate_hz)
    u = excitation("multisine", n, bench.rate_hz, amplitude=AMPLITUDE_V, band=BAND_HZ, seed=SEED)
    return simulate_preset(bench, u, seed=SEED)


def demo_csv(simulation: Simulation) -> str:
    """Write the record of the demo with the few digits that a logger keeps.

    `simulation`: as `demo_simulation` gives it. Returns CSV: voltage to 1 mV, current to 10 uA, position to 1 nm.
    """
    record = simulation.record
    lines = [
        f"# ambid demo: preset {PRESET} in closed loop, multisine of {AMPLITUDE_V:g} V in {BAND_HZ[0]:g} to"
        f" {BAND_HZ[1]:g} Hz, seed {SEED}",
        ",".join(["time [ms]", *(f"{name} [{unit}]" for name, unit, _, _ in _COLUMNS)]),
    ]
    scaled = [(1e3 * record.time_s).tolist(), *((factor * record[name]).tolist() for name, _, factor, _ in _COLUMNS)]
    formats = ["%.2f", *(f"%.{digits}f" for *_, digits in _COLUMNS)]
    pattern = ",".join(formats)
    lines.extend(pattern % row for row in zip(*scaled, strict=True))
    return "\n".join(lines) + "\n"


def write_demo_record(folder: Path) -> Path:
    """Write the record of the demo.

    `folder`: where to. Returns the file.
    """
    path = folder / "demo.csv.gz"
    path.write_bytes(gzip.compress(demo_csv(demo_simulation()).encode(), compresslevel=9, mtime=0))
    return path


if __name__ == "__main__":
    print(write_demo_record(Path(__file__).resolve().parents[1] / "data"))
