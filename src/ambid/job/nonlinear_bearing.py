"""The job of the nonlinear bearing: several records and one rig in, one estimate with curves out.

Read -> estimate -> judge -> NonlinearBearingEstimate. A further record, if any, is only judged on.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ambid.errors import EstimationError
from ambid.job._progress import Tick, silent
from ambid.job.bearing_checks import checked_together
from ambid.job.bearing_estimate import judged
from ambid.job.bearing_records import Magnet, Reading, TakenRecord, bearing_rig, known_numbers, laws_of, taken_record
from ambid.physics.parameters import Parameter
from ambid.record import Record
from ambid.rig import Rig, rig_text

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate


def identify_nonlinear(
    records: Sequence[Record | str | Path],
    rig: Rig | str | Path | None = None,
    *,
    magnet: Magnet | None = None,
    held: Sequence[Record | str | Path] = (),
    parameters: Sequence[Parameter] = (),
    eddy: bool = False,
    drift: bool = False,
    off_below: float | None = None,
    validate: Record | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    tick: Tick | None = None,
) -> NonlinearBearingEstimate:
    """Identify one nonlinear bearing from several records at several operating points at once.

    Prediction error with an extended Kalman predictor, consistent under feedback as far as its linearised noise is.

    `held`: records with the rotor held at rest at different distances: they show the coil; `validate`: a further
    record, of a rotor that moves, to judge the estimate on; `rate_hz`: for files without time; `gaps`: what to do about
    gaps in a file.
    """
    how = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    taken = read_records(
        records, rig, held=held, validate=validate, magnet=magnet, parameters=parameters, eddy=eddy, drift=drift,
        off_below=off_below, how=how, tick=tick,
    )  # fmt: skip
    return identify_taken(taken, tick=tick)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingJob:
    """What was read for one identification."""

    rig: Rig  # with a `magnet` that says all that is known and wished
    taken: tuple[TakenRecord, ...]  # those in which the rotor moves, then those in which it is held
    second: TakenRecord | None  # to judge on
    read_s: float  # time that reading took, in s


def read_records(
    records: Sequence[Record | str | Path],
    rig: Rig | str | Path | None,
    *,
    held: Sequence[Record | str | Path],
    validate: Record | str | Path | None,
    magnet: Magnet | None = None,
    parameters: Sequence[Parameter] = (),
    eddy: bool = False,
    drift: bool = False,
    off_below: float | None = None,
    how: Reading,
    tick: Tick | None = None,
) -> BearingJob:
    """Read all records of one identification.

    `off_below`: in V; `tick`: all as `identify_nonlinear`.
    """
    say, begun = tick or silent, time.perf_counter()
    bench = bearing_rig(rig, magnet=magnet, parameters=parameters, eddy=eddy, drift=drift, off_below=off_below)
    if not records:
        raise EstimationError("no record, or every one holds the rotor; forces want one in which it moves. Give one")
    taken = list[TakenRecord]()
    for source, is_held in [*((r, False) for r in records), *((r, True) for r in held)]:
        say("read")
        taken.append(taken_record(source, bench, how, held=is_held))
    second = None if validate is None else taken_record(validate, bench, how)
    rates = {t.record.rate_hz for t in taken if not t.record.held}
    if second is not None and second.record.rate_hz not in rates:  # the predictor could not judge it: say so now
        known = ", ".join(f"{rate:g} Hz" for rate in sorted(rates))
        raise EstimationError(
            f"{second.record.name}, to judge on, is sampled at {second.record.rate_hz:g} Hz, the records at {known}; "
            "they have to agree. Resample it, or leave --validate out"
        )
    checked = checked_together(taken, second)
    return BearingJob(rig=bench, taken=checked, second=second, read_s=time.perf_counter() - begun)


def identify_taken(job: BearingJob, *, tick: Tick | None = None) -> NonlinearBearingEstimate:
    """Identify from records that were read.

    `tick`: as `identify_nonlinear`.
    """
    from ambid.bearing.magnet.estimate import estimate_bearing
    from ambid.bearing.magnet.uncertainty import uncertainty

    say, begun, bench = tick or silent, time.perf_counter(), job.rig
    assert bench.magnet is not None
    laws, extend = laws_of(bench.magnet, [t.record for t in job.taken if not t.record.held])
    wanted = bench.channel("voltage").delay
    fit = estimate_bearing(
        [t.record for t in job.taken], known_numbers(bench), laws=laws,
        delay=None if wanted == "auto" else float(wanted), extend=extend, eddy=bench.magnet.eddy,
        drift=bench.magnet.drift, tick=say,
    )  # fmt: skip
    if fit.status == "failed":
        raise EstimationError(
            "the search led to numbers without a predictor for these records; no law explains them. Check columns, "
            "signs and units"
        )
    fitted = time.perf_counter()
    say("check")
    estimate = judged(fit, uncertainty(fit), job.taken, delay_given=wanted != "auto")
    laps = {"read": job.read_s, "fit": fitted - begun, "checks": time.perf_counter() - fitted}
    estimate = replace(estimate, timing_s=laps, rig=_remembered(bench))
    return estimate if job.second is None else replace(estimate, validation=_validated(estimate, job.second))


def validate_bearing(
    estimate: NonlinearBearingEstimate,
    record: Record | str | Path,
    rig: Rig | str | Path,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
) -> dict[str, object]:
    """Judge an estimate on a further record, of a rotor that moves.

    `rig`: through which the record is read; `from_s`, `to_s`: part of it, in s; overrides the rig's; `rate_hz`: for a
    file without time. Returns as `ambid.validate.nonlinear_bearing.validation`.
    """
    how = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    return _validated(estimate, taken_record(record, bearing_rig(rig), how))


def _validated(estimate: NonlinearBearingEstimate, second: TakenRecord) -> dict[str, object]:
    from ambid.validate.nonlinear_bearing import validation

    return validation(estimate, second.record)


def _remembered(rig: Rig) -> dict[str, object]:
    """What an estimate keeps of its rig, the wishes of the call included, so that other records are read alike."""
    folder = Path.cwd() if rig.source is None else rig.source.resolve().parent
    return {"name": rig.name, "text": rig_text(rig, folder), "folder": str(folder)}
