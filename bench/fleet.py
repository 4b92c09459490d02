"""Many records at once: beside a plain loop, and under random kills.

``PYTHONPATH=. python bench/fleet.py [RECORDS] [KILLS]``. Figures are printed; none is asserted.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import ambid
from ambid.fleet import fleet
from ambid.ledger import open_ledger
from tests.fleet.jobs import count, judge

ALLOWED = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2", "DASK_LOGGING__DISTRIBUTED": "critical"}
PARENT = """
import sys
from ambid.fleet.run import run_fleet
from bench.fleet import slowly
if __name__ == "__main__":
    folder, how = sys.argv[1:]
    workers = {"workers": 2} if how == "workers" else {"scheduler": how}
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
    for name, how in (("two processes", {"workers": 2}), ("Dask, local:2", {"scheduler": "local:2"})):
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


def time_left(n: int, folder: Path) -> None:
    """Records of 250 to 4,000 samples in no order: what is said to be left after a tenth, and what is."""
    rng, shares = random.Random(1), list[tuple[float, float, str]]()
    for k in range(n):
        record = ambid.simulate("thesis", duration=rng.choice((0.025, 0.1, 0.4)), seed=k)
        ambid.write_record(record, folder / f"{k:04}.h5")
    begin = time.perf_counter()

    def tick(said: str, done: float | None = None, /) -> None:
        shares.append((time.perf_counter() - begin, done or 0.0, said))

    fleet([folder / f"{k:04}.h5" for k in range(n)], workers=2, tick=tick)
    end = time.perf_counter() - begin
    print(f"time left of {n} records of different lengths:")
    for part in (0.1, 0.2, 0.5):
        now, share, said = shares[int(part * n) - 1]
        print(f"  after {part * n:g}, {now:.1f} s: {now / share - now:.1f} s are left, in truth {end - now:.1f} s: "
              f"ratio {(now / share - now) / (end - now):.2f}; {said}")  # fmt: skip


def under_kills(kills: int, folder: Path, how: str) -> None:
    """Kill processes at random: the parent, its workers, and where they are services of their own the scheduler."""
    poison = {50: "kill", 150: "hang", 250: "nothing"}
    for k in range(300):
        (folder / f"{k:03}.txt").write_text(poison.get(k, str(k)))
    rng, victims, starts = random.Random(1), Counter[str](), 0
    with ExitStack() as stack:
        services = {}
        if how == "scheduler":
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                where = f"tcp://127.0.0.1:{free.getsockname()[1]}"
            how = where
            services = {"scheduler": ("dask_scheduler", "--host", where)}
            services |= dict.fromkeys(("worker 1", "worker 2"), ("dask_worker", where, "--nthreads", "1"))
        running: dict[str, subprocess.Popen[bytes]] = {}
        stack.callback(lambda: [p.kill() for p in running.values()])
        while starts < kills + 5:
            run = subprocess.Popen([sys.executable, "-c", PARENT, str(folder), how], stderr=subprocess.DEVNULL)
            starts += 1
            begin = time.monotonic()
            while run.poll() is None:
                for name, (module, *words) in services.items():
                    if name not in running or running[name].poll() is not None:
                        running[name] = subprocess.Popen(
                            [sys.executable, "-m", f"distributed.cli.{module}", *words, "--no-dashboard"],
                            stderr=subprocess.DEVNULL, env=os.environ | ALLOWED,
                        )  # fmt: skip
                time.sleep(rng.uniform(0.2, 0.6))
                if time.monotonic() - begin < 3.0 or victims.total() == kills:
                    continue
                workers = [x for name in services if name != "scheduler" for x in _descendants(running[name].pid)]
                choice = {"worker": workers or _descendants(run.pid)} | {
                    name: [p.pid] for name, p in {"parent": run, **running}.items() if "worker" not in name
                }
                role = rng.choices(list(choice), [3] + [1] * (len(choice) - 1))[0]
                if choice[role]:
                    with suppress(ProcessLookupError):
                        os.kill(rng.choice(choice[role]), signal.SIGKILL)
                        victims[role] += 1
            if run.returncode == 0:
                break
    with open_ledger(folder / "f.db", write=False) as ledger:
        shas = [e.sha for b in ledger.bearings() for e in ledger.history(b.name).estimates]
        failed = {Path(f.record).name: f.reason for f in ledger.failures().values()}
    times = sum(len(path.read_text().splitlines()) for path in folder.glob("*.begun"))
    sound = sqlite3.connect(folder / "f.db").execute("PRAGMA integrity_check").fetchone()[0]
    print(f"{how}: killed {dict(victims)}, {starts} starts: {len(shas)} of 297 done, {len(set(shas))} of them "
          f"different; begun {times} times; ledger {sound}; failed: {failed}")  # fmt: skip


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
    with tempfile.TemporaryDirectory() as folder:
        time_left(max(n // 5, 40), Path(folder))
    for how in ("workers", "local:2", "scheduler"):
        with tempfile.TemporaryDirectory() as folder:
            under_kills(kills, Path(folder), how)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 1000, int(sys.argv[2]) if sys.argv[2:] else 30)
