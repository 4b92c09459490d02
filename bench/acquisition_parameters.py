"""Parameters from data that came through converter, line and protocol, beside the truth of the emulated bench."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from table import Table
from tests.bars.identified import BAND_HZ, BENCHES, chain

RUNS = {
    "prototype": int(os.environ.get("ACQUISITION_RUNS", "40")),
    "heavy": int(os.environ.get("ACQUISITION_OTHER_RUNS", "12")),
    "ball": int(os.environ.get("ACQUISITION_OTHER_RUNS", "12")) // 2,
}
ABOUT = {
    "prototype": "differential pair, 0.3 kg, 12 V bridge",
    "heavy": "linear, 1.2 kg, 24 V bridge, another coil",
    "ball": "one magnet, gravity and bias, single transistor",
}
WIDEST = float(norm.isf(0.5e-3))
GROUP = "Acquisition: parameters through converter, line and protocol (emulated)"
COLUMNS = (
    "bench", "parameter", "truth", "error, mean", "error, sd", "error, largest", "z, mean", "z, sd", "z, largest",
    "inside 99.9 % intervals",
)  # fmt: skip


def parameter_tables() -> Iterator[Table]:
    """One table over all benches."""
    rows: list[tuple[str, ...]] = []
    remarks, data = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for bench, runs in RUNS.items():
            found = []
            for seed in range(runs):
                found.append(chain(bench, folder, seed))
                print(bench, seed, _short(found[-1]), flush=True)
            rows += _rows(bench, found)
            remarks.append(_remark(bench, found))
            data[bench] = [
                {"seed": f.seed, "value": f.value, "sd": f.sd, "true": f.true, "failed": f.failed} for f in found
            ]
    before = (
        "The firmware's own PID levitates the rotor of the emulated bench; the controller plays a multisine of"
        f" {BAND_HZ[0]:g} to {BAND_HZ[1]:g} Hz, 2000 samples a second come over the line, are recorded and identified"
        " with every parameter free, mass too; each run with its own noise and phases. z: error over the estimate's own"
        " standard deviation. The truth of a magnet is that of its linear bench at the point of rest: what its"
        " curvature does to large motion is part of the error."
    )
    yield Table(
        group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=tuple(remarks), data={"runs": data}
    )


def _rows(bench: str, found: Sequence[Any]) -> Iterator[tuple[str, ...]]:
    for name, true in found[0].true.items():
        error = np.array([f.error(name) for f in found])
        z = np.array([f.z(name) for f in found])
        inside = int(np.count_nonzero(np.abs(z) < WIDEST))
        yield (
            bench, name, f"{true:.4g}", f"{error.mean():+.2%}", f"{error.std():.2%}", f"{np.abs(error).max():.2%}",
            f"{z.mean():+.2f}", f"{z.std():.2f}", f"{np.abs(z).max():.1f}", f"{inside} of {len(found)}",
        )  # fmt: skip


def _remark(bench: str, found: Sequence[Any]) -> str:
    way = BENCHES[bench]
    lost, damaged = sum(f.lost for f in found), sum(f.damaged for f in found)
    converged = sum(f.status == "converged" for f in found)
    failed = sum(bool(f.failed) for f in found)
    return (
        f"{bench}: {ABOUT[bench]}; excitation {way.amplitude_v:g} V peak, {way.seconds:g} s; {converged} of"
        f" {len(found)} searches converged, {failed} estimates with a failed check, {lost} samples lost, {damaged}"
        " frames damaged."
    )


def _short(found: Any) -> str:
    return ", ".join(f"{n} {found.error(n):+.2%} ({found.z(n):+.1f})" for n in found.value)
