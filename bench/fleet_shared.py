"""Two runs that share one list by leases: the time against one run alone, and each record once under random kills.

``PYTHONPATH=. python bench/fleet_shared.py [RECORDS] [KILLS] [sqlite|postgresql] [wait|compute]``: two processes stand
for two machines, each with one worker. The job stands for an identification: it takes 0.2 s a record, in which it waits
(then processors that others use do not count: what is measured is what sharing costs) or computes. Figures are printed;
none is asserted.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from ambid.ledger import open_ledger
from tests.fleet.jobs import judge

WORK_S = 0.2
RUN = """
import sys
from ambid.fleet.run import run_fleet
from bench.fleet_shared import busily
if __name__ == "__main__":
    records, ledger, how = sys.argv[1:]
    run = run_fleet([records + "/*.txt"], ledger=ledger, job=busily, settings={"how": how}, taken_at="file", workers=1)
    print(*(run.counts[k] for k in ("done", "known", "failed", "left")))
"""


def busily(record: Any, rig: Any, *, how: str) -> Any:
    """A job that waits or computes for a certain time, and notes when it begins."""
    with Path(f"{record}.begun").open("a") as file:
        file.write("x")
    end = time.process_time() + WORK_S
    if how == "wait":
        time.sleep(WORK_S)
    while how == "compute" and time.process_time() < end:
        sum(range(2000))
    return judge(record, rig)


def records(n: int, folder: Path) -> Path:
    folder.mkdir()
    for k in range(n):
        (folder / f"{k:05}.txt").write_text(str(k))
    return folder


def start(folder: Path, ledger: str, how: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", RUN, str(folder), ledger, how], stdout=subprocess.PIPE, text=True)


def timed(runs: int, folder: Path, ledger: str, how: str) -> tuple[float, float]:
    """Time of so many runs at once from start to end, and processor time of all of them."""
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    said = [p.communicate()[0].strip() for p in [start(folder, ledger, how) for _ in range(runs)]]
    taken, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"  {runs} run(s): {taken:.1f} s, {used:.1f} s of processors; done known failed left: {said}", flush=True)
    return taken, used


def under_kills(kills: int, folder: Path, ledger: str, how: str) -> None:
    """Kill one of two runs at random again and again while it works, and start it anew at once."""
    rng, killed, begin = random.Random(1), 0, time.perf_counter()
    pause_s = 0.5 * WORK_S * len([*folder.iterdir()]) / (kills + 2)  # from one to the next
    runs = [start(folder, ledger, how) for _ in range(2)]
    while any(p.poll() is None for p in runs):
        time.sleep(pause_s * rng.uniform(0.6, 1.4))
        k = rng.randrange(2)
        if killed < kills and runs[k].poll() is None:
            os.kill(runs[k].pid, signal.SIGKILL)
            runs[k].communicate()
            runs[k], killed = start(folder, ledger, how), killed + 1
    said = [p.communicate()[0].strip() for p in runs]
    print(f"  killed {killed}, {time.perf_counter() - begin:.1f} s; at the end done known failed left: {said}")


def account(folder: Path, ledger: str) -> None:
    with open_ledger(ledger, write=False) as known:
        shas = [e.sha for b in known.bearings() for e in known.history(b.name).estimates]
        failed = len(known.failures())
    times = Counter(len(path.read_text()) for path in folder.glob("*.begun"))
    print(f"  ledger: {len(shas)} estimates of {len(set(shas))} records, {failed} failed; records by how often they "
          f"were begun: {dict(sorted(times.items()))}", flush=True)  # fmt: skip


def main(n: int, kills: int, url: str | None, how: str) -> None:
    with tempfile.TemporaryDirectory() as place:

        def ledger(name: str) -> str:
            if url is None:
                return f"{place}/{name}.db"
            from tests.ledger.server import new_database

            return new_database(url, name)

        times = {}
        for runs in (1, 2):
            folder, where = records(n, Path(place) / f"r{runs}"), ledger(f"r{runs}")
            times[runs] = timed(runs, folder, where, how)
            account(folder, where)
        share, used = (times[2][k] / times[1][k] for k in (0, 1))
        print(f"{how}: two runs take {share:.3f} of the time of one, {used:.3f} of its processors' time; load "
              f"{os.getloadavg()[0]:.1f} on {os.cpu_count()}", flush=True)  # fmt: skip
        folder, where = records(n, Path(place) / "killed"), ledger("killed")
        under_kills(kills, folder, where, how)
        account(folder, where)


if __name__ == "__main__":
    words = sys.argv[1:]
    words += ["1000", "10", "sqlite", "wait"][len(words) :]
    if words[2] == "postgresql":
        from tests.ledger.server import server

        with server() as url:
            main(int(words[0]), int(words[1]), url, words[3])
    else:
        main(int(words[0]), int(words[1]), None, words[3])
