"""Make the record of ``ambid demo`` anew: ``python tools/demo_record.py`` writes it into the package's data.

A test makes it and compares it with the file.
"""

from __future__ import annotations

import gzip
from pathlib import Path

from ambid.cli.demo import PRESET
from ambid.physics.presets import preset
from ambid.signals import excitation
from ambid.simulation import Simulation, simulate_preset

SEED = 3
DURATION_S = 0.1
AMPLITUDE_V = 40.0
BAND_HZ = (5.0, 2000.0)

# As a data logger would: header, factor from SI, digits after the point.
_COLUMNS = (("voltage", "V", 1.0, 2), ("current", "mA", 1e3, 1), ("position", "um", 1e6, 2))


def demo_simulation(duration_s: float = DURATION_S, amplitude: float = AMPLITUDE_V) -> Simulation:
    """Simulate the bench of the demo: the unstable bearing under its PID, with process and sensor noise.

    Returns its `truth` is what the demo compares with.
    """
    bench = preset(PRESET)
    n = round(duration_s * bench.rate_hz)
    u = excitation("multisine", n, bench.rate_hz, amplitude=amplitude, band=BAND_HZ, seed=SEED)
    return simulate_preset(bench, u, seed=SEED)


def demo_csv(simulation: Simulation) -> str:
    """Write the record of the demo with the few digits that a logger keeps.

    `simulation`: as `demo_simulation` gives it. Returns CSV: voltage to 10 mV, current to 0.1 mA, position to 10 nm.
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


if __name__ == "__main__":
    target = Path(__file__).resolve().parents[1] / "src" / "ambid" / "data" / "demo.csv.gz"
    target.write_bytes(gzip.compress(demo_csv(demo_simulation()).encode(), compresslevel=9, mtime=0))
    print(target)
