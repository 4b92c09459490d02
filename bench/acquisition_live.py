"""The live path at real pace: does the chain keep up on this machine, how late are samples and values, what load."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.program import program
from ambid.acquisition.session import Course, acquire
from ambid.estimation.estimate import Estimate
from ambid.job import identify
from ambid.job.track_live import track_live
from ambid.recursive.lines import TrackLine
from ambid.rig import load_rig
from ambid.tracking.blocks import Frame
from table import Table
from tests.bars.identified import BAND_HZ, BENCHES
from timing import quantity

SECONDS = float(os.environ.get("ACQUISITION_LIVE_S", "10"))
RATE = 2000.0
EVERY_S = 0.01
GROUP = "Acquisition: the live path at real pace (emulated)"
COLUMNS = (
    "what follows", "samples", "lost", "blocks overrun", "sample later than the quickest: median", "99 %", "largest",
    "tracked value: median", "99 %", "largest", "emulator, load of a core", "host, load of a core",
)  # fmt: skip
RIG = load_rig(BENCHES["prototype"].rig)


@dataclass(slots=True)
class Arrivals:
    """A tap that writes down when each block was there, by the clock of the host."""

    after: list[int] = field(default_factory=list)
    at_s: list[float] = field(default_factory=list)
    origin: int | None = None

    def take(self, frame: Frame) -> None:
        if self.origin is None:
            self.origin = frame.block.first
        self.after.append(frame.block.first + len(frame.block.values) - self.origin)
        self.at_s.append(frame.arrived_s)

    def begun_s(self) -> float:
        """When sample 0 was taken, had it come as quickly as the quickest of all."""
        return float(np.min(np.array(self.at_s) - (np.array(self.after) - 1) / RATE))

    def late_s(self) -> np.ndarray:
        """How much later than the quickest each sample was."""
        n = np.concatenate([np.arange(a, b) for a, b in zip([0, *self.after[:-1]], self.after, strict=True)])
        sizes = np.diff([0, *self.after])
        return np.repeat(self.at_s, sizes) - n / RATE - self.begun_s()


def live_tables() -> Iterator[Table]:
    """One table: recorded alone, and tracked."""
    start = _start()
    rows, data = [], {}
    for name, follow in {"recorder and quality": _recorded, "tracker": lambda: _tracked(start)}.items():
        cells, found = follow()
        rows.append((name, *cells))
        data[name] = found
        print("; ".join(rows[-1]), flush=True)
    before = (
        f"{SECONDS:g} s of the excited prototype at 2 kHz, emulated at the pace of the wall clock: emulator, line,"
        " ordinary driver and who follows share this machine's cores. From the tick to the last byte of its frame it"
        " takes the longest work of the tick and ten bit times a byte, some 0.4 ms of emulated time; samples come in"
        " bundles, because a read waits up to 5 ms. Lateness is over the quickest sample of the run; a tracked value"
        f" is a line each {quantity(EVERY_S, 's')}, from its last sample to the call, after 2 s. Load average before:"
        f" {os.getloadavg()[0]:.1f}."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)


def _course(seconds: float, seed: int) -> Course:
    amplitude = BENCHES["prototype"].amplitude_v
    wave = program("multisine", amplitude_v=amplitude, band=BAND_HZ, rate_hz=RATE, seconds=seconds, seed=seed)
    return Course(mode="levitate", seconds=seconds, settle_s=1.0, program=wave)


def _start() -> Estimate:
    with tempfile.TemporaryDirectory() as folder, EmulatedDevice(RIG, seed=1) as device:
        acquire(device, RIG, Path(folder) / "start.h5", _course(10.0, 1))
        return identify(Path(folder) / "start.h5", RIG)


def _recorded() -> tuple[tuple[str, ...], dict[str, object]]:
    taps = Arrivals()
    with tempfile.TemporaryDirectory() as folder, EmulatedDevice(RIG, seed=2, pace="real") as device:
        used = _Used(device)
        done = acquire(device, RIG, Path(folder) / "live.h5", _course(SECONDS, 2), taps=[taps])
        loads = used.loads()
        counters = device.counters()
    return _cells(done.run.samples, counters.lost, counters.overruns, taps.late_s(), None, loads)


def _tracked(start: Estimate) -> tuple[tuple[str, ...], dict[str, object]]:
    taps, lines = Arrivals(), list[tuple[float, float]]()

    def heard(line: TrackLine) -> None:
        lines.append((line.t, time.perf_counter()))

    with EmulatedDevice(RIG, seed=3, pace="real") as device:
        used = _Used(device)
        done = track_live(
            device, RIG, _course(SECONDS, 3), start=start, every_s=EVERY_S, taps=[taps], on_line=heard, keep=False
        )
        loads = used.loads()
        counters = device.counters()
    told = np.array([at - t for t, at in lines if t > 2.0]) - taps.begun_s()  # before that it compiles and catches up
    return _cells(done.run.samples, counters.lost, done.overruns + counters.overruns, taps.late_s(), told, loads)


class _Used:
    """Processor time of emulator and host since it was made, as a load of one core."""

    def __init__(self, device: EmulatedDevice) -> None:
        assert device.emulator is not None
        self._pid = device.emulator.pid
        self._begun = (time.perf_counter(), self._emulator_s(), time.process_time())

    def loads(self) -> tuple[float, float]:
        wall, emulator, host = self._begun
        passed = time.perf_counter() - wall
        return (self._emulator_s() - emulator) / passed, (time.process_time() - host) / passed

    def _emulator_s(self) -> float:
        fields = Path(f"/proc/{self._pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _cells(
    samples: int, lost: int, overruns: int, late: np.ndarray, told: np.ndarray | None, loads: tuple[float, float]
) -> tuple[tuple[str, ...], dict[str, object]]:
    def three(values: np.ndarray | None) -> tuple[str, ...]:
        if values is None:
            return ("–", "–", "–")
        return tuple(quantity(float(np.quantile(values, q)), "s") for q in (0.5, 0.99, 1.0))

    cells = (str(samples), str(lost), str(overruns), *three(late), *three(told), *(f"{x:.0%}" for x in loads))
    quantiles = (0.5, 0.9, 0.99, 1.0)
    data: dict[str, object] = {
        "samples": samples, "lost": lost, "overruns": overruns, "emulator": loads[0], "host": loads[1],
        "late_s": dict(zip(map(str, quantiles), np.quantile(late, quantiles).tolist(), strict=True)),
        "told_s": None if told is None else np.quantile(told, quantiles).tolist(),
    }  # fmt: skip
    return cells, data
