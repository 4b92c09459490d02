"""``ambid track``: on-line identification, a record replayed through the supervised tracker."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli import options as opt
from ambid.cli.interrupts import INTERRUPTED
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs
from ambid.errors import AmbidError, nearest

if TYPE_CHECKING:
    from ambid.cli.live import Flag, Follower
    from ambid.recursive.lines import TrackHeader

_NAMES = {
    "every_s": "--every", "limit": "--limit", "memory": "--memory", "start": "--start", "start_s": "--start-seconds"
}  # fmt: skip


def command(
    record: opt.RecordFile,
    rig: opt.RigFile = None,
    method: Annotated[
        str,
        option(
            "--method NAME",
            "rpem, the supervised tracker; ekf or ukf without supervisor; or coefficients from --input to"
            " --output: rls, lms, nlms, iv, or a recursive arx, armax, oe, bj, ...",
            True,
        ),
    ] = "rpem",
    inputs: opt.Inputs = None,
    output: opt.OutputColumns = None,
    orders: Annotated[str | None, option("--orders na=2,nb=2,nk=1", "Orders of coefficients.")] = None,
    reference: opt.References = None,
    open_loop: opt.OpenLoop = False,
    step: Annotated[float | None, option("--step X", "Step of lms and nlms, for signals of size one.")] = None,
    start: Annotated[
        Path | None,
        option(
            "--start ESTIMATE.json",
            "Begin with this estimate; by default one is identified from the beginning of the record.",
        ),
    ] = None,
    start_seconds: Annotated[
        float | None, option("--start-seconds S", "Identify the start from that much of the record.")
    ] = None,
    every: Annotated[float, option("--every S", "Reporting interval, s of record.", True)] = 0.01,
    limit: Annotated[float, option("--limit X", "Acceptable model error; 1 is that at identification.", True)] = 1.5,
    memory: Annotated[
        str,
        option(
            "--memory auto|all|S", "How long data count: found from the data, for ever, or a time constant in s.", True
        ),
    ] = "auto",
    pace: Annotated[
        Literal["fastest", "real-time"], switch("--pace", "Replay as fast as possible, or as it was taken.")
    ] = "fastest",
    flag: Annotated[
        list[str] | None,
        option("--flag T:hold", "Set a flag at a time of the record: track, hold, accept or revert; repeat."),
    ] = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    json: opt.TrackFile = None,
    plot: Annotated[
        Path | None,
        option("--plot FILE.png", "Draw the tracks, beside the truth where the record has columns true_NAME."),
    ] = None,
    quiet: Annotated[bool, switch("--no-live --quiet", "No live view, also on a terminal.")] = False,
    strict: Annotated[
        bool,
        switch("--strict", "End with exit code 3 if a change stays unanswered, or the end is frozen or off the limit."),
    ] = False,
) -> None:
    """Follow the physical parameters of a bench through a record, as the tracker does beside a running machine.

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
    check_settings(how, _NAMES)
    settings: dict[str, Any] = {
        "input": inputs, "output": output, "reference": reference, "orders": orders, "open_loop": open_loop,
        "step": step,
    }  # fmt: skip
    given = {name: value for name, value in settings.items() if value}
    if method == "rpem" and given:
        raise AmbidError(f"{', '.join(given)}: not for the supervised tracker. Name another --method, or leave it out")
    with Outputs(record, rig, start, json=json, plot=plot) as outputs:
        bench = None if rig is None else load_rig(rig)
        follower = Follower(json, keep=plot is not None, quiet=quiet, real_time=pace == "real-time")

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
            )
        )
        if follower.summary is not None:
            try:
                outputs.draw(plot, lambda: _figure(follower, record, rate), str)
            except KeyboardInterrupt:
                kept = f"; {follower.path} holds the track" if follower.path else ""
                print(f"ambid: interrupted while drawing{kept}", file=sys.stderr)
                raise typer.Exit(INTERRUPTED) from None
    follower.finish(drawn=plot, strict=strict, flags=times)


def _check_interval(every: float, rate_hz: float) -> None:
    """Refuse an interval that holds no sample, now that the rate is known."""
    if every * rate_hz < 1.0 - 1e-9:
        raise AmbidError(
            f"--every {every:g} s is less than one sample at {rate_hz:g} Hz; a line needs a sample."
            f" Give {1.0 / rate_hz:g} or more"
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


def _figure(follower: Follower, record: Path, rate: float | None) -> Any:
    from ambid.report.track_figures import track_figure

    assert follower.header is not None
    assert follower.history is not None
    units = follower.header.units
    truth = truth_columns(record, rate, {name: units.get(name, "") for name in follower.history.names})
    return track_figure(follower.history, truth=truth)


def truth_columns(record: Path, rate: float | None, units: Mapping[str, str]) -> dict[str, tuple[Any, Any]]:
    """Read the truth that a simulated record holds: columns ``true_NAME``.

    `rate`: sampling rate in Hz, for a record without time; `units`: SI unit of each tracked number; empty where it is
    not known. Returns ndarrays of shape (n_samples,), s of record and SI; without parameters that have no such column,
    or one in another unit.
    """
    from ambid.record import read_record

    if not _may_hold_truth(record):
        return {}
    try:
        raw = read_record(record, rate_hz=rate, gaps="interpolate")
    except AmbidError as refused:
        print(f"ambid: drawn without the truth: {refused}", file=sys.stderr)
        return {}
    found = {}
    for channel in raw.channels:
        name = channel.name.removeprefix("true_")
        if name == channel.name or name not in units:
            continue
        if units[name] not in ("", channel.unit):
            inside = f"is in [{channel.unit}], the tracked number in [{units[name]}]"
            print(f"ambid: column {channel.name!r} {inside}: it is not drawn", file=sys.stderr)
            continue
        found[name] = (raw.time_s, channel.values)
    return found


def _may_hold_truth(record: Path) -> bool:
    """Look at the beginning of a text file, so that a long record is not read again for nothing."""
    import gzip

    if not record.name.lower().endswith((".csv", ".csv.gz")):
        return True
    try:
        with gzip.open(record) if record.name.lower().endswith(".gz") else record.open("rb") as file:
            return b"true_" in file.read(65536)
    except (OSError, EOFError):
        return False
