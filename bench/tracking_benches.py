"""The benches on which tracking is measured, as streams that take the same memory however long they run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.estimation.estimate import Estimate
from ambid.job import identify
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Noise, placed_loop
from ambid.physics.presets import Preset, preset
from ambid.record import Channel, Record
from ambid.recursive.lines import Event
from ambid.signals import multisine
from ambid.simulation.bench import VaryingLoop
from ambid.simulation.plant import LinearPlant
from ambid.simulation.rig_bench import Bench
from ambid.simulation.scenarios import amplitude_for, one_period
from ambid.simulation.scenarios import scenario as scenario_of
from ambid.simulation.variation import Variation
from ambid.tracking.evidence import Samples
from ambid.tracking.numbers import TrackedNumbers, tracked_numbers
from ambid.tracking.rpem import PhysicalRpem
from ambid.tracking.supervisor import Supervisor

Array = NDArray[np.float64]
Streams = Callable[[str, int, float, float], Iterator[tuple[int, Samples]]]

RATE = 20_000.0
BLOCK = 100  # samples: 5 ms, one evidence
START_S = 1.0  # of excited running from which the start is identified
_PERIOD = 20_000
_CHUNK = 20_000
PHYSICAL = ("m", "k_x", "k_i", "R", "L")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackBench:
    """A bench under feedback; `stream` gives a scenario's samples from a seed, a length and a beginning in s."""

    name: str
    truth: Mapping[str, float]
    stream: Streams

    def samples(self, scenario: str, seed: int, seconds: float, at_s: float = 0.0) -> Samples:
        """Return a whole record."""
        parts = [part for _, part in self.stream(scenario, seed, seconds, at_s)]
        return Samples(u=np.concatenate([p.u for p in parts]), y=np.concatenate([p.y for p in parts]))


def preset_bench() -> TrackBench:
    """The unstable bearing as `ambid scenario` simulates it: excitation 5 Hz to 1 kHz, 0.4 of its limits."""
    bench = preset("unstable-bearing")

    def stream(scenario: str, seed: int, seconds: float, at_s: float) -> Iterator[tuple[int, Samples]]:
        b, s = Bench.of(bench, None, True), scenario_of(scenario)
        period = _amplitude() * one_period(b, seed) if s.excited else np.zeros(1)
        running = VaryingLoop(
            b.plant, s.vary(b, at_s, s.size_for(b, None), seconds), rate_hz=b.rate_hz, seed=seed, loop=b.loop,
            limits=b.limits, noise=b.noise, operating_point=b.point,
        )  # fmt: skip
        outputs = b.linear.model.outputs
        for first in range(0, round(seconds * b.rate_hz), _CHUNK):
            n = min(_CHUNK, round(seconds * b.rate_hz) - first)
            done = running.advance(period[(first + np.arange(n)) % period.size])
            position, current = (done.measured[:, outputs.index(x)] for x in ("position", "current"))
            yield first, _samples(done.command, position, current)

    return TrackBench(name="unstable-bearing", truth=bench.parameters, stream=stream)


@cache
def _amplitude() -> float:
    """What `ambid scenario` chooses, once for all seeds."""
    b = Bench.of(preset("unstable-bearing"), None, None)
    return amplitude_for(b, one_period(b, 1), 1)


def second_bench() -> TrackBench:
    """A bearing of half the inductance under more noise, and a multisine of 6 V rms from 2 Hz to 2 kHz."""
    parameters = MappingProxyType({"m": 4.0, "k_x": -1.29e5, "k_i": 55.7, "R": 0.8, "L": 13.0e-3, "c": 0.0})
    bench = Preset(
        name="bearing of 13 mH",
        summary="",
        parameters=parameters,
        loop=placed_loop(parameters, (-600, -120 + 120j, -120 - 120j, -20), derivative_cutoff_hz=1500.0, delay=1.0),
        usually_closed=True,
        noise=Noise.held(rate_hz=RATE, position=2e-7, current=2e-3, force=2.0, voltage=0.05),
        limits=Limits(),
        rate_hz=RATE,
    )

    def stream(scenario: str, seed: int, seconds: float, at_s: float) -> Iterator[tuple[int, Samples]]:
        period = np.zeros(_PERIOD)
        if scenario != "quiet":
            period = multisine(
                _PERIOD, RATE, amplitude=6.0, band=(2.0, 2000.0), shape="pink", seed=seed, amplitude_is="rms"
            )
        running = VaryingLoop(
            LinearPlant(model=model("one-axis"), parameters=parameters),
            _variation(scenario, bench, at_s, seconds),
            rate_hz=RATE, seed=seed, loop=bench.loop, noise=bench.noise,
        )  # fmt: skip
        for first in range(0, round(seconds * RATE), _CHUNK):
            n = min(_CHUNK, round(seconds * RATE) - first)
            done = running.advance(period[(first + np.arange(n)) % _PERIOD])
            yield first, _samples(done.command, done.measured[:, 0], done.measured[:, 1])

    return TrackBench(name=bench.name, truth=parameters, stream=stream)


def _variation(scenario: str, bench: Preset, at_s: float, seconds: float) -> Variation:
    from ambid.simulation.rig_bench import Bench
    from ambid.simulation.scenarios import scenario as named

    found, b = named(scenario), Bench.of(bench, None, None)
    return found.vary(b, at_s, found.size_for(b, None), seconds)


def _samples(voltage: Array, position: Array, current: Array) -> Samples:
    return Samples(
        u=np.ascontiguousarray(voltage[:, None]), y=np.ascontiguousarray(np.column_stack([position, current]))
    )


def record_of(samples: Samples, stop: int | None = None) -> Record:
    """Put the first samples into a record."""
    cut = slice(0, stop)
    return Record(
        rate_hz=RATE,
        channels=(
            Channel(name="voltage", unit="V", values=samples.u[cut, 0].copy()),
            Channel(name="current", unit="A", values=samples.y[cut, 1].copy()),
            Channel(name="position", unit="m", values=samples.y[cut, 0].copy()),
        ),
    )


def identified(samples: Samples) -> Estimate:
    """Identify the start of tracking from the first second."""
    return identify(record_of(samples, round(START_S * RATE)))


@cache
def start_of(bench: str) -> TrackedNumbers:
    """A start from one second of excited running of seed 1, the same for everything that needs only one."""
    which = BENCHES[bench]()
    return tracked_numbers(identified(which.samples("steady", 1, START_S)))


BENCHES: Mapping[str, Callable[[], TrackBench]] = MappingProxyType(
    {"unstable-bearing": preset_bench, "bearing of 13 mH": second_bench}
)


def supervised(
    start: TrackedNumbers | Estimate, *, first: int = 0, listener: Callable[[Event], None] = lambda _: None
) -> Supervisor:
    """The supervisor as the command makes it; `first` is the number of its first sample."""
    numbers = start if isinstance(start, TrackedNumbers) else tracked_numbers(start)
    found = Supervisor(PhysicalRpem(numbers), listener=listener)
    found.diagnosis.restart(first)
    return found


def blocks(samples: Samples, first: int = 0, size: int = BLOCK) -> Iterator[tuple[int, Samples]]:
    """Cut into blocks as they would come."""
    for k in range(first, samples.y.shape[0], size):
        yield k, samples.part(k, min(k + size, samples.y.shape[0]))


def told_of(event: Event) -> dict[str, object]:
    """What an event says, for the file of results."""
    return {
        "t": event.t,
        "kind": event.kind,
        "parameter": event.parameter,
        "why": event.why,
        "values": dict(event.values),
    }
