"""The on-line job: a record, or a running device, through the supervised tracker of a bench's physical parameters.

Read -> start (an estimate, or one identified from the beginning of the record) -> track block by block -> lines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ambid.blackbox.data import Orders
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Names, Reading, RigSource, Source, known_rig
from ambid.job.following import (
    EstimatorWords,
    Followed,
    Following,
    FollowingWords,
    Memory,
    OnLine,
    Pace,
    check_settings,
)
from ambid.job.track_start import BenchRows, Start, check_settling, credible_limits, rows_of, start_of
from ambid.physics.linear_model import model
from ambid.recursive.lines import Track, TrackHeader, TrackLine
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import refuse_given
from ambid.settings.calls import of_job
from ambid.tracking.blocks import Block, Frame, Stretch
from ambid.tracking.engine import run
from ambid.tracking.evidence import Samples
from ambid.tracking.gate import Flag
from ambid.tracking.guard import ABSURD, StreamGuard
from ambid.tracking.lines_file import Tally
from ambid.tracking.numbers import Forcing
from ambid.tracking.reporter import Reporter, header
from ambid.tracking.rpem import PhysicalRpem
from ambid.tracking.supervisor import Supervisor, warm_up


@of_job("track")
def track(
    record: Source,
    rig: RigSource | None = None,
    *,
    method: str = "rpem",
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    orders: Orders | str | None = None,
    open_loop: bool = False,
    step: float | None = None,
    start: Estimate | RotorEstimate | str | Path | float | None = None,
    every_s: float = 0.01,
    limit: float = 1.5,
    memory: Memory = "auto",
    pace: Pace = "fastest",
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    on_header: Callable[[TrackHeader], None] | None = None,
    on_line: OnLine | None = None,
    keep: bool = True,
    tick: Tick | None = None,
) -> Track:
    """Track the physical parameters of a bench through a record, or the coefficients of another `method`.

    Of a rotor on many axes (a rig with ``[bearings.X]``) force factors, stiffnesses, resistances and modes are tracked
    from one period of the excitation to the next; `every_s` is then rounded to whole periods.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
        Rows may be missing or damaged.
    rig : Rig, path, dict or TOML text, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    method : str, optional
        ``rpem``, the supervised tracker, or one of `ambid.job.track_estimator.METHODS`.
    input, output : str or sequence of str, optional
        Names of channels, for methods that follow coefficients.
    orders : str or Mapping[str, int], optional
        Of those coefficients, as `ambid.fit`.
    open_loop : bool, optional
        Declare the record open loop.
    step : float, optional
        Step size of ``lms`` and ``nlms``, for signals of size one.
    start : Estimate, RotorEstimate, str, Path or float, optional
        Where tracking begins: an estimate, or an identification of so many seconds of the record's first part.
    every_s : float, optional
        Reporting interval, s of record.
    limit : float, optional
        Acceptable model error, in multiples of that at identification.
    memory : float, "auto" or "all", optional
        Memory of the estimator: a time constant in s, found from the data ("auto"), or infinite ("all").
    pace : {"fastest", "real-time"}, optional
        Replay as fast as possible, or as the record was taken.
    from_s, to_s, rate_hz, units, layout : optional
        As `ambid.identify`.
    on_header, on_line : callable, optional
        Called once before the first line, and with each line; flags of an operator that `on_line` returns are set:
        "track", "hold", "accept", "revert".
    keep : bool, optional
        Keep all lines for the result; without, the last one only, and memory stays constant.
    tick : callable, optional

    Returns
    -------
    Track

    Raises
    ------
    AmbidError
        If record or rig break a rule.
    EstimationError
        If start or settings make no sense, or nothing can be identified to start from.
    """
    following = FollowingWords(
        every_s=every_s, limit=limit, memory=memory, pace=pace, on_header=on_header, on_line=on_line,
        keep=keep,
    )  # fmt: skip
    check_settings({**following, "start": start, "from_s": from_s, "to_s": to_s, "rate_hz": rate_hz})
    say, how, settings = tick or silent, Following(**following), EstimatorWords(
        input=input, output=output, orders=orders, open_loop=open_loop, step=step,
    )  # fmt: skip
    bench = None if rig is None else known_rig(rig)
    part = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, units=units, layout=layout)
    if bench is not None and bench.rotor is not None:
        from ambid.job.track_rotor import track_rotor

        refuse_given(
            {
                "method": method != "rpem" and method,
                "pace": how.pace != "fastest" and how.pace,
            },
            "{} is for one axis; a rotor is tracked from one period to the next. Omit it",
        )
        return replace(track_rotor(record, bench, start, part, how, say), used=Followed(record=record))
    if isinstance(start, RotorEstimate):
        raise EstimationError("the start is the estimate of a rotor; the rig has no [bearings.X]. Give the rotor's rig")
    if method != "rpem" or any(settings.values()):
        from ambid.job.track_estimator import track_estimator

        if how.pace != "fastest":
            raise EstimationError(f"method {method} has no supervisor: it takes no pace. Omit it")
        result = track_estimator(record, bench, method, start, part, how, settings)
        return replace(result, used=Followed(record=record, rate_hz=rate_hz))
    source = rows_of(record, bench, **part)
    say("start")
    begin = start_of(source, known_rig(bench), start=start, rig_speaks=bench is not None)
    say("track")
    result = follow(source.replay.since(begin.first), source, begin, how)
    return replace(result, used=Followed(record=record, rate_hz=rate_hz))


def follow(
    blocks: Iterable[Block | Frame], source: BenchRows, begin: Start, how: Following, *, live: bool = False
) -> Track:
    """Follow a bench's parameters through SI blocks from ``begin.first`` on, replayed or live: guard, supervisor and
    reporter; `live`: without a known end.
    """
    numbers, first, forcing = begin.numbers, begin.first, source.forcing
    rpem = PhysicalRpem(numbers, memory=how.memory)
    check_settling(rpem, float("inf") if live else source.duration_s, first)
    supervisor = Supervisor(rpem, limit=how.limit, t0=source.t0, listener=lambda event: reporter.note(event))
    warm_up(numbers, how.memory)
    lines: list[TrackLine] = []
    take = how.collect(lines)

    def counted(line: TrackLine) -> Sequence[Flag] | None:
        tally.add(line)
        return take(line)

    reporter = Reporter(
        supervisor, every_s=how.every_s, on_line=counted, t0=source.t0, first=first,
    )  # fmt: skip
    samples = None if live else int(np.count_nonzero(source.replay.numbers >= first))
    top = header(
        supervisor, limit=how.limit, every_s=reporter.every_s, method=f"rpem, memory {how.memory}",
        record={**source.origin, "samples": samples}, said=begin.said,
    )  # fmt: skip
    tally = Tally(top)
    if how.on_header is not None:
        how.on_header(top)
    n_u = len(model(begin.estimate.model).inputs)
    with one_thread():
        report = run(
            blocks,
            lambda stretch: reporter.consume(_samples(stretch, n_u, forcing), stretch.first, restart=stretch.restart),
            reporter.reject,
            guard=_guard(source, begin.estimate), pace=how.pace,
        )  # fmt: skip
    reporter.finish()
    summary = reporter.summary(computing_s=report.working_s, latency=report.latency, complete=not report.interrupted)
    summary = replace(summary, unanswered=tally.open_changes, recurring=tally.recurring)
    return Track(header=top, lines=tuple(lines), totals=summary)


def _guard(source: BenchRows, estimate: Estimate) -> StreamGuard:
    """A guard that watches outputs for freezing, but no input and no forcing: these may rest."""
    plant, n_f = model(estimate.model), 0 if source.forcing is None else 2
    n_u, n_y = len(plant.inputs), len(plant.outputs)
    return StreamGuard(
        source.replay.rate_hz,
        n_u + n_y + n_f,
        limits=credible_limits(source, estimate) + [ABSURD] * n_f,
        watched=[False] * n_u + [True] * n_y + [False] * n_f,
    )


def _samples(stretch: Stretch, n_u: int, forcing: Forcing | None) -> Samples:
    """Take the columns of a stretch apart."""
    n = stretch.values.shape[1] - (0 if forcing is None else 2)
    u, y, extra = np.split(stretch.values, [n_u, n], axis=1)
    return Samples(
        u=np.ascontiguousarray(u),
        y=np.ascontiguousarray(y),
        forcing=None if forcing is None else np.ascontiguousarray(extra),
    )
