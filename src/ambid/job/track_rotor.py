"""The on-line job of a rotor: a record with periodic excitation, followed from one block of periods to the next.

Read -> start (an estimate, or one identified from the first periods) -> filter block by block -> lines.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.margins import sensitivity_by_axis
from ambid.errors import EstimationError
from ambid.estimation.estimate import plain_json
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick
from ambid.job.closed_loop import controller_of, loop_and_peaks, measure, refuse_unstable
from ambid.job.data import Reading, Source, load_bench, origin
from ambid.job.following import Following, tell
from ambid.job.rotor import identify_rotor
from ambid.job.track_start import BenchRows, words_of_start
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record
from ambid.recursive.lines import Event, StartWords, Track, TrackedValue, TrackHeader, TrackLine
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.likelihood import Experiment, Point, noise_weight
from ambid.rotor.spectra import Excitation, PeriodSpectra, find_excitation, period_spectra
from ambid.rotor.synchronous import rotation_of, separate, synchronous_response
from ambid.rotor.unknowns import Unknowns
from ambid.settings.caller import saved, setting
from ambid.tracking.blocks import Block as Samples
from ambid.tracking.blocks import Frame
from ambid.tracking.rotor_filter import Block, RotorFilter, State

_START = 4  # periods from which a start is identified, where the record has three times as many
_LEAST = 2
_AGE = ("k_i", "k_x", "R")
_OF_MODES = {"omega": ("frequency", "Hz", 0.5 / np.pi), "zeta": ("damping", "1", 1.0)}
_SPEED = 0.01  # relative difference of speeds
_RATE = 1e-6  # of rates
_LIVE_LINES = 400  # of a live filter, beside those of modes:
_NEAR, _WIDTHS = 0.08, 5.0  # all within so much of their frequency, or half widths; levitated they stand elsewhere
_JUDGED_S = 10.0  # between two sensitivities of a live loop


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
        samples = (excitation.count - first) * excitation.period
        header = _header(follower, bench, excitation, size, samples, how, words_of_start(estimate, rig))
        say("track")
        blocks = (
            _block(whole, spectra.U[k : k + size], spectra.Y[k : k + size], excitation.first + k * excitation.period)
            for k in range(first, excitation.count - size + 1, size)
        )
        return tell(header, (_line(follower, block) for block in blocks), how)


def follow_rotor(
    lead: BenchRows,
    frames: Iterator[Frame],
    rig: Rig,
    start: object,
    how: Following,
    *,
    on_lag: Callable[[float], object],
    on_loop: Callable[[float, Mapping[str, Any]], object],
    say: Tick,
) -> Track:
    """Follow a rotor in a stream from its first periods on, which identify a start unless there is one; `say` may end
    that. `on_loop`: told the time and the sensitivity of each axis, as an estimate has it: measured in the run, without
    an excitation predicted by the start.
    """
    bench, model, identified = lead.record, rig.rotor, start is None or isinstance(start, (int, float))
    assert model is not None
    if np.any(np.diff(lead.replay.numbers) != 1) or not np.isfinite(lead.replay.values).all():
        raise EstimationError("samples of the first periods are missing; a start needs all of them. Start again")
    try:
        excitation = _excitation(bench, rig)
    except EstimationError:
        if not identified:  # what can be said of the loop without an excitation
            known = _given(start, rig, bench.rate_hz, model.speed)
            on_loop(bench.start_s, loop_and_peaks(known, rig, bench, None, model.speed)[1])
        raise
    n, period, still = excitation.count, excitation.period, separate(bench, model)
    excitation = replace(excitation, first=excitation.first - excitation.first % period)  # the rest is of the next one
    first = excitation.first + n * period
    if identified:
        estimate = identify_rotor([_periods(bench, excitation, 0, n)], rig, tick=say)
    else:
        estimate = _given(start, rig, bench.rate_hz, still.speed)
    every = Experiment(spectra=period_spectra(still.record, model, excitation, still.speed), speed=still.speed)
    keep = _telling(every.spectra, estimate, len(model.axes))
    whole = replace(every, spectra=every.spectra.lines(keep))
    with one_thread():
        follower, size = _filter(estimate, rig, bench, whole, n, how), _size(how, bench, period)
        stream = _Stream(bench, int(lead.replay.numbers[0]), first, period, size)
        judge = _Judge(follower, estimate, rig, every, on_loop)

        def lines() -> Iterator[TrackLine]:
            judge(first)
            for at, window, arrived_s in stream.windows(frames):
                if window is None:
                    yield _missing(follower, at, size * period)
                    continue
                U, Y = _spectra_of(window, model, every, size)
                yield _line(follower, _block(whole, U[:, keep], Y[:, keep], at))
                on_lag(time.perf_counter() - arrived_s)
                judge.take(U, Y, at + size * period)

        header = _header(follower, bench, excitation, size, None, how, words_of_start(estimate, rig))
        return tell(header, lines(), how)


def _missing(follower: RotorFilter, at: int, samples: int) -> TrackLine:
    """Return the line of a block that is not whole: the last values."""
    why = "samples of this block, or of the one before it, are missing"
    event = Event(kind="rejected", t=follower.time(at), why=why, samples=samples)
    values, t = _values(follower, stale=True), follower.time(at + samples)
    return TrackLine(t=t, parameters=values, error=np.nan, state="frozen", events=(event,))


def _telling(spectra: PeriodSpectra, estimate: RotorEstimate, axes: int) -> NDArray[np.bool_]:
    """Return which lines a filter beside a run takes: those of bending modes, and of the others, which are dealt out to
    the axes, as many to the octave.
    """
    f = spectra.frequency_hz
    groups = np.arange(f.size) // axes
    keep = np.isin(groups, np.unique(np.geomspace(1, groups[-1] + 1, _LIVE_LINES // axes).astype(int)) - 1)
    for r in range(1, estimate.n_modes + 1):
        hz = estimate.numbers[f"mode{r}.omega"] / (2.0 * np.pi)
        keep |= np.abs(f - hz) < hz * max(_NEAR, _WIDTHS * estimate.numbers[f"mode{r}.zeta"])
    return np.asarray(keep)


class _Stream:
    """Cuts a stream into windows of a period and the `size` periods after it, aligned with those of the start."""

    def __init__(self, lead: Record, origin: int, first: int, period: int, size: int) -> None:
        self._lead, self._period, self._size = lead, period, size
        tail = np.column_stack([c.values for c in lead.channels])[first - period :]
        self._rows, self._n, self._at = [tail], len(tail), first
        self._next = origin + lead.n_samples

    def windows(self, frames: Iterator[Frame]) -> Iterator[tuple[int, Record | None, float]]:
        """Yield where the last periods of a window begin, the window, None where samples are missing, and when its end
        was there.
        """
        new, whole = self._size * self._period, (self._size + 1) * self._period
        for frame in frames:
            self._take(frame.block)
            while self._n >= whole:
                rows = np.concatenate(self._rows)
                self._rows, self._n = [rows[new:]], len(rows) - new
                sound = bool(np.isfinite(rows[:whole]).all())
                yield self._at, self._record(rows[:whole]) if sound else None, frame.arrived_s
                self._at += new

    def _take(self, block: Samples) -> None:
        lost, seen = block.first - self._next, max(0, self._next - block.first)
        values = block.values[seen:]
        if lost > 0:
            values = np.concatenate([np.full((lost, values.shape[1]), np.nan), values])
        self._rows.append(values)
        self._n += len(values)
        self._next += len(values)

    def _record(self, rows: Array) -> Record:
        start_s = self._lead.start_s + (self._at - self._period) / self._lead.rate_hz
        channels = tuple(replace(c, values=rows[:, k].copy()) for k, c in enumerate(self._lead.channels))
        return replace(self._lead, channels=channels, start_s=start_s)


def _spectra_of(window: Record, model: RotorModel, whole: Experiment, size: int) -> tuple[Complex, Complex]:
    """Return the spectra of the last periods of a window at the lines of the start, without what turns with the rotor,
    which the period before them helps to tell.
    """
    spectra, run = whole.spectra, Excitation(period=whole.spectra.period, first=0, count=size + 1)
    rotation = rotation_of(window, replace(model, speed=whole.speed), run) if whole.speed else None
    roles, n = (*model.inputs, *model.outputs), len(model.inputs)
    if rotation is None:
        x = np.column_stack([window[role].values for role in roles])
    else:
        x = synchronous_response(window, roles, rotation, run).left
    bins = np.round(spectra.frequency_hz * run.period / window.rate_hz).astype(int)
    found = np.fft.rfft(x[run.period :].reshape(size, run.period, -1), axis=1)[:, bins] / run.period
    return found[..., :n], found[..., n:]


class _Judge:
    """Tells the sensitivity of the loop from time to time, by the numbers of the filter and the last periods."""

    def __init__(
        self, follower: RotorFilter, estimate: RotorEstimate, rig: Rig, whole: Experiment,
        on_loop: Callable[[float, Mapping[str, Any]], object],
    ) -> None:  # fmt: skip
        self._follower, self._estimate, self._rig, self._on_loop = follower, estimate, rig, on_loop
        self._spectra, self._keep = whole.spectra, whole.spectra.n_periods
        self._last = 0

    def take(self, U: Complex, Y: Complex, at: int) -> None:
        """Take the spectra of the last periods; `at`: the sample after them."""
        s = self._spectra
        self._spectra = replace(s, U=np.concatenate([s.U, U])[-self._keep :], Y=np.concatenate([s.Y, Y])[-self._keep :])
        if at - self._last >= _JUDGED_S * s.rate_hz:
            self(at)

    def __call__(self, at: int) -> None:
        self._last, f = at, self._follower
        names, covariance = f.covariance()
        rotor = f.unknowns.model
        plant = Plant.of(rotor, f.point.theta, self._estimate.delay, self._spectra.rate_hz, names, covariance)
        try:
            loop = ClosedLoop.of(plant, controller_of(plant, self._rig, self._spectra))
            refuse_unstable(loop, self._rig)
        except EstimationError:  # as an estimate, which has then no sensitivity: that of before holds no more
            self._on_loop(f.t0 + at / f.rate_hz, {})
            return
        found = sensitivity_by_axis(loop, measure(loop, None, self._spectra))
        self._on_loop(f.t0 + at / f.rate_hz, plain_json(found))


def _line(follower: RotorFilter, block: Block) -> TrackLine:
    step = follower.take(block)
    return TrackLine(
        t=follower.t0 + block.last / follower.rate_hz, parameters=_values(follower, stale=not step.used),
        error=step.error, state="tracking" if step.settled else "changed",
        events=tuple(_told(e) for e in step.events),
    )  # fmt: skip


def _block(whole: Experiment, U: Complex, Y: Complex, at: int) -> Block:
    """Return spectra of periods (n_periods, n_lines, n) from a sample on as one measurement."""
    experiment = replace(whole, spectra=replace(whole.spectra, U=U, Y=Y))
    return Block(experiment=experiment, first=at, last=at + len(U) * whole.spectra.period)


def _header(
    follower: RotorFilter, bench: Record, excitation: Excitation, size: int, samples: int | None, how: Following,
    said: StartWords,
) -> TrackHeader:  # fmt: skip
    """Return the header of a track; `said`: of the start."""
    start, moved = _values(follower, stale=False), {_shown(n)[0]: x for n, x in said["scale_sd"].items()}
    said = {**said, "scale_sd": {name: x for name, x in moved.items() if name in start}}
    return TrackHeader(
        rate_hz=bench.rate_hz, limit=how.limit, method=f"periods, memory {how.memory}", model="rotor",
        every_s=size * excitation.period / bench.rate_hz, units=_units(follower),
        start=start, record={**origin(bench), "samples": samples}, **said,
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


def given_start(start: object) -> RotorEstimate:
    """Return an estimate of a rotor, read from its file where it is none."""
    from ambid.job.results import load_result

    found = load_result(start) if isinstance(start, (str, Path)) else start
    if not isinstance(found, RotorEstimate):
        raise EstimationError(
            f"the start is no estimate of a rotor. Give {saved('identify')} for a rig with [bearings.X]"
        )
    return found


def _given(start: object, rig: Rig, rate_hz: float, speed: float) -> RotorEstimate:
    """Return a start that was given, or read from its file; refuse that of another machine, rate or speed."""
    start = given_start(start)
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
