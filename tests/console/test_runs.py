"""Runs of a console: jobs of one record, a live bench that no dying console disturbs, and who orders it."""

import shutil
import time

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")

from ambid.console.envelope import spectrum
from ambid.console.feed import FeedReader, FeedWriter, json_frames, whole_frames
from ambid.console.runs import Runs
from ambid.job import load
from ambid.record import read_record
from tests.console.pages import console, prototype_rig, told, until


def test_a_feed_is_read_as_it_was_written_and_old_parts_go(tmp_path):
    feed = FeedWriter(tmp_path, part_bytes=2000, kept=3)
    feed.tell("head", {"a": 1}, sticky="head")
    for k in range(200):
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
    assert found[0] == {"kind": "head", "a": 1}  # any part can be read alone


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
    hz, (amplitude, other) = spectrum(np.column_stack([3.0 * np.sin(2 * np.pi * 125.0 * t), 0 * t]), 4000.0)
    assert amplitude.max() == pytest.approx(3.0, rel=1e-3)
    assert hz[np.argmax(amplitude)] == pytest.approx(125.0, abs=1.0)
    assert other.max() == 0.0


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folder")
    prototype_rig(folder)
    return folder


def test_a_record_is_identified_from_the_page(bench, tmp_path):
    from ambid import simulate

    for file in bench.iterdir():
        shutil.copy(file, tmp_path)
    from ambid.record import write_record

    write_record(simulate("thesis", duration=0.5, seed=1), tmp_path / "rec.csv")
    with console(tmp_path) as page:
        page.open()
        begun = page.json("POST", "/api/runs", {"job": "preview", "record": page.number("rec.csv")})
        seen = until(Runs(tmp_path).one(begun["id"]))
        (shown,) = told(seen, "preview")
        assert [c["name"] for c in shown["channels"]] == ["voltage", "current", "position"]
        wish = {"job": "rig", "text": shown["draft"], "out": "drafted"}
        assert told(until(Runs(tmp_path).one(page.json("POST", "/api/runs", wish)["id"])), "end")[0]["how"] == "done"
        wish = {"job": "identify", "record": page.number("rec.csv"), "rig": page.number("drafted.toml"), "out": "found"}
        seen = until(Runs(tmp_path).one(page.json("POST", "/api/runs", wish)["id"]))
        assert told(seen, "result")[0]["verdict"] == load(tmp_path / "found.json").verdict.word
        assert {"found.json", "found.html"} <= {f["name"] for f in page.state()["files"]}
        assert page.json("POST", "/api/runs", wish)["error"].startswith("found.json already exists")
        wrong = {"job": "rig", "text": 'schema = "ambid.rig/1"\nmodle = "x"', "out": "wrong"}
        end = told(until(Runs(tmp_path).one(page.json("POST", "/api/runs", wrong)["id"])), "end")[0]
        assert end["how"] == "refused"
        assert "modle" in end["why"]
        assert not (tmp_path / "wrong.toml").exists()


def test_a_live_run_outlives_its_consoles_and_obeys_one_page(bench):
    wish = {"job": "live", "port": "simulated", "seconds": 9.0, "amplitude": 1.4, "excitation": "multisine"}
    run = None
    for k in range(5):
        with console(bench) as page:
            page.open()
            if run is None:
                started = page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "run"})
                run = Runs(bench).one(started["id"])
                second = page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "two"})
                assert "under way" in second["error"]
            (found,) = [r for r in page.state()["runs"] if r["id"] == run.id]
            assert found["alive"]
            path = f"/api/runs/{run.id}/say"
            assert page.ask("POST", path, {"word": "hold" if k == 0 else "track"}).status == 200
            other = page.ask("POST", path, {"word": "accept"}, headers={"X-Ambid": "page-2"})
            assert b"another page has the machine" in other.body
            with page.feed(run.id) as feed:
                assert json_frames(feed.recv(timeout=5))[0]["kind"] == "begin"
            # the console is killed here
    seen = until(run)
    assert told(seen, "end")[0]["how"] == "done", seen[-3:]
    (kept,) = told(seen, "recorded")
    record = read_record(bench / "run.h5")
    assert kept["lost"] == kept["not_stored"] == 0
    assert record.n_samples == kept["samples"] == 18_000
    names = told(seen, "signals")[0]["names"]
    assert set(names) == {"voltage", "position", "current"}
    assert told(seen, "line")
    end = time.monotonic() + 20.0
    while run.alive and time.monotonic() < end:
        time.sleep(0.05)
    assert not run.alive


def test_anybody_may_stop_and_what_came_is_kept(bench):
    with console(bench) as page:
        page.open()
        wish = {"job": "live", "port": "simulated", "seconds": 600.0, "amplitude": 1.4, "excitation": "multisine"}
        run = Runs(bench).one(
            page.json("POST", "/api/runs", {**wish, "rig": page.number("rig.toml"), "out": "long"})["id"]
        )
        assert told(until(run, "spectrum"), "spectrum")  # a second was recorded
        stop = page.ask("POST", f"/api/runs/{run.id}/say", {"word": "stop"}, headers={"X-Ambid": "page-2"})
        assert stop.status == 200
        seen = until(run, "end")
        assert told(seen, "end")
    (kept,) = told(seen, "recorded")
    assert read_record(bench / "long.h5").n_samples == kept["samples"] > 2000
