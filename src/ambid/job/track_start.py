"""Where tracking begins: the rows of a record, damage and all, and an estimate, given or identified from the first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Unpack

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, RecordError, counted
from ambid.estimation.estimate import Estimate
from ambid.job.data import Reading, began, known_rig, load_bench
from ambid.job.identification import identify_axis
from ambid.job.results import load_result
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.record import Channel, Record, Source, read_rows
from ambid.recursive.lines import StartWords
from ambid.report.parameters import calibration_lines
from ambid.rig import Rig, bench_record
from ambid.rig.rig import OPTIONAL_ROLES, RigChannel
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import command, saved, setting
from ambid.tracking.blocks import Replay, blocks_of
from ambid.tracking.guard import ABSURD
from ambid.tracking.numbers import Forcing, TrackedNumbers, forcing_of, left_out, tracked_numbers
from ambid.tracking.rpem import PhysicalRpem

_START_S, _START_SAMPLES = 1.0, 10_000  # at least, where the record has three times as much
_SETTLED_S, _SETTLED_PART = 5.0, 1 / 3  # longest time, and part of the record, until a predictor has settled
_CREDIBLE, _SPREADS = 1e3, 4.0  # times an output's range at identification; standard deviations in that range
_INPUT_CREDIBLE, _MOST_OF = 1e6, 0.99  # times what most of an input stays under
_LEAST = 1e-9  # part of an output that is not predicted
_SAME = 1e-6  # relative difference of values that were written and read
_FAR = 4.0  # standard deviations between a prior and a start that contradicts it
_BLOCK_S = 0.01  # of the stream
_ROWS = (".csv", ".csv.gz", ".h5", ".hdf5")  # formats whose rows are read with their damage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BenchRows:
    """Rows of a bench's record."""

    record: Record  # channels named by role; may hold NaN
    replay: Replay  # inputs, outputs and forcing as a stream of blocks
    forcing: Forcing | None  # where the angle of the rotor is known
    t0: float  # time of sample number 0, s of record

    @property
    def duration_s(self) -> float:
        """From the first number to the last, s."""
        return (float(self.replay.numbers.max()) + 1.0) / self.replay.rate_hz

    @property
    def origin(self) -> dict[str, object]:
        """Where the record came from."""
        provenance = self.record.provenance
        return {"file": provenance.get("file"), "sha256": provenance.get("sha256"), **began(self.record)}

    def clean_part(self, n: int, *, begin_anywhere: bool) -> tuple[Record, int]:
        """Return the first clean stretch of `n` samples, and the next number; `begin_anywhere`: later or shorter for a
        damaged beginning.
        """
        numbers = self.replay.numbers
        sound = np.asarray(np.isfinite(self.replay.values).all(axis=1))
        if not sound.any():
            raise RecordError(
                "no row of the record has finite values in every tracked channel; tracking must start from a clean "
                "part. Check the columns, or give an estimate"
            )
        joined = np.concatenate([[False], sound[1:] & sound[:-1] & (np.diff(numbers) == 1)])
        begins = np.flatnonzero(sound & ~joined)
        ends = np.append(begins[1:], numbers.size)
        lengths = np.array([int(sound[b:e].sum()) for b, e in zip(begins, ends, strict=True)], dtype=np.int64)
        fits = np.flatnonzero(lengths >= n)
        if fits.size and (begin_anywhere or begins[fits[0]] == 0):
            at, length = int(begins[fits[0]]), n
        elif begin_anywhere and lengths.size:
            best = int(np.argmax(lengths))
            at, length = int(begins[best]), int(lengths[best])
        else:
            raise RecordError(
                f"the first {n / self.replay.rate_hz:g} s of the record are damaged; tracking must start from a "
                "clean part. Give a shorter start, or an estimate"
            )
        channels = tuple(replace(c, values=c.values[at : at + length].copy()) for c in self.record.channels)
        part = replace(self.record, channels=channels, start_s=self.t0 + float(numbers[at]) / self.replay.rate_hz)
        return part, int(numbers[at]) + length


def rows_of(record: Source, stated: Rig | None, **reading: Unpack[Reading]) -> BenchRows:
    """Read the rows of a table, file or record through a rig, else by roles, also of a turning rotor."""
    rig, rate_hz = known_rig(stated), reading.get("rate_hz")
    if isinstance(record, Record) or (isinstance(record, (str, Path)) and not str(record).lower().endswith(_ROWS)):
        bench, stamps = load_bench(record, rig, **reading), None
    else:
        rate = rate_hz if rate_hz is not None else rig.record.rate_hz
        layout = {**rig.record.layout, **(reading.get("layout") or {})}
        rows = read_rows(record, rate_hz=rate, units=reading.get("units"), layout=layout)
        from_s, to_s = reading.get("from_s"), reading.get("to_s")
        bench, stamps = _part(
            bench_record(rows.record, _with_rotation(rig, rows.record) if stated is None else rig),
            rows.time_s,
            rig.record.from_s if from_s is None else from_s, rig.record.to_s if to_s is None else to_s,
        )  # fmt: skip
    plant = model(rig.model)
    forcing = forcing_of(bench) if "force" in plant.disturbances else None
    stream = _stream(bench, plant, forcing)
    replay = blocks_of(stream, max(1, round(_BLOCK_S * bench.rate_hz)), time_s=stamps)
    t0 = bench.start_s if stamps is None else float(stamps[np.isfinite(stamps)][0])
    return BenchRows(record=bench, replay=replay, forcing=forcing, t0=t0)


def _with_rotation(rig: Rig, record: Record) -> Rig:
    """Columns named speed and angle, in these units, are what they say."""
    turning = tuple(
        RigChannel(role=role, column=role)
        for role in ("speed", "angle")
        if role in record.names and record.channel(role).unit == OPTIONAL_ROLES[role]
    )
    return replace(rig, channels=(*rig.channels, *turning))


def _part(bench: Record, time_s: Array | None, from_s: float | None, to_s: float | None) -> tuple[Record, Array | None]:
    """Keep the rows stamped from_s <= t < to_s; rows without a stamp stay with the row before them."""
    if from_s is None and to_s is None:
        return bench, time_s
    stamps = bench.time_s if time_s is None else time_s
    stamped = np.flatnonzero(np.isfinite(stamps))
    last = stamped[np.maximum(np.searchsorted(stamped, np.arange(stamps.size), side="right") - 1, 0)]
    t = stamps[last]
    inside = (t >= (-np.inf if from_s is None else from_s)) & (t < (np.inf if to_s is None else to_s))
    if not inside.any():
        raise RecordError(
            f"the record spans {np.nanmin(stamps):g} to {np.nanmax(stamps):g} s and has nothing between "
            f"{from_s if from_s is not None else 'its start'} and {to_s if to_s is not None else 'its end'} s. "
            "Give times inside it"
        )
    channels = tuple(replace(c, values=c.values[inside]) for c in bench.channels)
    first = float(t[inside][0])
    return replace(bench, channels=channels, start_s=first), None if time_s is None else time_s[inside]


def _stream(bench: Record, plant: LinearModel, forcing: Forcing | None) -> Record:
    """The channels that the tracker takes, forcing last."""
    channels = [bench.channel(role) for role in (*plant.inputs, *plant.outputs)]
    if forcing is not None:
        names = ("forcing_cos", "forcing_sin")
        channels += [Channel(name=n, unit="1", values=c) for n, c in zip(names, forcing.columns.T, strict=True)]
    return replace(bench, channels=tuple(channels))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """Where tracking begins."""

    estimate: Estimate
    numbers: TrackedNumbers
    first: int  # number of the first sample that is tracked
    said: StartWords  # of the estimate


def start_of(
    source: BenchRows,
    rig: Rig,
    *,
    start: Estimate | str | Path | float | None,
    rig_speaks: bool,
) -> Start:
    """Take the estimate or file to begin with, or identify the first part of the record, of so many seconds."""
    warnings: list[str] = []
    if start is None or isinstance(start, (int, float)):
        estimate, first = _identify_beginning(source, rig, start)
        numbers = _numbers(estimate, source)
    else:
        estimate, first = start if isinstance(start, Estimate) else read_start(start), 0
        try:
            _check_fit(estimate, source, rig)
            if rig_speaks:
                warnings += _contradictions(estimate, rig)
            numbers = _numbers(estimate, source)
        except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
            raise EstimationError(
                f"the start estimate is incomplete ({type(error).__name__}: {error}). Write it again with "
                f"'{command('identify', json=True)}'"
            ) from error
    said = words_of_start(estimate, rig, [*warnings, *estimate.warnings], numbers.warnings)
    return Start(estimate=estimate, numbers=numbers, first=first, said=said)


def words_of_start(
    estimate: Estimate | RotorEstimate, rig: Rig, first: Sequence[str] = (), last: Sequence[str] = ()
) -> StartWords:
    """Return what a track says of its start: what stands against it, which a track inherits, with warnings `first` and
    `last`, and what calibration does to it.
    """
    grave = {r.text: None for r in estimate.reasons if r.grave}
    warnings = dict.fromkeys([*first, *(r.text for r in estimate.reasons), *last])
    lacking = left_out(estimate) if isinstance(estimate, Estimate) else ()
    if lacking:
        text = f"the start's model was extended by {', '.join(lacking)}, which tracking leaves out: intervals are as"
        warnings[f"{text} wide as that may move the values. Remove the cause, or identify part by part"] = None
    stated = {**{c.role: c.gain_sd for c in rig.channels}, "rate": rig.record.rate_sd}
    known = {**estimate.calibration_sd, **{source: sd for source, sd in stated.items() if sd is not None}}
    scale_sd = dict[str, float]()
    for source, moves in estimate.calibration.items():
        for name, x in moves.items() if source in known else ():
            scale_sd[name] = math.hypot(scale_sd.get(name, 0.0), x * known[source])
    return {
        "warnings": tuple(text for text in warnings if text not in grave),
        "grave": tuple(f"the start is unusable: {text}" for text in grave),
        "notes": tuple(calibration_lines(replace(estimate, calibration_sd=known))),
        "scale_sd": scale_sd,
    }


def check_settling(rpem: PhysicalRpem, duration_s: float, first: int) -> None:
    """Refuse a start whose predictor would never say anything of a record of `duration_s` (infinite for a live stream),
    tracked from number `first` on.
    """
    rate = rpem.numbers.rate_hz
    settling_s, left_s = rpem.stream.settling_samples / rate, duration_s - first / rate
    most_s = min(_SETTLED_S, _SETTLED_PART * duration_s)
    if settling_s > most_s:
        raise EstimationError(
            f"the predictor of the start needs {settling_s:.3g} s to settle, of {left_s:.3g} s to track; the limit "
            f"is {most_s:.3g} s. Check the values of the start, or use a longer record"
        )


def credible_limits(source: BenchRows, estimate: Estimate) -> list[float]:
    """Say for each input, then output, from which magnitude, SI, on a value is no measurement: outputs by their spread
    at identification, inputs, without one in an estimate, by the record.
    """
    plant, point = model(estimate.model), estimate.operating_point
    limits = []
    for role in plant.inputs:
        magnitude = np.abs(source.record[role].values)
        magnitude = magnitude[np.isfinite(magnitude)]
        size = float(np.quantile(magnitude, _MOST_OF)) if magnitude.size else 0.0
        limits.append(_INPUT_CREDIBLE * max(size, abs(point[role])) or ABSURD)
    for role in plant.outputs:
        fit = estimate.fit[role]
        spread = fit.innovation_sd / max(1.0 - fit.one_step, _LEAST)
        limits.append(_CREDIBLE * (abs(point[role]) + _SPREADS * spread))
    return [min(x, ABSURD) if math.isfinite(x) and x > 0.0 else ABSURD for x in limits]


def _numbers(estimate: Estimate, source: BenchRows) -> TrackedNumbers:
    forcing = source.forcing
    return tracked_numbers(
        estimate, synchronous=forcing is not None, top_speed=1.0 if forcing is None else forcing.top_speed
    )


def _identify_beginning(source: BenchRows, rig: Rig, seconds: float | None) -> tuple[Estimate, int]:
    length, rate = source.duration_s, source.replay.rate_hz
    wanted = min(max(_START_S, _START_SAMPLES / rate), length / 3) if seconds is None else seconds
    n = round(wanted * rate)
    if not 0 < n < length * rate:
        raise EstimationError(
            f"a start of {wanted:g} s leaves nothing of the {length:g} s to track. Give a shorter one, or an estimate"
        )
    part, first = source.clean_part(n, begin_anywhere=seconds is None)
    return identify_axis(part, rig), first


def read_start(path: object) -> Estimate:
    """Read the estimate from which tracking of one axis begins."""
    if not isinstance(path, (str, Path)):
        raise EstimationError(
            f"start is a {type(path).__name__}; it must be an Estimate, the path of one, or seconds. Give one"
        )
    found = load_result(path)
    if isinstance(found, Estimate):
        return found
    raise EstimationError(
        f"{path} holds a black-box fit or a nonlinear estimate; tracking starts from linear physical parameters."
        f" Give {saved('identify')} without {setting('identify_nonlinear')}"
    )


def _check_fit(estimate: Estimate, source: BenchRows, rig: Rig) -> None:
    """Refuse an estimate of another model or rate, or one without an operating point."""
    estimate_rate, rate = float(str(estimate.record["rate_hz"])), source.replay.rate_hz
    if estimate.model != rig.model or abs(estimate_rate / rate - 1.0) > 1e-6:
        raise EstimationError(
            f"the start estimate is of model {estimate.model!r} at {estimate_rate:g} Hz, the record of {rig.model!r} "
            f"at {rate:g} Hz; they must agree. Identify a start from this bench at this rate"
        )
    plant, point = model(estimate.model), estimate.operating_point
    for role in (*plant.inputs, *plant.outputs):
        x = point.get(role) if isinstance(point, Mapping) else None
        if isinstance(x, bool) or not isinstance(x, (int, float)) or not math.isfinite(x):
            raise EstimationError(
                f"the start estimate's operating_point.{role} is {x!r}; it must be a number. Write the estimate again"
                f" with '{command('identify', json=True)}'"
            )


def _contradictions(estimate: Estimate, rig: Rig) -> list[str]:
    """Refuse a rig that contradicts the estimate; warn where what it says is not used."""
    warnings = [said for p in rig.parameters if (said := _parameter(p, estimate))]
    for role in model(rig.model).inputs:
        wanted, delay = rig.channel(role).delay, estimate.delay[role]
        if wanted != "auto" and abs(delay.samples + delay.fraction - wanted) > _SAME:
            raise EstimationError(
                f"the rig gives channels.{role}.delay = {wanted}, the start estimate has "
                f"{counted(delay.samples + delay.fraction, 'sample')}; tracking uses the latter. Identify a start "
                "with this rig, or omit the delay there"
            )
        if wanted == "auto" and delay.how == "given":
            warnings.append(
                f"the start estimate was made with a given delay of {role}, {counted(delay.samples, 'sample')}; "
                "the rig leaves it open, and tracking keeps it. Identify a start with this rig"
            )
    return warnings


def _parameter(p: Parameter, estimate: Estimate) -> str | None:
    """What a rig says of one parameter beside what the estimate knows: refused, warned of, or no contradiction."""
    e = estimate.parameter(p.name)
    remedy = "Identify a start with this rig, or make both agree"
    if p.role == "fixed" and p.value is not None:
        if e.role != "fixed" or not np.isclose(e.value, p.value, rtol=_SAME, atol=0.0):
            raise EstimationError(
                f"the rig fixes {p.name} at {p.value:g} {p.unit}, the start estimate has it {e.role} at "
                f"{e.value:.6g} {e.unit}; tracking would use the latter. {remedy}"
            )
        return None
    if e.role == "fixed":
        return (
            f"the start estimate holds {p.name} fixed at {e.value:g} {e.unit}, the rig has it {p.role}: it is not"
            f" tracked. {remedy}"
        )
    if p.role == "prior" and p.value is not None and p.sd is not None:
        apart = abs(e.value - p.value) / math.hypot(p.sd, e.sd)
        if apart > _FAR:
            raise EstimationError(
                f"the rig's prior of {p.name} is {p.value:g} ± {p.sd:g} {p.unit}, the start estimate has "
                f"{e.value:.6g} ± {e.sd:.2g}: {apart:.3g} standard deviations apart (limit {_FAR:g}). {remedy}"
            )
    if p.role != e.role:
        return f"the rig has {p.name} {p.role}, the start estimate {e.role}: tracking uses the latter. {remedy}"
    return None
