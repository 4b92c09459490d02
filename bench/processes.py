"""What is measured from outside: whole commands, their peak memory, and reading a large file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ambid.record import read_record, write_record
from cases import Case, bearing_record
from timing import Line, Timing, alternate

HERE = Path(__file__).resolve().parent
SCRIPT = "SciPy: script on the same file (loadtxt, least_squares); start, delay, noise weight given"
PROCESSES = "Whole processes, from start to exit"
MEMORY = "Peak memory of whole processes"
N_LARGE = 1_000_000


def command() -> str:
    """The installed command beside the interpreter that runs this."""
    return str(Path(sys.executable).parent / "ambid")


def watched(words: Sequence[str], **environment: str) -> dict[str, float]:
    """Run a command in a small process of its own; wall time in s and peak memory in bytes."""
    child = [sys.executable, "-S", str(HERE / "child.py"), *words]
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    done = subprocess.run(child, capture_output=True, text=True, check=True, env={**inherited, **environment})
    seen = json.loads(done.stdout)
    if seen["code"] != 0:
        raise RuntimeError(f"{' '.join(words)} ended with {seen['code']}: {seen['said']}")
    return {"wall_s": seen["wall_s"], "peak_bytes": seen["peak_bytes"]}


def given_to_scipy(case: Case, path: Path) -> None:
    """Write what the SciPy script is given for free."""
    scales = case.problem.scales
    np.savez(
        path, start=case.start, weight=case.weight / scales.output, skip=case.problem.skip, delay=case.problem.delay,
        **case.scale(),
    )  # fmt: skip


def process_lines(case: Case) -> Iterator[Line]:
    """Cold starts and memory on a record of 20 000 samples."""
    with tempfile.TemporaryDirectory() as folder:
        record, given = Path(folder) / "record.csv", Path(folder) / "given.npz"
        write_record(case.simulation.record, record)
        given_to_scipy(case, given)
        ours = [command(), "identify", str(record)]
        theirs = [sys.executable, str(HERE / "scipy_command.py"), str(record), str(given)]
        yield _help()
        seen = [(watched(ours), watched(theirs)) for _ in range(6)][1:]  # the first fills caches
        wall, peak = (
            [Timing.of([pair[who][key] for pair in seen]) for who in (0, 1)] for key in ("wall_s", "peak_bytes")
        )
        job = "ambid identify, CSV of 20 000 samples"
        yield Line(group=PROCESSES, job=job, unit="s", ambid=wall[0], beside=SCRIPT, other=wall[1])
        cache = Path(folder) / "cache"
        cache.mkdir()
        cold = watched(ours, NUMBA_CACHE_DIR=str(cache))
        yield Line(
            group=PROCESSES, job=f"{job}, nothing compiled yet (once)", unit="s", ambid=Timing.of([cold["wall_s"]])
        )
        yield Line(group=MEMORY, job=job, unit="B", ambid=peak[0], beside=SCRIPT, other=peak[1])


def _help() -> Line:
    """The command that does nothing, beside importing what any SciPy script imports."""
    imports = [sys.executable, "-c", "import numpy, scipy.linalg, scipy.optimize, scipy.signal"]
    seen = [(watched([command(), "--help"])["wall_s"], watched(imports)["wall_s"]) for _ in range(8)][1:]
    ours, theirs = (Timing.of(values) for values in zip(*seen, strict=True))
    return Line(
        group=PROCESSES, job="ambid --help", unit="s", ambid=ours, beside="SciPy: its imports alone", other=theirs
    )


def large_lines(case: Case) -> Iterator[Line]:
    """A record of a million samples: reading it as CSV, and identifying it."""
    with tempfile.TemporaryDirectory() as folder:
        record, given = Path(folder) / "large.csv", Path(folder) / "given.npz"
        write_record(bearing_record(N_LARGE).record, record)
        given_to_scipy(case, given)

        def plain() -> np.ndarray:
            return np.loadtxt(record, delimiter=",", skiprows=1)

        ours, theirs = alternate(2, (lambda: read_record(record), 1), (plain, 1))
        read, table = read_record(record), plain()
        same = all(np.array_equal(c.values, table[:, j]) for j, c in enumerate(read.channels, start=1))
        yield Line(
            group="Reading CSV",
            job="1 000 000 rows, 4 columns, checked, with its SHA-256",
            unit="s",
            ambid=ours,
            beside="NumPy: loadtxt",
            other=theirs,
            notes={"bytes": record.stat().st_size, "equal_to_the_last_bit": same},
        )
        del read, table
        mine = watched([command(), "identify", str(record)])
        beside = watched([sys.executable, str(HERE / "scipy_command.py"), str(record), str(given), "1"])
        yield Line(
            group=MEMORY,
            job="ambid identify, CSV of 1 000 000 samples (once)",
            unit="B",
            ambid=Timing.of([mine["peak_bytes"]]),
            beside=f"{SCRIPT}; stopped after one residual and Jacobian",
            other=Timing.of([beside["peak_bytes"]]),
            notes={"wall_s": mine["wall_s"], "scipy_wall_s": beside["wall_s"]},
        )
        yield Line(
            group=PROCESSES,
            job="ambid identify, CSV of 1 000 000 samples (once)",
            unit="s",
            ambid=Timing.of([mine["wall_s"]]),
        )
