"""A real levitated ball
=====================

Real records: a steel ball (60.54 g) under one magnet, closed loop, 1 kHz; least squares beside the likelihood.

The records are public, from the student laboratory repository 062020-Lab-Mechatronics, and not part of this one; the
example takes their folder, or ``maglev`` in the folder that AMBID_RECORDS names. The check that uses no fit at all is
gravity: the magnet's force is proportional to the current squared and carries the ball, so k_i = df/di = -2 m g/i0 and
k_i/m = -2 g/i0 at the mean current i0 (the position is the gap: it grows away from the magnet).

Run: ``python docs/examples/real_maglev.py [FOLDER]``
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.signal import butter, sosfiltfilt

from ambid.estimation.estimate import Estimate
from ambid.job import identify, load_bench
from ambid.record import Record
from ambid.rig import load_rig

DATA = Path(os.environ.get("AMBID_RECORDS") or Path(__file__).resolve().parents[3] / "shared" / "data") / "maglev"
RECORDS = ("levitate_stairs_a", "levitate_stairs_b", "levitate_sine_e")
CUTOFFS_HZ = (10.0, 20.0, 50.0)
GRAVITY, MASS, MEASURED_OHM = 9.81, 0.06054, 4.17

RIG = """
schema = "ambid.rig/1"
name   = "steel ball under one magnet"
model  = "one-axis"
[channels.voltage]
column = "duty_upper"
table  = '{table}'              # measured: duty -> coil voltage; the delay is found ("auto")
[channels.current]
column = "current_upper"
[channels.position]
column = "position"
[parameters]
m   = {{ value = 60.54, unit = "g", role = "fixed" }}     # weighed
k_x = {{ unit = "N/m" }}
k_i = {{ unit = "N/A" }}
R   = {{ unit = "ohm" }}
L   = {{ unit = "H" }}
[record]
from = 2.0                        # before, the ball is picked up from its rest
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One record: k_i/m by three ways, in N/(A kg), and the whole estimate."""

    balance: float
    least_squares: dict[float, float]
    estimate: Estimate

    @property
    def ratio(self) -> float:
        """k_i/m of the likelihood estimate."""
        return self.estimate.values["k_i"] / MASS


def gravity_balance(record: Record) -> float:
    """Return k_i/m = -2 g/i0, i0 the mean current."""
    return -2.0 * GRAVITY / float(record["current"].values.mean())


def plain_least_squares(record: Record, cutoff_hz: float) -> float:
    """Return k_i/m of x'' = -(k_x/m) x + (k_i/m) i + constant, x'' by second differences of the low-passed position.

    Noise of the position stands on both sides of the equation and goes through the controller into the current: the
    result is biased, and depends on the cutoff.
    """
    sections = butter(4, cutoff_hz, fs=record.rate_hz, output="sos")
    x, i = (sosfiltfilt(sections, record[name].values) for name in ("position", "current"))
    acceleration = np.diff(x, n=2) * record.rate_hz**2
    regressors = np.column_stack([-x[1:-1], i[1:-1], np.ones(acceleration.size)])
    return float(np.linalg.lstsq(regressors, acceleration, rcond=None)[0][1])


def main(folder: Path = DATA) -> dict[str, Result]:
    """Identify three of the records and print the comparison; return the numbers by record."""
    if not (folder / "duty_to_voltage.csv").is_file():
        print(f"the maglev records are not in {folder}; give their folder: python docs/examples/real_maglev.py FOLDER")
        return {}
    results = {}
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / "maglev.toml"
        path.write_text(RIG.format(table=(folder / "duty_to_voltage.csv").as_posix()), encoding="utf-8")
        rig = load_rig(path)
        for name in RECORDS:
            record = load_bench(folder / f"{name}.csv", rig)
            results[name] = Result(
                balance=gravity_balance(record),
                least_squares={cutoff: plain_least_squares(record, cutoff) for cutoff in CUTOFFS_HZ},
                estimate=identify(record, rig),
            )
    _print(results)
    return results


def _print(results: dict[str, Result]) -> None:
    print("k_i/m in N/(A kg)")
    heads = "".join(f"  LS {cutoff:g} Hz" for cutoff in CUTOFFS_HZ)
    print(
        f"{'record':18} {'balance':>8}{heads} {'likelihood':>11} {'sd':>6}  delay    R [ohm]        L [H]    warnings"
    )
    for name, r in results.items():
        found = {p.name: p for p in r.estimate.parameters}
        plain = "".join(f" {value:9.2f}" for value in r.least_squares.values())
        k_i, ohm, henry, delay = found["k_i"], found["R"], found["L"], r.estimate.delay["voltage"]
        print(
            f"{name:18} {r.balance:8.2f}{plain} {r.ratio:11.2f} {k_i.sd / MASS:6.2f}"
            f"  {delay.samples + delay.fraction:5.2f}  {ohm.value:.3f} ±{ohm.sd:.3f}"
            f"  {henry.value:.4f} ±{henry.sd:.4f}  {len(r.estimate.warnings)}"
        )
    for name, r in results.items():
        print(f"\n{name}:", *(r.estimate.warnings or ("no warnings",)), sep="\n  - ")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else DATA)
