"""Runs: what a console has started in a folder, each a process of its own with a folder of its own.

``FOLDER/.ambid/runs/ID/``: ``spec.json`` (what is wanted), ``process.json`` (who does it), ``control.jsonl`` (what
operators ordered), ``orders.jsonl`` (what became of that), ``lease.bin`` (who may order), ``status.bin`` (how the run
is, also on a full disk), the feed, and ``log.txt``. A console that starts anew finds them there.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ambid.console.authority import Lease, Machine
from ambid.console.folder import open_plain
from ambid.console.orders import Desk
from ambid.console.slot import Slot, append
from ambid.errors import AmbidError

MOVING = ("live", "commission")
"""Jobs that may move the machine: a folder has one such run at a time, and one page orders it."""
_ID = re.compile(r"[0-9]{10}-[0-9a-f]{6}")
_KEPT = 200  # runs that are over; older ones are removed when one begins


class Run:
    """One run of a folder.

    `place`: its folder.
    """

    def __init__(self, place: Path) -> None:
        self.place = place
        self.id = place.name

    @property
    def spec(self) -> dict[str, Any]:
        """What is wanted."""
        return _read(self.place / "spec.json")

    @property
    def alive(self) -> bool:
        """Whether its process works."""
        about = _read(self.place / "process.json")
        pid, began = about.get("pid"), about.get("began")
        return isinstance(pid, int) and isinstance(began, float) and 0 < pid < 1 << 31 and process_began(pid) == began

    @property
    def status(self) -> dict[str, Any]:
        """How it is, as its process wrote it last: see `Desk`."""
        return Slot(self.place / "status.bin").read()

    @property
    def follows(self) -> bool:
        """Whether it tracks a live bench now."""
        return self.alive and self.status.get("follows") is True

    @property
    def lease(self) -> Lease:
        """The right to order it."""
        return Lease(self.place)

    def say(self, word: str, **more: Any) -> str:
        """Order something; it is appended, and read within 20 ms. A full disk hinders no stop. Returns what the answer
        is known by.
        """
        name = secrets.token_hex(6)
        line = json.dumps({"word": word, "id": name, "at": time.time(), **more})
        try:
            append(self.place / "control.jsonl", f"\n{line}")  # whole, also after half a line
        except OSError:
            if word != "stop" or not self.alive:
                raise
            os.kill(_read(self.place / "process.json")["pid"], signal.SIGTERM)
        return name

    def answer(self, name: str) -> dict[str, Any] | None:
        """Return what its process answered to an order; None as long as it did not."""
        answers = self.status.get("answers")
        found = [a for a in answers if isinstance(a, dict)] if isinstance(answers, list) else []
        return next((a for a in found if a.get("id") == name), None)

    def claim(self) -> None:
        """Note that this process does it."""
        _write(self.place / "process.json", {"pid": os.getpid(), "began": process_began(os.getpid())})

    def release(self) -> None:
        """Note that it is over: the process, which takes a while to end, holds no machine any more."""
        with suppress(OSError):
            (self.place / "process.json").unlink()


class Heard:
    """Reads what the operator says to a run, as it comes."""

    def __init__(self, run: Run) -> None:
        self._path, self._at = run.place / "control.jsonl", 0

    def __iter__(self) -> Iterator[dict[str, Any]]:
        try:
            if self._path.stat().st_size <= self._at:
                return
            with open_plain(self._path) as file:
                file.seek(self._at)
                data = file.read(1 << 16)
        except OSError:
            return
        whole = data.rpartition(b"\n")[0]
        self._at += len(whole) + bool(whole) if len(data) < 1 << 16 or whole else len(data)
        for line in whole.splitlines():
            with suppress(ValueError, RecursionError):  # what is no word of a console is nothing
                said = json.loads(line)
                if isinstance(said, dict):
                    yield said


class Runs:
    """The runs of a folder.

    `place`: where they are kept; None: in the folder itself.
    """

    def __init__(self, folder: Path, place: Path | None = None) -> None:
        self.folder = folder
        self._place = folder / ".ambid" / "runs" if place is None else place

    def start(self, spec: Mapping[str, Any], *, page: str = "", by: str = "this machine") -> Run:
        """Begin a run in a process that outlives this one; `page`: that may order it, of the name `by`."""
        if not self._own:
            raise AmbidError("the folder .ambid is a link; runs are kept in the folder itself. Remove it")
        self._place.mkdir(parents=True, exist_ok=True)
        machine = Machine(self.folder, str(spec.get("port", ""))) if spec["job"] in MOVING else None
        try:
            if machine is not None:
                machine.seize({"job": spec["job"], "out": str(spec.get("out", ""))[:80], "by": by})
                if self.moving():
                    raise AmbidError("a run that moves the machine is under way. Stop it first")
            return self._begin(spec, machine, page, by)
        finally:
            if machine is not None:
                machine.release()

    def _begin(self, spec: Mapping[str, Any], machine: Machine | None, page: str, by: str) -> Run:
        for old in self.all()[_KEPT:]:
            if not old.alive:
                shutil.rmtree(old.place, ignore_errors=True)
        place = self._place / f"{int(time.time()):010d}-{secrets.token_hex(3)}"
        place.mkdir(mode=0o700)
        _write(place / "spec.json", {**spec, "folder": str(self.folder)})
        run, locks = Run(place), [] if machine is None else machine.locks
        Desk(place)
        if machine is not None:
            run.lease.slot.make()
            if page:
                run.lease.take(page, by)
        with (place / "log.txt").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "ambid.console.worker", str(place), *map(str, locks)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                pass_fds=locks if os.name == "posix" else (),
                cwd=place,  # never the folder: Python would run a numpy.py that is in it
            )  # fmt: skip
        _CHILDREN.append(process)
        try:
            _write(place / "process.json", {"pid": process.pid, "began": process_began(process.pid)})
        except OSError:  # who is told that nothing began can rely on it
            process.kill()
            raise
        return run

    def all(self) -> list[Run]:
        """Return all runs, the newest first."""
        for child in list(_CHILDREN):
            if child.poll() is not None:
                with suppress(ValueError):  # another thread looked too
                    _CHILDREN.remove(child)
        found = self._place.iterdir() if self._own and self._place.is_dir() else ()
        return [Run(p) for p in sorted(found, reverse=True) if _ID.fullmatch(p.name) and not p.is_symlink()]

    def moving(self) -> list[Run]:
        """Return the runs that may move the machine now."""
        return [r for r in self.all() if r.alive and r.spec.get("job") in MOVING]

    def has(self, name: str) -> bool:
        """Whether there is a run of a name."""
        return bool(_ID.fullmatch(name)) and self._own and (self._place / name).is_dir()

    def one(self, name: str) -> Run:
        """Return the run of a name."""
        place = self._place / name
        if not self.has(name) or place.is_symlink():
            raise AmbidError("there is no such run in the folder. Reload the page")
        return Run(place)

    @property
    def _own(self) -> bool:
        """Whether runs are kept in the folder, and no link leads elsewhere."""
        return not self._place.is_symlink() and not self._place.parent.is_symlink()


def size_of(spec: Mapping[str, Any]) -> float:
    """Return how much a run has to do: bytes of the record, estimate or ledger that its spec names, else its length."""
    names = [spec[k] for k in ("record", "estimate", "ledger") if k in spec]
    with suppress(OSError):
        return float(sum((Path(spec["folder"]) / str(n)).stat().st_size for n in names)) or float(
            spec.get("seconds", 0.0)
        )
    return 0.0


def usual_times(run: Run) -> tuple[float, float] | None:
    """Return after which times a run may have its verdict, and be over, s: as the latest of its job in the same place,
    by how much they had to do; None where none is known.
    """
    job, size = run.spec.get("job"), size_of(run.spec)
    for other in Runs(run.place, run.place.parent).all():
        taken = other.status.get("taken")
        if isinstance(taken, dict) and other.id != run.id and other.spec.get("job") == job:
            verdict, whole, before = (float(taken[k]) for k in ("verdict", "whole", "size"))
            scale = size / before if size and before else 1.0
            return scale * verdict, scale * whole
    return None


_CHILDREN: list[subprocess.Popen[bytes]] = []  # of this process: asked for their end, so that none stays a zombie


def process_began(pid: int) -> float | None:
    """Return what identifies a process beside its number, its start; None where it does not run."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        pass
    else:
        return None if stat[0] in "ZX" else float(stat[19])
    if Path("/proc/self/stat").exists():
        return None
    try:
        os.kill(pid, 0)
    except OSError:
        return None
    return 0.0


def _read(path: Path) -> dict[str, Any]:
    try:
        with open_plain(path) as file:
            found = json.loads(file.read(1 << 20))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _write(path: Path, content: Mapping[str, Any]) -> None:
    beside = path.with_name(f".{path.name}-{os.getpid()}")
    beside.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
    os.replace(beside, path)
