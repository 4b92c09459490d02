"""``ambid track``: on-line identification, a record replayed through the supervised tracker."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.interrupts import INTERRUPTED
from ambid.cli.keeping import Bearing, LedgerPlace, TakenAt, keeping
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs, json_path
from ambid.errors import AmbidError, nearest

if TYPE_CHECKING:
    from ambid.cli.live import Flag
    from ambid.recursive.lines import TrackHeader


def command(
    record: opt.RecordFile,
    rig: opt.RigFile = None,
    method: Annotated[
        str,
        option(
            "--method NAME",
            "rpem, the supervised tracker; ekf or ukf without supervisor; or coefficients from --input to --output "
            "by rls, lms, nlms, iv, or a recursive arx, armax, oe, bj, ...",
            True,
        ),
    ] = "rpem",
    inputs: opt.Inputs = None,
    output: opt.OutputColumns = None,
    orders: Annotated[str | None, option("--orders na=2,nb=2,nk=1", "Orders of the tracked coefficients.")] = None,
    reference: opt.References = None,
    open_loop: opt.OpenLoop = False,
    step: Annotated[float | None, option("--step X", "Step size of lms and nlms, for signals of size one.")] = None,
    start: Annotated[
        Path | None,
        option(
            "--start ESTIMATE.json",
            "Start from this estimate instead of one from the beginning of the record.",
        ),
    ] = None,
    start_seconds: Annotated[
        float | None, option("--start-seconds S", "Identify the start from this much of the record.")
    ] = None,
    every: Annotated[float, option("--every S", "Reporting interval, in s of record.", True)] = 0.01,
    limit: Annotated[
        float, option("--limit X", "Acceptable model error, relative to that at identification.", True)
    ] = 1.5,
    memory: Annotated[
        str,
        option(
            "--memory auto|all|S",
            "Memory of the estimator: found from the data, infinite, or a time constant in s.",
            True,
        ),
    ] = "auto",
    pace: Annotated[
        Literal["fastest", "real-time"], switch("--pace", "Replay as fast as possible, or in real time.")
    ] = "fastest",
    flag: Annotated[
        list[str] | None,
        option("--flag T:hold", "Set a flag at a time of the record: track, hold, accept or revert; repeatable."),
    ] = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    layout: opt.Layout = None,
    json: opt.TrackFile = None,
    plot: Annotated[
        Path | None,
        option("--plot FILE.png", "Draw the tracks, with the truth if the record has columns true_NAME."),
    ] = None,
    report: opt.Report = None,
    ledger: LedgerPlace = None,
    bearing: Bearing = None,
    taken_at: TakenAt = None,
    quiet: Annotated[bool, switch("--no-live --quiet", "No live view, even on a terminal.")] = False,
    strict: opt.Strict = False,
) -> None:
    """Track the physical parameters of a bench through a record, as beside a running machine.

    On a terminal a live view shows parameters, error, state and decisions; h, t, a and r set flags, q ends.
    """
    from ambid.cli.live import Follower
    from ambid.job.following import check_settings
    from ambid.job.tracking import track
    from ambid.rig import load_rig

    times = _flags(flag)
    how: dict[str, Any] = {
        "start": start, "start_s": start_seconds, "every_s": every, "limit": limit, "memory": _memory(memory),
        "pace": pace, "flags": times, "rate_hz": rate,
    }  # fmt: skip
    check_settings(how)
    settings: dict[str, Any] = {
        "input": inputs, "output": output, "reference": reference, "orders": orders, "open_loop": open_loop,
        "step": step,
    }  # fmt: skip
    given = {name: value for name, value in settings.items() if value}
    if method == "rpem" and given:
        raise AmbidError(f"{', '.join(given)}: not for the supervised tracker. Name another --method, or omit it")
    told: dict[str, Any] = {"layout": opt.layout_of(layout)} if layout else {}
    asked = {**how, **given, **told, "method": method, "from_s": from_s, "to_s": to_s}
    with keeping(ledger, [record], rig, bearing=bearing, taken_at=taken_at, job="track", **asked) as store:
        with Outputs(record, rig, start, plot=plot, report=report) as outputs:
            outputs.claim(json_path(json), "json")
            bench = None if rig is None else load_rig(rig)
            follower = Follower(
                json, keep=plot is not None or report is not None, quiet=quiet, real_time=pace == "real-time"
            )
            follower.record, follower.rate_hz = record, rate

            def begin(header: TrackHeader) -> None:
                _check_interval(every, header.rate_hz)
                follower.on_header(header)

            follower.run(
                lambda: track(
                    record,
                    bench,
                    method=method,
                    from_s=from_s,
                    to_s=to_s,
                    on_header=begin,
                    on_line=follower.on_line,
                    keep=False,
                    tick=follower.tick,
                    **how,
                    **given,
                    **told,
                )
            )
            if follower.track is not None:
                try:
                    outputs.give(follower.track)
                except KeyboardInterrupt:
                    kept = f"; {follower.path} holds the track" if follower.path else ""
                    print(f"ambid: interrupted while drawing{kept}", file=sys.stderr)
                    raise typer.Exit(INTERRUPTED) from None
        follower.finish(outputs, drawn=plot, strict=strict, flags=times, store=store)


def _check_interval(every: float, rate_hz: float) -> None:
    """Refuse an interval that holds no sample, now that the rate is known."""
    if every * rate_hz < 1.0 - 1e-9:
        raise AmbidError(
            f"--every {every:g} s is shorter than one sample at {rate_hz:g} Hz. Give {1.0 / rate_hz:g} or more"
        )


def _memory(text: str) -> Any:
    """Read ``--memory``: a time in s, or a word, which is judged later."""
    try:
        return float(text)
    except ValueError:
        return text


def _flags(texts: list[str] | None) -> tuple[tuple[float, Flag], ...]:
    """Read ``--flag``, each a time in s, a colon and a flag, in the order of their times."""
    from ambid.job.following import FLAGS

    found: list[tuple[float, Flag]] = []
    for text in texts or []:
        time, colon, name = text.partition(":")
        flag = next((f for f in FLAGS if f == name), None)
        if colon and flag is None:
            raise AmbidError(
                f"--flag {text}: flag {name!r} is unknown; known: {', '.join(FLAGS)}{nearest(name, FLAGS)}"
            )
        try:
            t = float(time)
        except ValueError:
            t = math.nan
        if flag is None or not math.isfinite(t):
            raise AmbidError(f"--flag {text} is not of the form T:FLAG, such as 12.5:hold. Correct it")
        found.append((t, flag))
    return tuple(sorted(found, key=lambda f: f[0]))
