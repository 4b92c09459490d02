"""Guided commissioning: self-test, rest, levitate, excite, record, identify, validate, report, then track.

Each step is judged before the next begins; one that is not good enough ends it, with the reasons. All that was found up
to there stays in the folder.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ambid.acquire.device import Device, DeviceEvent
from ambid.acquire.program import program
from ambid.acquire.session import Course
from ambid.errors import AmbidError
from ambid.identify.estimate import Estimate
from ambid.job._progress import Tick, silent
from ambid.job.acquire import Acquired, Progress, acquire
from ambid.job.commission import bench, result
from ambid.job.commission.step import Step, StepName, Wishes
from ambid.job.look import Room, looking
from ambid.job.physical import identify, load, signals_of
from ambid.job.track_live import track_live
from ambid.physics.models import model
from ambid.rig import Rig, rig_text
from ambid.track.lines_json import TrackWriter

SCHEMA = "ambid.commission/1"
FILES = ("rig.toml", "record.h5", "second.h5", "estimate.json", "report.html", "track.jsonl", "commission.json")
"""What a commissioning leaves in its folder."""

_LIMIT = 1.5  # acceptable model error of tracking


@dataclass(frozen=True, slots=True, kw_only=True)
class Commissioned:
    """What came of a commissioning.

    Attributes
    ----------
    steps : tuple of Step
        Those that were done, the last one perhaps not passed.
    estimate : Estimate or None
        Where it came as far.
    folder : Path
        Where the files are.
    """

    steps: tuple[Step, ...]
    estimate: Estimate | None
    folder: Path

    @property
    def passed(self) -> bool:
        """Whether every step was done and is good enough."""
        return self.steps[-1].name == "track" and all(s.passed for s in self.steps)


class Declined(AmbidError):
    """The operator did not agree to the next step."""


def commission(
    device: Device,
    rig: Rig,
    folder: str | Path,
    *,
    wishes: Wishes | None = None,
    on_begin: Callable[[StepName], object] | None = None,
    on_step: Callable[[Step], object] | None = None,
    on_progress: Callable[[Progress], object] | None = None,
    on_event: Callable[[DeviceEvent], object] | None = None,
    confirm: Callable[[StepName], bool] | None = None,
    stopped: Callable[[], bool] = lambda: False,
    tick: Tick | None = None,
) -> Commissioned:
    """Bring a bench from a controller that answers to physical parameters that are tracked.

    Parameters
    ----------
    device : Device
        Opened, idle. It is idle again, with its output off, when this returns.
    rig : Rig
        The bench, with ``[loop]`` and ``[daq]``.
    folder : str or Path
        Where the files go; it has to exist, and none of `FILES` may be in it.
    wishes : Wishes, optional
        What is to be reached.
    on_begin, on_step : callable, optional
        Told of a step before it begins, and of what it found.
    on_progress, on_event : callable, optional
        As `ambid.job.acquire.acquire`.
    confirm : callable, optional
        Asked before the rotor is lifted; False ends it.
    stopped : callable, optional
        Asked while samples come; True ends the run.
    tick : callable, optional
        Sign of life while computing.

    Returns
    -------
    Commissioned
        Also where a step was not good enough.

    Raises
    ------
    AmbidError
        If device, rig or folder break a rule, or the operator does not agree.
    """
    place = Path(folder)
    _check_folder(place)
    guide = _Guide(device, rig, place, wishes or Wishes(), on_progress, on_event, stopped, tick or silent)
    done: list[Step] = []
    for name, step in guide.steps(on_begin or silent, confirm or _agreed):
        del name
        done.append(step)
        _write(place / "commission.json", _summary(done, device, guide.wishes))
        if on_step is not None:
            on_step(step)
        if not step.passed:
            break
    return Commissioned(steps=tuple(done), estimate=guide.estimate, folder=place)


def _agreed(name: StepName) -> bool:
    del name
    return True


def _check_folder(place: Path) -> None:
    if not place.is_dir():
        raise AmbidError(f"{place} is no folder; commissioning leaves {len(FILES)} files in one. Make it first")
    there = [name for name in FILES if (place / name).exists()]
    if there:
        raise AmbidError(f"{place} holds {', '.join(there)} of an earlier commissioning. Take an empty folder")


class _Guide:
    """The steps in their order, and what one leaves to the next."""

    def __init__(
        self,
        device: Device,
        rig: Rig,
        place: Path,
        wishes: Wishes,
        on_progress: Callable[[Progress], object] | None,
        on_event: Callable[[DeviceEvent], object] | None,
        stopped: Callable[[], bool],
        tick: Tick,
    ) -> None:
        self._device, self._rig, self._place = device, rig, place
        self._on_progress, self._on_event, self._stopped, self._tick = on_progress, on_event, stopped, tick
        self._room = Room.of(rig)
        self.wishes = wishes
        self.estimate: Estimate | None = None

    def steps(
        self, on_begin: Callable[[StepName], object], confirm: Callable[[StepName], bool]
    ) -> Iterator[tuple[StepName, Step]]:
        """Do one step after the other; whoever iterates stops at one that is not passed."""
        device, room, wishes = self._device, self._room, self.wishes
        look = looking(device, self._rig, self._stopped)
        _write(self._place / "rig.toml", rig_text(self._rig, self._place))

        def begin(name: StepName) -> StepName:
            on_begin(name)
            return name

        yield begin("self-test"), bench.self_test(device)
        yield begin("rest"), bench.rest(look, room, wishes)
        if not confirm("levitate"):
            raise Declined("levitation was not agreed to; the output stayed off. Begin again when the bench is clear")
        name = begin("levitate")
        hover = bench.levitate(look, room, wishes)
        yield name, hover
        name = begin("excite")
        size = bench.excite(look, room, wishes, device.info.rate_hz, hover)
        yield name, size
        yield begin("record"), self._record(size.numbers["amplitude_v"])
        yield begin("identify"), self._identify()
        assert self.estimate is not None
        yield begin("validate"), result.validation(self.estimate)
        yield begin("report"), self._report()
        yield begin("track"), self._track(size.numbers["amplitude_v"])

    def _record(self, amplitude_v: float) -> Step:
        """Take the record, and a second one with another excitation."""
        wishes = self.wishes
        first = result.record("record", self._acquire("record.h5", "multisine", amplitude_v, wishes.record_s, 0))
        if not first.passed:
            return first
        second = result.record(
            "second record", self._acquire("second.h5", "multisine", 0.8 * amplitude_v, wishes.second_s, 1)
        )
        return replace(
            second, findings=(*first.findings, *second.findings), cautions=(*first.cautions, *second.cautions)
        )

    def _acquire(self, name: str, kind: str, amplitude_v: float, seconds: float, seed: int) -> Acquired:
        return acquire(
            self._device, self._rig, self._place / name, self._course(kind, amplitude_v, seconds, seed),
            on_progress=self._on_progress, on_event=self._on_event, stopped=self._stopped,
        )  # fmt: skip

    def _course(self, kind: str, amplitude_v: float, seconds: float, seed: int) -> Course:
        wishes, rate_hz = self.wishes, self._device.info.rate_hz
        wave = program(
            kind, amplitude_v=amplitude_v, band=wishes.band(rate_hz), rate_hz=rate_hz, seconds=seconds,
            seed=wishes.seed + seed,
        )  # fmt: skip
        return Course(mode="levitate", seconds=seconds, settle_s=wishes.settle_s, program=wave)

    def _identify(self) -> Step:
        self.estimate = identify(
            self._place / "record.h5", self._rig, validate=self._place / "second.h5", tick=self._tick
        )
        _write(self._place / "estimate.json", self.estimate.dumps())
        return result.identification(self.estimate, self.wishes)

    def _report(self) -> Step:
        from datetime import UTC, datetime

        from ambid.report.figures import Evidence
        from ambid.report.page import report_html
        from ambid.validate.second_record import replay

        assert self.estimate is not None
        self._tick("report")
        used = load(self._place / "record.h5", self._rig)
        run = replay(self.estimate, signals_of(used, model(self.estimate.model)))
        evidence = Evidence(estimate=self.estimate, run=run, start_s=used.start_s)
        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        _write(self._place / "report.html", report_html(evidence, made=made))
        return Step(name="report", findings=(f"{self._place / 'report.html'}",))

    def _track(self, amplitude_v: float) -> Step:
        """Let the tracker follow the running bench, excited as for the record, from what was identified."""
        course = self._course("multisine", amplitude_v, self.wishes.track_s, 2)
        done = track_live(
            self._device, self._rig, course, start=self.estimate, limit=_LIMIT, on_event=self._on_event,
        )  # fmt: skip
        writer = TrackWriter(self._place / "track.jsonl")
        writer.header(done.track.header)
        for line in done.track.lines:
            writer.line(line)
        if done.track.summary is not None:
            writer.summary(done.track.summary)
        writer.close()
        return result.tracking(done, _LIMIT)


def _summary(done: list[Step], device: Device, wishes: Wishes) -> str:
    info = device.info
    return json.dumps(
        {
            "schema": SCHEMA,
            "device": {"kind": info.kind, "port": info.port, "identity": dict(info.identity), "rate_hz": info.rate_hz},
            "wishes": {name: getattr(wishes, name) for name in wishes.__slots__},
            "steps": [s.as_json() for s in done],
            "passed": done[-1].name == "track" and all(s.passed for s in done),
        },
        indent=1,
    )


def _write(path: Path, text: str) -> None:
    """Put a file in place whole."""
    beside = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    except OSError as failure:
        raise AmbidError(f"{path} cannot be written: {failure.strerror or failure}. Check folder and disk") from None
    finally:
        beside.unlink(missing_ok=True)
