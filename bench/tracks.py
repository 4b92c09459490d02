"""What a track makes of a bench that changes, and whether it calls itself usable while it is wrong.

Each record is tracked as `ambid track` does. A line is judged as if the record ended there: it counts as wrong where
the verdict is "usable" and a parameter is more than four standard deviations from the truth, from `AFTER_S` behind the
beginning of what happens on; while disturbances come again it is wrong wherever it is usable.

Alone: ``python bench/tracks.py [--bench heavy,light] [--only ramp,strength] [--seeds 10] [--json FILE]``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.job.tracking import track
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Noise, placed_loop
from ambid.physics.presets import Preset, preset
from ambid.record import Channel, Record
from ambid.recursive.lines import Track, TrackLine
from ambid.signals import multisine
from ambid.simulation.bench import VaryingLoop
from ambid.simulation.plant import LinearPlant
from ambid.simulation.variation import Schedule, Variation
from ambid.tracking.lines_file import Tally

Array = NDArray[np.float64]
PHYSICAL = ("m", "k_x", "k_i", "R", "L")
START_S, AT_S, AFTER_S, FAR = 1.0, 2.003, 0.5, 4.0
_PERIOD = 10_000


def _light() -> Preset:
    parameters = MappingProxyType({"m": 0.3, "k_x": -4e4, "k_i": 25.0, "R": 2.0, "L": 8e-3, "c": 0.0})
    return Preset(
        name="light",
        summary="",
        parameters=parameters,
        loop=placed_loop(parameters, (-1500, -400 + 300j, -400 - 300j, -60), derivative_cutoff_hz=2500.0, delay=1.0),
        usually_closed=True,
        noise=Noise.held(rate_hz=10e3, position=1e-7, current=1e-3, force=0.2, voltage=0.03),
        limits=Limits(),
        rate_hz=10e3,
    )


BENCHES: Mapping[str, Callable[[], Preset]] = {"heavy": lambda: preset("unstable-bearing"), "light": _light}
VOLTS = {"heavy": 4.0, "light": 1.5}  # rms of the excitation
LOAD = {"heavy": 8.0, "light": 0.6}  # N
AMPERES = {"heavy": 0.05, "light": 0.05}


@dataclass(frozen=True, slots=True, kw_only=True)
class Happening:
    """What happens: courses of parameters (factors at times), a load's course over its size, and what is logged."""

    factors: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    load: tuple[tuple[float, float], ...] = ()
    sensor: str = ""
    seconds: float = 5.0
    judged_s: float = AT_S + AFTER_S
    recurring: bool = False  # no line is usable as long as it comes again


def _step(factor: float) -> tuple[tuple[float, float], ...]:
    return (AT_S, 1.0), (AT_S, factor)


def _together(
    powers: Mapping[str, float], *knots: tuple[float, float]
) -> Mapping[str, tuple[tuple[float, float], ...]]:
    """Every power of one factor; a course of many knots where a power is no line."""
    return {name: tuple((t, f**power) for t, f in knots) for name, power in powers.items()}


STRENGTH, BIAS = {"k_i": 1.0, "k_x": 1.0, "L": 1.0}, {"k_i": 1.0, "k_x": 2.0}
_DRIFT = (AT_S, 1.0), (5.0, 1.0 + 0.033 * (5.0 - AT_S))
_PUSHES = tuple(
    knot
    for k, size in enumerate((1, -0.6, 1.4, 0.3, -1.2, 0.8, -0.2, 1.1, -0.9, 0.5, 1.3, -0.4, 0.9, -1.1, 0.2))
    for knot in ((AT_S + 0.2 * k, size if k % 2 else 0.0), (AT_S + 0.2 * k, 0.0 if k % 2 else size))
)
HAPPENINGS: Mapping[str, Happening] = {
    "sound": Happening(),
    "ramp": Happening(load=((AT_S, 0.0), (AT_S + 1.0, 1.0)), judged_s=AT_S + AFTER_S),
    "load": Happening(load=((AT_S, 0.0), (AT_S, 1.0))),
    "strength": Happening(factors=_together(STRENGTH, *_step(0.97))),
    "strength -15 %": Happening(factors=_together(STRENGTH, *_step(0.85))),
    "bias": Happening(factors=_together(BIAS, *_step(0.97))),
    "k_i": Happening(factors={"k_i": _step(0.97)}),
    "k_x": Happening(factors={"k_x": _step(0.97)}),
    "L": Happening(factors={"L": _step(0.97)}),
    "drift R": Happening(factors={"R": _DRIFT}),
    "drift k_i": Happening(factors={"k_i": _DRIFT}),
    "drift strength": Happening(factors=_together(STRENGTH, *_DRIFT)),
    "offset": Happening(sensor="offset"),
    "offset step": Happening(sensor="offset step"),
    "spikes": Happening(sensor="spikes"),
    "spikes at random": Happening(sensor="spikes at random"),
    "pushes": Happening(load=_PUSHES, recurring=True),
}


@cache
def _bench(name: str) -> Preset:
    return BENCHES[name]()


def record_of(name: str, what: Happening, seed: int) -> Record:
    """Simulate a bench under a multisine while something happens."""
    bench = _bench(name)
    n = round(what.seconds * bench.rate_hz)
    schedules = {
        p: Schedule(times_s=tuple(t for t, _ in knots), values=tuple(f * bench.parameters[p] for _, f in knots))
        for p, knots in what.factors.items()
    }
    force = None
    if what.load:
        force = Schedule(times_s=tuple(t for t, _ in what.load), values=tuple(LOAD[name] * f for _, f in what.load))
    running = VaryingLoop(
        LinearPlant(model=model("one-axis"), parameters=bench.parameters),
        Variation(parameters=schedules, force=force), rate_hz=bench.rate_hz, seed=seed, loop=bench.loop,
        noise=bench.noise,
    )  # fmt: skip
    period = multisine(
        _PERIOD, bench.rate_hz, amplitude=VOLTS[name], band=(2.0, 0.12 * bench.rate_hz), shape="pink", seed=seed,
        amplitude_is="rms",
    )  # fmt: skip
    done = running.advance(period[np.arange(n) % _PERIOD])
    position, current = done.measured.T.copy()
    rng, at = np.random.default_rng([seed, 77]), round(AT_S * bench.rate_hz)
    if what.sensor == "offset":
        current += AMPERES[name]
    elif what.sensor == "offset step":
        current[at:] += AMPERES[name]
    elif what.sensor == "spikes":
        places = np.linspace(START_S + 0.5, START_S + 2.0, 30, endpoint=False) * bench.rate_hz
        current[places.astype(np.int64)] += 0.3 * np.where(rng.random(30) < 0.5, -1.0, 1.0)
    elif what.sensor:
        places = rng.integers(at, at + round(1.5 * bench.rate_hz), 30)
        current[places] += 0.3 * np.where(rng.random(30) < 0.5, -1.0, 1.0)
    columns = (("voltage", "V", done.command), ("current", "A", current), ("position", "m", position))
    return Record(
        rate_hz=bench.rate_hz,
        channels=tuple(Channel(name=c, unit=u, values=np.ascontiguousarray(v)) for c, u, v in columns),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """One track against the truth."""

    word: str  # verdict at the end
    z: Mapping[str, float]  # at the end
    wrong: float  # share of judged lines that are usable and wrong
    far: float  # largest |z| of a usable line
    far_of: str
    usable: float  # share of judged lines that are usable
    inside: float  # share of values in judged lines whose interval holds the truth, of those that are not stale
    width: float  # geometric mean of the standard deviations over those of the start
    events: tuple[str, ...]


def judged(name: str, what: Happening, followed: Track) -> Found:
    """Hold each line against the truth, with the verdict that a record would have that ended with it."""
    truth, tally = _bench(name).parameters, Tally(followed.header)
    usable, far, inside, width = list[bool](), list[tuple[float, str]](), list[float](), list[float]()
    z: dict[str, float] = {}
    for line in followed.lines:
        tally.add(line)
        z = _errors(line, what, truth)
        if line.t < what.judged_s:
            continue
        now = replace(followed, lines=(line,), totals=tally.summary(computing_s=0.0))
        worst = max(z, key=lambda n: abs(z[n]) if not line.parameters[n].stale else 0.0)
        usable.append(now.verdict.word == "usable")
        far.append((abs(z[worst]) if usable[-1] else 0.0, worst))
        width += [np.log(line.parameters[n].sd / followed.header.start[n].sd) for n in z]
        inside += [abs(z[n]) < 1.96 for n in z if not line.parameters[n].stale]
    over = [z > FAR for z, _ in far]
    return Found(
        word=followed.verdict.word, z=z, wrong=float(np.mean(usable if what.recurring else over)), far=max(far)[0],
        far_of=max(far)[1], usable=float(np.mean(usable)), inside=float(np.mean(inside or [np.nan])),
        width=float(np.exp(np.mean(width))),
        events=tuple(
            f"{e.t:.3f} {e.kind} {e.parameter or ''}: {e.why}"
            for line in followed.lines for e in line.events
        ) + tuple(f"{r.check}{' (grave)' if r.grave else ''}: {r.text}" for r in followed.reasons),
    )  # fmt: skip


def _errors(line: TrackLine, what: Happening, truth: Mapping[str, float]) -> dict[str, float]:
    found = {}
    for name in PHYSICAL:
        factor = 1.0
        if name in what.factors:
            times, factors = np.array(what.factors[name]).T
            factor = float(np.interp(line.t, times, factors)) if line.t > AT_S else 1.0
        v = line.parameters[name]
        found[name] = (v.value - factor * truth[name]) / v.sd
    return found


def tracked(name: str, what: Happening, seed: int) -> Found:
    """Simulate and track one record."""
    return judged(name, what, track(record_of(name, what, seed), start=START_S))


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--bench", default=",".join(BENCHES))
    words.add_argument("--only", default=",".join(HAPPENINGS))
    words.add_argument("--seeds", type=int, default=10)
    words.add_argument("--first", type=int, default=1)
    words.add_argument("--json", type=Path)
    words.add_argument("--events", action="store_true")
    given, all_found = words.parse_args(), dict[str, object]()
    print("bench happening: words at the end; records with lines usable and wrong; largest |z| of a usable line;")
    print("    median over records of max |z| at the end, its parameter; usable lines; coverage and widths")
    for bench in given.bench.split(","):
        for key in given.only.split(","):
            found = [tracked(bench, HAPPENINGS[key], s) for s in range(given.first, given.first + given.seeds)]
            ends = [max(f.z.items(), key=lambda item: abs(item[1])) for f in found]
            far = max(found, key=lambda f: f.far)
            count = {w: sum(f.word == w for f in found) for w in ("usable", "caution", "unusable")}
            print(
                f"{bench:6} {key:16}: {count['usable']}/{count['caution']}/{count['unusable']};"
                f" wrong {sum(f.wrong > 0 for f in found)} of {len(found)} ({np.mean([f.wrong for f in found]):.0%});"
                f" {far.far:.1f} ({far.far_of}); end {np.median([abs(z) for _, z in ends]):.1f}"
                f" ({','.join(sorted({n for n, _ in ends}))}); usable {np.mean([f.usable for f in found]):.0%};"
                f" inside {np.nanmean([f.inside for f in found]):.0%}, sd {np.mean([f.width for f in found]):.2f}",
                flush=True,
            )
            if given.events:
                for seed, f in enumerate(found, given.first):
                    print(f"  seed {seed}: {f.word}, {', '.join(f'{n} {z:+.1f}' for n, z in f.z.items())}")
                    print("\n".join(f"    {e}" for e in f.events))
            all_found[f"{bench} {key}"] = [
                {"word": f.word, "wrong": f.wrong, "far": f.far, "usable": f.usable, "z": dict(f.z)} for f in found
            ]
    if given.json:
        given.json.write_text(json.dumps(all_found), encoding="utf-8")


if __name__ == "__main__":
    main()
