"""``ambid track``: on-line identification, a record replayed through the supervised tracker."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ambid.cli.interrupts import INTERRUPTED
from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs, json_path, keeping
from ambid.errors import AmbidError
from ambid.settings.caller import setting

if TYPE_CHECKING:
    from ambid.recursive.lines import TrackHeader


@verb("track")
def command(v: Values) -> None:
    """Track the physical parameters of a bench through a record, as beside a running machine.

    A line shows where it is; 'ambid console' shows everything live. Ctrl-C ends in order.
    """
    from ambid.cli.live import Follower
    from ambid.job.following import check_settings
    from ambid.job.tracking import track
    from ambid.rig import load_rig

    start = Path(x) if isinstance(x := _number(v.start), str) else x
    how = v.only("every_s limit pace rate_hz") | {"start": start, "memory": _number(v.memory)}
    check_settings(how)
    own = {name: x for name, x in v.only("input output orders open_loop step").items() if x}
    if v.method == "rpem" and own:
        raise AmbidError(
            f"{', '.join(own)}: not for the supervised tracker. Name another {setting('method')}, or omit it"
        )
    how |= own | ({"layout": v.layout} if v.layout else {}) | v.only("method from_s to_s")
    with keeping(v, "track", [v.record], **how) as store:
        with Outputs(
            v.record, v.rig, start if isinstance(start, Path) else None, **v.outputs | {"json": None}
        ) as outputs:
            outputs.claim(json_path(v.json), "json")
            bench = None if v.rig is None else load_rig(v.rig)
            drawn = v.plot is not None or v.report is not None
            follower = Follower(v.json, keep=drawn, real_time=v.pace == "real-time")
            follower.record, follower.rate_hz = v.record, v.rate_hz

            def begin(header: TrackHeader) -> None:
                _check_interval(v.every_s, header.rate_hz)
                follower.on_header(header)

            told: dict[str, Any] = {"on_header": begin, "on_line": follower.on_line, "tick": follower.tick}
            follower.run(lambda: track(v.record, bench, keep=False, **told, **how))
            if follower.track is not None:
                try:
                    outputs.give(follower.track)
                except KeyboardInterrupt:
                    kept = f"; {follower.path} holds the track" if follower.path else ""
                    print(f"ambid: interrupted while drawing{kept}", file=sys.stderr)
                    raise typer.Exit(INTERRUPTED) from None
        follower.finish(outputs, drawn=v.plot, strict=v.strict, store=store)


def _check_interval(every: float, rate_hz: float) -> None:
    """Refuse an interval that holds no sample, now that the rate is known."""
    if every * rate_hz < 1.0 - 1e-9:
        raise AmbidError(
            f"--every {every:g} s is shorter than one sample at {rate_hz:g} Hz. Give {1.0 / rate_hz:g} or more"
        )


def _number(text: str | None) -> Any:
    """Read ``--memory`` or ``--start``: a time in s, or a word, which is judged later."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return text
