"""Runs of a console: jobs of one record, a live bench that no dying console disturbs, and who orders it."""

import os
import shutil
import signal
import subprocess
import sys
import time
from io import FileIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")

from ambid.console.envelope import spectrum
from ambid.console.feed import FeedReader, FeedWriter, json_frames, whole_frames
from ambid.console.runs import Runs
from ambid.console.worker import _Lines
from ambid.errors import AmbidError
from ambid.job import load
from ambid.record import read_record
from ambid.rig import rig_from_text
from tests.console.pages import console, frames_of, pid_of, prototype_rig, told, until
from tests.tracking.tracks import track_of


def test_a_feed_is_read_as_it_was_written_and_old_parts_go(tmp_path):
    feed = FeedWriter(tmp_path, part_bytes=2000, kept=3)
    feed.tell("head", {"a": 1}, sticky="head")
    sent = []
    feed.keep("state", lambda: {"sent": len(sent)})
    for k in range(200):
        sent.append(k)
        feed.tell("n", {"k": k})
        feed.envelope(bytes(50))
    reader, found = FeedReader(tmp_path, parts=99), []
    while data := reader.read(300):
        assert whole_frames(data) == len(data)
        found += json_frames(data)
    numbers = [m["k"] for m in told(found, "n")]
    assert numbers == list(range(numbers[0], 200))
    assert numbers[0] > 0
    assert len(list(tmp_path.glob("feed-*"))) <= 3
    assert found[0] in [{"kind": "state", "sent": n} for n in (numbers[0], numbers[0] + 1)]  # as known by then
    assert found[1] == {"kind": "head", "a": 1}  # any part can be read alone


def test_a_page_that_comes_late_is_told_what_went_before(tmp_path):
    track = track_of(seconds=12.0, every_s=0.05)
    feed = FeedWriter(tmp_path, part_bytes=100)  # each frame in a part of its own
    lines = _Lines(SimpleNamespace(feed=feed, follow=lambda *, on: None, flags=[]), orders=True)
    lines.header(track.header)
    for line in track.lines:
        lines.line(line)
    feed.envelope(bytes(50))
    frames = json_frames(FeedReader(tmp_path, parts=1).read())
    assert [m["kind"] for m in frames].index("told") < [m["kind"] for m in frames].index("line")  # as the page reads it
    (known,) = told(frames, "told")
    changes = [e for x in track.lines for e in x.events if e.kind == "change"]
    assert [e["t"] for e in known["events"] if e["what"] == "change"] == [e.t for e in changes] != []


def test_half_a_frame_waits_for_the_rest(tmp_path):
    feed = FeedWriter(tmp_path)
    feed.tell("one", {})
    path = next(tmp_path.glob("feed-*"))
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:7])
    reader = FeedReader(tmp_path)
    assert reader.read() == whole
    assert reader.read() == b""
    path.write_bytes(whole + whole)
    assert reader.read() == whole


def test_a_spectrum_shows_the_peak_of_a_sine():
    t = np.arange(4000) / 4000.0
    hz, (amplitude, other) = spectrum(np.vstack([3.0 * np.sin(2 * np.pi * 125.0 * t), 0 * t]), 4000.0)
    assert amplitude.max() == pytest.approx(3.0, rel=1e-3)
    assert hz[np.argmax(amplitude)] == pytest.approx(125.0, abs=1.0)
    assert other.max() == 0.0


def test_a_disk_that_takes_nothing_stops_no_run_and_is_told(tmp_path, monkeypatch):
    whole, frames = FileIO.write, []

    class Full(FileIO):
        def write(self, data):
            return whole(self, data if room[0] else data[:3])

    room = [True]
    monkeypatch.setattr("ambid.console.feed.FileIO", Full)
    feed, reader = FeedWriter(tmp_path, part_bytes=400), FeedReader(tmp_path)
    feed.tell("head", {}, sticky="head")
    for k in range(30):
        room[0] = k % 10 < 5
        feed.tell("n", {"k": k})
        frames += json_frames(reader.read())
    assert [m["k"] for m in told(frames, "n")] == [k for k in range(30) if k % 10 < 5]
    assert [m["text"][:11] for m in told(frames, "note")] == ["5 messages ", "5 messages "]
    shutil.rmtree(tmp_path)
    for k in range(50):  # parts cannot be opened any more
        feed.tell("n", {"k": k})


def test_a_worker_that_dies_or_whose_folder_goes_is_told(tmp_path):
    (tmp_path / "other").mkdir()
    for folder in (tmp_path, tmp_path / "other"):
        prototype_rig(folder)
    wish = {"job": "live", "port": "simulated", "seconds": 600.0, "amplitude": 1.4, "excitation": "multisine",
            "rig": "rig.toml", "pace": "real-time"}  # fmt: skip
    gone = Runs(tmp_path / "other").start({**wish, "out": "gone.h5"})
    with console(tmp_path) as page:
        page.open()
        run = Runs(tmp_path).one(page.json("POST", "/api/runs", {"job": "rig", "text": "x", "out": "x"})["id"])
        until(run)
        killed = Runs(tmp_path).start({**wish, "out": "killed.h5"})
        until(killed, "spectrum")
        with page.feed(killed.id) as feed:
            os.kill(pid_of(killed), signal.SIGKILL)
            seen = frames_of(feed)  # to its end
        assert told(seen, "spectrum")
        assert not told(seen, "end")
    assert not killed.alive
    words = [sys.executable, "-m", "ambid", "recover", tmp_path / "killed.h5.journal"]
    assert subprocess.run(words, check=False, capture_output=True).returncode == 0
    assert read_record(tmp_path / "killed.h5").n_samples > 1900
    until(gone, "spectrum")
    shutil.rmtree(gone.place)
    end = time.monotonic() + 20.0
    while not (tmp_path / "other" / "gone.h5").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert read_record(tmp_path / "other" / "gone.h5").n_samples > 1900


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folder")
    prototype_rig(folder)
    return folder


def test_a_record_is_identified_from_the_page(bench, tmp_path):
    from ambid import simulate

    for file in filter(Path.is_file, bench.iterdir()):  # another test's console may have run there
        shutil.copy(file, tmp_path)
    from ambid.record import write_record

    write_record(simulate("thesis", duration=0.5, seed=1), tmp_path / "rec.csv")
    with console(tmp_path) as page:
        page.open()
        begun = page.json("POST", "/api/runs", {"job": "preview", "record": page.number("rec.csv")})
        with page.feed(begun["id"]) as feed:
            (shown,) = told(frames_of(feed), "preview")
        assert not (tmp_path / ".ambid").exists()  # of a look nothing stays
        assert "channels.position" in shown["draft"]
        wish = {"job": "rig", "text": shown["draft"], "out": "drafted"}
        assert told(until(Runs(tmp_path).one(page.json("POST", "/api/runs", wish)["id"])), "end")[0]["how"] == "done"
        wish = {"job": "identify", "record": page.number("rec.csv"), "rig": page.number("drafted.toml"), "out": "found"}
        seen = until(Runs(tmp_path).one(page.json("POST", "/api/runs", wish)["id"]))
        assert told(seen, "result")[0]["content"]["verdict"] == load(tmp_path / "found.json").verdict.word
        assert {"found.json", "found.html"} <= {f["name"] for f in page.state()["files"]}
        again = until(Runs(tmp_path).one(page.json("POST", "/api/runs", wish)["id"]), "result")
        assert told(again, "result")[0]["name"] == "found-2"
        for text, why in (('modle = "x"', "modle"), (ELSEWHERE.format("/etc/passwd"), "is outside of")):
            wrong = {"job": "rig", "text": f'schema = "ambid.rig/1"\n{text}', "out": "wrong"}
            end = told(until(Runs(tmp_path).one(page.json("POST", "/api/runs", wrong)["id"])), "end")[0]
            assert end["how"] == "refused"
            assert why in end["why"]
            while any(r["alive"] for r in page.state()["runs"]):
                time.sleep(0.05)
            assert end["why"][:400] in [r["why"] for r in page.state()["runs"] if r["end"] == "refused"]
            assert not (tmp_path / "wrong.toml").exists()


def test_a_ledger_is_shown_over_time_without_numbers_that_are_not_known(tmp_path):
    pytest.importorskip("sqlalchemy", reason="the extra [fleet] is not installed")
    from ambid.console.views import drawn
    from ambid.ledger import open_ledger
    from tests.ledger.entries import entry, parameter

    hidden = (parameter("k_i", 80.0, 0.5), parameter("R", 4.2, 0.1, seen=False), parameter("L", 0.1, 0.0, role="fixed"))
    bad = [entry(0), entry(1, parameters=hidden), entry(2, verdict="unusable", failed=("white",), rig="two")]
    with open_ledger(tmp_path / "works.db") as ledger:
        ledger.add([*bad, entry(0, 'B"; DROP TABLE value')])
    (tmp_path / "other.db").write_bytes(b"SQLite format 3\0" + bytes(4080))
    before = sorted(tmp_path.iterdir())
    with console(tmp_path, "--read-only") as page:
        page.open()

        def look(name, **more):
            wish = {"job": "history", "ledger": page.number(name), **more}
            with page.feed(page.json("POST", "/api/previews", wish)["id"]) as feed:
                return frames_of(feed)

        seen = look("works.db", bearing='B"; DROP TABLE value')
        assert told(seen, "bearings")[0]["names"] == ["A", 'B"; DROP TABLE value']
        assert told(seen, "history")[0]["bearing"] == 'B"; DROP TABLE value'
        assert "is not a ledger" in told(look("other.db"), "end")[0]["why"]
        assert page.ask("POST", "/api/previews", {"job": "history"}).status == 400
    with open_ledger(tmp_path / "works.db", write=False) as ledger:
        found = ledger.history("A")
        a = drawn(found)
    assert sorted(tmp_path.iterdir()) == before
    assert [a["bearing"], found.verdict.word, len(a["estimates"])] == ["A", "caution", 3]
    assert a["series"]["k_i"]["value"] == [80.0, 80.0, None]
    assert a["series"]["R"]["value"] == [4.2, None, None]
    assert a["series"]["R"]["half"][1:] == [None, None]
    assert a["series"]["R"]["verdict"] == ["usable", "hidden", "unusable"]
    assert "L" not in a["series"]
    assert [e["kind"] for e in a["events"]] == ["rig"]


ELSEWHERE = 'model = "one-axis"\n[channels.voltage]\ncolumn = "duty"\ntable = "{}"\n'


@pytest.mark.parametrize(
    "name", ["../outside.csv", "{outside}", "linked.csv", "sub/../../outside.csv", "way/outside.csv"]
)
def test_tables_of_a_rig_lie_in_the_folder(tmp_path, monkeypatch, name):
    shown, outside = tmp_path / "shown", tmp_path / "outside.csv"
    (shown / "sub").mkdir(parents=True)
    outside.write_text("duty [1],voltage [V]\n0,0\n1,12\n", encoding="utf-8")
    shutil.copy(outside, shown / "inside.csv")
    (shown / "linked.csv").symlink_to(outside)
    (shown / "way").symlink_to(tmp_path)
    monkeypatch.setattr("ambid.record.record.INSIDE", [shown])
    rig = f'schema = "ambid.rig/1"\n{ELSEWHERE}'
    with pytest.raises(AmbidError, match="is outside of"):
        rig_from_text(rig.format(name.format(outside=outside)), shown / "rig.toml")
    with pytest.raises(AmbidError, match=r"channels\.(current|position)"):  # the table is none of its faults
        rig_from_text(rig.format("sub/../inside.csv"), shown / "rig.toml")


def test_a_live_run_outlives_its_consoles_and_obeys_one_page(bench):
    wish = {"job": "live", "port": "simulated", "seconds": 600.0, "amplitude": 1.4, "excitation": "multisine"}
    run = None
    for k in range(3):
        with console(bench) as page:
            page.open()
            if run is None:
                started = page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "run"})
                run = Runs(bench).one(started["id"])
                until(run, "beat")
                assert "tracks nothing now" in page.say(run, "accept")["error"]
                until(run, "header")
                second = page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "two"})
                assert "in use by the run live run.h5, started by page page-1" in second["error"]
            (found,) = [r for r in page.state()["runs"] if r["id"] == run.id]
            assert found["alive"]
            if k == 0:
                assert page.say(run, "hold") == {"delivered": True}
                assert "page page-1 of the console at" in page.say(run, "accept", page="page-2")["error"]
            with page.feed(run.id) as feed:
                assert json_frames(feed.recv(timeout=5))[0]["kind"] == "begin"
            # the console is killed here
    run.say("stop")
    seen = until(run)
    assert told(seen, "end")[0]["how"] == "done", seen[-3:]
    (kept,) = told(seen, "recorded")
    record = read_record(bench / "run.h5")
    assert kept["lost"] == kept["not_stored"] == 0
    assert record.n_samples == kept["samples"] > 4_000
    names = told(seen, "signals")[0]["names"]
    assert set(names) == {"voltage", "position", "current"}
    assert told(seen, "line")
    end = time.monotonic() + 20.0
    while run.alive and time.monotonic() < end:
        time.sleep(0.05)
    assert not run.alive
    with console(bench) as page:
        assert "the run is over" in page.open().say(run, "hold")["error"]


def test_a_stopped_commissioning_tells_what_was_reached_and_takes_no_word_of_tracking(bench):
    with console(bench) as page:
        wish = {"job": "commission", "port": "simulated", "seconds": 4.0, "rig": page.open().number("rig.toml")}
        run = Runs(bench).one(page.json("POST", "/api/runs", {**wish, "out": "halted"})["id"])
        for word in ("hold", "track", "accept", "revert"):
            assert "is for a run of live" in page.say(run, word)["error"]
        (asked,) = told(until(run, "ask"), "ask")
        old = page.say(run, "go", number=asked["number"] - 1)  # an answer to another question is none
        assert "no longer asked" in old["error"]
        beats = told(until(run, "beat"), "beat")
        assert beats, "a run that waits is not silent"
        assert page.say(run, "go", number=asked["number"]) == {"delivered": True}
        until(run, "beginning", of={"name": "levitate"})
        assert page.say(run, "stop") == {"delivered": True}
        seen = until(run)
        (made,) = told(seen, "commissioned")
        names = ["self-test", "rest", "polarity", "levitate"]  # it may be over before the word comes
        assert made["reached"] in [f"{n} of 9 steps were good enough: {', '.join(names[:n])}" for n in (3, 4)]
        assert (bench / made["report"]).stat().st_size > 10_000
        assert [(m["how"], made["reached"] in m["why"]) for m in told(seen, "end")] == [("cancelled", True)]
        assert all(p["image"].startswith("data:image/svg+xml") for m in told(seen, "step") for p in m["pictures"])


def test_anybody_may_stop_and_what_came_is_kept(bench):
    with console(bench) as page:
        page.open()
        wish = {"job": "live", "port": "simulated", "seconds": 600.0, "amplitude": 1.4, "excitation": "multisine"}
        answer = page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "long"})
        assert "id" in answer, answer
        run = Runs(bench).one(answer["id"])
        assert told(until(run, "spectrum"), "spectrum")  # a second was recorded
        stop = page.ask("POST", f"/api/runs/{run.id}/say", {"word": "stop"}, headers={"X-Ambid": "page-2"})
        assert stop.status == 200
        seen = until(run, "end")
        assert told(seen, "end")
    (kept,) = told(seen, "recorded")
    assert read_record(bench / "long.h5").n_samples == kept["samples"] > 2000
