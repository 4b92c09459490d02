"""Records of a nonlinear bearing as its predictor sees them, through a rig that says what is known of the magnet; not
the same data or channel twice, the stage off, a held rotor that moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Unpack

import numpy as np

from ambid.bearing.magnet_problem import BearingRecord, touching
from ambid.errors import EstimationError, counted
from ambid.estimation.progress import Tick
from ambid.job.data import Reading, Source, known_rig, load_bench, origin, overlap
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.rig import Rig, RigMagnet
from ambid.settings.caller import setting

_OFF_SD = 1.0  # of the voltage of a stage that is off, V: a diode's, or none
_LINEAR = ("m", "R", "c")  # numbers that stand with the linear model's
_LEAST = 100  # samples
_REVERSED = 0.2  # largest current backwards over that forwards from which two magnets are taken
_SAME = 1e-9  # part of a channel's spread that another one leaves over, at or below which both are the same signal
_ROCKS = 0.25  # spread of a held position over that of the moving ones from which it is told


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TakenRecord:
    """A record that was read for a nonlinear bearing."""

    record: BearingRecord  # what the predictor runs over
    # ``samples``, ``rate_hz``, ``sha256``, ``file``, ``held`` and ``history``, for the estimate
    remembered: Mapping[str, object]
    warnings: tuple[str, ...]  # what was changed in it
    start_s: float  # time of its first sample in s


class BearingWords(Reading, total=False):
    """What a caller says of a nonlinear bearing beside its rig, and how records are read."""

    eddy: bool
    drift: bool


def bearing_rig(rig: Rig | str | Path | None, **words: Unpack[BearingWords]) -> Rig:
    """Return a rig whose `magnet` is known as it says, but for what is given here."""
    bench = known_rig(rig)
    if bench.model != "one-axis":
        raise EstimationError(
            f"the rig's model is {bench.model!r}; a nonlinear bearing needs 'one-axis'. Correct model, or use "
            "another rig"
        )
    magnet = bench.magnet or RigMagnet()
    magnet = replace(
        magnet, eddy=magnet.eddy or words.get("eddy", False), drift=magnet.drift or words.get("drift", False)
    )
    return replace(bench, magnet=magnet)


def numbers_of(rig: Rig) -> dict[str, Parameter]:
    """Return what a rig with a `magnet` knows of a nonlinear bearing: m, R and c, and the magnet's numbers."""
    assert rig.magnet is not None
    return {**{n: rig.parameter(n) for n in _LINEAR}, **{p.name: p for p in rig.magnet.parameters}}


def laws_of(magnet: RigMagnet, records: Sequence[BearingRecord]) -> tuple[list[MagnetLaw], bool]:
    """Return the laws between which the likelihood of moving rotors' `records` decides, and `extend`: whether to try a
    rising leakage, and unequal magnets of a pair.
    """
    kind = magnet.kind
    if kind == "auto" and magnet.gap == "exponential":
        kind = "single"
    if kind == "auto" and records:
        low, high = min(r.kept[:, 1].min() for r in records), max(r.kept[:, 1].max() for r in records)
        kind = "pair" if low < -_REVERSED * high else "single"
    rise, pair = bool(magnet.rise), kind == "pair"
    gaps: tuple[Literal["hyperbolic", "exponential"], ...] = ("hyperbolic", "exponential")
    if magnet.gap or pair:
        gaps = (magnet.gap or "hyperbolic",)
    laws = [
        MagnetLaw(gap=gap, pair=pair, asymmetric=bool(magnet.asymmetric), saturation=magnet.saturation, rise=rise)
        for gap in gaps
    ]
    return laws, magnet.rise is None and magnet.asymmetric is None


def take_record(record: Source, rig: Rig, how: Reading, *, held: bool = False) -> TakenRecord:
    """Read a record as the predictor sees it, by a rig with a `magnet`; all of it where the rotor is `held` at rest."""
    if held:
        rig = replace(rig, record=replace(rig.record, from_s=None, to_s=None))
        how = {**how, "from_s": None, "to_s": None}
    bench = load_bench(record, rig, **how)
    u, name = np.array(bench["voltage"].values), str(bench.provenance.get("file") or "record")
    warnings, off = list[str](), None if rig.magnet is None else rig.magnet.off_below
    if rig.limits is not None:
        low, high = rig.limits.voltage
        beyond = int(np.count_nonzero((u < low) | (u > high)))
        if beyond:
            u = np.clip(u, low, high)
            warnings.append(
                f"{name}: {counted(int(beyond), 'sample')} of the voltage beyond loop.limits.voltage; replaced by "
                "the limit"
            )
    y = np.column_stack([bench["position"].values, bench["current"].values])
    loose = np.zeros(u.size) if off is None else np.where(u <= off, _OFF_SD, 0.0)
    valid = np.ones(y.shape, dtype=np.bool_)
    reading = BearingRecord(name=name, rate_hz=bench.rate_hz, u=u, loose=loose, y=y, valid=valid, held=held)
    _check_moves(reading)
    if rig.limits is not None:
        reading = touching(reading, rig.limits.position)
        warnings += _stops(reading)
    provenance = {**origin(bench), "held": held}
    return TakenRecord(record=reading, remembered=provenance, warnings=tuple(warnings), start_s=bench.start_s)


def _stops(record: BearingRecord) -> list[str]:
    """Say where the rotor touched its stops and where it lay on them; refuse where too little is left."""
    warnings = list[str]()
    if record.knock is not None and record.knock.any():
        warnings.append(
            f"{record.name}: the rotor touches a stop (loop.limits.position) in {np.count_nonzero(record.knock)} "
            "samples; the force there is treated as unknown"
        )
    if record.cut is not None:
        lies, left = float(np.mean(record.cut)), int(np.count_nonzero(~record.cut))
        if max((end - first for first, end in record.parts), default=0) < _LEAST:
            raise EstimationError(
                f"{record.name}: the rotor rests on a stop (loop.limits.position) in {lies:.0%} of the record and "
                f"is nowhere free for {_LEAST} samples. Correct the limits, or record with the rotor levitated"
            )
        warnings.append(
            f"{record.name}: the rotor rests on a stop (loop.limits.position) in {lies:.1%} of the record; that "
            f"part was cut out, and {left} samples in {counted(len(record.parts), 'part')} remain"
        )
    return warnings


def _check_moves(record: BearingRecord) -> None:
    """Refuse what no number can come from."""
    if record.u.size < _LEAST:
        raise EstimationError(
            f"{record.name} has {counted(record.u.size, 'sample')}; a nonlinear bearing needs {_LEAST}. Give a "
            "longer record, or omit it"
        )
    channels = {"voltage": record.u, "current": record.y[:, 1]} | ({} if record.held else {"position": record.y[:, 0]})
    for role, x in channels.items():
        if not np.ptp(x) > 0.0:
            raise EstimationError(
                f"{record.name}: channel {role!r} is constant in the whole record. Check its column and unit, or "
                "omit the record"
            )


def take_all(
    records: Sequence[Source],
    held: Sequence[Source],
    validate: Source | None,
    rig: Rig,
    words: BearingWords,
    say: Tick,
) -> tuple[tuple[TakenRecord, ...], TakenRecord | None]:
    """Read the records of one identification: those to identify from, and the one to validate on."""
    how: Reading = {k: words[k] for k in Reading.__annotations__ if k in words}  # type: ignore[assignment, literal-required]
    if not records:
        raise EstimationError(
            "no record with a moving rotor was given; forces cannot be estimated without one. Give one"
        )
    readings: list[TakenRecord] = []
    for source, is_held in [*((r, False) for r in records), *((r, True) for r in held)]:
        say("read")
        readings.append(take_record(source, rig, how, held=is_held))
    second = None if validate is None else take_record(validate, rig, how)
    rates = {t.record.rate_hz for t in readings if not t.record.held}
    if second is not None and second.record.rate_hz not in rates:  # the predictor could not judge it: say so now
        rates_text = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
        raise EstimationError(
            f"{second.record.name}, for validation, is sampled at {second.record.rate_hz:g} Hz, the records at "
            f"{rates_text}; the rates must agree. Resample it, or omit {setting('validate')}"
        )
    return check_together(readings, second), second


def check_together(readings: Sequence[TakenRecord], second: TakenRecord | None) -> tuple[TakenRecord, ...]:
    """Check what only values show, or `readings` and `second` (to judge on) together; warn of a moving held rotor."""
    for j, one in enumerate(readings):
        _refuse_senseless(one.record)
        for other in readings[:j]:
            if _overlap(one, other):
                raise EstimationError(
                    f"{other.record.name} and {one.record.name} hold the same samples and would count twice. Omit one"
                )
    for one in readings:
        if second is not None and _overlap(one, second):
            raise EstimationError(
                f"{second.record.name}, for validation, holds samples that the estimate is fitted to. Give another "
                f"record, or omit {setting('validate')}"
            )
    moving = max((float(t.record.y[:, 0].std()) for t in readings if not t.record.held), default=0.0)
    return tuple(_warn_moving(t, moving) for t in readings)


def _refuse_senseless(record: BearingRecord) -> None:
    if np.all(record.loose > 0.0):
        raise EstimationError(
            f"{record.name}: every voltage is at or below off_below, where the stage is off, so none would be "
            "known. Correct magnet.off_below of the rig (in V)"
        )
    channels = {"voltage": record.u, "position": record.y[:, 0], "current": record.y[:, 1]}
    if record.held:
        del channels["position"]
    names = list(channels)
    unit = {name: (x - x.mean()) / x.std() for name, x in channels.items()}
    for j, one in enumerate(names):
        for other in names[:j]:
            a, b = unit[one], unit[other]
            if np.std(a - np.sign(a @ b) * b) <= _SAME:
                raise EstimationError(
                    f"{record.name}: {other} and {one} are the same signal up to scale and offset. Correct "
                    f"channels.{other}.column or channels.{one}.column"
                )


def _overlap(a: TakenRecord, b: TakenRecord) -> bool:
    """Whether both come from one file and one stretch of its time."""
    return overlap(*((t.remembered["sha256"], t.start_s, t.record.u.size, t.record.rate_hz) for t in (a, b)))


def _warn_moving(one: TakenRecord, moving: float) -> TakenRecord:
    rocks = float(one.record.y[:, 0].std())
    if not one.record.held or rocks <= _ROCKS * moving:
        return one
    warning = (
        f"{one.record.name}: the rotor is declared held, but its position scatters by {1e6 * rocks:.3g} um, "
        f"{rocks / moving:.0%} of its motion in the other records; R and L are biased if it moved"
    )
    return replace(one, warnings=(*one.warnings, warning))
