"""Levitate, excite, record, identify: the whole chain on an emulated bench whose parameters are known."""

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from ambid.acquisition.devices.benches import bench_of
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.program import program
from ambid.acquisition.session import Course, acquire
from ambid.job import identify
from ambid.physics.nonlinear import NonlinearPlant
from ambid.rig import load_rig
from tests.bars.host import DATA

HERE = Path(__file__).resolve().parent
BAND_HZ = (2.0, 66.0)  # as `ambid commission` excites
SETTLE_S = 1.0


@dataclass(frozen=True)
class Way:
    """A rig as its owner wrote it, without values for what is to be found, the bench behind it, and the excitation."""

    rig: Path
    amplitude_v: float
    seconds: float = 20.0


BENCHES = {
    "prototype": Way(DATA / "prototype.toml", 1.5),
    "heavy": Way(HERE / "heavy.toml", 4.0),
    "ball": Way(HERE / "ball.toml", 1.5, 60.0),
}


@dataclass
class Found:
    """What came out: values and standard deviations by name, and what was counted on the way."""

    bench: str
    seed: int
    status: str
    value: dict = field(default_factory=dict)
    sd: dict = field(default_factory=dict)
    true: dict = field(default_factory=dict)
    lost: int = 0
    damaged: int = 0
    complete: bool = False
    failed: tuple = ()
    used: dict = field(default_factory=dict)

    def error(self, name):
        return self.value[name] / self.true[name] - 1.0

    def z(self, name):
        return (self.value[name] - self.true[name]) / self.sd[name]


@cache
def truth(bench):
    """The parameters of the bench, seen as a linear one at its point of rest."""
    rig = load_rig(BENCHES[bench].rig)
    behind = bench_of(rig, None)
    if isinstance(behind.plant, NonlinearPlant):
        return dict(behind.plant.linearise(behind.point.position))
    return dict(behind.plant.parameters)


def chain(bench, folder, seed, *, seconds=None):
    """Go the whole way once."""
    way = BENCHES[bench]
    rig, seconds = load_rig(way.rig), seconds or way.seconds
    path = Path(folder) / f"{bench}-{seed}.h5"
    wave = program(
        "multisine", amplitude_v=way.amplitude_v, band=BAND_HZ, rate_hz=rig.daq.rate_hz, seconds=seconds, seed=seed
    )
    course = Course(mode="levitate", seconds=seconds, settle_s=SETTLE_S, program=wave)
    with EmulatedDevice(rig, seed=seed) as device:
        done = acquire(device, rig, path, course)
    estimate = identify(path, rig)
    path.unlink()
    free = [p for p in estimate.parameters if p.role == "free"]
    return Found(
        bench=bench, seed=seed, status=estimate.status, value={p.name: p.value for p in free},
        sd={p.name: p.sd for p in free}, true={p.name: truth(bench)[p.name] for p in free}, lost=done.run.lost,
        damaged=done.counters.damaged, complete=done.run.complete,
        failed=tuple(n for n, c in estimate.checks.items() if not c.passed),
        used={c.name: c for c in done.quality.columns},
    )  # fmt: skip
