"""Who may order what moves: one run at a time has the machine, and one page at a time orders that run."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ambid.console.slot import Slot, descriptor, lock
from ambid.errors import AmbidError

LEASE_S = 3.0
"""How long the right to order outlives the last sign of its holder, s."""

_NAME_S = 0.02  # in which who has just locked something writes who it is


class Lease:
    """The right to order a run, kept in the run's folder, the same for all consoles and their tabs.

    `place`: the run's folder. A page holds it while it gives signs of life, until it goes or another takes over.
    """

    def __init__(self, place: Path) -> None:
        self.slot = Slot(place / "lease.bin")

    @property
    def holder(self) -> Mapping[str, Any]:
        """The page that orders, by its `page` and `name`; empty where none does."""
        return _fresh(self.slot.read())

    def take(self, page: str, name: str, *, over: bool = False) -> None:
        """Give a page the right, `over`: also where another has it; a refusal names that one."""
        with self.slot.transaction() as content:
            other = _fresh(content)
            if other and other.get("page") != page and not over:
                raise AmbidError(f"{other.get('name')} has the right to order this run. Take over first, or stop only")
            content.update(page=page, name=name, at=time.monotonic())

    def beat(self, page: str) -> None:
        """Take a sign of life of a page; it matters where that page holds the right."""
        with suppress(AmbidError, OSError), self.slot.transaction() as content:
            if _fresh(content).get("page") == page:
                content["at"] = time.monotonic()

    def drop(self, page: str) -> None:
        """Take the right back from a page that is gone."""
        with suppress(AmbidError, OSError), self.slot.transaction() as content:
            if content.get("page") == page:
                content.clear()


def _fresh(content: Mapping[str, Any]) -> Mapping[str, Any]:
    at = content.get("at")
    return content if isinstance(at, float) and 0 <= time.monotonic() - at <= LEASE_S else {}


def busy(folder: Path) -> bool:
    """Whether a run has the bench of a folder, also one that only begins, or whose files another user keeps."""
    try:
        fd = descriptor(folder / ".ambid" / "bench.lock", os.O_RDWR)
    except OSError as failure:
        return not isinstance(failure, (FileNotFoundError, NotADirectoryError))
    try:
        return not lock(fd)
    finally:
        os.close(fd)


class Machine:
    """What a run moves: the bench of a folder, and the serial port that it names, each locked for one run.

    The locks die with the process of the run, which inherits them.
    """

    def __init__(self, folder: Path, port: str) -> None:
        self._names = [("the bench of this folder", folder / ".ambid" / "bench.lock")]
        if port.startswith("/") or port.upper().startswith("COM"):
            shared = Path(tempfile.gettempdir()) / f"ambid-{os.getuid() if hasattr(os, 'getuid') else 'ports'}"
            shared.mkdir(mode=0o700, exist_ok=True)
            if hasattr(os, "getuid") and (shared.is_symlink() or shared.stat().st_uid != os.getuid()):
                raise AmbidError(f"{shared} belongs to somebody else. Remove it")
            device = re.sub(r"[^\w.-]", "_", os.path.realpath(port))
            self._names.append((f"the port {port}", shared / f"{device}.lock"))
        self.locks: list[int] = []

    def seize(self, holder: Mapping[str, Any]) -> None:
        """Lock all of it for a run, told of by `holder`, or refuse and name who has it."""
        for what, path in self._names:
            path.parent.mkdir(parents=True, exist_ok=True)
            slot = Slot(path)
            slot.make()
            fd = descriptor(path, os.O_RDWR)
            if not lock(fd):
                os.close(fd)
                self.release()
                time.sleep(_NAME_S)
                has = slot.read()
                raise AmbidError(
                    f"{what} is in use by the run {has.get('job', '')} {has.get('out', '')}, started by "
                    f"{has.get('by', 'another console')}. Stop it first"
                )
            self.locks.append(fd)
            slot.write(holder)

    def release(self) -> None:
        """Let go of it here; a process that inherited the locks keeps them."""
        while self.locks:
            os.close(self.locks.pop())
