"""A ledger that is corrected, thinned, restored, merged and brought to a new version, and killed in the middle of it.

``PYTHONPATH=. python bench/ledger_kills.py [KILLS [ENGINES [WHAT...]]]``: each is a process of its own, which SIGKILL
ends at a random moment of 1.2 times what it takes undisturbed, in SQLite and, where its programs are, in PostgreSQL.
The ledger must then be as before or as undisturbed; where it is as before, doing it again must end as undisturbed.
Its check must find nothing. Figures are printed.
"""

from __future__ import annotations

import multiprocessing
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ambid.errors import AmbidError
from ambid.ledger import Ledger, open_ledger
from ambid.ledger.entry import Note
from tests.ledger import version1
from tests.ledger.contents import contents
from tests.ledger.entries import BEGIN, DAY, entry, parameter
from tests.ledger.server import absent, new_database, server

RECORDS, SEED = 200, 1
WHAT = ("rename", "redate", "remove", "merge", "restore", "retain", "backup", "migrate")


def do(what: str, ledger: Ledger, other: str, archive: str) -> None:
    match what:
        case "rename":
            ledger.correct("rename", "A", "B")
        case "redate":
            ledger.correct("redate", "A", 5.0, record="day7.h5")
        case "remove":
            ledger.correct("remove", "A")
        case "merge":
            ledger.merge(other)
        case "restore":
            ledger.restore(other)
        case "retain":
            ledger.retain(archive, before=BEGIN + RECORDS * DAY / 2, keep="month")
        case "backup":
            ledger.backup(archive)  # to migrate, it is enough to open it


def fill(place: str, names: str, first: int = 0) -> None:
    """Fill a ledger: as many records of each name, with documents and events."""
    numbers = tuple(parameter(name, 80.0, 0.5) for name in ("m", "k_x", "k_i", "R", "L"))
    note = Note(at=BEGIN, kind="change", text="it fell", parameter="k_i")
    with open_ledger(place) as ledger:
        for name in names:
            days = range(first, first + RECORDS)
            ledger.add(
                [entry(k, name, parameters=numbers, events=(note,), document="{}" + " " * 3000) for k in days]
            )  # fmt: skip


def facts(place: str) -> dict[str, Any]:
    """Contents without what a repetition changes: who corrected when, and how often."""
    found = contents(place)
    found["correction"] = {row[2:4] for row in found["correction"]}
    return found


def work(what: str, place: str, other: str, archive: str, begun: Any) -> None:
    begun.send(None)
    with open_ledger(place) as ledger:
        do(what, ledger, other, archive)


def child(*words: str) -> tuple[Any, float]:
    """Begin to do it in a process that has all imports already; the process, and when it began."""
    hear, tell = FORK.Pipe(duplex=False)
    run = FORK.Process(target=work, args=(*words, tell))
    run.start()
    hear.recv()
    return run, time.monotonic()


class Trials:
    """Ledgers of one engine to begin from, and what becomes of them."""

    def __init__(self, folder: Path, url: str | None) -> None:
        self.folder, self.url, self.n = folder, url, 0
        self.other = str(folder / "other.db")
        fill(self.other, "AC", RECORDS // 2)
        for name, make in (("old", version1.make), ("full", lambda place: fill(place, "A"))):
            make(str(folder / name) if url is None else new_database(url, name))

    def new(self, what: str) -> tuple[str, str]:
        """Make a ledger to begin from; its place and that of an archive."""
        self.n += 1
        archive, base = str(self.folder / f"{self.n}_archive.db"), "old" if what == "migrate" else "full"
        if self.url is None:
            return shutil.copy(self.folder / base, str(self.folder / f"{self.n}.db")), archive
        import psycopg

        with psycopg.connect(self.url.format("postgres"), autocommit=True) as c:
            c.execute(f"CREATE DATABASE k{self.n} TEMPLATE {base}")
        return self.url.format(f"k{self.n}"), archive

    def measure(self, what: str, kills: int) -> str:
        place, archive = self.new(what)
        before = None if what == "migrate" else facts(place)
        run, begin = child(what, place, self.other, archive)
        run.join()
        assert run.exitcode == 0
        taken, after = time.monotonic() - begin, facts(place)
        copy = facts(archive) if what in ("retain", "backup") else None
        ends, wrong = Counter[str](), 0
        for _ in range(kills):
            place, archive = self.new(what)
            run, _ = child(what, place, self.other, archive)
            time.sleep(DRAW.uniform(0.0, 1.2 * taken))
            run.kill()
            run.join()
            ends["ended before" if run.exitcode == 0 else "killed"] += 1
            state = self.state(what, place, before, after)
            ends[state] += 1
            if state == "as before":
                child(what, place, self.other, archive)[0].join()
            with open_ledger(place) as ledger:
                sound = not ledger.check() and facts(place) == after
            wrong += not (sound and (copy is None or facts(archive) == copy))
        counts = ", ".join(f"{n} {word}" for word, n in sorted(ends.items()))
        return f"{what:8s} {1e3 * taken:6.0f} ms undisturbed; {kills} kills: {counts}; {wrong} wrong"

    def state(self, what: str, place: str, before: Any, after: Any) -> str:
        """Say how a killed one left the ledger."""
        try:
            now = facts(place)
        except AmbidError as refusal:
            return "as before" if what == "migrate" and "is of version 1" in str(refusal) else "neither"
        return "as before" if now == before else "as undisturbed" if now == after else "neither"


DRAW, FORK = random.Random(SEED), multiprocessing.get_context("fork")


def main(kills: str = "20", engines: str = "SQLite,PostgreSQL", *what: str) -> None:
    for engine in engines.split(","):
        why = absent() if engine == "PostgreSQL" else None
        if why is not None:
            print(f"{engine} left out: {why}")
            continue
        with tempfile.TemporaryDirectory() as folder, server() if engine == "PostgreSQL" else nullcontext() as url:
            trials = Trials(Path(folder), url)
            for one in what or WHAT:
                print(f"{engine:10s}  {trials.measure(one, int(kills))}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
