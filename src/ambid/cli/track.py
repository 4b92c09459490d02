"""``ambid track``: on-line identification, a record replayed through the supervised tracker."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.cli.interrupts import INTERRUPTED
from ambid.cli.options import (
    FAILED_CHECK,
    FIGURE_ENDINGS,
    From,
    Inputs,
    OpenLoop,
    OutputColumns,
    Rate,
    RecordFile,
    References,
    RigFile,
    To,
    TrackFile,
    json_path,
    option,
    orders_of,
    switch,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter
from ambid.errors import AmbidError, nearest

if TYPE_CHECKING:
    from ambid.cli.live import Flag, Follower
    from ambid.recursive.lines import TrackHeader, TrackSummary

_NAMES = {
    "every_s": "--every", "limit": "--limit", "memory": "--memory", "start": "--start", "start_s": "--start-seconds"
}  # fmt: skip


def command(
    record: RecordFile,
    rig: RigFile = None,
    method: Annotated[
        str,
        option(
            "--method",
            "NAME",
            "rpem, the supervised tracker; ekf or ukf without supervisor; or coefficients from --input to"
            " --output: rls, lms, nlms, iv, or a recursive arx, armax, oe, bj, ...",
            True,
        ),
    ] = "rpem",
    inputs: Inputs = None,
    output: OutputColumns = None,
    orders: Annotated[str | None, option("--orders", "na=2,nb=2,nk=1", "Orders of coefficients.")] = None,
    reference: References = None,
    open_loop: OpenLoop = False,
    step: Annotated[float | None, option("--step", "X", "Step of lms and nlms, for signals of size one.")] = None,
    start: Annotated[
        Path | None,
        option(
            "--start",
            "ESTIMATE.json",
            "Begin with this estimate; by default one is identified from the beginning of the record.",
        ),
    ] = None,
    start_seconds: Annotated[
        float | None, option("--start-seconds", "S", "Identify the start from that much of the record.")
    ] = None,
    every: Annotated[float, option("--every", "S", "Reporting interval, s of record.", True)] = 0.01,
    limit: Annotated[float, option("--limit", "X", "Acceptable model error; 1 is that at identification.", True)] = 1.5,
    memory: Annotated[
        str,
        option(
            "--memory",
            "auto|all|S",
            "How long data count: found from the data, for ever, or a time constant in s.",
            True,
        ),
    ] = "auto",
    pace: Annotated[
        Literal["fastest", "real-time"], switch("--pace", "Replay as fast as possible, or as it was taken.")
    ] = "fastest",
    flag: Annotated[
        list[str] | None,
        option("--flag", "T:hold", "Set a flag at a time of the record: track, hold, accept or revert; repeat."),
    ] = None,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    json: TrackFile = None,
    plot: Annotated[
        Path | None,
        option("--plot", "FILE.png", "Draw the tracks, beside the truth where the record has columns true_NAME."),
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
    from ambid.job.tracking import check_settings, track
    from ambid.rig import load_rig
    from ambid.track.lines_file import TrackWriter

    remembered, flags = memory_of(memory), flags_of(flag)
    check_settings(
        record, start=start, start_s=start_seconds, every_s=every, limit=limit, memory=remembered, pace=pace,
        flags=flags, rate_hz=rate, names=_NAMES,
    )  # fmt: skip
    settings: dict[str, Any] = {
        "inputs": tuple(inputs or ()),
        "outputs": tuple(output or ()),
        "references": tuple(reference or ()),
        "orders": None if orders is None else orders_of(orders),
        "open_loop": open_loop,
        "step": step,
    }
    given = {name: value for name, value in settings.items() if value}
    if method == "rpem" and given:
        raise AmbidError(f"{', '.join(given)}: not for the supervised tracker. Name another --method, or leave it out")
    with Outputs(record, rig, start) as outputs:
        path = json_path(json)
        outputs.claim(path, "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        bench = None if rig is None else load_rig(rig)
        writer = TrackWriter(path) if path else TrackWriter(sys.stdout) if json == "-" else None
        same = json == "-" and sys.stdout.isatty()
        live = not quiet and sys.stderr.isatty() and not same

        def begin(header: TrackHeader) -> None:
            _check_interval(every, header.rate_hz)
            follower.on_header(header)

        follower = Follower(writer, keep=plot is not None, live=live, real_time=pace == "real-time")
        summary = follower.run(
            lambda: track(
                record,
                bench,
                method=method,
                start=start,
                start_s=start_seconds,
                every_s=every,
                limit=limit,
                memory=remembered,
                pace=pace,
                flags=flags,
                from_s=from_s,
                to_s=to_s,
                rate_hz=rate,
                on_header=begin,
                on_line=follower.on_line,
                keep=False,
                tick=follower.tick,
                **given,
            )
        )
        if plot is not None and summary is not None:
            try:
                _draw(follower, record, rate, plot, outputs)
            except KeyboardInterrupt:
                kept = f"; {path} holds the track" if path else ""
                print(f"ambid: interrupted while drawing{kept}", file=sys.stderr)
                raise typer.Exit(INTERRUPTED) from None
    finish(follower, summary, [str(p) for p in (path, plot) if p], table=json != "-", strict=strict, flags=flags)


def _check_interval(every: float, rate_hz: float) -> None:
    """Refuse an interval that holds no sample, now that the rate is known."""
    if every * rate_hz < 1.0 - 1e-9:
        raise AmbidError(
            f"--every {every:g} s is less than one sample at {rate_hz:g} Hz; a line needs a sample."
            f" Give {1.0 / rate_hz:g} or more"
        )


def memory_of(text: str) -> Any:
    """Read ``--memory``: a time in s, or a word, which is judged later."""
    try:
        return float(text)
    except ValueError:
        return text


def flags_of(texts: list[str] | None) -> tuple[tuple[float, Flag], ...]:
    """Read ``--flag``.

    `texts`: each a time in s, a colon and a flag. Returns in the order of their times.
    """
    from ambid.job.tracking import FLAGS

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


def _draw(follower: Follower, record: Path, rate: float | None, plot: Path, outputs: Outputs) -> None:
    from ambid.report.drawing import save
    from ambid.report.track_figures import track_figure

    assert follower.header is not None
    assert follower.history is not None
    units = follower.header.units
    truth = truth_columns(record, rate, {name: units.get(name, "") for name in follower.history.names})
    page = track_figure(follower.history, truth=truth)
    outputs.stage(plot, lambda path: save(page, path))


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


def finish(
    follower: Follower,
    summary: TrackSummary | None,
    written: list[str],
    *,
    table: bool,
    strict: bool,
    flags: Sequence[tuple[float, Flag]],
) -> None:
    """Print the table, say what was interrupted or not reached, and end with the exit code.

    `follower`: that followed the run; `summary`: none where the run ended before its first line; `written`: files that
    hold the track; `table`, `strict`: whether to print the table; whether troubles end with exit code 3; `flags`: as
    given.
    """
    header, last = follower.header, follower.last
    if summary is None or header is None or last is None:
        if follower.code:
            print("ambid: interrupted before the first line of the track", file=sys.stderr)
            raise typer.Exit(follower.code)
        raise AmbidError("the record ends before the first reporting interval. Take a longer one, or a shorter --every")
    from ambid.report.track_text import track_text, troubles_of

    troubles = troubles_of(header, last, follower.open_changes)
    if not summary.samples:
        troubles = (*troubles, "no sample of the record was used: these are the values of the start")
    if table:
        typer.echo(track_text(header, last, summary, events=follower.told, troubles=troubles, paint=painter()))
    if follower.code:
        kept = f"; {' and '.join(written)} hold{'s' if len(written) == 1 else ''} the track so far" if written else ""
        print(f"ambid: interrupted at {last.t:.4g} s of record{kept}", file=sys.stderr)
        raise typer.Exit(follower.code)
    for t, flag in flags:
        if t > last.t:
            said = f"the last line is at {last.t:.6g} s, so it was never set. Give a time in the record"
            print(f"ambid: --flag {t:g}:{flag} was not reached: {said}", file=sys.stderr)
    if strict and troubles:
        raise typer.Exit(FAILED_CHECK)
