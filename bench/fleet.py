"""Many records at once: beside a plain loop, and under random kills.

``PYTHONPATH=. python bench/fleet.py [RECORDS] [KILLS]``. Figures are printed; none is asserted.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import ambid
from ambid.fleet import fleet
from ambid.ledger import open_ledger
from tests.fleet.jobs import count, judge

PARENT = """
import sys
from ambid.fleet.run import run_fleet
from bench.fleet import slowly
if __name__ == "__main__":
    folder, workers = sys.argv[1], {"dask": 2} if sys.argv[2] == "dask" else {"workers": 2}
    run_fleet([folder + "/*.txt"], ledger=folder + "/f.db", job=slowly, taken_at="file", limit_s=5.0, **workers)
"""


def slowly(record: Any, rig: Any) -> Any:
    """A job of a tenth of a second that notes when it begins."""
    with Path(f"{record}.begun").open("a") as file:
        file.write(f"{time.time()}\n")
    time.sleep(0.1)
    return judge(record, rig)


def beside_a_loop(n: int, folder: Path) -> None:
    for k in range(n):
        ambid.write_record(ambid.simulate("thesis", duration=0.1, seed=k), folder / f"{k:04}.h5")
    paths = sorted(folder.glob("*.h5"))
    ambid.identify(paths[0])
    begin = time.perf_counter()
    loop = [ambid.identify(path) for path in paths]
    alone = time.perf_counter() - begin
    print(f"{n} records of 1,000 samples, one after the other: {alone:.1f} s ({1e3 * alone / n:.1f} ms each)")
    for name, how in (("two processes", {"workers": 2}), ("Dask, local:2", {"dask": 2})):
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        table = fleet(paths, **how)
        taken = time.perf_counter() - begin
        same = all(
            table[p.name].iloc[k] == p.value and table[f"{p.name} sd"].iloc[k] == p.sd
            for k, e in enumerate(loop) for p in e.parameters if p.role != "fixed" and p.identifiable
        )  # fmt: skip
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        print(f"  {name}: {taken:.1f} s, {alone / taken:.2f} times the loop, equal to the last digit: {same}, "
              f"this process grew by {grown:.0f} MiB")  # fmt: skip
    for m in (n, 10 * n):
        begin, cpu = time.perf_counter(), time.process_time()
        fleet([paths[0]] * m, job=count, workers=2)
        taken, used = time.perf_counter() - begin, time.process_time() - cpu
        print(f"  {m} tasks that do nothing: {1e3 * taken / m:.3f} ms a task, {1e3 * used / m:.3f} ms of this process")


def under_kills(kills: int, folder: Path, how: str) -> None:
    poison = {50: "kill", 150: "hang", 250: "nothing"}
    for k in range(300):
        (folder / f"{k:03}.txt").write_text(poison.get(k, str(k)))
    rng, left, starts = random.Random(1), kills, 0
    while starts < kills + 5:
        run = subprocess.Popen([sys.executable, "-c", PARENT, str(folder), how], stderr=subprocess.DEVNULL)
        starts += 1
        time.sleep(3.0)
        while run.poll() is None:
            time.sleep(rng.uniform(0.2, 0.6))
            if left:
                children = _descendants(run.pid)
                victim = run.pid if rng.random() < 0.2 or not children else rng.choice(children)
                left -= 1
                try:
                    os.kill(victim, signal.SIGKILL)
                except ProcessLookupError:
                    left += 1
        if run.returncode == 0:
            break
    with open_ledger(folder / "f.db", write=False) as ledger:
        shas = [e.sha for b in ledger.bearings() for e in ledger.history(b.name).estimates]
        failed = {Path(f.record).name: f.reason for f in ledger.failures().values()}
    times = sum(len(path.read_text().splitlines()) for path in folder.glob("*.begun"))
    sound = sqlite3.connect(folder / "f.db").execute("PRAGMA integrity_check").fetchone()[0]
    print(f"{how}: {kills - left} kills, {starts} starts: {len(shas)} of 297 done, {len(set(shas))} of them different; "
          f"begun {times} times; ledger {sound}; failed: {failed}")  # fmt: skip


def _descendants(pid: int) -> list[int]:
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = place.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(words[1]) == pid:
            child = int(place.parent.name)
            found += [child, *_descendants(child)]
    return found


def main(n: int, kills: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        beside_a_loop(n, Path(folder))
    for how in ("pool", "dask"):
        with tempfile.TemporaryDirectory() as folder:
            under_kills(kills, Path(folder), how)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 1000, int(sys.argv[2]) if sys.argv[2:] else 30)
