"""How the verbs with a device open it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Literal

import typer

from ambid.cli.options import preset_of

if TYPE_CHECKING:
    from ambid.acquisition.device import Device
    from ambid.rig import Rig


def open_bench(
    port: str, rig: Rig, *, bench: str | None, pace: Literal["fastest", "real-time"], seed: int, closes: bool
) -> AbstractContextManager[Device]:
    """Open a device and close it, as `ambid.job.acquiring.opened`, with notes on standard error."""
    from ambid.job.acquiring import opened

    behind = None if bench is None else preset_of(bench) or bench
    return opened(port, rig, bench=behind, pace=pace, seed=seed, closes=closes, note=say_note)


def say_note(line: str) -> None:
    """Say something on standard error."""
    typer.echo(f"ambid: note: {line}", err=True)
