"""What acquire, commission, recover and init refuse: one line on standard error, exit code 2, nothing written."""

import io
import os
import signal
import subprocess
import sys
import warnings
from contextlib import suppress
from importlib.resources import files
from io import FileIO

import pytest

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.settings import fault_words
from ambid.cli import _BestEffort
from ambid.cli.interrupts import Stop, signals

PROTOTYPE = files("ambid").joinpath("data", "prototype.toml").read_text(encoding="utf-8")
SHORT = ("acquire", "--port", "simulated", "--rig", "p.toml", "-o", "a.h5", "--seconds", "0.05", "--settle", "0.05")
LONG = "n" * 300


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a rig of the prototype."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.toml").write_text(PROTOTYPE, encoding="utf-8")
    return tmp_path


def refused(outcome, *parts):
    """The one line that is no note."""
    assert outcome.code == 2
    assert outcome.out == ""
    lines = [line for line in outcome.err.splitlines() if not line.startswith("ambid: note: ")]
    assert len(lines) == 1, outcome.err
    for part in parts:
        assert part in lines[0]


@pytest.mark.parametrize("option", ["--seconds", "--settle", "--amplitude"])
@pytest.mark.parametrize("number", ["nan", "inf", "-1", "1e308"])
def test_numbers_that_nothing_can_be_done_with_are_refused(ambid, folder, option, number):
    refused(ambid(*SHORT, option, number), option, "must be")
    assert os.listdir(folder) == ["p.toml"]


@pytest.mark.parametrize("option", ["--seconds", "--track-seconds", "--amplitude", "--widest"])
@pytest.mark.parametrize("number", ["nan", "0", "1e308"])
def test_commission_refuses_them_too(ambid, folder, option, number):
    refused(ambid("commission", "--port", "simulated", "--rig", "p.toml", "-o", "f", option, number), option)
    assert os.listdir(folder) == ["p.toml"]


def test_a_record_too_short_to_be_read_is_refused(ambid, folder):
    refused(ambid(*SHORT, "--seconds", "1e-300"), "--seconds is 1e-300", "at least 8", "Give 0.004 or more")
    assert os.listdir(folder) == ["p.toml"]


@pytest.mark.parametrize(
    "words",
    [
        (*SHORT, "-o", LONG + ".h5"),
        ("commission", "--port", "simulated", "--rig", "p.toml", "-o", LONG),
        ("init", "--preset", "prototype", "-o", LONG),
        ("recover", LONG),
        ("recover", "p.toml", "-o", LONG + ".h5"),
    ],
)
def test_a_name_that_no_file_can_have_is_refused(ambid, folder, words):
    refused(ambid(*words), "name")
    assert os.listdir(folder) == ["p.toml"]


def test_a_journal_without_a_name_is_refused(ambid, folder):
    refused(ambid("recover", ""), "is a folder")


def test_a_link_to_nowhere_is_refused_before_anything_is_recorded(ambid, folder):
    os.symlink("nowhere/x.h5", "to_no_folder.h5")
    os.symlink("x.h5", "to_no_file.h5")
    refused(ambid(*SHORT, "-o", "to_no_folder.h5"), "there is no folder")
    refused(ambid(*SHORT, "-o", "to_no_file.h5"), "already exists")


def test_a_record_is_not_replayed_onto_itself(ambid, folder):
    assert ambid(*SHORT).code == 0
    before = (folder / "a.h5").read_bytes()
    words = ("acquire", "--port", "replay:a.h5", "--rig", "p.toml", "-o", "./a.h5", "--force", "--seconds", "0.02")
    refused(ambid(*words), "is also an input, which would be overwritten")
    assert (folder / "a.h5").read_bytes() == before


def replayed(folder, change=None):
    """Write a record of 100 rows in counts, and return the words that replay it."""
    rows = [f"{k / 2000:.4f},512.0,{510 + k % 3}.0,{400 + k % 7}.0\n" for k in range(100)]
    text = "time [s],position [1],current [1],duty [1]\n" + "".join(rows if change is None else change(rows))
    (folder / "r.csv").write_text(text, encoding="utf-8")
    return ("acquire", "--port", "replay:r.csv", "--rig", "p.toml", "-o", "a.h5", "--seconds", "0.05")


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="file names are UTF-8 here")
def test_file_names_of_other_bytes_are_read_and_written(ambid, folder):
    words = replayed(folder)
    odd = os.fsdecode(b"r\xff")
    os.rename("r.csv", f"{odd}.csv")
    done = ambid(*words, "--port", f"replay:{odd}.csv", "-o", f"{odd}.h5")
    assert done.code == 0, done.err
    assert os.path.exists(f"{odd}.h5")


def test_a_record_in_other_units_than_the_rigs_is_not_replayed(ambid, folder):
    words = replayed(folder)
    text = (folder / "r.csv").read_text(encoding="utf-8")
    (folder / "r.csv").write_text(text.replace("duty [1]", "duty [V]"), encoding="utf-8")
    refused(ambid(*words), "column 'duty' is in [V]", "takes [1], counts")
    assert not (folder / "a.h5").exists()


def test_a_record_of_another_rate_than_the_rigs_is_told(ambid, folder):
    words = replayed(folder)
    assert "recorded at" not in ambid(*words).err
    (folder / "p.toml").write_text(PROTOTYPE.replace("rate_hz = 2000.0", "rate_hz = 1000.0"), encoding="utf-8")
    done = ambid(*words, "--force")
    assert done.code == 0
    assert "r.csv was recorded at 2000 Hz, which is kept; the rig says 1000 Hz" in done.err


def test_a_journal_that_is_kept_is_told_and_a_replay_is_not_called_a_device(ambid, folder):
    words = replayed(folder, lambda rows: rows[:60] + rows[20:60])
    done = ambid(*words)
    assert done.code == 0
    assert (folder / "a.h5.journal").exists()
    assert "note: a.h5.journal is kept: it holds 40 samples" in done.err
    assert "ambid recover a.h5.journal" in done.err
    assert "a.h5: 60 samples" in done.out
    assert "the replayed record runs backwards" in " ".join(done.out.split())
    assert "Restart" not in done.out


def test_a_replay_that_is_over_before_it_has_settled_is_told(ambid, folder):
    refused(ambid(*replayed(folder), "--settle", "100"), "ended after 0.05 s, within the 100 s of --settle")


def test_values_too_large_for_sums_are_judged(ambid, folder):
    words = replayed(folder, lambda rows: [row.replace(",512.0,", ",1e300,") for row in rows])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = ambid(*words)
    assert done.code == 0, done.err
    assert "position ranges from 1e+300 to 1e+300, which is too large" in " ".join(done.out.split())


@pytest.mark.skipif(sys.platform == "win32", reason="a shell limits the size of files")
def test_a_full_disk_is_told_once_and_in_the_end_what_is_kept(folder):
    program = [sys.executable, "-c", "from ambid.cli import main; main()", *SHORT, "--seconds", "4"]
    told = ["sh", "-c", 'ulimit -f 60; exec "$0" "$@"', *program]
    done = subprocess.run(told, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    first, last = (line for line in done.stderr.splitlines() if "note" not in line)
    assert "largest size" in first
    assert "largest size" not in last
    assert "'ambid recover a.h5.journal -o NAME'" in last


@pytest.mark.parametrize("port", ["", "  "])
def test_a_port_without_a_name_is_refused(ambid, folder, port):
    refused(ambid(*SHORT, "--port", port), "the port has no name")


def test_a_port_that_was_mistyped_is_recognised(ambid, folder):
    pytest.importorskip("serial")
    refused(ambid(*SHORT, "--port", "Emulatd"), "does not exist", "Did you mean 'emulated'?")


@pytest.mark.parametrize(
    ("entry", "parts"),
    [
        ("third = ' '", ("daq.third", "printable")),
        ('third = "a\\u0000b"', ("daq.third", "printable")),
        ("third = '" + "z" * 1000 + "'", ("daq.third", "200")),
        ("baud = 99999999999999999999", ("daq.baud", "300 to 12000000")),
        ("duty = [0]", ("daq.duty is [0]", "[low, high]")),
        ("duty_off = 410", ("daq.duty_off is 410", "must be 0 V within 2% of 12 V")),
    ],
)
def test_strange_entries_of_daq_are_refused(ambid, folder, entry, parts):
    (folder / "p.toml").write_text(PROTOTYPE.replace("[daq]\n", f"[daq]\n{entry}\n"), encoding="utf-8")
    refused(ambid(*SHORT), *parts)


OWN = {"m": "0.3", "k_x": "-6702.0", "k_i": "20.1", "R": "6.0", "L": "0.0803"}


def rig_with(folder, values, *changes):
    """Write the prototype's rig with values of its own, and no bench that is named."""
    text = PROTOTYPE.replace('bench   = "prototype"', "")
    for name, value in values.items():
        text = text.replace(f"{name:3} = {{ unit", f"{name:3} = {{ value = {value}, unit")
    for sound, changed in changes:
        assert sound in text, sound
        text = text.replace(sound, changed)
    (folder / "p.toml").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "value"), [("m", "1e-12"), ("k_x", "-1e300"), ("k_i", "1e300"), ("R", "1e300"), ("L", "1e-300")]
)
def test_a_plant_beyond_all_numbers_is_refused_or_played(ambid, folder, name, value):
    rig_with(folder, OWN | {name: value})
    outcome = ambid(*SHORT)
    assert outcome.code in (0, 2), outcome.err
    if outcome.code:
        refused(outcome, "rig")


def test_an_unstable_loop_is_refused_by_the_rig_and_what_it_lacks_by_the_bench(ambid, folder):
    assert "stability" not in ambid(*SHORT).err
    (folder / "p.toml").write_text(PROTOTYPE.replace("kd = 92.57", "kd = 9.0"), encoding="utf-8")
    (folder / "a.h5").unlink()
    refused(ambid(*SHORT), "unstable on the rig's own plant with k_x, k_i, L of the bench", "largest pole", "--force")
    assert "note: the loop is unstable" in ambid(*SHORT, "--force").err
    (folder / "a.h5").unlink()
    assert ambid(*SHORT, "--mode", "sample").code == 0  # nothing is closed


@pytest.mark.parametrize("role", ["voltage", "current", "position"])
def test_a_gain_too_small_for_any_count_is_refused(ambid, folder, role):
    before, after = PROTOTYPE.split(f"[channels.{role}]\n")
    lines = [line if "gain " not in line else "gain = 1e-300" for line in after.split("\n\n")[0].splitlines()]
    rest = after[len(after.split("\n\n")[0]) :]
    (folder / "p.toml").write_text(f"{before}[channels.{role}]\n" + "\n".join(lines) + rest, encoding="utf-8")
    refused(ambid(*SHORT), f"channels.{role}", "each count needs a value of its own")


@pytest.mark.parametrize("says", [None, "hello", "[1]", "{}"])
def test_a_program_that_is_no_emulated_bench_is_refused(ambid, folder, monkeypatch, says):
    pytest.importorskip("serial")
    program = folder / "bench.sh"
    program.write_text(f"#!/bin/sh\necho '{says}'\n", encoding="utf-8")
    program.chmod(0o644 if says is None else 0o755)
    monkeypatch.setenv("AMBID_BENCH", str(program))
    monkeypatch.setenv("AMBID_FIRMWARE", str(folder / "p.toml"))
    refused(ambid(*SHORT, "--port", "emulated"), "emulated bench", "cannot be started" if says is None else "said")
    assert sorted(os.listdir(folder)) == ["bench.sh", "p.toml"]


@pytest.mark.parametrize(
    ("sound", "changed", "parts"),
    [
        ("[-0.9e-3, 0.9e-3]", "[-1e-9, 1e-9]", ("rig p.toml", "spans less than two counts", "Widen daq.trip.position")),
        ("lift_ms = 300", "lift_ms = 0", ("out_of_gap", "daq.lift_ms = 0: raise it")),
        ("rate_hz = 2000.0", "rate_hz = 2001.0", ("rig p.toml: daq.rate_hz is 2001 Hz",)),
    ],
)
def test_entries_that_cannot_work_are_told_by_their_name(ambid, folder, sound, changed, parts):
    assert sound in PROTOTYPE
    (folder / "p.toml").write_text(PROTOTYPE.replace(sound, changed), encoding="utf-8")
    refused(ambid(*SHORT), *parts)


def test_a_fault_long_after_lift_off_is_not_put_down_to_it():
    late = DeviceEvent(kind="fault", sample=2000, what="out_of_gap")
    assert "gains of [loop], excite less" in fault_words(late, rate_hz=2000.0, lift_ms=300)
    assert "gains of [loop], excite less" in fault_words(late)


@pytest.mark.parametrize("volts", ["1e9", "1e-9"])
def test_an_amplitude_is_told_in_few_digits(ambid, folder, volts):
    done = ambid(*SHORT, "--seconds", "1", "--excitation", "prbs", "--amplitude", volts)
    refused(done, "an excitation of", "1 to 380 are possible")
    assert "e+10 counts" in done.err or "e-08 counts" in done.err


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="no /dev/null here")
def test_only_what_may_go_to_standard_output_is_advised_to(ambid, folder):
    refused(ambid(*SHORT, "-o", "/dev/null"), "is a device or a pipe; it must be a file. Name one")


def test_a_replay_of_nothing_is_refused(ambid, folder):
    refused(ambid(*SHORT, "--port", "replay:"), "'replay:' names no record")


@pytest.mark.parametrize(
    ("words", "part"),
    [(("--seconds", "0.01"), "the record has 0.01 s"), (("--band", "900:2000"), "band 900 to 2000 Hz")],
)
def test_commission_refuses_lengths_and_bands_before_anything_moves(ambid, folder, words, part):
    refused(ambid("commission", "--port", "simulated", "--rig", "p.toml", "-o", "f", *words), part)
    assert os.listdir(folder) == ["p.toml"]


def test_a_firmware_of_another_machine_is_refused(ambid, folder, monkeypatch):
    pytest.importorskip("serial")
    program = folder / "bench.sh"
    program.write_text("#!/bin/sh\n", encoding="utf-8")
    program.chmod(0o755)
    (folder / "host.elf").write_bytes(b"\x7fELF" + bytes(14) + b"\x3e\x00")
    monkeypatch.setenv("AMBID_BENCH", str(program))
    monkeypatch.setenv("AMBID_FIRMWARE", str(folder / "host.elf"))
    refused(ambid(*SHORT, "--port", "emulated"), "host.elf is a program, but not of an AVR", "AMBID_FIRMWARE")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="terminals do not close here")
def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals(Stop().take):
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    finally:
        signal.signal(signal.SIGHUP, before)


def test_more_than_two_signals_tear_no_cleaning_off():
    stop = Stop()
    stop.take(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        stop.take(signal.SIGINT)
    stop.take(signal.SIGINT)
    stop.take(signal.SIGTERM)
    assert stop.code == 130


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_what_is_said_of_a_recording_to_nobody_does_not_end_it():
    with FileIO("/dev/full", "w") as full:
        before = io.TextIOWrapper(io.BufferedWriter(full))
        told = _BestEffort.of(before)
        told.write("a note\n")
        told.flush()
        with pytest.raises(OSError, match="space"):
            before.buffer.flush()
        with suppress(OSError):
            before.close()


@pytest.mark.skipif(sys.platform == "win32", reason="a shell closes standard error")
def test_no_file_becomes_standard_error_where_that_was_closed(folder):
    program = [sys.executable, "-c", "from ambid.cli import main; main()", *SHORT]
    done = subprocess.run(["sh", "-c", 'exec "$0" "$@" 2>&-', *program], stdout=subprocess.PIPE, check=False)
    assert done.returncode == 0
    assert b"100 samples" in done.stdout
    assert (folder / "a.h5").exists()
