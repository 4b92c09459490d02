"""Guided commissioning: self-test, rest, polarity, levitate, excite, record, identify, validate, track; and its report.
A step not good enough ends it, with the reasons; all that was found stays in the folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

from ambid.acquisition.device import Device, DeviceInfo, Program
from ambid.acquisition.review import loop_on, refuse_unstable
from ambid.acquisition.session import Course, Listeners, acquire
from ambid.acquisition.settings import BenchView, law_trial, with_default_daq
from ambid.acquisition.trials import VOLTAGE, Kept, Look, Room, Size, make_look
from ambid.control.design import Design
from ambid.control.experiment import Experiment
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import Estimate, json_text, plain_json, read_as, read_whole
from ambid.estimation.progress import Tick, silent
from ambid.estimation.result import Reason, Result
from ambid.job import commissioning_steps as judge
from ambid.job.commissioning_steps import STEPS, Plan, StepName
from ambid.job.controller_design import design_controller
from ambid.job.experiment_design import HIGHEST, design_experiment
from ambid.job.identification import identify_axis
from ambid.job.loop_margins import margins, margins_beside
from ambid.job.presentation import page
from ambid.job.results import load_result
from ambid.job.track_live import track_live
from ambid.physics.linear_model import model
from ambid.record import Channel, Record
from ambid.recursive.lines import Track
from ambid.report.commission import Step, trace_picture
from ambid.rig import Rig, load_rig, rig_text
from ambid.rig.load import SELECTED
from ambid.settings.caller import setting
from ambid.simulation.margins import LoopMargins
from ambid.tracking.lines_file import TrackWriter

FILES = (
    "rig.toml", "experiment.json", "record.h5", "second.h5", "estimate.json", "report.html", "track.jsonl",
    "commission.json",
)  # fmt: skip
"""What a commissioning leaves in its folder."""
REDESIGNED = ("design.json", "redesigned.toml", "redesigned.h5")
"""What it leaves beside them where a better loop was designed."""

SCHEMA = "ambid.commission/1"
_LIMIT = 1.5  # acceptable model error of tracking
_SHOWN = 4000  # samples of a record that its picture shows
_FIRST = 1 / 3  # of the excitation's part of the room, for the small one that the experiment is designed on
_LINES = 60  # of the experiment
# of that part of the room, which a designed excitation uses: it shows so much that over more of the gap the magnet,
# which is not linear, would move the numbers by more than their standard deviations
_DESIGNED = 0.7
_RMS = 4.0  # peak over rms of noise
_SECOND = 0.8  # amplitude of the second record's excitation, of what its part of the room allows
_UNITS = {"voltage": "V", "current": "A", "position": "m"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Commissioned(Result):
    """The result of a commissioning."""

    steps: tuple[Step, ...]  # those that were done, the last one perhaps not passed
    estimate: Estimate | None  # where it came as far
    track: Track | None  # of the running bench, where it came as far
    folder: Path  # where the files are
    rig: Rig
    device: DeviceInfo
    plan: Plan
    names: tuple[StepName, ...] = STEPS  # of all steps, those that were not reached too

    @classmethod
    def of_file(cls, document: Mapping[str, Any], path: str) -> Commissioned:
        """Read ``commission.json`` and what stands beside it: the rig and, as far as it came, estimate and track."""
        folder = Path(path).parent
        if not (folder / "rig.toml").exists():
            raise EstimationError(
                f"commission {path} cannot be read: rig.toml, which it was made with, does not lie beside it. Copy it "
                "there too"
            )

        def beside(name: str) -> Any:
            return load_result(folder / name) if (folder / name).exists() else None

        def read() -> Commissioned:
            plan, device = read_as(Plan, document.get("wishes"), "wishes"), document.get("device")
            return cls(
                steps=read_as(tuple[Step, ...], document.get("steps"), "steps"), estimate=beside("estimate.json"),
                track=beside("track.jsonl"), folder=folder, rig=load_rig(folder / "rig.toml"), plan=plan,
                device=read_as(DeviceInfo, device and {**device, "columns": []}, "device"), names=plan.steps,
            )  # fmt: skip

        return read_whole(read, f"commission {path}", "commission", "commission")

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why it ended early, and what is to be known although a step is good enough."""
        graves = [Reason(check=s.name, text=text, grave=True) for s in self.steps for text in s.reasons]
        if not graves and not _all_passed(self.steps):
            graves = [Reason(check="steps", text="it ended before all steps were done. Commission again", grave=True)]
        return (*graves, *(Reason(check=s.name, text=text) for s in self.steps for text in s.cautions))

    @property
    def passed(self) -> bool:
        """Whether every step was done and is good enough."""
        return _all_passed(self.steps)

    def dumps(self) -> str:
        """Return what ``commission.json`` holds."""
        info = self.device
        return json_text(
            {
                "schema": SCHEMA,
                "verdict": plain_json(self.verdict),
                "device": {
                    "kind": info.kind,
                    "port": info.port,
                    "identity": dict(info.identity),
                    "rate_hz": info.rate_hz,
                },
                "wishes": plain_json(self.plan),
                "steps": [s.as_json() for s in self.steps],
                "passed": self.passed,
            }
        )


class Declined(AmbidError):
    """The operator did not agree to the next step."""


class _Interrupted(AmbidError):
    """Somebody asked for the end while numbers were worked out."""


def commission(
    device: Device,
    rig: Rig,
    folder: str | Path,
    *,
    plan: Plan | None = None,
    on_begin: Callable[[StepName], object] | None = None,
    on_step: Callable[[Step], object] | None = None,
    confirm: Callable[[StepName], bool] | None = None,
    stopped: Callable[[], bool] = lambda: False,
    tick: Tick | None = None,
    force: bool = False,
    **listeners: Unpack[Listeners],
) -> Commissioned:
    """Bring a bench from a controller that answers to physical parameters that are tracked.

    Parameters
    ----------
    device : Device
        Opened, idle.
    rig : Rig
        The bench, with ``[loop]`` and ``[daq]``.
    folder : str or Path
        Where everything is left; see `FILES`.
    plan : Plan, optional
        What is to be reached.
    on_begin, on_step : callable, optional
        Called with the name of a step before it begins, and with what it found.
    confirm : callable, optional
        Asked before the output is switched on; False ends it.
    stopped : callable, optional
        Asked now and then; True ends it.
    tick : callable, optional
        Sign of life while computing.
    force : bool
        Go on with a loop that is predicted unstable.
    **listeners
        See `ambid.acquisition.session.Listeners`.

    Returns
    -------
    Commissioned
        Also where a step was not good enough, or could not be done: the error is then the step's reason.

    Raises
    ------
    AmbidError
        If the bench cannot be commissioned, its loop is predicted unstable, or the folder holds an earlier one.
    """
    place = Path(folder)
    check_folder(place)
    guide = _Guide(device, rig, place, plan or Plan(), listeners, stopped, tick or silent)
    guide.check()
    guide.predict(force=force)
    write_text(place / "rig.toml", rig_text(rig, place))
    try:
        for name, do in guide.steps(confirm or (lambda _: True)):
            if on_begin is not None:
                on_begin(name)
            step = _do(name, do)
            guide.done.append(step)
            write_text(place / "commission.json", guide.found().dumps())
            if on_step is not None:
                on_step(step)
            if not step.passed:
                break
    finally:
        if guide.done:
            (tick or silent)("report")
            write_text(place / "report.html", page(guide.found()))
    return guide.found()


def _do(name: StepName, do: Callable[[], Step]) -> Step:
    """Do a step; what makes it impossible is its reason."""
    try:
        return do()
    except Declined:
        raise
    except AmbidError as failure:
        return Step(name=name, reasons=(str(failure),))


def _all_passed(steps: Sequence[Step]) -> bool:
    return bool(steps) and steps[-1].name == STEPS[-1] and all(s.passed for s in steps)


class _Guide:
    """The steps in their order, and what one leaves to the next."""

    def __init__(
        self,
        device: Device,
        rig: Rig,
        place: Path,
        plan: Plan,
        listeners: Listeners,
        stopped: Callable[[], bool],
        tick: Tick,
    ) -> None:
        self._device, self._rig, self._place = device, rig, place
        self._listeners, self._stopped, self._told = listeners, stopped, tick
        self._room = Room.of(rig)
        self.plan = plan
        self.estimate: Estimate | None = None
        self.track: Track | None = None
        self.done: list[Step] = []
        self._experiment: Experiment | None = None  # where one was designed
        self._program: Program | None = None  # that plays it
        self._design: Design | None = None  # of a better loop, where one was found
        self._loops: dict[str, LoopMargins] = {}  # as it was predicted

    def found(self) -> Commissioned:
        """Return what came of it so far."""
        return Commissioned(
            steps=tuple(self.done), estimate=self.estimate, track=self.track, folder=self._place, rig=self._rig,
            device=self._device.info, plan=self.plan, names=self.plan.steps,
        )  # fmt: skip

    def predict(self, *, force: bool) -> None:
        """Predict the loop, and refuse one that is unstable unless that is wished."""
        expected, whose = loop_on(self._rig, self._device.info)
        if expected is not None:
            self._loops = {f"expected: {whose}": expected}
            if not force:
                refuse_unstable(self._rig, self._device.info)

    def check(self) -> None:
        """Refuse what cannot be done, before anything moves."""
        plan, rate_hz = self.plan, self._device.info.rate_hz
        if self._device.info.kind == "replay":
            raise AmbidError(f"{self._device.info.port} is a record that is replayed: it cannot be commissioned")
        if self._rig.loop is None or not self._rig.loop.closed or self._rig.open_loop:
            raise AmbidError("the rig has no [loop] with a gain: there is nothing to levitate with. Give [loop]")
        if plan.redesign and self._device.info.kind == "simulated":
            raise AmbidError(
                f"{self._device.info.port} is simulated; only the firmware tries another loop. Take "
                f"{setting('port', 'emulated')} "
                f"or a bench, or omit {setting('redesign')}"
            )
        for what, seconds in (
            ("a trial of the amplitude", plan.longest_trial_s(rate_hz)),
            ("the record", plan.record_s),
            ("the second record", plan.second_s),
            ("tracking", plan.track_s),
        ):
            try:
                self._course(1.0, seconds, 0)
            except AmbidError as failure:
                raise AmbidError(f"{what}: {failure}") from None
        top = HIGHEST * rate_hz
        if plan.band_hz and plan.band_hz[1] > top and (plan.amplitude_v is None or plan.redesign):
            raise AmbidError(
                f"{setting('band')} goes up to {plan.band_hz[1]:g} Hz; an experiment is designed up to {top:g} Hz, "
                f"{HIGHEST:g} of "
                "the rate. Lower it"
            )

    def steps(self, confirm: Callable[[StepName], bool]) -> Iterator[tuple[StepName, Callable[[], Step]]]:
        """Yield one step after the other; whoever iterates does it, and stops at one that is not passed."""
        device, room, plan = self._device, self._room, self.plan
        look, rate_hz = make_look(device, self._rig, self._stopped), device.info.rate_hz
        found: dict[str, Step] = {}

        def keep(step: Step) -> Step:
            found[step.name] = step
            return step

        def amplitude() -> float:
            return found["excite"].numbers["amplitude_v"]

        yield "self-test", lambda: judge.self_test(device)
        yield "rest", lambda: judge.rest(look, room, plan, device.info.rate_hz)
        if not confirm("polarity"):
            raise Declined("pulses and levitation were not agreed to; the output stayed off. Clear the bench first")
        yield "polarity", lambda: judge.polarity(look, room, self._rig, device)
        yield "levitate", lambda: keep(judge.levitate(look, room, plan, rate_hz))
        yield "excite", lambda: keep(self._excite(look, found["levitate"]))
        yield "record", lambda: self._record(amplitude())
        yield "identify", self._identify
        yield "validate", self._validate
        if plan.redesign:
            yield "redesign", self._redesign
            yield "load", lambda: self._load(look, found["levitate"], amplitude())
        yield "track", lambda: self._track(amplitude())

    def _excite(self, look: Look, hover: Step) -> Step:
        """Design the excitation on what a small one shows; where that fails, find a flat one by trials."""
        plan, room, rate_hz = self.plan, self._room, self._device.info.rate_hz
        if plan.amplitude_v is not None:
            return judge.excite(look, room, plan, rate_hz, hover)[0]
        small, size = judge.excite(look, room, replace(plan, use=_FIRST * plan.use), rate_hz, hover)
        if self._stopped():
            return small
        try:
            if not small.passed:
                raise EstimationError("; ".join(small.reasons))
            made = self._experiment_on(size)
        except _Interrupted:
            raise
        except AmbidError as failure:
            step, _ = judge.excite(look, room, plan, rate_hz, hover)
            return replace(step, cautions=(f"a flat multisine is played, as no experiment was designed: {failure}",))
        gentle = replace(plan, use=_DESIGNED * plan.use)
        step, self._program = judge.designed(look, room, gentle, rate_hz, hover, made)
        self._experiment = made
        made.save(self._place / "experiment.json")
        low, high = room.voltage
        noise = _RMS * max(  # of the room, which the small excitation used too
            hover.numbers[f"{role}_sd"] / min(abs(end - hover.numbers[f"{role}_mean"]) for end in ends)
            for role, ends in room.trips.items()
        )
        own = math.sqrt(max(size.used**2 - noise**2, (size.used / 3.0) ** 2))
        flat = min(size.amplitude_v * plan.use / own, VOLTAGE * (high - low) / 2.0)
        return replace(
            step, findings=(*small.findings, *step.findings), pictures=(*small.pictures, *step.pictures),
            numbers={"amplitude_v": flat, **step.numbers},
        )  # fmt: skip

    def _experiment_on(self, size: Size) -> Experiment:
        """Design the experiment on the last trial; EstimationError where that shows too little."""
        channels = [Channel(name=n, unit=unit, values=size.last[n]) for n, unit in _UNITS.items() if n in size.last]
        seen = Record(rate_hz=self._device.info.rate_hz, channels=tuple(channels), history=(SELECTED,))
        first = identify_axis(seen, self._rig, tick=self._tick)
        weak = [p.name for p in first.parameters if not p.identifiable]
        if first.status != "converged" or weak:
            raise EstimationError(
                f"the trial of {size.amplitude_v:.3g} V does not show {', '.join(weak) or 'the plant'}"
            )
        return self._experiment_for(first, self.plan.record_s)

    def _experiment_for(self, estimate: Estimate, seconds: float, rig: Rig | None = None) -> Experiment:
        plan = self.plan
        return design_experiment(
            estimate, rig, seconds=seconds, band=plan.band_hz, use=_DESIGNED * plan.use, lines=_LINES, tick=self._tick
        )  # fmt: skip

    def _record(self, amplitude_v: float) -> Step:
        """Take the record, and a second one with another excitation."""
        plan = self.plan
        first = self._acquire("record", "record.h5", self._course(amplitude_v, plan.record_s, 0), plan.record_s)
        if not first.passed:
            return first
        course = plan.trial(self._device.info.rate_hz, plan.second_s, 1).course(
            _SECOND * amplitude_v, self._device.info.rate_hz
        )
        second = self._acquire("second record", "second.h5", course, plan.second_s)
        return replace(
            second,
            findings=(*first.findings, *second.findings),
            cautions=(*first.cautions, *second.cautions),
            parts=(*first.parts, *second.parts),
            pictures=(*first.pictures, *second.pictures),
        )

    def _acquire(self, name: str, file: str, course: Course, seconds: float) -> Step:
        plant, info, path = model(self._rig.model), self._device.info, self._place / file
        kept = Kept(BenchView(info, self._rig, (*plant.inputs, *plant.outputs)), most=_SHOWN)
        done = acquire(
            self._device, self._rig, path, course, taps=[kept], stopped=self._stopped, **self._listeners,
        )  # fmt: skip
        caption = f"The first {min(seconds, _SHOWN / info.rate_hz):.3g} s; dashed: the controller's trips."
        picture = trace_picture(f"The {name}", caption, kept.roles(), info.rate_hz, self._room.trips)
        return judge.record(name, done, (picture,) if kept.values else ())

    def _course(self, amplitude_v: float, seconds: float, seed: int) -> Course:
        """Return a course that plays the designed excitation, else a multisine."""
        plan, rate_hz = self.plan, self._device.info.rate_hz
        if self._program is not None:
            return Course(mode="levitate", seconds=seconds, settle_s=plan.settle_s, program=self._program)
        return plan.trial(rate_hz, seconds, seed).course(amplitude_v, rate_hz)

    def _validate(self) -> Step:
        assert self.estimate is not None
        return judge.validation(self.estimate)

    def _tick(self, stage: str, done: float | None = None, /) -> None:
        """Take a sign of life from what is worked out, and end it if that is requested."""
        if self._stopped():
            raise _Interrupted(f"interrupted while working it out ({stage})")
        self._told(stage, done)

    def _identify(self) -> Step:
        self.estimate = identify_axis(
            self._place / "record.h5", self._rig, validate=self._place / "second.h5", tick=self._tick
        )
        write_text(self._place / "estimate.json", self.estimate.dumps())
        late = next(iter(self.estimate.delay.values()))
        delay = late.samples + late.fraction
        found = loop_on(self._rig, self._device.info, self.estimate.values, delay=delay)[0]
        loops = {"identified": found} if found is not None else {}
        beside = margins_beside(self.estimate, self.estimate.used)
        return judge.identification(
            self.estimate, self.plan, {**loops, **self._loops}, self._experiment, beside,
            simulated=self._device.info.kind == "simulated",
        )  # fmt: skip

    def _redesign(self) -> Step:
        """Design a better loop on what was identified; where none is found the present one stays."""
        assert self.estimate is not None
        try:
            design = design_controller(self.estimate, self._rig, tick=self._tick)
        except EstimationError as failure:
            return Step(name="redesign", cautions=(f"the present loop stays: {failure}",))
        design.save(self._place / "design.json")
        step = judge.redesign(design, self.estimate)
        if step.numbers["better"]:
            self._design = design
            write_text(self._place / "redesigned.toml", rig_text(design.new_rig, self._place))
        return step

    def _load(self, look: Look, hover: Step, amplitude_v: float) -> Step:
        """Let the controller try the new loop, record and hover with it, and measure both loops."""
        if self._design is None:
            return Step(name="load", findings=("the present loop stays",))
        plan, rate_hz, kind = self.plan, self._device.info.rate_hz, self._device.info.kind
        rig = replace(self._rig, loop=self._design.loop)
        assert self.estimate is not None
        try:
            made = self._experiment_for(self.estimate, plan.second_s, rig)
            course = Course(mode="levitate", seconds=plan.second_s, settle_s=plan.settle_s, program=made.program)
        except EstimationError:
            course = plan.trial(rate_hz, plan.second_s, 3).course(amplitude_v, rate_hz)
        present = with_default_daq(self._rig) if kind in ("emulated", "simulated") else self._rig
        course = replace(course, trial=law_trial(present, rig))
        done = acquire(
            self._device, rig, self._place / "redesigned.h5", course, stopped=self._stopped, **self._listeners
        )  # fmt: skip
        after = judge.levitate(look, self._room, plan, rate_hz)
        loops = {
            words: margins(self._place / file, of, estimate=self.estimate, tick=self._tick)
            for words, file, of in (("before", "record.h5", self._rig), ("after", "redesigned.h5", rig))
        }
        return judge.load(done, after, hover, loops)

    def _track(self, amplitude_v: float) -> Step:
        """Let the tracker follow the running bench, excited as for the record, from what was identified."""
        course = self._course(amplitude_v, self.plan.track_s, 2)
        done = track_live(
            self._device, self._rig, course, start=self.estimate, limit=_LIMIT,
            on_event=self._listeners.get("on_event"), stopped=self._stopped,
        )  # fmt: skip
        self.track = done.track if done.track.lines else None
        with whole_file(self._place / "track.jsonl") as beside, TrackWriter(beside) as writer:
            writer.header(done.track.header)
            for line in done.track.lines:
                writer.line(line)
            if done.track.totals is not None:
                writer.summary(done.track.totals)
        return judge.tracking(done, _LIMIT)


def check_folder(folder: str | Path) -> None:
    """Refuse a folder that holds an earlier commissioning."""
    place = Path(folder)
    if not place.is_dir():
        raise AmbidError(f"{place} is no folder; commissioning leaves {len(FILES)} files in one. Make it first")
    if not os.access(place, os.W_OK):
        raise AmbidError(f"folder {place} may not be written. Choose another folder")
    there = [name for name in (*FILES, *REDESIGNED) if (place / name).exists()]
    there += sorted(path.name for path in place.glob("*.journal"))
    if there:
        raise AmbidError(f"{place} holds {', '.join(there)} of an earlier commissioning. Take an empty folder")


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 file, over an existing one, whole or not at all."""
    with whole_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Let a file be written under the returned name, and put it in place whole."""
    beside = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as failure:
        raise AmbidError(f"{path} cannot be written: {failure.strerror or failure}. Check folder and disk") from None
    finally:
        beside.unlink(missing_ok=True)
