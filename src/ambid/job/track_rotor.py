"""The on-line job of a rotor: a record with periodic excitation, followed from one block of periods to the next.

Read -> start (an estimate, or one identified from the first periods) -> filter block by block -> lines.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick
from ambid.job.data import Reading, Source, load_bench, origin
from ambid.job.following import Following, tell
from ambid.job.rotor import identify_rotor
from ambid.record import Record
from ambid.recursive.lines import Event, Track, TrackedValue, TrackHeader, TrackLine
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.likelihood import Experiment, Point, noise_weight
from ambid.rotor.spectra import Excitation, find_excitation, period_spectra
from ambid.rotor.synchronous import separate
from ambid.rotor.unknowns import Unknowns
from ambid.settings.caller import saved, setting
from ambid.tracking.rotor_filter import Block, RotorFilter, State

_START = 4  # periods from which a start is identified, where the record has three times as many
_LEAST = 2
_AGE = ("k_i", "k_x", "R")
_OF_MODES = {"omega": ("frequency", "Hz", 0.5 / np.pi), "zeta": ("damping", "1", 1.0)}
_SPEED = 0.01  # relative difference of speeds
_RATE = 1e-6  # of rates


def track_rotor(
    record: Source,
    rig: Rig,
    start: object,
    part: Reading,
    how: Following,
    say: Tick,
) -> Track:
    """Follow the numbers of a rotor that age; options as of `ambid.track`."""
    bench = load_bench(record, rig, **part)
    model, excitation = rig.rotor, _excitation(bench, rig)
    assert model is not None
    still = separate(bench, model)
    speed = still.speed
    say("start")
    if start is None or isinstance(start, (int, float)):
        n = min(_START, excitation.count // 3) if start is None else round(start * bench.rate_hz / excitation.period)
        if not _LEAST <= n < excitation.count:
            raise EstimationError(
                f"the record has {excitation.count} whole periods of {excitation.period / bench.rate_hz:.4g} s, {n} of "
                f"them for the start, which needs {_LEAST} and leaves some to track. Use a longer record, or give "
                f"{setting('start')}"
            )
        estimate, first = identify_rotor([_periods(bench, excitation, 0, n)], rig, tick=say), n
    else:
        estimate, first, n = _given(start, rig, bench.rate_hz, speed), 0, min(_START, excitation.count)
    spectra = period_spectra(still.record, model, excitation, speed)
    head = period_spectra(_periods(still.record, excitation, 0, n), model, replace(excitation, first=0, count=n), speed)
    whole = Experiment(spectra=replace(spectra, between=head.between), speed=speed)
    with one_thread():
        follower, size = _filter(estimate, rig, bench, whole, n, how), _size(how, bench, excitation.period)
        header = TrackHeader(
            rate_hz=bench.rate_hz, limit=how.limit, method=f"periods, memory {how.memory}", model="rotor",
            every_s=size * excitation.period / bench.rate_hz, units=_units(follower),
            start=_values(follower, stale=False),
            record={**origin(bench), "samples": (excitation.count - first) * excitation.period},
            warnings=tuple(r.text for r in estimate.verdict.reasons) if start is None else (),
        )  # fmt: skip
        say("track")
        return tell(header, _lines(follower, whole, excitation, first, size), how)


def _lines(
    follower: RotorFilter, whole: Experiment, excitation: Excitation, first: int, size: int
) -> Iterator[TrackLine]:
    for k in range(first, excitation.count - size + 1, size):
        spectra = replace(whole.spectra, U=whole.spectra.U[k : k + size], Y=whole.spectra.Y[k : k + size])
        at = excitation.first + k * excitation.period
        block = Block(experiment=replace(whole, spectra=spectra), first=at, last=at + size * excitation.period)
        step = follower.take(block)
        yield TrackLine(
            t=follower.t0 + block.last / follower.rate_hz, parameters=_values(follower, stale=not step.used),
            error=step.error, state="tracking" if step.settled else "changed",
            events=tuple(_told(e) for e in step.events),
        )  # fmt: skip


def _filter(estimate: RotorEstimate, rig: Rig, bench: Record, whole: Experiment, n: int, how: Following) -> RotorFilter:
    """Return the filter at an estimate; the noise is that of the first `n` periods."""
    assert rig.rotor is not None
    model = rig.rotor.with_modes(estimate.n_modes).at_speed(whole.speed)
    roles = [f"{role}.delay" for role in model.inputs]
    theta = dict(estimate.numbers)
    at = Point(theta=theta, delays=np.array([_late(estimate, role) for role in model.inputs]))
    chosen = tuple(n for n in estimate.covariance_names if n not in roles)
    lengths = {p.name for p in model.parameters if p.unit == "m"}
    damping = {n for n in chosen if n.startswith("mode") and ".z" in n}
    span = model.span(theta)
    scales = {
        n: span if n in lengths else max(abs(x), 0.1) if n in damping or n.startswith("gyro") else x or 1.0
        for n, x in theta.items()
    }  # fmt: skip
    unknowns = Unknowns(model=model, known=(), scales=scales, held_modes=True, chosen=chosen)
    size = np.array([theta[name] if name in unknowns.logs else scales[name] for name in unknowns.names])
    head = replace(whole, spectra=replace(whole.spectra, U=whole.spectra.U[:n], Y=whole.spectra.Y[:n]))
    weight = noise_weight(head, model, at)
    blocks = _size(how, bench, whole.spectra.period)
    block_s = blocks * whole.spectra.period / bench.rate_hz
    top = 2.0 * np.pi * float(whole.spectra.frequency_hz.max())
    within = {f"mode{r}" for r in range(1, model.n_modes + 1) if theta[f"mode{r}.omega"] <= top}
    ages = [
        what in _AGE or (what in _OF_MODES and part in within)
        for part, _, what in (x.partition(".") for x in unknowns.names)
    ]
    memory = {"auto": None, "all": np.inf}.get(how.memory) if isinstance(how.memory, str) else how.memory / block_s
    return RotorFilter(
        unknowns=unknowns, base=at, weight=replace(weight, whiten=weight.whiten * np.sqrt(blocks / n)),
        start=State(q=unknowns.pack(theta, at.delays), P=estimate.covariance_of(unknowns.names) / np.outer(size, size)),
        ages=np.array(ages), block_s=block_s, t0=bench.start_s, rate_hz=bench.rate_hz, memory=memory,
    )  # fmt: skip


def _excitation(bench: Record, rig: Rig) -> Excitation:
    """Return the excitation of a whole record, whose response may change on the way."""
    model = rig.rotor
    assert model is not None
    excitation = find_excitation(bench, model)
    if excitation is None:
        raise EstimationError(
            "the record is not periodic or has less than two whole periods; a rotor is tracked from one period to the "
            "next. Excite with a multisine of whole periods"
        )
    head = _periods(bench, Excitation(period=excitation.period, first=0, count=0), 0, _START)
    begun = find_excitation(head, model)  # where a first transient is over; a later change is none
    first = 0 if begun is None else begun.first
    return Excitation(period=excitation.period, first=first, count=(bench.n_samples - first) // excitation.period)


def _periods(bench: Record, excitation: Excitation, first: int, count: int) -> Record:
    """Return some periods of a record."""
    a = excitation.first + first * excitation.period
    part = slice(a, a + count * excitation.period)
    channels = tuple(replace(c, values=c.values[part]) for c in bench.channels)
    return replace(bench, channels=channels, start_s=bench.start_s + a / bench.rate_hz)


def _given(start: object, rig: Rig, rate_hz: float, speed: float) -> RotorEstimate:
    """Return a start that was given, or read from its file; refuse that of another machine, rate or speed."""
    from ambid.job.results import load

    if isinstance(start, (str, Path)):
        start = load(start)
    if not isinstance(start, RotorEstimate):
        raise EstimationError(
            f"the start is no estimate of a rotor. Give {saved('identify')} for a rig with [bearings.X]"
        )
    assert rig.rotor is not None
    model = rig.rotor.with_modes(start.n_modes).at_speed(speed)
    missing = next((p.name for p in model.parameters if p.name not in start.numbers), None)
    if missing is not None:
        turned = "the record turns, the start does not" if abs(start.speed) < _SPEED * abs(speed) else "another machine"
        raise EstimationError(f"the start has no {missing}: {turned}. Identify a start from this machine at this speed")
    rate = float(str(start.record["rate_hz"]))
    if abs(rate / rate_hz - 1.0) > _RATE:
        raise EstimationError(
            f"the start was made at {rate:g} Hz, the record has {rate_hz:g} Hz; delays count in samples of one rate. "
            "Identify a start at this rate"
        )
    return start


def _late(estimate: RotorEstimate, role: str) -> float:
    delay = estimate.delay[role]
    return delay.samples + delay.fraction


def _size(how: Following, bench: Record, period: int) -> int:
    """Return the periods of a block."""
    return max(1, round(how.every_s * bench.rate_hz / period))


def _shown(name: str) -> tuple[str, str | None, float]:
    """Return how a number is called in a track, its unit where it is not the model's, and what turns it into that."""
    part, _, what = name.partition(".")
    called, unit, factor = _OF_MODES.get(what, (what, None, 1.0)) if part.startswith("mode") else (what, None, 1.0)
    return f"{part}.{called}", unit, factor


def _told(event: Event) -> Event:
    """Return an event with numbers called as in the track."""
    if event.parameter is None:
        return event
    called, _, factor = _shown(event.parameter)
    values = {k: x if k == "statistic" else factor * x for k, x in event.values.items()}
    return replace(event, parameter=called, why=event.why.replace(event.parameter, called), values=values)


def _values(follower: RotorFilter, *, stale: bool) -> dict[str, TrackedValue]:
    theta, sd, values = follower.point.theta, follower.sd(), dict[str, TrackedValue]()
    for name, ages in zip(follower.unknowns.names, follower.ages, strict=True):
        if ages:
            called, _, factor = _shown(name)
            values[called] = TrackedValue(value=factor * theta[name], sd=factor * sd[name], stale=stale)
    return values


def _units(follower: RotorFilter) -> dict[str, str]:
    units = {p.name: p.unit for p in follower.unknowns.model.parameters}
    names = zip(follower.unknowns.names, follower.ages, strict=True)
    return {_shown(n)[0]: _shown(n)[1] or units[n] for n, ages in names if ages}
