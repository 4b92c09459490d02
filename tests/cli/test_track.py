"""``ambid track``: options, what is printed and written, exit codes, interruption, keys; the job is a stand-in."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from ambid.errors import AmbidError
from ambid.recursive.lines import Event
from ambid.tracking.lines_file import read_track
from tests.conventions.sources import ROOT
from tests.tracking.tracks import track_of

SECONDS, EVERY = 12.0, 0.05


@pytest.fixture(scope="module")
def whole():
    return track_of(seconds=SECONDS, every_s=EVERY)


@pytest.fixture
def job(monkeypatch, whole):
    """Put a stand-in into the job's place; returns what it was called with, and lets a test change the track."""
    seen = {"track": whole, "flags back": []}

    def stand_in(record, rig, *, on_header, on_line, tick, **settings):
        seen.update(settings, record=record, rig=rig)
        tick("identify")
        track = seen["track"]
        on_header(track.header)
        for k, line in enumerate(track.lines):
            if seen.get("at") == k:
                seen["do"]()
            seen["flags back"] += on_line(line) or []
        return replace(track, lines=())

    monkeypatch.setattr(importlib.import_module("ambid.job.tracking"), "track", stand_in)
    return seen


@pytest.mark.drawn
def test_a_track_is_printed_written_and_drawn(bench, ambid, job, whole):
    words = ("--rig", "rig.toml", "--json", "track.jsonl", "--plot", "track.png", "--strict")
    found = ambid("track", "record.csv", *words)
    assert (found.code, found.err) == (0, "")
    assert "k_i  47." in found.out
    assert "change k_i: k_i fell by 15 %" in found.out
    assert "14 samples rejected in 1 place" in found.out
    assert read_track("track.jsonl") == whole
    assert (bench / "track.png").stat().st_size > 50_000
    assert job["rig"].model == "one-axis"


def test_options_reach_the_job(bench, ambid, job):
    words = "--start 0.02 --every 0.5 --limit 2 --memory 3.5 --pace real-time --from 0.01 --to 0.1 --rate 1e4"
    assert ambid("track", "record.csv", *words.split()).code == 0
    expected = {
        "start": 0.02, "every_s": 0.5, "limit": 2.0, "memory": 3.5, "pace": "real-time",
        "from_s": 0.01, "to_s": 0.1, "rate_hz": 1e4, "keep": False,
    }  # fmt: skip
    assert {name: job[name] for name in expected} == expected
    assert ambid("track", "record.csv").code == 0
    assert (job["memory"], job["every_s"], job["limit"], job["pace"]) == ("auto", 0.01, 1.5, "fastest")
    assert job["rig"] is None


REFUSED = {
    "memory": (["--memory", "long"], "--memory is 'long'; it must be 'auto', 'all' or a positive number"),
    "no memory": (["--memory", "0"], "--memory is 0.0; it must be"),
    "interval": (["--every", "0"], "--every is 0; it must be a positive"),
    "limit": (["--limit", "nan"], "--limit is nan; it must be a positive"),
    "flag": (["--flag", "3:hold"], "'ambid console', whose Live page plays a record too"),
    "pace": (["--pace", "slow"], "'--pace'"),
    "no seconds": (["--start", "-1"], "--start is -1.0; it must be a positive number"),
    "the record": (["--json", "record.csv"], "is also an input"),
    "the start": (["--start", "e.json", "--json", "e.json"], "is also an input"),
    "no picture": (["--plot", "track.jpeg"], "must end in .png"),
    "rig": (["--rig", "none.toml"], "none.toml does not exist"),
}


@pytest.mark.parametrize(("words", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_wrong_options_are_refused_before_any_work(bench, ambid, job, words, said):
    before = {p.name: p.read_bytes() for p in bench.iterdir()}
    found = ambid("track", "record.csv", *words)
    assert found.code == 2
    assert said in found.err
    assert len(found.err.splitlines()) == 1
    assert "record" not in job
    assert {p.name: p.read_bytes() for p in bench.iterdir()} == before


def test_lines_of_json_on_standard_output_come_alone(bench, ambid, job, whole):
    found = ambid("track", "record.csv", "--json", "-")
    assert (found.code, found.err) == (0, "")
    rows = [json.loads(row) for row in found.out.splitlines()]
    assert len(rows) == len(whole.lines) + 2
    assert rows[0]["schema"] == "ambid.track/1"
    assert rows[-1]["summary"]["complete"] is True


def test_strict_ends_with_3_where_something_is_left_open(bench, ambid, job, whole):
    n = next(k for k, x in enumerate(whole.lines) if x.state == "frozen")
    unanswered = [replace(x, events=tuple(e for e in x.events if e.kind != "accepted")) for x in whole.lines]
    off = replace(whole.lines[-1], error=1.7)
    for lines, said in (
        (whole.lines[: n + 3], "without excitation"),
        (unanswered, "not followed"),
        ((*whole.lines[:-1], off), "above the limit"),
    ):
        job["track"] = replace(whole, lines=tuple(lines))
        lenient, strict = ambid("track", "record.csv"), ambid("track", "record.csv", "--strict")
        assert (lenient.code, strict.code) == (0, 3)
        assert said in " ".join(strict.out.split())


@pytest.mark.drawn
def test_ctrl_c_keeps_the_track_and_says_so(bench, ambid, job, whole):
    job.update(at=100, do=lambda: os.kill(os.getpid(), signal.SIGINT))
    before = signal.getsignal(signal.SIGINT)
    found = ambid("track", "record.csv", "--json", "track.jsonl", "--plot", "track.png")
    assert found.code == 130
    assert found.err == "ambid: interrupted at 5.05 s of record; track.jsonl and track.png hold the track so far\n"
    assert "stopped before its end" in found.out
    kept = read_track("track.jsonl")
    assert kept.lines == whole.lines[:101]
    assert kept.totals.complete is False
    assert len(kept.totals.changes) == 1
    assert json.loads((bench / "track.jsonl").read_text().splitlines()[-1]).keys() == {"verdict", "summary"}
    assert (bench / "track.png").stat().st_size > 50_000
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_ctrl_c_does_not_wait_for_the_next_line(bench, ambid, job, whole):
    def twice():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    job.update(at=100, do=twice)
    found = ambid("track", "record.csv", "--json", "track.jsonl")
    assert found.code == 130
    assert read_track("track.jsonl").lines == whole.lines[:100]


def test_a_signal_to_terminate_also_keeps_the_track(bench, ambid, job, whole):
    job.update(at=50, do=lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert ambid("track", "record.csv", "--json", "track.jsonl").code == 143
    assert read_track("track.jsonl").lines == whole.lines[:51]


def test_ctrl_c_before_the_first_line_leaves_nothing(bench, ambid, monkeypatch):
    def stand_in(*words, tick, **settings):
        tick("identify")
        os.kill(os.getpid(), signal.SIGINT)
        tick("identify")

    monkeypatch.setattr(importlib.import_module("ambid.job.tracking"), "track", stand_in)
    before = sorted(p.name for p in bench.iterdir())
    found = ambid("track", "record.csv", "--json", "track.jsonl")
    assert (found.code, found.out, found.err) == (130, "", "ambid: interrupted; nothing was written\n")
    assert sorted(p.name for p in bench.iterdir()) == before


def test_an_error_on_the_way_leaves_a_file_that_says_so(bench, ambid, job, whole):
    def fails():
        raise AmbidError("the disk has gone. Bring it back")

    job.update(at=30, do=fails)
    found = ambid("track", "record.csv", "--json", "track.jsonl", "--plot", "track.png")
    assert (found.code, found.out, found.err) == (2, "", "ambid: the disk has gone. Bring it back\n")
    kept = read_track("track.jsonl")
    assert kept.lines == whole.lines[:30]
    assert not kept.totals.complete
    assert not (bench / "track.png").exists()


def test_a_record_shorter_than_an_interval_is_refused(bench, ambid, job, whole):
    job["track"] = replace(whole, lines=())
    found = ambid("track", "record.csv")
    assert found.code == 2
    assert "shorter --every" in found.err


def test_routine_decisions_do_not_bury_a_change(bench, ambid, job, whole):
    def more(k):
        why = f"gap number {k}."
        routine = Event(kind="accepted", t=0.05 * k, why=f"routine {k}.")
        return (routine, Event(kind="rejected", t=0.05 * k, why=why, samples=3))

    lines = [replace(x, events=(*x.events, *more(k))) for k, x in enumerate(whole.lines)]
    job["track"] = replace(whole, lines=tuple(lines))
    found = ambid("track", "record.csv", "--json", "track.jsonl")
    assert found.out.count("gap number") == 1
    assert "gap number 239." in found.out
    assert "routine 239." in found.out
    assert found.out.index("change k_i: ") < found.out.index("routine ")
    assert found.out.count("routine ") == 2  # the first after the change, and the last
    assert len(read_track("track.jsonl").lines[100].events) == 2  # nothing is left out there


def test_truth_in_the_record_is_drawn(bench, ambid, job, capsys, monkeypatch):
    from ambid.job.following import truth_beside
    from ambid.report import track_figures

    rows = "\n".join(f"{k / 100},{k},{1600 + k},5" for k in range(50))
    (bench / "true.csv").write_text(f"time [s],voltage [V],true_R [mohm],true_m [V]\n{rows}\n".replace("mohm", "ohm"))
    found = truth_beside(bench / "true.csv", None, {"R": "ohm", "m": "kg"})
    assert list(found) == ["R"]
    assert found["R"][0][3] == pytest.approx(0.03)
    assert found["R"][1][3] == pytest.approx(1603.0)
    assert "'true_m' is in [V], the tracked number in [kg]" in capsys.readouterr().err
    assert truth_beside(bench / "record.csv", None, {"R": "ohm"}) == {}
    given = {}
    drawn = track_figures.track_figure
    monkeypatch.setattr(
        track_figures, "track_figure", lambda h, truth, **form: given.update(truth) or drawn(h, truth=truth, **form)
    )
    assert ambid("track", "true.csv", "--plot", "t.png").code == 0
    assert list(given) == ["R"]


ON_A_TERMINAL = f"""
import fcntl, importlib, sys, termios, time
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.path.insert(0, {str(ROOT)!r})
from tests.tracking.tracks import track_of
job = importlib.import_module("ambid.job.tracking")
def stand_in(record, rig, *, on_header, on_line, **settings):
    track = track_of(seconds=600.0, every_s=1.0, names=("R",))
    on_header(track.header)
    for line in track.lines:
        on_line(line)
        time.sleep(0.05)
job.track = stand_in
from ambid.cli import main
main(["track", "record.csv", "--json", "track.jsonl", *sys.argv[1:]])
"""


def on_a_terminal(folder, talk, *words):
    """Run the command on a pseudo-terminal: exit code, what it showed, whether the terminal is as before."""
    import pty
    import select
    import termios

    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    job = subprocess.Popen(
        [sys.executable, "-c", ON_A_TERMINAL, *words],
        stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, cwd=folder,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "90", "LINES": "40"},
    )  # fmt: skip
    shown, until = "", time.monotonic() + 60
    while job.poll() is None and time.monotonic() < until:
        if select.select([ours], [], [], 0.05)[0]:
            shown += os.read(ours, 65536).decode("utf-8", "replace")
        if talk and talk[0][0] in shown:
            os.write(ours, talk.pop(0)[1])
    while select.select([ours], [], [], 0.1)[0]:
        shown += os.read(ours, 65536).decode("utf-8", "replace")
    after = termios.tcgetattr(theirs)
    job.kill()
    os.close(ours)
    os.close(theirs)
    return job.returncode, shown, before == after


@pytest.mark.skipif(sys.platform == "win32", reason="terminals as POSIX has them")
def test_ctrl_c_on_a_terminal_leaves_it_as_before(bench):
    code, shown, same = on_a_terminal(bench, [("model error", b"\x03")])
    assert (code, same) == (130, True)
    assert "track.jsonl holds the track so far" in " ".join(shown.split())
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h")  # the cursor is shown again
