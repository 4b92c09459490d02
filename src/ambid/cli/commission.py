"""``ambid commission``: guided, from a controller that answers to physical parameters that are tracked."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ambid.cli.interrupts import INTERRUPTED, Stop, signals
from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs, end, keeping
from ambid.cli.terminal import painter, say_note, watching
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquisition.session import Progress
    from ambid.job.commissioning_steps import StepName
    from ambid.report.commission import Step


@verb("commission")
def command(v: Values) -> None:
    """Commission a bench: self-test, rest, polarity, levitate, excite, record, identify, validate, track; and report.

    Each step is judged before the next begins. One that is not good enough ends it with the reasons, and exit code 3;
    what was found up to there stays in the folder. A real bench is asked for before its output is switched on.
    """
    from ambid.estimation.estimate import plain_json
    from ambid.job import commission
    from ambid.job.acquiring import opened
    from ambid.job.commissioning import check_folder
    from ambid.job.commissioning_steps import Plan, second_s
    from ambid.physics.presets import preset_of
    from ambid.report.commission import next_text, step_section
    from ambid.report.device import progress_line
    from ambid.report.document import sections_text
    from ambid.report.text import verdict_lines
    from ambid.rig import load_rig

    outputs = Outputs(v.rig, **v.outputs)
    plan = Plan(
        record_s=v.seconds, second_s=second_s(v.seconds), track_s=v.track_seconds, amplitude_v=v.amplitude,
        band_hz=v.band, **v.only("widest seed redesign"),
    )  # fmt: skip
    known, paint, stop = load_rig(v.rig), painter(), Stop()
    _check_port(v.port, yes=v.yes)
    _check_place(v.out)
    if v.out.exists():
        check_folder(v.out)
    last: list[Step] = []
    begun: list[StepName] = []
    behind = None if v.bench is None else preset_of(v.bench) or v.bench
    opening = opened(v.port, known, bench=behind, pace=v.pace, seed=v.seed, closes=not v.force, note=say_note)
    shelf = partial(keeping, v, "commission", [v.out / "record.h5"], taken_now=True, **plain_json(plan))
    with shelf():  # refused before the rotor moves
        pass
    with watching() as watch, signals(stop.take), opening as device:
        new = _make(v.out)

        def begin(name: StepName) -> None:
            begun.append(name)
            watch.show(name, plan.steps.index(name) / len(plan.steps), "")

        def show(now: Progress) -> None:
            watch.show("record", now.samples / max(now.wanted, 1), progress_line(now.quality, now.counters))

        def tell(step: Step) -> None:
            last.append(step)
            watch.clear()
            section = step_section(step, f"{len(last)}/{len(plan.steps)}")
            typer.echo(sections_text([section], paint=paint), err=v.json == "-")

        def agreed(name: StepName) -> bool:
            del name
            watch.clear()
            asked = "The controller will switch its output on and lift the rotor."
            return (
                v.yes
                or device.info.kind != "serial"  # a real bench alone moves
                or typer.confirm(f"{asked} Is the bench clear, and the emergency stop within reach?")
            )

        def alive(stage: str, done: float | None = None, /) -> None:
            del done
            watch.show(begun[-1], plan.steps.index(begun[-1]) / len(plan.steps), stage)

        try:
            done = commission(
                device, known, v.out, plan=plan, on_begin=begin, on_step=tell, on_progress=show, confirm=agreed,
                stopped=stop.wished, tick=alive, force=v.force,
            )  # fmt: skip
        except AmbidError:
            with suppress(OSError):
                if new:
                    v.out.rmdir()  # where nothing was found, nothing is left
            raise
        except KeyboardInterrupt:
            stop.number = stop.number or INTERRUPTED - 128
    if stop.number is not None:
        typer.echo(f"ambid: interrupted; the output is off, and {v.out} holds what was found before", err=True)
        raise typer.Exit(stop.code)
    with outputs:
        outputs.give(done)
    if v.json == "-":
        outputs.show(done)
    if done.estimate is not None:
        with shelf() as store:
            store(done.estimate)
    name, command, passed = last[-1].name, "", done.passed
    if passed:
        volts = next(s.numbers["amplitude_v"] for s in last if s.name == "excite")
        made = v.out / "experiment.json"
        flat = {
            "--excitation": "multisine",
            "--band": None if v.band is None else "{:g}:{:g}".format(*v.band),
            "--amplitude": f"{volts:.6g}",
        }
        better = v.out / "redesigned.toml"
        given = {
            "--port": v.port, "--rig": better if better.exists() else v.rig, "--bench": v.bench,
            **({"--excitation": made} if made.exists() else flat), "--track": v.out / "estimate.json",
            "-o": v.out / "next.h5",
        }  # fmt: skip
        command = _line("acquire", given) + (" --force" if v.force else "")
    elif last[-1].remedy:
        command = _line("design controller", {"": v.out / "estimate.json", "--rig": v.rig, "-o": v.out / "better.toml"})
    elif name == "identify":
        command = _line("identify", {"": v.out / "record.h5", "--rig": v.rig})
    typer.echo("\n".join(verdict_lines(done.verdict, paint=paint)), err=v.json == "-")
    said = next_text(
        passed, name, len(last), len(plan.steps), str(v.out), command=command, remedy=last[-1].remedy
    )  # fmt: skip
    typer.echo(said, err=v.json == "-")
    end(failed=not passed)


def _line(verb: str, given: Mapping[str, object]) -> str:
    """Write a command as a shell takes it, with the options that are given."""
    words = [w for name, value in given.items() if value is not None for w in (name, str(value)) if w]
    return shlex.join(["ambid", *verb.split(), *words])


def _check_port(port: str, *, yes: bool) -> None:
    """Refuse what cannot be commissioned, before it is opened."""
    if port.startswith("replay:"):
        raise AmbidError(f"{port} is a replayed record: nothing can be levitated. Give a bench")
    if port not in ("emulated", "simulated") and not yes and not sys.stdin.isatty():
        raise AmbidError(
            f"{port}: the controller would switch its output on, and there is no terminal to ask. Clear the "
            "bench, and give --yes"
        )


def _check_place(folder: Path) -> None:
    try:
        exists = folder.exists()
    except OSError as failure:  # a name that no folder can have
        raise AmbidError(f"-o {folder} cannot be used: {failure.strerror or failure}. Give another name") from None
    if exists and not folder.is_dir():
        raise AmbidError(f"-o {folder} is a file; it must be a folder. Name one")
    if not folder.parent.is_dir():
        raise AmbidError(f"-o {folder}: there is no folder {folder.parent}. Make it first, or correct the path")


def _make(folder: Path) -> bool:
    """Make the folder; whether there was none."""
    new = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as failure:
        raise AmbidError(f"-o {folder} cannot be made: {failure.strerror or failure}. Choose another folder") from None
    return new
