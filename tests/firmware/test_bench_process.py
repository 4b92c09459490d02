"""The emulated bench as a process: its start, its pace, its end, and what it refuses."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from ambid.acquisition.devices.emulated import Emulator, find_firmware, find_program
from ambid.errors import DeviceError
from tests.firmware.probe_host import LIMIT_S, Line

PLANT = "kind linear\nm 1\nk_x 0\nk_i 0\nR 1\nL 1e-2\nhigh_voltage 24\nlow_voltage -24\n"


@pytest.fixture
def plant(tmp_path):
    path = tmp_path / "bench.plant"
    path.write_text(PLANT)
    return path


def gone(pid):
    """True once a process is no more, or waits only for its parent to notice."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] in "ZX"
    except FileNotFoundError:
        return True


def wait_until(what):
    limit = time.monotonic() + LIMIT_S
    while not what():
        assert time.monotonic() < limit, "it does not come to pass"
        time.sleep(0.02)


def test_it_says_its_port_and_nothing_more_and_ends_when_asked(bench_program, probe_elf, plant, tmp_path):
    log, link = tmp_path / "log.jsonl", tmp_path / "port"
    command = [bench_program, "--firmware", probe_elf, "--plant", plant, "--log", log, "--link", link]
    process = subprocess.Popen([str(w) for w in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        first = json.loads(process.stdout.readline())
        assert set(first) == {"pty"}
        assert os.readlink(link) == first["pty"]
        with Line(str(link)) as line:
            line.greet()
    finally:
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, out, err) == (0, b"", b"")
    assert not link.is_symlink()
    events = [json.loads(line) for line in log.read_text().splitlines()]
    assert [e["event"] for e in events] == ["start", "host", *["host"] * (len(events) - 3), "end"]
    assert events[-1]["reason"] == "asked"


@pytest.mark.parametrize("lockstep_ms", [0, 100])
def test_it_ends_while_it_waits(emulated, probe_elf, plant, lockstep_ms):
    bench = emulated(plant, firmware=probe_elf, lockstep_ms=lockstep_ms)
    with Line(bench.port) as line:
        line.greet()
        line.write(b"s\x01")
        time.sleep(0.3)  # it waits now: for a host that reads, or that speaks
        pid = bench.pid
        bench.close(keep=True)
    assert gone(pid)
    assert bench.events("end")[0]["reason"] == "asked"


def test_it_ends_with_its_parent(bench_program, probe_elf, plant):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom ambid.acquisition.devices.emulated import Emulator\n"
        "e = Emulator(Path(sys.argv[1]), firmware=Path(sys.argv[2]), program=Path(sys.argv[3]))\n"
        "e.start()\nprint(e.pid, flush=True)\ntime.sleep(600)\n"
    )
    words = [sys.executable, "-c", code, str(plant), str(probe_elf), str(bench_program)]
    parent = subprocess.Popen(words, stdout=subprocess.PIPE)
    try:
        pid = int(parent.stdout.readline())
        assert not gone(pid)
    finally:
        parent.kill()
        parent.communicate()
    wait_until(lambda: gone(pid))


def test_it_outlives_the_thread_that_started_it(bench_program, probe_elf, plant, tmp_path):
    bench = Emulator(plant, firmware=probe_elf, program=bench_program, folder=tmp_path / "folder")
    try:
        thread = threading.Thread(target=bench.start)
        thread.start()
        thread.join()
        with Line(bench.port) as line:
            line.greet()
            line.wait_ticks(10)
        assert bench.running
    finally:
        bench.close()
    assert not bench.running


def test_emulated_time_waits_for_a_host_that_spoke(emulated, probe_elf, plant):
    bench = emulated(plant, firmware=probe_elf, lockstep_ms=50)
    with Line(bench.port) as line:
        line.greet()
        for _ in range(3):
            before = line.ticks()
            time.sleep(0.2)  # more than a second of emulated time, did it not wait
            assert line.ticks() - before <= 104


def test_emulated_time_waits_for_the_first_host(emulated, probe_elf, plant):
    bench = emulated(plant, firmware=probe_elf, lockstep_ms=20)
    time.sleep(0.3)
    with Line(bench.port) as line:
        line.greet()
    bench.close(keep=True)
    assert bench.events("host")[0]["t"] <= 0.0205


def test_a_script_lets_emulated_time_run_without_the_host(emulated, probe_elf, plant):
    bench = emulated(plant, firmware=probe_elf, lockstep_ms=50, script="+0.01 lockstep 0")
    with Line(bench.port) as line:
        line.greet()
        line.enable(1)
        before = line.ticks()
        limit = time.monotonic() + LIMIT_S
        while line.ticks() - before < 1000:
            assert time.monotonic() < limit
            time.sleep(0.05)


def test_at_real_pace_it_is_never_ahead_of_the_wall_clock(emulated, probe_elf, plant):
    began = time.monotonic()
    bench = emulated(plant, firmware=probe_elf, pace="real", lockstep_ms=0)
    with Line(bench.port) as line:
        line.greet()
        for _ in range(5):
            line.wait_ticks(100)
            assert line.ticks() * 0.5e-3 <= time.monotonic() - began + 2e-3


def test_a_script_ends_it(emulated, probe_elf, plant):
    bench = emulated(plant, firmware=probe_elf, script="0.05 end")
    wait_until(lambda: not bench.running)
    assert bench.events("end")[0]["t"] == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize(
    ("script", "complaint"),
    [
        ("force 1", "script.txt:1: a line begins with seconds"),
        ("# so\n\n1 jump", "script.txt:3: it knows force, pulse"),
        ("1 force", "force wants newtons"),
        ("1 pulse 1", "pulse wants newtons and seconds"),
        ("1 override speed 1", "override wants position, current or third"),
        ("1 override current high", "override wants volts"),
        ("1 interlock", "interlock wants open or closed"),
        ("1 cable cut high", "cable wants cut, cut low or mend"),
        ("1 line damage 2", "the chance of damage is 0 to 1"),
        ("1 force 1 2 3", "there is a word too many"),
        ("-1 end", "a line begins with seconds"),
    ],
)
def test_a_wrong_script_is_refused(emulated, probe_elf, plant, script, complaint):
    with pytest.raises(DeviceError, match="ended with 2 before its port was there") as caught:
        emulated(plant, firmware=probe_elf, script=script)
    assert complaint in str(caught.value)


def test_a_wrong_plant_is_refused_with_its_line(emulated, probe_elf, plant):
    plant.write_text(PLANT + "weight 3\n")
    with pytest.raises(DeviceError, match=r"bench\.plant:9: weight 3: is not a known key"):
        emulated(plant, firmware=probe_elf)


def test_a_file_that_is_no_firmware_is_refused(emulated, plant):
    with pytest.raises(DeviceError, match="not an ELF file"):
        emulated(plant, firmware=plant)


@pytest.mark.parametrize(
    "words", [[], ["--pace", "slow"], ["--lockstep", "soon"], ["--seed", "x"], ["--lockstep", "-1"], ["more"]]
)
def test_wrong_options_are_refused(bench_program, probe_elf, plant, words):
    command = [bench_program, "--firmware", probe_elf, *words, *(["--plant", plant] if words else [])]
    done = subprocess.run([str(w) for w in command], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 2
    assert done.stderr.startswith("usage: amb_bench")


def test_a_log_that_nobody_reads_is_refused(bench_program, probe_elf, plant, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    command = [bench_program, "--firmware", probe_elf, "--plant", plant, "--log", tmp_path / "pipe"]
    done = subprocess.run([str(w) for w in command], capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 2
    assert "no regular file" in done.stderr


@pytest.mark.parametrize(("variable", "find"), [("AMBID_BENCH", find_program), ("AMBID_FIRMWARE", find_firmware)])
def test_a_named_program_must_be_there(monkeypatch, tmp_path, variable, find):
    monkeypatch.setenv(variable, str(tmp_path / "none"))
    with pytest.raises(DeviceError, match=f"{variable} names .*none; there is no such file"):
        find()
    (tmp_path / "none").write_text("here")
    assert find() == tmp_path / "none"


def test_what_it_leaves_is_removed(bench_program, probe_elf, plant):
    with Emulator(plant, firmware=probe_elf, program=bench_program) as bench:
        folder, pid = bench.log_path.parent, bench.pid
        assert folder.is_dir()
        assert bench.events("start")
    assert gone(pid)
    assert not folder.exists()
    assert bench.events() == []
