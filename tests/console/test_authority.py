"""One run has the machine and one page orders it; what a page was shown is kept; a full disk ends a run in words."""

import asyncio
import errno
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")

from ambid.console import runs
from ambid.console.authority import Lease, Machine
from ambid.console.envelope import EnvelopeTap
from ambid.console.feed import FeedReader, FeedWriter, json_frames
from ambid.console.orders import Desk, Order, acknowledge, acknowledged
from ambid.console.runs import Heard, Run, Runs
from ambid.console.server import _answered
from ambid.console.slot import Slot
from ambid.console.worker import Worker
from ambid.errors import AmbidError
from ambid.record import read_record
from ambid.tracking.blocks import Block, Frame
from tests.console.pages import LIVE, Started, console, over, pid_of, prototype_rig, told, until


def test_eight_starts_from_two_consoles_give_one_run_and_seven_refusals_by_name(tmp_path):
    prototype_rig(tmp_path)
    with console(tmp_path) as one, console(tmp_path) as two, ThreadPoolExecutor(8) as clients:
        pages = [one.open(), two.open()]
        wish = {**LIVE, "rig": one.number("rig.toml")}
        two.number("rig.toml")

        def start(k):
            return pages[k % 2].json(
                "POST", "/api/runs", {**wish, "out": f"run-{k % 4}"}, headers={"X-Ambid": f"page-{k}"}
            )

        answers = list(clients.map(start, range(8)))
        (started,) = [a["id"] for a in answers if "id" in a]
        refusals = [a["error"] for a in answers if "error" in a]
        assert len(refusals) == 7
        assert all("the bench of this folder is in use by the run live run-" in why for why in refusals)
        assert all("started by page page-" in why and "of the console at 127.0.0.1:" in why for why in refusals)
        run = Runs(tmp_path).one(started)
        assert [r.id for r in Runs(tmp_path).all()] == [started]
        until(run, "begin")
        os.kill(pid_of(run), signal.SIGKILL)  # its locks die with it
        assert over(run)
        again = start(0)
        run = Runs(tmp_path).one(again["id"])
        assert one.ask("POST", "/api/stop", {}).status == 200
        assert told(until(run), "end")


def test_a_run_that_another_console_begins_right_now_is_not_taken_for_over(tmp_path):
    begun = Runs(tmp_path)
    place = tmp_path / ".ambid" / "runs" / f"{int(time.time()):010d}-00000a"
    place.mkdir(parents=True)
    with console(tmp_path) as page:
        assert [r["alive"] for r in page.open().state()["runs"]] == [False]
        (place / "spec.json").write_text('{"job": "live"}', encoding="utf-8")
        begun.one(place.name).claim()  # as its process does
        assert [r["alive"] for r in page.state()["runs"]] == [True]


def test_a_port_is_locked_for_all_folders_by_what_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    (tmp_path / "ttyX").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyX")
    one = Machine(tmp_path / "a", str(tmp_path / "ttyX"))
    one.seize({"job": "live", "out": "run.h5", "by": "page 1"})
    other = Machine(tmp_path / "b", str(tmp_path / "by-id"))
    with pytest.raises(AmbidError, match=r"the port .*by-id is in use by the run live run\.h5, started by page 1"):
        other.seize({})
    assert other.locks == []
    one.release()
    other.seize({})
    other.release()


def test_a_start_that_fails_gives_the_machine_back(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patched:
        patched.setattr("ambid.console.slot._put", full)
        with pytest.raises(OSError, match="no space left"):
            Runs(tmp_path).start(LIVE)
    with monkeypatch.context() as patched:
        patched.setattr("ambid.console.runs._write", lambda path, _: full() if path.name == "process.json" else None)
        with pytest.raises(OSError, match="no space left"):
            Runs(tmp_path).start(LIVE)
    assert runs._CHILDREN[-1].wait(timeout=10.0) == -signal.SIGKILL
    machine = Machine(tmp_path, "simulated")
    machine.seize({})  # by another start, once there is room again
    machine.release()


def test_stop_reaches_a_run_that_begins_and_one_behind_many_newer_ones(tmp_path):
    prototype_rig(tmp_path)
    (tmp_path / ".ambid" / "runs").mkdir(parents=True)
    machine = Machine(tmp_path, "simulated")
    with console(tmp_path) as page:
        page.open()
        assert page.json("POST", "/api/stop", {}) == {"runs": [], "delivered": True}
        machine.seize({})
        assert "a run has the bench and cannot be reached" in page.json("POST", "/api/stop", {})["error"]
        with ThreadPoolExecutor(1) as clients:
            stop = clients.submit(page.json, "POST", "/api/stop", {})
            time.sleep(0.1)
            run = Runs(tmp_path)._begin({**LIVE, "out": "run.h5"}, machine, "", "")
            machine.release()
            assert stop.result()["runs"] == [run.id]
        until(run, "begin")
        for k in range(60):
            (tmp_path / ".ambid" / "runs" / f"{9_000_000_000 + k}-000000").mkdir()
        assert run.id in [r["id"] for r in page.state()["runs"] if r["alive"]]
        assert page.json("POST", "/api/stop", {})["runs"] == [run.id]
        assert told(until(run), "end")


def test_a_run_that_was_told_to_stop_and_froze_is_not_said_to_have_taken_it_again(tmp_path):
    run = Run(tmp_path)
    desk = Desk(tmp_path)
    desk.beat()
    desk.note(stopping=True)
    assert asyncio.run(_answered(run, "x", stop=True)) == {"done": True}
    desk.note(at=time.monotonic() - 9.0)
    assert asyncio.run(_answered(run, "x", stop=True)) is None


def test_a_start_that_waited_in_a_frozen_console_is_refused_when_it_wakes(tmp_path):
    prototype_rig(tmp_path)
    with console(tmp_path) as page:
        wish = {**LIVE, "rig": page.open().number("rig.toml"), "out": "late", "now": page.state()["now"]}
        page.process.send_signal(signal.SIGSTOP)
        try:
            with ThreadPoolExecutor(1) as clients:
                start = clients.submit(page.json, "POST", "/api/runs", wish)
                time.sleep(5.5)
                page.process.send_signal(signal.SIGCONT)
                assert "the start waited too long" in start.result()["error"]
        finally:
            page.process.send_signal(signal.SIGCONT)
        assert Runs(tmp_path).all() == []


def test_half_an_order_spoils_none_after_it(tmp_path, monkeypatch):
    run, whole = Run(tmp_path), os.write
    monkeypatch.setattr("os.write", lambda fd, data: whole(fd, data[:9]))
    with pytest.raises(OSError, match="no space left"):
        run.say("hold")
    monkeypatch.undo()
    run.say("stop")
    assert [x["word"] for x in Heard(run)] == ["stop"]


def test_a_run_that_could_hear_no_more_orders_ends(tmp_path, monkeypatch):
    (tmp_path / "spec.json").write_text(json.dumps({"job": "rig", "folder": str(tmp_path)}), encoding="utf-8")
    worker, run = Worker(Run(tmp_path)), Run(tmp_path)
    monkeypatch.setattr(worker, "_hear", lambda order: order.missing)  # a defect
    threading.Thread(target=worker._listen, daemon=True).start()
    run.say("hold")
    assert worker.wished.wait(5.0)
    assert Order.of({"word": "hold", "by": "\ud800"}).by == "?"


def test_an_answer_that_came_twice_answers_no_later_question(tmp_path):
    (tmp_path / "spec.json").write_text(json.dumps({"job": "commission", "folder": str(tmp_path)}), encoding="utf-8")
    worker = Worker(Run(tmp_path))
    with ThreadPoolExecutor(1) as asking:
        for number in (1, 2):
            asked = asking.submit(worker.agreed, "on")
            while not worker._asks:
                time.sleep(0.001)
            for word in ("go", "go") if number == 1 else ("no",):
                worker._answers.append(Order(word=word, number=number))
            assert asked.result(timeout=5.0) is (number == 1)


def test_a_lease_is_kept_by_signs_of_life_told_by_name_and_given_back(tmp_path, monkeypatch):
    monkeypatch.setattr("ambid.console.authority.LEASE_S", 0.1)
    lease = Lease(tmp_path)
    lease.slot.make()
    lease.take("a", "page a")
    with pytest.raises(AmbidError, match="page a has the right"):
        Lease(tmp_path).take("b", "page b")
    for _ in range(4):
        time.sleep(0.05)
        lease.beat("a")
        lease.beat("b")  # which has no say
    assert lease.holder["page"] == "a"
    lease.take("b", "page b", over=True)
    lease.drop("a")
    assert lease.holder["name"] == "page b"
    lease.drop("b")
    assert lease.holder == {}
    lease.take("a", "page a")
    time.sleep(0.12)
    lease.take("b", "page b")
    assert lease.holder["page"] == "b"


def test_half_a_slot_is_not_read_and_one_that_others_hold_is_refused(tmp_path):
    slot = Slot(tmp_path / "slot")
    assert slot.read() == {}
    slot.make()
    slot.write({"a": 1})
    path = tmp_path / "slot"
    path.write_bytes(path.read_bytes().replace(b'"a"', b'"b"'))
    assert slot.read() == {}
    with slot.transaction(), pytest.raises(AmbidError, match="another console"), Slot(path).transaction():
        pass
    with pytest.raises(ValueError, match="do not fit"):
        slot.write({"a": "x" * 10_000})


def test_orders_that_are_late_or_of_another_state_are_refused_and_all_are_logged(tmp_path, monkeypatch):
    desk = Desk(tmp_path)
    beat = desk.beat()
    fresh = Order.of({"word": "go", "id": "1", "by": "page a", "beat": beat, "until": time.monotonic() + 9.0})
    assert not desk.late(fresh)
    assert desk.late(Order.of({"word": "go", "beat": beat, "until": time.monotonic() - 0.01}))
    assert desk.late(Order.of({"word": "go", "beat": beat - 1}))
    monkeypatch.setattr("ambid.console.orders.FRESH_S", 0.0)
    assert desk.late(fresh)
    desk.answer(fresh, "no")
    desk.note(follows=True, end={"how": "done", "why": "x" * 900})
    for k in range(30):
        desk.answer(Order.of({"word": "hold", "id": str(k)}), "y" * 900)
    state = Slot(tmp_path / "status.bin").read()
    assert state["follows"]
    assert [a["id"] for a in state["answers"]][-1] == "29"
    lines = [json.loads(x) for x in (tmp_path / "orders.jsonl").read_text(encoding="utf-8").splitlines()]
    assert (lines[0]["word"], lines[0]["by"], lines[0]["done"], lines[0]["why"]) == ("go", "page a", False, "no")
    assert len(lines) == 31


def envelopes(folder):
    """First sample and number of samples of each envelope of a feed, and samples lost by then."""
    data, at, found = FeedReader(folder, parts=99).read(1 << 26), 0, []
    while at < len(data):
        length, kind = struct.unpack_from("<Ic", data, at)
        if kind == b"E":
            first, lost, n, _, group = struct.unpack_from("<QQIHH", data, at + 5)
            found.append((first, n * group, lost))
        at += 5 + length
    return found


def test_a_sample_is_shown_once_the_journal_has_it_and_lost_ones_are_counted(tmp_path):
    view = SimpleNamespace(units={"x": "m"}, rate_hz=2000.0, block=lambda block: block)
    journal = SimpleNamespace(stored=True, written=-1)
    tap = EnvelopeTap(FeedWriter(tmp_path), view, journal)

    def take(first, n=20, arrived=[0.0]):  # noqa: B006
        arrived[0] += 0.1
        tap.take(Frame(block=Block(first=first, time_s=first / 2000, values=np.ones((n, 1))), arrived_s=arrived[0]))

    take(100)
    take(120)
    assert envelopes(tmp_path) == []
    journal.written = 125
    take(140)
    assert envelopes(tmp_path) == [(0, 20, 0)]  # of 25, whole envelopes of 10
    journal.written = 160
    take(170)  # ten are lost
    journal.stored = False
    take(190)  # and those found no room
    journal.stored, journal.written = True, 240
    take(210)
    tap.end()
    shown = envelopes(tmp_path)
    assert [(a, n) for a, n, _ in shown] == [(0, 20), (20, 40), (70, 20), (110, 20)]
    assert shown[-1][2] == 30


def test_a_limit_that_is_passed_and_samples_that_are_lost_are_alarms_which_a_late_page_is_told(tmp_path):
    view = SimpleNamespace(units={"position": "m"}, rate_hz=2000.0, block=lambda block: block)
    journal = SimpleNamespace(stored=True, written=2**62)
    lines = {"position": [{"at": 9e-4, "words": "trip"}, {"at": -1e-3, "words": "the rotor touches"}]}
    feed = FeedWriter(tmp_path, part_bytes=400, kept=10_000)  # a few frames a part
    tap = EnvelopeTap(feed, view, journal, lines)
    for k in range(600):  # six seconds
        values = np.zeros((20, 1))
        values[7] = {10: 9.5e-4, 11: 9.6e-4, 300: 9.7e-4, 301: -2e-3}.get(k, 0.0)
        first = 20 * k + 40 * (k > 400)  # forty are lost
        tap.take(Frame(block=Block(first=first, time_s=first / 2000, values=values), arrived_s=0.06 * k))
    reader, frames = FeedReader(tmp_path, parts=9999), []
    while data := reader.read():
        frames += json_frames(data)
    alarms = told(frames, "alarm")
    assert [(m["t"], m["what"]) for m in alarms] == [
        (pytest.approx(0.1035), "limit"), (pytest.approx(3.0035), "limit"), (pytest.approx(3.0135), "limit"),
        (pytest.approx(4.03, abs=0.03), "lost"),
    ]  # fmt: skip
    assert [m["why"] for m in alarms[1:]] == [
        "position passed 0.0009 m: trip", "position passed -0.001 m: the rotor touches", "40 samples lost",
    ]  # fmt: skip
    late = json_frames(FeedReader(tmp_path, parts=1).read(1 << 26))
    assert told(late, "before")[0]["events"] == alarms


def test_who_acknowledged_an_event_first_is_kept(tmp_path):
    acknowledge(tmp_path, ["a", "b"], "page one")
    Desk(tmp_path).answer(Order.of({"word": "hold", "id": "1"}))
    acknowledge(tmp_path, ["b"], "page two")
    with (tmp_path / "orders.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"word": "acknowledge", "keys": 3}\nx"acknowledge"\n')
    assert {key: by for key, (by, at) in acknowledged(tmp_path).items() if at > 1.7e9} == {
        "a": "page one",
        "b": "page one",
    }
    assert acknowledged(tmp_path / "none") == {}


def test_no_sample_that_was_shown_is_missing_after_a_kill(tmp_path):
    prototype_rig(tmp_path)
    for k in range(3):
        run = Runs(tmp_path).start({**LIVE, "out": f"run-{k}.h5"})
        assert until(run, "spectrum")
        time.sleep(0.013 * k)
        os.kill(pid_of(run), signal.SIGKILL)
        assert over(run)
        first, n, _ = envelopes(run.place)[-1]
        words = [sys.executable, "-m", "ambid", "recover", tmp_path / f"run-{k}.h5.journal"]
        assert subprocess.run(words, check=False, capture_output=True).returncode == 0
        assert read_record(tmp_path / f"run-{k}.h5").n_samples >= first + n > 1900


@contextmanager
def small_disk(folder, size="24m"):
    """A console of a folder on a disk of its own: started in a namespace, seen from here through its process."""
    words = ["unshare", "-rm", "sh", "-c", f"mount -t tmpfs -o size={size} none {folder} && cp {folder}.toml "
             f"{folder}/rig.toml && exec {sys.executable} -m ambid console {folder} --no-browser"]  # fmt: skip
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline()
        if "http" not in line:
            pytest.skip("no disk of its own can be had here (unshare -rm, mount): " + process.stderr.read()[:200])
        yield Started(process, line[line.index("http") :].split()[0]), Path(f"/proc/{process.pid}/root{folder}")
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


def fill(folder):
    with suppress(OSError), (folder / "filler").open("ab", buffering=0) as filler:
        while filler.write(bytes(1 << 12)) == 1 << 12:
            pass


@pytest.mark.skipif(shutil.which("unshare") is None, reason="unshare is not installed: apt-get install util-linux")
def test_a_full_disk_ends_a_run_with_its_reason_and_takes_no_order_but_stop(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    prototype_rig(tmp_path)
    (tmp_path / "rig.toml").rename(tmp_path / "disk.toml")
    with small_disk(folder) as (page, inside):
        page.open()
        wish = {**LIVE, "rig": page.number("rig.toml"), "seconds": 30.0}
        (run,) = [Runs(inside).one(page.json("POST", "/api/runs", {**wish, "out": "full"})["id"])]
        until(run, "header")
        fill(inside)
        seen = until(run, seconds=30.0)
        (end,) = told(seen, "end")
        assert end["how"] == "refused"
        assert "the disk is full" in end["why"]
        assert "the disk is full" in run.status["end"]["why"]
        began = time.monotonic()
        while (about := page.state()["runs"][0])["alive"] and time.monotonic() - began < 20.0:
            time.sleep(0.1)
        assert "the disk is full" in about["why"]
        fill(inside)  # what the run kept for its end is free again
        said = page.json("POST", "/api/runs", {**wish, "out": "more"})["error"]
        assert "cannot be written: the disk is full. Make room" in said
        assert page.json("POST", "/api/stop", {}) == {"runs": [], "delivered": True}


def test_a_full_disk_refuses_hold_in_words_and_lets_stop_through(tmp_path):
    resource = pytest.importorskip("resource", reason="the system has no limits of a process")
    prototype_rig(tmp_path)
    run = Runs(tmp_path).start({**LIVE, "out": "run.h5"})
    until(run, "line")
    with console(tmp_path) as page:
        page.open()
        (run.place / "control.jsonl").touch()
        resource.prlimit(page.process.pid, resource.RLIMIT_FSIZE, (8192, 8192))  # the lease alone may be written
        (run.place / "control.jsonl").write_bytes(b" " * 9000)
        said = page.say(run, "hold")
        assert "cannot be written: the disk is full. Make room" in said["error"]
        began = time.monotonic()
        assert page.json("POST", "/api/stop", {}) == {"runs": [run.id], "delivered": True}
        assert time.monotonic() - began < 1.0
    assert told(until(run), "end")
    assert json_frames(FeedReader(run.place, parts=1).read())
