"""Leases: which records of a ledger's fleets are in hand, and whose; several runs share one list by them."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

from ambid.ledger import entry
from ambid.ledger.store import Ledger

if TYPE_CHECKING:
    from sqlalchemy import Connection

HEARTBEAT_S = 5.0
LIMIT_S = 60.0
"""A lease whose heartbeat is older may be taken over, as that of a clock which was set back since."""
_FORGOTTEN_S = 86_400.0  # what nobody came back for is swept


class Leases:
    """The leases of one run. On PostgreSQL the server's clock counts, on SQLite that of the machine."""

    def __init__(self, ledger: Ledger) -> None:
        """Hold none yet."""
        self._ledger = ledger
        self.owner = f"{_process_of(os.getpid())} {uuid4().hex[:8]}"
        self.others = 0  # runs that held leases when this one last took some
        self._held, self._over = set[str](), set[str]()  # what is over is given back on the way
        self._beat_at = time.monotonic()

    def take(self, records: dict[str, str]) -> set[str]:
        """Take those that nobody has in hand, or whose owner is gone, and return their keys; `records`: names by the
        key of the estimate to come.
        """
        from sqlalchemy import insert, select, update

        t = entry.tables().tables["claim"]
        with self._ledger._leasing() as (c, now):
            self._give_back(c)
            held = {row.key: row for row in c.execute(select(t.c.key, t.c.owner, t.c.heartbeat_at))}
            fresh = {key: row.owner for key, row in held.items() if abs(now - row.heartbeat_at) <= LIMIT_S}
            alive = {owner for owner in {*fresh.values()} if not _is_gone(owner)}
            self.others = len(alive - {self.owner})
            left = [key for key in records if key in held and fresh.get(key) not in alive]
            mine = {"owner": self.owner, "begun_at": now, "heartbeat_at": now}
            if left:
                c.execute(update(t).where(t.c.key.in_(left)).values(**mine, tries=t.c.tries + 1))
            new = [key for key in records if key not in held]
            if new:
                c.execute(insert(t), [{"key": key, "record": records[key], "tries": 1, **mine} for key in new])
        self._held |= {*left, *new}
        return {*left, *new}

    def release(self, keys: Iterable[str]) -> None:
        """Give some back, with whatever is written next: that of which the ledger has a result is in nobody's way."""
        self._over |= self._held & set(keys)

    def _give_back(self, c: Connection) -> None:
        from sqlalchemy import delete

        if self._over:
            t = entry.tables().tables["claim"]
            c.execute(delete(t).where(t.c.key.in_(self._over), t.c.owner == self.owner))
            self._held -= self._over
            self._over.clear()

    def beat(self) -> None:
        """Say that this run is alive, where it is time to; called often."""
        from sqlalchemy import update

        if self._held and time.monotonic() - self._beat_at > HEARTBEAT_S:
            self._beat_at = time.monotonic()
            t = entry.tables().tables["claim"]
            with self._ledger._leasing() as (c, now):
                self._give_back(c)
                c.execute(update(t).where(t.c.owner == self.owner).values(heartbeat_at=now))

    def close(self) -> None:
        """Give all back, and sweep what was left behind long ago."""
        from sqlalchemy import delete, or_

        t = entry.tables().tables["claim"]
        with self._ledger._leasing() as (c, now):
            c.execute(delete(t).where(or_(t.c.owner == self.owner, t.c.heartbeat_at < now - _FORGOTTEN_S)))


def _process_of(pid: int) -> str:
    """Name a process for all times and machines, where Linux tells: machine, boot, its space of numbers, start."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        space, state, start = os.readlink("/proc/self/ns/pid"), words[0], words[19]
    except (OSError, IndexError):
        boot, space, state, start = "", "", "", ""
    return (
        f"{socket.gethostname()} {boot or '-'}/{space or '-'} {pid} {'gone' if state in ('Z', 'X') else start or '-'}"
    )


def _is_gone(owner: str) -> bool:
    """Whether a run was of this machine and its process has ended: then nobody has to wait for its heartbeat."""
    machine, space, pid, start, *_ = [*owner.split(), *[""] * 4]
    here = _process_of(os.getpid()).split()
    if (machine, space) != (here[0], here[1]) or "-" in (start, *space.split("/")) or not pid.isdecimal():
        return False
    return _process_of(int(pid)).split()[3] != start
