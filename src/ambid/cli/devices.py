"""How the verbs with a device choose its mode and open it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from ambid.cli.options import preset_of

if TYPE_CHECKING:
    from ambid.acquisition.device import Device, Mode
    from ambid.physics.presets import Preset
    from ambid.rig import Rig

_SAME_RATE = 1e-3  # a rate from a time column is rounded


def course_mode(port: str, rig: Rig, mode: Mode | None, excitation: str | None) -> Mode:
    """Choose what a device does where the user does not say.

    `port`: see ``--port``; `rig`: of the device; `mode`: as given; `excitation`: as given. Returns of a replay, sample.
    Levitate where the rig has a loop and does not say ``open_loop``; else drive, if there is something to play.
    """
    if mode is not None:
        return mode
    if port.startswith("replay:"):
        return "sample"
    if rig.loop is not None and rig.loop.closed and not rig.open_loop:
        return "levitate"
    return "sample" if excitation is None else "drive"


@contextmanager
def open_bench(
    port: str, rig: Rig, *, bench: str | None, pace: Literal["fastest", "real-time"], seed: int, closes: bool
) -> Iterator[Device]:
    """Open a device and close it.

    `port`: see ``--port``; `rig`: of the device; `bench`: see ``--bench``; `pace`: of a device that is no hardware;
    `seed`: of simulated noise; `closes`: whether a loop is to be closed that has to be stable. Returns idle.
    """
    from ambid.acquisition.default_daq import default_daq_notes, with_default_daq
    from ambid.acquisition.devices.choose import open_device
    from ambid.acquisition.review import refuse_unstable, review
    from ambid.acquisition.settings import controller_settings

    behind, invented = _bench(bench), port in ("emulated", "simulated")
    complete = with_default_daq(rig) if invented else rig
    for line in default_daq_notes(rig) if invented else ():
        typer.echo(f"ambid: note: {line}", err=True)
    made = open_device(port, rig, bench=behind, pace="real" if pace == "real-time" else "fastest", seed=seed)
    if closes:
        refuse_unstable(rig, made.info)
    with made as device:
        notes = (
            _replay_notes(device, rig)
            if port.startswith("replay:")
            else review(complete, controller_settings(complete), parameters=device.info.plant)
        )
        for line in notes:
            typer.echo(f"ambid: note: {line}", err=True)
        yield device


def _replay_notes(device: Device, rig: Rig) -> tuple[str, ...]:
    """Say where a record that is replayed has another rate than the rig: it keeps its own."""
    rate = device.info.rate_hz
    wanted = rig.daq.rate_hz if rig.daq is not None else rig.record.rate_hz
    if device.info.kind != "replay" or wanted is None or math.isclose(rate, wanted, rel_tol=_SAME_RATE):
        return ()
    return (
        f"{device.info.port} was taken at {rate:.6g} Hz, which it keeps; the rig says {wanted:g} Hz. Make sure that it"
        " is of this bench",
    )


def _bench(name: str | None) -> Preset | Rig | None:
    if name is None:
        return None
    from ambid.rig import load_rig

    return preset_of(name) or load_rig(Path(name))
