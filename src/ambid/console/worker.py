"""What a run's process does: one job, told through its feed, led by what the operator says.

``python -m ambid.console.worker RUN`` is started by `ambid.console.runs`; it needs no console from then on. A run that
acquires writes the journal of every acquisition.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.console import views
from ambid.console.envelope import EnvelopeTap, throttled
from ambid.console.feed import FeedWriter
from ambid.console.folder import Folder, plain
from ambid.console.orders import LATE, Desk, Order
from ambid.console.rotor_view import Orbits, loop_content
from ambid.console.runs import MOVING, Heard, Run, size_of, usual_times
from ambid.console.words import PAGE_WORDS, RIG_WORDS
from ambid.errors import AmbidError
from ambid.record.record import INSIDE, cut
from ambid.settings.caller import speaking

if TYPE_CHECKING:
    from ambid.acquisition.session import Recording
    from ambid.recursive.lines import Event
    from ambid.tracking.lines_file import LiveState

_LISTEN_S = 0.02
_BEAT_S = 0.5  # between two signs of life
_LINE_S = 0.1  # between two lines of parameters that are shown
_FLAGS = ("track", "hold", "accept", "revert")
_LONGEST_S = 86_400.0


class Worker:
    """One run at work."""

    def __init__(self, run: Run, locks: Sequence[int] = ()) -> None:
        self.run, self.spec, self._locks = run, run.spec, locks
        for lock in locks:
            os.set_inheritable(lock, False)
        self.feed, self.desk = FeedWriter(run.place), Desk(run.place)
        self.folder = Path(self.spec["folder"])
        self.wished = threading.Event()  # the operator wants the end
        self.flags: deque[Order] = deque()
        self.cancelled = "cancelled before a result was there"
        self._question, self._asks, self._follows = 0, False, False
        self._powered = False  # whether a device may have its output on
        self._off = False  # whether its output was told to be off
        self._answers: deque[Order] = deque()
        self._began = time.perf_counter()
        self._verdict_s: float | None = None  # when the result was told
        self._usual = usual_times(run)
        self._progress = throttled(_LINE_S, self._tell_progress)

    def work(self) -> int:
        """Do the job, and tell how it ended; the exit code."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.wished.set())
        INSIDE.append(self.folder)
        self.run.claim()
        self.feed.tell("begin", {"job": self.spec["job"], "wall": time.time()}, sticky="begin")
        threading.Thread(target=self._listen, name="operator", daemon=True).start()
        try:
            with speaking("console", PAGE_WORDS if self.spec["job"] == "preview" else RIG_WORDS):
                JOBS[self.spec["job"]](self)
            self.end("done", "")
        except AmbidError as refusal:
            self.end("refused", str(refusal))
        except KeyboardInterrupt:
            self.end("cancelled", self.cancelled)
        except BaseException as defect:
            if isinstance(defect, OSError) and defect.errno in (errno.ENOSPC, errno.EDQUOT):
                self.end("refused", f"{defect.filename or self.folder} cannot be written: the disk is full. Make room")
                return 0
            with suppress(OSError):  # of a full disk
                traceback.print_exc()
            self.end("failed", f"a defect of the program: {type(defect).__name__}: {defect}. {self.run.place}/log.txt")
            return 1
        finally:
            self.feed.close()
            self.run.release()
            for lock in self._locks:  # this process takes a while to end
                os.close(lock)
        return 0

    def end(self, how: str, why: str) -> None:
        """Tell the end, also on a full disk."""
        if self.spec["job"] in MOVING and not self._powered:
            self.output_off()
        said = {"how": how, "why": why, "wall": time.time()}
        whole = time.perf_counter() - self._began
        taken = {"verdict": self._verdict_s or whole, "whole": whole, "size": size_of(self.spec)}
        self.desk.note(end={**said, "why": why[:400]}, **({"taken": taken} if how == "done" else {}))
        self.feed.tell("end", said, sticky="end", last=True)

    def tick(self, stage: str, done: float | None = None, /) -> None:
        """Take progress of a job; a job that is to be cancelled is interrupted here, and keeps its best."""
        if self.wished.is_set():
            raise KeyboardInterrupt
        self.show(stage, done)

    def show(self, stage: str, done: float | None = None, /) -> None:
        """Take progress of a job that ends itself where it is stopped."""
        self._progress(stage, done)

    def note(self, line: str) -> None:
        """Tell a remark."""
        self.feed.tell("note", {"text": line, "wall": time.time()})

    def stopped(self) -> bool:
        """Whether the operator wants the end."""
        return self.wished.is_set()

    def follow(self, *, on: bool) -> None:
        """Tell whether a live bench is tracked from now on; only then do the words of `_FLAGS` mean something."""
        self._follows = on
        self.desk.note(follows=on)
        self.feed.tell("following", {"on": on}, sticky="following")
        while not on and self.flags:
            self._obeys(self.flags.popleft(), "tracking has ended")

    def agreed(self, what: str) -> bool:
        """Ask the operator, and wait for the answer."""
        self._question += 1  # an answer to the question before is none
        self._asks = True
        self.feed.tell("ask", {"what": what, "number": self._question}, sticky="ask")
        word = ""
        while not word and not self.wished.is_set():
            time.sleep(_LISTEN_S)
            while self._answers and not word:
                order = self._answers.popleft()
                old = "" if order.number == self._question else "this question is no longer asked"
                word = order.word if self._obeys(order, old) else ""
        self._asks = False
        self.feed.tell("ask", {"what": "", "answer": word or "no"}, sticky="ask")
        return word == "go"

    def orders(self, goal: float | None) -> list[str]:
        """Return what operators order of the tracker now; `goal`: time of the values that a revert would return to."""
        taken = list[str]()
        for _ in range(len(self.flags)):
            order = self.flags.popleft()
            moved = order.word == "revert" and order.goal is not None and order.goal != goal
            if self._obeys(order, "what revert would return to has changed. Look again" if moved else ""):
                taken.append(order.word)
        return taken

    def _obeys(self, order: Order, why: str = "") -> bool:
        """Answer an order, and tell all pages; whether it is to be carried out, which `why` is against."""
        why = LATE if self.desk.late(order) else why
        self.feed.tell("order", self.desk.answer(order, why))
        return not why

    def path(self, key: str) -> Path | None:
        """Return a file that the spec names; None where it names none."""
        name = self.spec.get(key)
        found = None if name is None else self.folder / str(name)
        if found is not None and plain(found, self.folder) is None:
            raise AmbidError(f"{name} is no plain file of the folder any more. Choose another one")
        return found

    def named(self, key: str) -> Path:
        """Return a file that the spec has to name."""
        found = self.path(key)
        assert found is not None
        return found

    def give(self, result: Any) -> str:
        """Write a result under its name, or the next that is free, and tell it; the name."""
        from ambid.job.presentation import content

        name = Folder(self.folder).free(str(self.spec["out"]))
        result.save(self.folder / f"{name}.json")
        self.feed.tell("result", {"name": name, "content": content(result)}, sticky="result")
        self._verdict_s = time.perf_counter() - self._began
        return name

    def draw(self, result: Any, name: str, *, caption: str = "") -> None:
        """Write the report of a result that was told, and tell it, with the figure where it has a `caption`; what fails
        is told too, and changes nothing of the result.
        """
        from ambid.job.presentation import drawing
        from ambid.report.picture import image

        self._tell_progress("report", None)
        report = self.folder / f"{name}.html"
        try:
            result.report(report)
            figures = [{"title": name, "caption": caption, "image": image(drawing(result), name)}] if caption else []
            told = {"name": report.name, "pictures": figures, "why": ""}
        except Exception as failure:
            with suppress(OSError):
                traceback.print_exc()
            told = {"name": "", "pictures": [], "why": f"the report could not be drawn: {failure}"}
        self.feed.tell("report", told, sticky="report")

    @contextmanager
    def minded(self, device: Any) -> Iterator[Any]:
        """Yield a device of which is told that its output is off: once it has confirmed that after a stop, and at the
        end.
        """
        self._powered = True
        try:
            yield _Minded(device, self)
        finally:
            with suppress(AmbidError):  # the line is lost: nobody knows whether it is off
                device.stop()
                self._powered = False
                self.output_off()

    def output_off(self) -> None:
        """Tell that the device has confirmed that its output is off."""
        if not self._off:
            self._off = True
            self.desk.note(off=True)
            self.feed.tell("off", {}, sticky="off")

    def _tell_progress(self, stage: str, done: float | None) -> None:
        taken = time.perf_counter() - self._began
        usual = self._usual and self._usual[self._verdict_s is not None]
        told = {"stage": stage, "done": done, "seconds": round(taken, 2), "left": usual and round(usual - taken, 2)}
        self.feed.tell("progress", told, sticky="progress")

    def _listen(self) -> None:
        if self.spec["job"] in MOVING:
            _before_others()  # of this thread, which hardly works: a stop is taken at once
        heard, beat, stopping = Heard(self.run), 0.0, False
        while True:
            try:
                for said in heard:
                    self._hear(Order.of(said))
                if self.wished.is_set() and not stopping:  # by whatever way
                    stopping = True
                    self.desk.note(stopping=True)
                    self.feed.tell("stopping", {}, sticky="stopping")
                if time.perf_counter() - beat >= _BEAT_S:  # a frozen process falls silent, one that waits does not
                    beat = time.perf_counter()
                    self.feed.tell("beat", {"n": self.desk.beat()})
                    if not self.run.place.exists():  # nobody can stop it from now on
                        self.wished.set()
            except OSError:  # of a disk that is full or gone: orders are heard all the same
                pass
            except Exception:  # a defect: nobody could stop it from now on
                self.wished.set()
                with suppress(OSError):
                    traceback.print_exc()
            time.sleep(_LISTEN_S)

    def _hear(self, order: Order) -> None:
        """Take an order: a stop at once and however old it is, others by whom they are for."""
        if order.word == "stop":
            self.wished.set()
            self._obeys(replace(order, until=None, beat=None))
        elif self.desk.late(order):
            self._obeys(order)
        elif order.word in _FLAGS and self._follows:
            self.flags.append(order)
        elif order.word in ("go", "no") and self._asks and order.number == self._question:
            self._answers.append(order)
        elif order.word in (*_FLAGS, "go", "no"):
            asks = order.word in _FLAGS
            self._obeys(order, "nothing is tracked now" if asks else "this question is no longer asked")


def _reading(worker: Worker) -> dict[str, Any]:
    """How a record is to be read that does not say all by itself."""
    return {k: worker.spec[k] for k in ("rate_hz", "gaps") if k in worker.spec}


def _preview(worker: Worker) -> None:
    for kind, shown in views.preview(worker.named("record"), _reading(worker), tick=worker.tick, note=worker.note):
        worker.feed.tell(kind, shown, sticky=kind)


def _result(worker: Worker) -> None:
    from ambid.estimation.estimate import read_whole
    from ambid.job.presentation import content
    from ambid.job.results import load

    path = worker.named("estimate")
    found = load(path)
    shown = read_whole(lambda: content(found), path.name, "result", "identify")  # entries of other readers among it
    worker.feed.tell("result", {"name": path.stem, "content": shown}, sticky="result")


def _look(worker: Worker) -> None:
    """Tell what plots show of a stretch of a record, and the limits of a rig."""
    from ambid.console.look import limits, look
    from ambid.record import read_record
    from ambid.rig import load_rig

    rig = worker.path("rig")
    asked = {
        k: worker.spec[k] for k in ("from_s", "to_s", "from_hz", "to_hz", "weights", "channel") if k in worker.spec
    }
    pair = [worker.spec[k] for k in ("across", "up") if k in worker.spec]
    lines = {} if rig is None else limits(load_rig(rig), columns=True)
    record = read_record(worker.named("record"), **_reading(worker))
    worker.feed.tell("look", {**look(record, orbit=pair, **asked), "limits": lines})


def _history(worker: Worker) -> None:
    for kind, shown in views.bearings(worker.named("ledger"), worker.spec.get("bearing"), worker.tick):
        worker.feed.tell(kind, shown)


def _rig(worker: Worker) -> None:
    """Check a rig's text by the schema, and write it."""
    from ambid.rig import rig_from_text

    path = worker.folder / str(worker.spec["out"])
    rig_from_text(str(worker.spec["text"]), path)
    with path.open("x", encoding="utf-8") as file:
        file.write(str(worker.spec["text"]))
    worker.feed.tell("rig", {"name": path.name}, sticky="rig")


def _identify(worker: Worker) -> None:
    from ambid.job import identify

    found = identify(worker.named("record"), worker.named("rig"), tick=worker.tick)
    worker.draw(found, worker.give(found))


def _margins(worker: Worker) -> None:
    from ambid.job import margins

    found = margins(worker.path("record") or worker.path("estimate"), worker.path("rig"))  # type: ignore[arg-type]
    worker.draw(found, worker.give(found), caption="The loop as it is, with the zones of ISO 14839-3.")


def _design(worker: Worker) -> None:
    """Design a better loop, and write the rig that has it."""
    from ambid.job import design_controller
    from ambid.rig import rig_text

    estimate = worker.named("estimate")
    found = design_controller(estimate, worker.path("rig"), tick=worker.tick)
    name = worker.give(found)
    with (worker.folder / f"{name}.toml").open("x", encoding="utf-8") as file:
        file.write(rig_text(found.new_rig, worker.folder))
    worker.draw(found, name, caption="The loop before and after, with the zones of ISO 14839-3.")


def _export(worker: Worker) -> None:
    """Write a stretch of a record as a record."""
    from ambid.record import read_record, write_record

    path, out = worker.named("record"), worker.folder / str(worker.spec["out"])
    record = cut(read_record(path, gaps="interpolate"), float(worker.spec["from_s"]), float(worker.spec["to_s"]))
    if out.exists():
        raise AmbidError(f"{out.name} already exists. Choose another name")
    write_record(record, out)
    worker.feed.tell("exported", {"name": out.name, "samples": record.n_samples}, sticky="exported")


def _live(worker: Worker) -> None:
    """Record and track what a device samples."""
    from ambid.acquisition.session import recording
    from ambid.acquisition.settings import BenchView, fault_words
    from ambid.console.look import limits
    from ambid.job.acquiring import Request, ready
    from ambid.job.track_live import live_start, track_live
    from ambid.rig import load_rig

    spec, rig_path, start, arm = worker.spec, worker.path("rig"), worker.path("estimate"), worker.path("arm")
    assert rig_path is not None
    rig, out = load_rig(rig_path), worker.folder / str(spec["out"])
    plant, known = rig.plant, None if start is None else live_start(start, rig)
    wanted = Request(
        seconds=min(float(spec.get("seconds", 60.0)), _LONGEST_S), excitation=spec.get("excitation") or None,
        amplitude=spec.get("amplitude"), seed=0, stopped=worker.stopped, arm=None if arm is None else load_rig(arm),
    )  # fmt: skip
    runs, shown = list[Any](), (*plant.inputs, *plant.outputs) if rig.rotor is None else plant.outputs
    if spec.get("pace", "real-time") == "real-time":
        _before_others()
    opening = ready(
        str(spec["port"]), rig, wanted, bench=None, pace=spec.get("pace", "real-time"), force=False, note=worker.note,
        tick=worker.tick, minded=worker.minded,
    )  # fmt: skip
    with opening as (device, course):
        view = BenchView(device.info, rig, shown)
        told = _Lines(worker, orders=rig.rotor is None)
        opening_record = recording(device, rig, out, course, on_trouble=lambda e: worker.note(str(e)))
        with _storing(opening_record) as tap:
            orbits = None if rig.rotor is None else Orbits(worker.feed, rig, device.info)
            picture = EnvelopeTap(worker.feed, view, tap, limits(rig), None if orbits is None else orbits.take)

            def event(what: Any) -> None:
                tap.tell(what)
                text = fault_words(what) if what.kind == "fault" else what.what
                worker.feed.tell("device", {"what": what.kind, "text": text, "sample": what.sample})

            troubles = list[str]()

            def trouble(error: AmbidError) -> None:
                worker.follow(on=False)
                troubles.append(str(error))
                worker.note(f"tracking ended, recording continues: {error}")

            try:
                made = track_live(
                    device, rig, course, start=known, taps=[tap, picture], on_event=event, on_run=runs.append,
                    on_trouble=trouble, on_loop=told.loop,
                    on_header=told.header, on_line=told.line, on_lag=told.lag, keep=False, every_s=0.02,
                    stopped=lambda: worker.stopped() or tap.failed is not None,  # a run that is not stored ends
                )  # fmt: skip
                worker.feed.tell("summary", _summary(made), sticky="summary")
            except AmbidError as refusal:
                if not runs:
                    raise
                if str(refusal) not in troubles:
                    worker.note(str(refusal))
            finally:
                worker.follow(on=False)
        picture.end()
        done = tap.acquired(runs[0])
        fault = done.run.fault
        worker.feed.tell(
            "recorded",
            {"name": out.name, "samples": done.run.samples, "lost": done.run.lost, "not_stored": done.not_stored,
             "fault": None if fault is None else fault.what},
            sticky="recorded",
        )  # fmt: skip
        if tap.failed is not None:
            raise tap.failed


@contextmanager
def _storing(opening: AbstractContextManager[Recording]) -> Iterator[Recording]:
    """Record; where the disk failed, that is the reason of the end, and what became of the record stands behind it."""
    tap: Recording | None = None
    try:
        with opening as tap:
            yield tap
    except AmbidError as failure:
        if tap is None or tap.failed is None:
            raise
        raise AmbidError(f"{tap.failed}. {failure}") from failure


def _before_others() -> None:
    """Ask for the processor before other work, by SCHED_RR or else a lower nice value; go on where neither is given."""
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        return
    with suppress(AttributeError, OSError):
        os.nice(-10)


class _Minded:
    """A device that tells its run when it has been stopped because the operator wanted that."""

    def __init__(self, device: Any, worker: Worker) -> None:
        self._device, self._worker = device, worker

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def stop(self) -> None:
        self._device.stop()
        if self._worker.wished.is_set():
            self._worker.output_off()


class _Lines:
    """Tells the lines of a track at a pace that eyes can follow; events at once."""

    def __init__(self, worker: Worker, *, orders: bool) -> None:
        self._worker, self._lag, self._last = worker, 0.0, float("-inf")
        self._orders = orders  # whether an operator may lead the tracker
        self._state: LiveState | None = None

    def header(self, header: Any) -> None:
        from ambid.console.look import meanings
        from ambid.tracking.lines_file import LiveState

        self._state = state = LiveState(header)
        start = {n: {"value": _number(v.value), "sd": _number(v.sd)} for n, v in header.start.items()}
        self._worker.feed.tell(
            "header",
            {"model": header.model, "method": header.method, "limit": header.limit, "units": dict(header.units),
             "start": start, "warnings": [*header.grave, *header.warnings], "meanings": meanings(header.model)},
            sticky="header",
        )  # fmt: skip
        self._worker.feed.keep("told", lambda: {"events": [_told(e) for e in state.events]})
        if self._orders:
            self._worker.follow(on=True)

    def loop(self, t: float, sensitivity: Mapping[str, Any]) -> None:
        self._worker.feed.tell("loop", loop_content(t, sensitivity), sticky="loop")

    def lag(self, lag_s: float) -> None:
        self._lag = max(lag_s, self._lag)

    def line(self, line: Any) -> Sequence[Any] | None:
        feed, now, state = self._worker.feed, time.perf_counter(), self._state
        assert state is not None
        for event in line.events:
            feed.tell("event", _told(event))
        state.add(line)  # after that: a part of the feed that begins between the two tells each once
        if now - self._last >= _LINE_S:
            self._last = now
            values = {n: [_number(v.value), _number(v.sd), v.stale] for n, v in line.parameters.items()}
            feed.tell(
                "line",
                {"t": round(line.t, 4), "values": values, "error": _number(line.error), "state": line.state,
                 "lag_s": round(self._lag, 5), "updates": state.tally.updates,
                 "rejected": state.tally.rejected_samples, "open": len(state.tally.open_changes),
                 "choices": {n: {"t": c.t, "values": _pairs(c.parameters)} for n, c in line.choices.items()}},
                sticky="line",
            )  # fmt: skip
            self._lag = 0.0
        revert = line.choices.get("revert")
        return self._worker.orders(None if revert is None else revert.t) if self._worker.flags else None


def _pairs(values: Mapping[str, Any]) -> Mapping[str, Any]:
    return {n: [_number(v.value), _number(v.sd)] for n, v in values.items()}


def _told(event: Event) -> Mapping[str, Any]:
    from ambid.tracking.lines_file import event_json

    return {"what" if k == "kind" else k: x for k, x in event_json(event).items()}


def _number(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _summary(made: Any) -> Mapping[str, Any]:
    from ambid.estimation.estimate import fields_json
    from ambid.job.presentation import content

    latency = made.track.totals.latency
    return {"content": content(made.track), "overruns": made.overruns, "latency": latency and fields_json(latency)}


def _commission(worker: Worker) -> None:
    """Commission a bench; the operator agrees before the output is switched on."""
    from ambid.acquisition.session import Progress
    from ambid.job import commission
    from ambid.job.acquiring import opened
    from ambid.job.commissioning_steps import Plan, second_s
    from ambid.report.document import plain_parts
    from ambid.report.drawing import single
    from ambid.report.picture import image
    from ambid.rig import load_rig

    spec, rig_path = worker.spec, worker.path("rig")
    assert rig_path is not None
    rig, folder = load_rig(rig_path), worker.folder / str(spec["out"])
    seconds = float(spec.get("seconds", 20.0))
    plan = Plan(
        record_s=seconds, second_s=second_s(seconds), track_s=float(spec.get("track_seconds", 5.0)),
        redesign=bool(spec.get("redesign", False)),
    )  # fmt: skip
    worker.feed.tell("plan", {"steps": list(plan.steps)}, sticky="plan")
    good = list[str]()

    def step(found: Any) -> None:
        good.extend([found.name] if found.passed else [])
        content = {
            "name": found.name, "passed": found.passed, "findings": list(found.findings),
            "reasons": list(found.reasons), "cautions": list(found.cautions), "parts": plain_parts(found.parts),
            "pictures": [
                {"title": p.title, "caption": p.caption, "image": image(single(p.block), p.title)}
                for p in found.pictures
            ],
        }  # fmt: skip
        worker.feed.tell("step", content, sticky=f"step {found.name}")

    def progress(now: Progress) -> None:
        worker.show("record", now.samples / max(now.wanted, 1))

    opening = opened(
        str(spec["port"]), rig, bench=None, pace=spec.get("pace", "fastest"), seed=0, closes=True, note=worker.note
    )
    with opening as bare, worker.minded(bare) as device:
        folder.mkdir()
        told: Mapping[str, Any] = {"passed": False, "verdict": "unusable", "reasons": []}
        try:
            found = commission(
                device, rig, folder, plan=plan, confirm=lambda name: worker.agreed(f"{name}"), stopped=worker.stopped,
                on_begin=lambda name: worker.feed.tell("beginning", {"name": name}, sticky="beginning"),
                on_step=step, on_progress=progress, tick=worker.show,
            )  # fmt: skip
            reasons = [f"{r.check}: {r.text}" for r in found.verdict.reasons]
            told = {"passed": found.passed, "verdict": found.verdict.word, "reasons": reasons}
        finally:
            reached = ", ".join(good) or "none"
            told = {**told, "reached": f"{len(good)} of {len(plan.steps)} steps were good enough: {reached}",
                    "report": f"{folder.name}/report.html"}  # fmt: skip
            if (folder / "report.html").exists():
                worker.feed.tell("commissioned", told, sticky="commissioned")
        if worker.stopped() and not found.passed:
            worker.cancelled = f"stopped. {told['reached']}. {folder.name} keeps what they found"
            raise KeyboardInterrupt


def _fleet(worker: Worker) -> None:
    from ambid.console.fleet_view import tell_fleet

    tell_fleet(worker.named("ledger"), worker.feed, worker.tick)


JOBS: Mapping[str, Callable[[Worker], None]] = {
    "preview": _preview, "look": _look, "result": _result, "rig": _rig, "identify": _identify, "margins": _margins,
    "design": _design, "export": _export, "history": _history, "fleet": _fleet, "live": _live,
    "commission": _commission,
}  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(Worker(Run(Path(sys.argv[1])), [int(fd) for fd in sys.argv[2:]]).work())
