"""The console at real pace: what worker and server take, how soon a sample is a pixel, and whether anything grows.

``PYTHONPATH=. python bench/console.py [SECONDS]``: a record of an unstable bearing at 20 kHz is replayed, recorded and
tracked with its three signals, then eight signals are shown without tracking, then a simulated rotor with eight signals
is levitated and tracked; where Chromium is installed, a page watches. Before that, one axis of 20,000 samples is
identified in turn by the command and by a click on the page: the time until the verdict stands. Figures are printed;
none is asserted.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ambid import identify, simulate
from ambid.console.envelope import EnvelopeTap
from ambid.console.feed import FeedReader, FeedWriter, json_frames
from ambid.console.runs import Run, Runs
from ambid.physics.presets import preset
from ambid.record import read_record, write_record
from ambid.rig import write_rig
from ambid.rig.draft import rig_of_preset
from ambid.tracking.blocks import Block, Frame
from tests.console.browser import CHROMIUM, chromium
from tests.console.pages import Started, console, pid_of, prototype_rig
from tracking_benches import RATE, preset_bench, record_of

SIGNALS = 8
# a click on Identify, and the time until the frame that shows the verdict and the table, ms
_CLICK = """(() => {
  const old = document.querySelector("#detail h2.result"), began = performance.now();
  window.shownAfter = null;
  new MutationObserver((_, own) => {
    const head = document.querySelector("#detail h2.result");
    if (!head || head === old || !document.querySelector("#detail td.good")) return;
    own.disconnect();
    requestAnimationFrame(() => { window.shownAfter = performance.now() - began; });
  }).observe(document.body, { childList: true, subtree: true });
  [...document.querySelectorAll("#detail button")].find((b) => b.textContent === "Identify").click();
})()"""
BLOCK = 100
TICKS = os.sysconf("SC_CLK_TCK")


def main(seconds: float) -> None:
    with tempfile.TemporaryDirectory() as made:
        verdicts(Path(made), 7)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_record(record_of(preset_bench().samples("change", 1, seconds, 0.6 * seconds)), folder / "played.h5")
        write_rig(rig_of_preset(preset("unstable-bearing")), folder / "rig.toml")
        before = time.perf_counter()
        with console(folder) as page:
            page.open().ask("GET", "/")
            print(f"command to page: {time.perf_counter() - before:.2f} s")
            wish = {"job": "live", "rig": page.number("rig.toml"), "port": "replay:played.h5", "seconds": seconds}
            run = Runs(folder).one(page.json("POST", "/api/runs", {**wish, "pace": "real-time", "out": "run"})["id"])
            pid = pid_of(run)
            watched("20 kHz, 3 strips, tracked", page, run, pid, seconds)
            words = [said for said in told_by(run) if said["kind"] in ("summary", "recorded")]
            for said in words:
                print("  ", said.get("latency") or {k: said.get(k) for k in ("samples", "lost", "not_stored", "fault")})
            place = folder / ".ambid/runs" / f"{int(time.time()):010d}-000001"
            place.mkdir()
            (place / "spec.json").write_text('{"job": "live"}')
            writer = subprocess.Popen([sys.executable, __file__, "--write", str(place), str(min(seconds, 60.0))])
            time.sleep(1.0)
            watched(f"20 kHz, {SIGNALS} strips, envelopes alone", page, Run(place), writer.pid, min(seconds, 60.0))
            writer.wait()
            rotor(page, folder, min(seconds, 60.0))
    with tempfile.TemporaryDirectory() as made:
        killed(Path(made), 20)


def verdicts(folder: Path, times: int) -> None:
    """Identify by the command and from a page in turn: from the click, or the start, until the verdict is shown."""
    record, rig = folder / "axis.csv", folder / "axis.toml"
    for words in (
        ["simulate", "unstable-bearing", "--duration", "1", "--seed", "1", "-o", str(record)],
        ["init", str(record), "-o", str(rig)],
    ):
        subprocess.run([sys.executable, "-m", "ambid", *words], check=True, capture_output=True)
    if CHROMIUM is None:
        print("from click to verdict: not measured, Chromium is not installed")
        return
    took: dict[str, list[float]] = {"command": [], "page": []}
    with console(folder) as served, chromium() as browser:
        page = browser.open(served.link)
        page.click(page.with_text("#list tr", "axis.csv"))
        page.with_text("#detail button", "Identify")
        page.put("#detail [name=rig]", "axis.toml")
        for _ in range(times):
            before = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "ambid", "identify", str(record), "--rig", str(rig)],
                check=True,
                capture_output=True,
            )
            took["command"].append(time.perf_counter() - before)
            page.evaluate(_CLICK)
            took["page"].append(page.until("window.shownAfter", 60.0) / 1e3)
            page.until("!document.querySelector('#work').children.length && document.querySelector('.report a')", 120.0)
    command, clicked = (np.array(x) for x in took.values())
    ratio = clicked / command
    print(
        f"from click to verdict, {times} in turn: page {np.median(clicked):.2f} s, command {np.median(command):.2f} s,"
    )
    print(
        f"  ratio median {np.median(ratio):.2f}, most {ratio.max():.2f}; load average {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def rotor(page: Started, folder: Path, seconds: float) -> None:
    """Levitate a rotor of four axes at 20 kHz, recorded and tracked from an estimate."""
    rig = rig_of_preset(preset("utrc"))
    write_rig(rig, folder / "rotor.toml")
    identify(simulate(rig, duration=3.0, seed=1), rig).save(folder / "rotor.json")
    files = {"rig": page.number("rotor.toml"), "estimate": page.number("rotor.json")}
    wish = {"job": "live", "port": "simulated", "excitation": "multisine", "seconds": seconds, "pace": "real-time"}
    run = Runs(folder).one(page.json("POST", "/api/runs", {**wish, **files, "out": "rotor"})["id"])
    watched("20 kHz, rotor of 4 axes, 8 strips, orbits, tracked", page, run, pid_of(run), seconds)
    said = list(told_by(run))
    lags = [1e3 * x["lag_s"] for x in said if x["kind"] == "line"]
    kept = next(x for x in said if x["kind"] == "recorded")
    print(
        f"  block to parameters: median {np.median(lags):.0f} ms, most {max(lags):.0f} ms; {kept['lost']} samples lost"
    )


def killed(folder: Path, times: int) -> None:
    """Kill the console again and again while a simulated bench is recorded: is the run found again, and whole?"""
    wish = {"job": "live", "port": "simulated", "seconds": 3600.0, "amplitude": 1.4, "excitation": "multisine"}
    prototype_rig(folder)
    run, found = None, 0
    for _ in range(times):
        with console(folder) as page:
            page.open()
            if run is None:
                wish |= {"rig": page.number("rig.toml"), "out": "killed", "pace": "real-time"}
                run = Runs(folder).one(page.json("POST", "/api/runs", wish)["id"])
            with page.feed(run.id) as feed:
                begins = json_frames(feed.recv(timeout=20.0))[0]["kind"] == "begin"
            found += begins and next(r["alive"] for r in page.state()["runs"] if r["id"] == run.id)
    assert run is not None
    run.say("stop")
    kept = next(said for said in told_by(run) if said["kind"] == "recorded")
    samples = read_record(folder / "killed.h5").n_samples
    print(f"console killed {times} times: found again alive {found} times; {samples} of {kept['samples']} samples in")
    print(f"  the record, {kept['lost']} lost, {kept['not_stored']} not stored", flush=True)


def write(place: Path, seconds: float) -> None:
    """Stand for a worker: eight signals at 20 kHz as envelopes, at real pace."""
    Run(place).claim()
    view = SimpleNamespace(units={f"signal {k}": "V" for k in range(SIGNALS)}, rate_hz=RATE, block=lambda block: block)
    journal = SimpleNamespace(stored=True, written=2**62)
    tap, wave = EnvelopeTap(FeedWriter(place), view, journal), np.random.default_rng(1).normal(size=(BLOCK, SIGNALS))  # type: ignore[arg-type]
    begin, n = time.perf_counter(), 0
    while n < seconds * RATE:
        time.sleep(max(0.0, begin + (n + BLOCK) / RATE - time.perf_counter()))
        block = Block(first=n, time_s=n / RATE, values=wave + np.sin(n / RATE))
        tap.take(Frame(block=block, arrived_s=begin + (n + BLOCK) / RATE))
        n += BLOCK


def watched(name: str, page: Started, run: Run, pid: int, seconds: float) -> None:
    """Print what a run takes while it is watched."""
    with viewer(page, run) as view:
        rows, begin = [], time.perf_counter()
        while time.perf_counter() - begin < seconds and run.alive:
            time.sleep(min(seconds / 8, 60.0))
            with suppress(OSError, IndexError):  # over
                rows.append(
                    (
                        time.perf_counter(),
                        *used(pid),
                        *used(page.process.pid),
                        sum(f.stat().st_size for f in run.place.glob("feed-*")),
                    )
                )
        seen = view()
    print(f"{name}: {rows[-1][0] - rows[0][0]:.0f} s, load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    at = np.array(rows)
    for label, k in (("worker", 1), ("server", 3)):
        load, size = np.diff(at[:, k]) / np.diff(at[:, 0]), at[:, k + 1] / 2**20
        print(
            f"  {label}: {np.median(load):.3f} of a core (most {load.max():.3f}), {size[0]:.1f} to {size[-1]:.1f} MiB"
        )
    print(
        f"  feed: {at[-1, 5] / 2**20:.1f} MiB in {len(list(run.place.glob('feed-*')))} parts; page: {seen}", flush=True
    )


def used(pid: int) -> tuple[float, float]:
    """CPU time of a process, s, and its memory, bytes."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS, int(fields[21]) * os.sysconf("SC_PAGE_SIZE")


def told_by(run: Run) -> Iterator[dict[str, Any]]:
    reader, end = FeedReader(run.place), time.monotonic() + 60.0
    while time.monotonic() < end:
        for said in json_frames(reader.read()):
            yield said
            if said["kind"] == "end":
                return
        time.sleep(0.02)


@contextmanager
def viewer(page: Started, run: Run) -> Iterator[Any]:
    """Watch in Chromium, or by a client that takes everything and draws nothing."""
    if CHROMIUM is None:
        with page.feed(run.id):
            yield lambda: "none: Chromium is not installed"
        return
    with chromium() as browser:
        shown = browser.open()
        name, _, value = page.cookie.partition("=")
        shown.send("Network.setCookie", name=name, value=value, url=f"http://{page.host}/", httpOnly=True)
        shown.goto(f"http://{page.host}/#key={page.key}")
        shown.until("ambidConsole.feed?.updates > 0")
        first = shown.evaluate("[ambidConsole.feed.updates, performance.now()]")

        def seen() -> str:
            last = shown.evaluate("[ambidConsole.feed.updates, performance.now(), ambidConsole.feed.lags]")
            rate, lags = (last[0] - first[0]) / (last[1] - first[1]) * 1e3, 1e3 * np.array(last[2])
            low, high = np.percentile(lags, [50, 95])
            return f"{rate:.1f} updates/s, sample to pixel median {low:.0f} ms, 95 % {high:.0f} ms"

        yield seen


if __name__ == "__main__":
    if sys.argv[1:2] == ["--write"]:
        write(Path(sys.argv[2]), float(sys.argv[3]))
    else:
        main(float(sys.argv[1]) if sys.argv[1:] else 60.0)
