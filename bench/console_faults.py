"""What a console does when it is abused: attacks, starts at once, double clicks, kills, freezes, Stop; counted.

``PYTHONPATH=. python bench/console_faults.py [TIMES [NAME...]]``. Benches are simulated; nothing is asserted.
"""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ambid.console.feed import FeedReader
from ambid.console.runs import Run, Runs
from ambid.record import read_record
from tests.console.attacks import SECRET, answer, attacks, everything, lay_out, planted, through
from tests.console.browser import SIZES, Page, chromium
from tests.console.pages import LIVE, console, frames_of, over, pid_of, prototype_rig, told, until

_PRESS = """(() => { let began = null; window.said = null; const host = $("delivery");
for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, (e) => { began ??= e.timeStamp; }, true);
new MutationObserver(() => { if (["good", "bad"].includes(host.className)) said ??= [host.className, Math.round(
performance.now() - began)]; }).observe(host, { attributes: true, childList: true }); })()"""


def end(run: Run) -> None:
    """Kill a run and wait until it is gone."""
    os.kill(pid_of(run), signal.SIGKILL)
    over(run)


def starts(folder: Path, times: int) -> str:
    right = 0
    with console(folder) as one, console(folder) as two, ThreadPoolExecutor(8) as clients:
        pages = [one.open(), two.open()]
        rigs = [p.number("rig.toml") for p in pages]
        for n in range(times):

            def start(k: int, n: int = n) -> Any:
                wish = {**LIVE, "rig": rigs[k % 2], "out": f"start-{n}-{k}"}
                return pages[k % 2].json("POST", "/api/runs", wish, headers={"X-Ambid": f"page-{k}"})

            answers = list(clients.map(start, range(8)))
            begun = [a["id"] for a in answers if "id" in a]
            named = sum("started by page page-" in a.get("error", "") for a in answers)
            right += len(begun) == 1 and named == 7
            for name in begun:
                end(Runs(folder).one(name))
    return f"8 starts from two consoles: one run and seven refusals by name in {right} of {times}"


def clicks(folder: Path, times: int) -> str:
    """Double clicks on one page, and clicks on the pages of two consoles one after the other."""
    right = {"double": 0, "two consoles": 0}
    with console(folder) as one, console(folder) as two, chromium() as browser:
        pages = [browser.open(one.link), browser.open(two.link)]
        for n in range(2 * times):
            for k, page in enumerate(pages):
                page.reload()
                page.evaluate("show('live')")
                page.put("#live-form [name=rig]", "rig.toml")
                page.put("#live-form [name=out]", f"click-{n}-{k}")
            before = len(Runs(folder).all())
            if n % 2:
                pages[0].click("#live-form button.go", times=2)
            else:
                for page in pages:
                    page.evaluate("document.querySelector('#live-form button.go').click()")
            pages[0].until("feed?.began")
            time.sleep(0.5)
            runs = Runs(folder).all()
            right["double" if n % 2 else "two consoles"] += len(runs) == before + 1
            for run in runs:
                if run.alive:
                    end(run)
    return f"one run each: {right['double']} of {times} double clicks, {right['two consoles']} of {times} two consoles"


def kills(folder: Path, times: int) -> str:
    missing = 0
    for k in range(times):
        run = Runs(folder).start({**LIVE, "out": f"kill-{k}.h5"})
        until(run, "spectrum")
        time.sleep(0.0137 * k % 0.1)
        end(run)
        data, at, shown = FeedReader(run.place, parts=99).read(1 << 26), 0, 0
        while at < len(data):
            length, kind = struct.unpack_from("<Ic", data, at)
            if kind == b"E":
                first, _, n, _, group = struct.unpack_from("<QQIHH", data, at + 5)
                shown = first + n * group
            at += 5 + length
        record = folder / f"kill-{k}.h5"
        words = [sys.executable, "-m", "ambid", "recover", f"{record}.journal"]
        subprocess.run(words, check=True, capture_output=True)
        missing += max(0, shown - read_record(record).n_samples)
    return f"{times} kills of the worker: {missing} samples shown and missing"


def freezes(folder: Path, times: int) -> str:
    slowest, told, ended = 0.0, 0, 0
    with console(folder) as served:
        page = served.open()
        for k in range(times):
            run = Runs(folder).start({**LIVE, "out": f"freeze-{k}.h5"})
            until(run, "line")
            pid = pid_of(run)
            os.kill(pid, signal.SIGSTOP)
            refused = page.say(run, "hold").get("error", "")
            began = time.monotonic()
            told += page.json("POST", "/api/stop", {})["delivered"] is False and "not delivered" in refused
            slowest = max(slowest, time.monotonic() - began)
            os.kill(pid, signal.SIGCONT)
            frames = until(run)
            orders = [(m["word"], m["done"]) for m in frames if m["kind"] == "order"]
            late = time.monotonic() + 20.0
            while run.alive and time.monotonic() < late:
                time.sleep(0.01)
            ended += orders == [("hold", False), ("stop", True)] and not run.alive
    return f"{times} freezes: not delivered {told}, within {slowest:.2f} s; on waking hold refused and stopped {ended}"


def stops(folder: Path, times: int) -> str:
    """Press Stop with the question of Accept open, in four sizes, by mouse, finger and key."""
    delivered: list[int] = []
    ways: list[Callable[[Page], object]] = [
        lambda p: p.click("#stop"), lambda p: p.click("#stop", tap=True), lambda p: p.key(".", ctrl=True)
    ]  # fmt: skip
    with console(folder) as served, chromium() as browser:
        page = browser.open(served.link)
        for k in range(times):
            width, height = SIZES[k % 4]
            run = Runs(folder).start({**LIVE, "out": f"stop-{k}.h5"})
            page.resize(width, height, touch=k % 3 == 1)
            page.reload()
            until(run, "line")
            page.until(f"feed?.id === '{run.id}' && feed.following && feed.lines.length > 5", 60.0)
            page.click("[data-say=accept]")
            page.until("!$('ask').hidden")
            page.evaluate(_PRESS)
            ways[k % 3](page)
            how, taken = page.until("window.said", 5.0)
            delivered += [taken] if how == "good" else []
            until(run)
            while run.alive:
                time.sleep(0.01)
    ordered = sorted(delivered)
    return (
        f"Stop in Chromium: delivered {len(ordered)} of {times}, median {ordered[len(ordered) // 2]} ms, most "
        f"{ordered[-1]} ms"
    )


def attacked(folder: Path, times: int) -> str:
    """Attack a console that runs, once whatever `times` says, and the runs that it begins by what its folder holds."""
    del times
    shown = lay_out(folder)
    over = Runs(shown).start({"job": "rig", "text": "no rig", "out": "new.toml"})
    until(over)
    with console(shown) as page:
        before, made = everything(shown), dict(attacks(page.open(), over.id))
        got = [name for name, raw in made.items() if through(answer(page, raw))]
        changed, wishes = everything(shown) != before, list(planted(page))
        for name, wish in wishes:
            with page.feed(page.json("POST", "/api/runs", wish)["id"]) as feed:
                frames = frames_of(feed)
            right = told(frames, "end")[0]["how"] == "refused" and SECRET.decode() not in str(frames)
            got += [] if right else [name]
    return (
        f"{len(made) + len(wishes)} attacks: {len(got)} got through{': ' if got else ''}{', '.join(got)}; "
        f"the folder is {'CHANGED' if changed else 'unchanged'}"
    )


if __name__ == "__main__":
    number = int(sys.argv[1]) if sys.argv[1:] else 20
    names = sys.argv[2:]  # of those that are wanted; without any, all
    for measure in (attacked, starts, clicks, kills, freezes, stops):
        if names and measure.__name__ not in names:
            continue
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as made:
            prototype_rig(Path(made))
            print(measure(Path(made), number), f"(load average {os.getloadavg()[0]:.1f})", flush=True)
