"""``ambid acquire``: a record from a controller, what is said of it, and an exit code for each way in which it ends."""

import json
import os
import signal
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from ambid import identify, simulate
from ambid.acquisition.quality import Quality
from ambid.acquisition.recorder import Recorder
from ambid.cli.acquire import loop_lines
from ambid.errors import DeviceError
from ambid.physics.presets import preset
from ambid.record import read_record
from ambid.rig import rig_of_preset, write_rig
from tests.firmware.conftest import avr_gcc, bench_program, firmware_elf, native_cc
from tests.job.benches import COIL, PLAIN, PROTOTYPE_FILE, THESIS, Silent, Spoiled, prototype

__all__ = ["avr_gcc", "bench_program", "firmware_elf", "native_cc"]

PLAYED = ("--excitation", "multisine", "--band", "2:66", "--amplitude", "1.4")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the prototype's rig and three without calibrations."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(PROTOTYPE_FILE.read_text(encoding="utf-8"), encoding="utf-8")
    for name, text in (("plain", PLAIN), ("coil", COIL), ("thesis", THESIS)):
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    return tmp_path


@pytest.fixture
def acquire(ambid, place):
    def call(*words, port="simulated", rig="rig.toml", record="o.h5"):
        return ambid("acquire", "--port", port, "--rig", rig, "-o", record, *words)

    return call


def samples(path="o.h5", **options):
    return len(read_record(path, **options).channels[0].values)


def at_block(monkeypatch, number, do):
    """Do something when the quality of a run is given its block of that number."""
    add, blocks = Quality.add, count(1)

    def adding(self, frame):
        if next(blocks) == number:
            do()
        add(self, frame)

    monkeypatch.setattr(Quality, "add", adding)


def signalled(monkeypatch, number, what=signal.SIGINT):
    at_block(monkeypatch, number, lambda: os.kill(os.getpid(), what))


# What it gives.
def test_a_record_and_what_is_to_be_said_of_it(acquire, place):
    done = acquire("--seconds", "2", *PLAYED)
    assert done.code == 0
    assert "o.h5: 4000 samples at 2000 Hz (2 s) from simulated prototype" in done.out
    for word in ("SNR", "range used", "saturated", "0 samples lost", "noise: what does not repeat"):
        assert word in done.out
    rows = {line.split()[0]: line for line in done.out.splitlines() if line.startswith(("position", "duty"))}
    assert "dB" in rows["position"]
    assert "dB" not in rows["duty"]  # what the controller orders has no noise
    assert samples() == 4000
    assert {p.name for p in place.iterdir()} == {"rig.toml", "plain.toml", "coil.toml", "thesis.toml", "o.h5"}


def test_without_an_excitation_no_ratio_is_made_up(acquire):
    done = acquire("--seconds", "1")
    assert done.code == 0
    assert "dB" not in done.out
    assert "upper bound" in done.out


def test_an_amplitude_that_is_not_given_is_found_and_told(acquire):
    done = acquire("--seconds", "2", "--excitation", "multisine", "--band", "2:66")
    assert done.code == 0
    assert "amplitude 1." in done.err
    assert "found by trials" in done.err


def test_a_slow_excitation_gets_a_trial_as_long_as_it_needs(acquire):
    done = acquire("--seconds", "5", "--excitation", "multisine", "--band", "1:60")
    assert (done.code, samples()) == (0, 10_000)


@pytest.mark.parametrize("rig", ["plain", "thesis", "coil"])
def test_a_rig_without_calibrations_gives_si_columns_that_are_identified(acquire, ambid, rig):
    done = acquire("--seconds", "3", "--excitation", "prbs", "--settle", "0.5", rig=f"{rig}.toml")
    assert done.code == 0
    assert "assumed to be" in done.err
    units = {c.name: c.unit for c in read_record("o.h5").channels}
    assert units.items() >= {"voltage": "V", "current": "A"}.items()
    assert units.get("position", "m") == "m"
    assert ("position" in units) == (rig != "coil")
    found = ambid("identify", "o.h5", "--rig", f"{rig}.toml", "--json", "e.json")
    assert found.code == 0
    estimate = json.loads(Path("e.json").read_text())
    assert estimate["status"] == "converged"
    truth = {"plain": 6.0, "thesis": 1.138, "coil": 6.0}[rig]
    assert abs(estimate["parameters"]["R"]["value"] / truth - 1.0) < 0.05


@pytest.mark.usefixtures("bench_program", "firmware_elf")
def test_a_rig_without_calibrations_on_the_emulated_controller(acquire, ambid):
    done = acquire("--seconds", "2", *PLAYED, port="emulated", rig="plain.toml", record="o.csv")
    assert done.code == 0
    assert "from emulated" in done.out
    assert "0 samples lost, 0 frames damaged" in done.out
    assert {c.name: c.unit for c in read_record("o.csv").channels} == {
        "position": "m", "current": "A", "voltage": "V", "excitation": "V",
    }  # fmt: skip
    found = ambid("identify", "o.csv", "--rig", "plain.toml", "--json", "e.json")
    assert found.code == 0
    assert abs(json.loads(Path("e.json").read_text())["parameters"]["k_i"]["value"] / 20.1 - 1.0) < 0.05


def test_equal_seeds_give_equal_records(acquire):
    for name in ("a.h5", "b.h5"):
        assert acquire("--seconds", "2", *PLAYED, "--seed", "5", record=name).code == 0
    a, b = (read_record(name).channels[0].values for name in ("a.h5", "b.h5"))
    np.testing.assert_array_equal(a, b)


# Modes.
def test_without_a_loop_it_samples_or_drives(acquire):
    assert acquire("--seconds", "1", rig="coil.toml").code == 0
    record = read_record("o.h5")
    assert np.ptp(next(c.values for c in record.channels if c.name == "voltage")) == 0.0
    assert acquire("--seconds", "1", "--excitation", "prbs", rig="coil.toml", record="p.h5").code == 0
    assert np.ptp(next(c.values for c in read_record("p.h5").channels if c.name == "voltage")) > 1.0


def test_what_has_no_loop_is_not_levitated(acquire, place):
    done = acquire("--mode", "levitate", rig="thesis.toml")
    assert done.code == 2
    assert "no loop with a gain" in done.err
    assert not (place / "o.h5").exists()


def test_a_replayed_record_is_sampled(acquire):
    assert acquire("--seconds", "2", *PLAYED).code == 0
    done = acquire("--seconds", "0.5", port="replay:o.h5", record="r.h5")
    assert done.code == 0
    np.testing.assert_array_equal(
        read_record("r.h5").channels[1].values,
        next(c.values for c in read_record("o.h5").channels if c.name == read_record("r.h5").channels[1].name)[:1000],
    )


def test_a_replay_that_ends_early_says_so(acquire):
    assert acquire("--seconds", "1").code == 0
    done = acquire("--seconds", "5", port="replay:o.h5", record="r.h5")
    assert done.code == 0
    assert "2000 samples of 10000 wanted" in done.out
    assert "replay:o.h5 ended after 2000 of 10000 samples" in done.err
    assert acquire("--seconds", "5", "--strict", port="replay:o.h5", record="s.h5").code == 3


# Refused.
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--seconds", "0"), "--seconds is 0"),
        (("--seconds", "nan"), "--seconds is nan"),
        (("--settle", "-1"), "--settle is -1"),
        (("--amplitude", "-2", "--excitation", "prbs"), "--amplitude is -2"),
        (("--amplitude", "2"), "--amplitude is for an excitation, and none was named"),
        (("--band", "1:20"), "--band is for an excitation, and none was named"),
        (("--band", "20:1", "--excitation", "prbs"), "--band is '20:1'"),
        (("--excitation", "multisin"), "'multisin'"),
        (("--excitation", "chirp"), "multisine"),
        (("--excitation", "multisine", "--mode", "sample"), "--mode sample keeps the output off"),
        (("--excitation", "multisine", "--band", "2:66", "--seconds", "1"), "needs 2 s"),
        (("--track", "none.json"), "none.json does not exist"),
        (("--track", "auto", "--seconds", "3"), "tracking needs 5 s for its start, and the run lasts 3 s"),
        (("--mode", "hover"), "hover"),
        (("--bench", "nothing"), "nothing"),
        (("--sekonds", "3"), "--sekonds"),
    ],
)
def test_wrong_words_are_refused_in_one_line(acquire, place, words, said):
    done = acquire(*words)
    assert done.code == 2
    last = done.err.splitlines()[-1]
    assert last.startswith("ambid: ")
    assert said in last
    assert done.out == ""
    assert not (place / "o.h5").exists()
    assert not list(place.glob("*.journal"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"port": "/dev/ttyNONE"}, "/dev/ttyNONE does not exist"),
        ({"port": "replay:none.h5"}, "none.h5 does not exist"),
        ({"rig": "none.toml"}, "none.toml"),
        ({"record": "o.txt"}, "must end in .h5"),
        ({"record": "nowhere/o.h5"}, "there is no folder nowhere"),
        ({"record": "rig.toml"}, "must end in .h5"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(acquire, options, said):
    done = acquire(**options)
    assert done.code == 2
    assert said in done.err.splitlines()[-1]
    assert "Traceback" not in done.err


def test_a_record_that_exists_is_kept_unless_forced(acquire, place, monkeypatch):
    (place / "o.h5").write_text("precious")
    opened = []
    monkeypatch.setattr("ambid.acquisition.devices.open_device", lambda *_, **__: opened.append(1))
    done = acquire("--seconds", "1")
    assert (done.code, opened) == (2, [])
    assert "o.h5 exists" in done.err
    assert "--force" in done.err
    assert (place / "o.h5").read_text() == "precious"
    monkeypatch.undo()
    monkeypatch.chdir(place)
    assert acquire("--seconds", "1", "--force").code == 0
    assert samples() == 2000


def test_an_excitation_that_a_record_cannot_play(acquire):
    acquire("--seconds", "1")
    done = acquire("--excitation", "prbs", port="replay:o.h5", record="r.h5")
    assert done.code == 2
    assert "cannot act on a replayed record" in done.err


# Ended early.
def bench(monkeypatch, device):
    monkeypatch.setattr("ambid.acquisition.devices.open_device", lambda *_, **__: device)


def test_a_fault_keeps_what_came_and_is_said_with_a_remedy(acquire, monkeypatch):
    def trip(values, device):
        if device.blocks == 200:
            device.become(("m", 0.01))

    bench(monkeypatch, Spoiled(prototype(), spoil=trip))
    done = acquire("--seconds", "10")
    assert done.code == 2
    last = done.err.splitlines()[-1]
    assert "went to its safe state: " in last
    assert "outside limits at sample" in last
    assert f"o.h5 holds the {samples()} samples before it" in last
    assert f"{samples()} samples of 20000 wanted" in done.out


def test_lost_samples_are_seen_without_strict_and_end_with_3_with_it(acquire, monkeypatch):
    for words, code in ((), 0), (("--strict", "--force"), 3):
        bench(monkeypatch, Spoiled(prototype(), lose=lambda device: device.blocks == 150))
        done = acquire("--seconds", "2", *words)
        assert done.code == code
        assert "20 samples lost" in done.out
        assert "read it with --gaps" in done.out
    assert samples(gaps="interpolate") == 4000


def test_a_poor_record_is_seen_without_strict_and_ends_with_3_with_it(acquire, monkeypatch):
    def dead(values, device):
        values[:, 1] = 512

    for words, code in ((), 0), (("--strict", "--force"), 3):
        bench(monkeypatch, Spoiled(prototype(), spoil=dead))
        done = acquire("--seconds", "2", *words)
        assert done.code == code
        assert "current is constant" in done.out


def test_a_lost_line_says_what_the_record_holds(acquire, monkeypatch):
    bench(monkeypatch, Silent(prototype(), after=200))
    done = acquire("--seconds", "4", *PLAYED)
    assert done.code == 2
    assert "the line is lost" in done.err
    assert f"o.h5 holds the {samples()} samples before it" in done.err


def test_a_full_disk_is_told_at_once_and_ends_with_2(acquire, monkeypatch):
    class Full(Recorder):
        def append(self, block):
            if self.blocks == 40:
                self.flush()
                self._writer._fail(DeviceError("the disk is full. Make room"))
            return super().append(block)

    monkeypatch.setattr("ambid.acquisition.session.Recorder", Full)
    done = acquire("--seconds", "30")
    assert done.code == 2
    told = [line for line in done.err.splitlines() if "the disk is full" in line]
    assert len(told) == 1  # at once; the end says what is missing, and where the rest is
    assert "samples are not in o.h5" in done.err.splitlines()[-1]
    assert samples() == 800
    assert "800 samples of 60000 wanted" in done.out


@pytest.mark.parametrize(("what", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_keeps_what_came(acquire, monkeypatch, what, code):
    usual = signal.getsignal(what)
    if usual is signal.SIG_IGN:  # SIGHUP, where these tests were started by nohup, which the command respects
        signal.signal(what, signal.SIG_DFL)
    before = signal.getsignal(what)
    try:
        signalled(monkeypatch, 40, what)
        done = acquire("--seconds", "600")
        assert done.code == code
        assert f"ambid: interrupted; o.h5 holds the {samples()} samples before it" in done.err
        assert 780 <= samples() <= 840
        assert signal.getsignal(what) is before
    finally:
        signal.signal(what, usual)


def test_a_second_signal_says_where_what_came_is(acquire, monkeypatch, place):
    def twice():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    at_block(monkeypatch, 40, twice)
    done = acquire("--seconds", "600")
    assert done.code == 130
    assert "nothing was written" not in done.err
    kept = place / ("o.h5" if (place / "o.h5").exists() else "o.h5.journal")
    assert kept.exists()
    assert kept.name in done.err.split("interrupted")[1]


def test_a_signal_while_an_amplitude_is_looked_for_records_nothing(acquire, monkeypatch, place):
    from ambid.acquisition.trials import Kept

    take = Kept.take

    def interrupted(self, frame):
        os.kill(os.getpid(), signal.SIGINT)
        monkeypatch.setattr(Kept, "take", take)

    monkeypatch.setattr(Kept, "take", interrupted)
    done = acquire("--seconds", "4", "--excitation", "prbs")
    assert done.code == 130
    assert done.err.splitlines()[-1] == "ambid: interrupted; nothing was recorded"
    assert not list(place.glob("o.h5*"))


# Tracked meanwhile.
@pytest.fixture(scope="module")
def estimate(tmp_path_factory):
    from ambid.acquisition.program import program
    from ambid.acquisition.session import Course, acquire
    from ambid.job import identify

    folder, rig = tmp_path_factory.mktemp("start"), prototype()
    wave = program("multisine", amplitude_v=1.4, band=(2.0, 66.0), rate_hz=2000.0, seconds=4.0)
    with Spoiled(rig) as device:
        acquire(device, rig, folder / "o.h5", Course(mode="levitate", seconds=4.0, settle_s=0.5, program=wave))
    return identify(folder / "o.h5", rig).dumps()


def track_of(text):
    return [json.loads(line) for line in text.splitlines()]


def test_a_record_is_tracked_from_an_estimate(acquire, place, estimate):
    (place / "e.json").write_text(estimate)
    done = acquire("--seconds", "2", *PLAYED, "--track", "e.json", "--json", "t.jsonl")
    assert done.code == 0
    assert "4000 samples" in done.out
    assert "state at the end: tracking" in done.out
    assert samples() == 4000
    track = track_of((place / "t.jsonl").read_text())
    assert track[-1]["summary"]["samples"] == 4000
    assert track[-1]["summary"]["rejected_samples"] == 0


def test_a_record_is_tracked_from_its_own_beginning(acquire):
    done = acquire("--seconds", "6", *PLAYED, "--track", "auto")
    assert done.code == 0
    assert "state at the end: tracking" in done.out
    assert samples() == 12_000


def test_with_a_track_on_standard_output_nothing_else_is_there(acquire, place, estimate):
    (place / "e.json").write_text(estimate)
    done = acquire("--seconds", "2", "--track", "e.json", "--json", "-")
    assert done.code == 0
    track = track_of(done.out)
    assert track[0]["schema"] == "ambid.track/1"
    assert "summary" in track[-1]
    assert "of the converter range" in done.err  # what is poor is still seen


def test_a_fit_is_no_start(acquire, place, estimate, ambid):
    (place / "e.json").write_text('{"schema": "ambid.fit/1"}')
    done = acquire("--track", "e.json")
    assert done.code == 2
    assert "e.json" in done.err


def test_a_tracker_that_fails_leaves_the_whole_record(acquire, place, monkeypatch):
    def refuse(*_, **__):
        raise DeviceError("nothing can be identified from it")

    monkeypatch.setattr("ambid.job.track_live.start_of", refuse)
    done = acquire("--seconds", "6", *PLAYED, "--track", "auto")
    assert done.code == 2
    assert "tracking ended, recording continues: nothing can be identified" in done.err
    assert done.err.splitlines()[-1].endswith("o.h5 holds all 12000 samples")
    assert samples() == 12_000


@pytest.mark.parametrize("least", [300, 1500], ids=["before the first line", "in the middle"])
def test_a_signal_while_it_tracks_keeps_the_record(acquire, place, estimate, monkeypatch, least):
    add, seen = Quality.add, [0]

    def adding(self, frame):
        add(self, frame)
        if seen[0] < least <= seen[0] + len(frame.block.values):
            os.kill(os.getpid(), signal.SIGTERM)
        seen[0] += len(frame.block.values)

    monkeypatch.setattr(Quality, "add", adding)
    (place / "e.json").write_text(estimate)
    words = ("--track", "auto") if least == 300 else ("--track", "e.json")
    done = acquire("--seconds", "600", "--pace", "real-time", *words)
    assert done.code == 143
    assert "interrupted" in done.err
    assert samples() == seen[0] >= least


def test_the_help_names_ports_modes_and_the_journal(ambid):
    done = ambid("acquire", "--help")
    assert done.code == 0
    for word in ("emulated", "simulated", "replay:FILE", "--track", "levitate", "ambid recover", "--strict"):
        assert word in " ".join(done.out.split())


def test_the_loop_of_a_rotor_is_told_axis_by_axis():
    found = {"peak_db": {"value": 8.0, "sd": 0.1}, "measured_peak_db": None}
    lines = loop_lines(3.0, {"ax": found, "ay": {**found, "measured_peak_db": 13.0, "measured_sd_db": 0.2}})
    assert lines[0] == "sensitivity at 3 s, opened at the position:"
    assert lines[1] == "  ax  8.00 dB, 95 % within ± 0.20 dB, zone A (> 99 %), predicted"
    assert lines[2].startswith("  ay  13.00 dB, 95 % within ± 0.39 dB, zone ")
    assert lines[2].endswith(", measured")
    assert loop_lines(3.0, {}) == []


@pytest.fixture(scope="module")
def rotor(tmp_path_factory):
    """A rotor's rig, and an estimate of it."""
    rig, made = rig_of_preset(preset("spindle")), tmp_path_factory.mktemp("rotor")
    write_rig(rig, made / "rotor.toml")
    identify(simulate(rig, duration=3.0, seed=1), rig).save(made / "start.json")
    return made


def test_a_rotor_is_levitated_tracked_and_its_loop_told(acquire, place, rotor):
    words = ("--seconds", "5", "--excitation", "zippered", "--amplitude", "4")
    done = acquire(*words, "--track", f"{rotor}/start.json", "--json", "t.jsonl", rig=f"{rotor}/rotor.toml")
    assert done.code == 0
    assert samples() == 100_000
    lines = [json.loads(line) for line in (place / "t.jsonl").read_text().splitlines()]
    assert len(lines) == 1 + 2 + 1
    assert {f"{axis}.k_x" for axis in ("ax", "ay", "bx", "by", "az")} <= set(lines[1]["parameters"])
    told = done.out[done.out.index("sensitivity at 3 s") :].splitlines()[1:6]
    assert [line.split()[0] for line in told] == ["ax", "ay", "bx", "by", "az"]
    assert all(line.endswith(", measured") for line in told)


def test_a_rotor_that_nothing_excites_is_recorded_and_its_loop_predicted(acquire, rotor):
    done = acquire("--seconds", "3", "--track", f"{rotor}/start.json", rig=f"{rotor}/rotor.toml")
    assert done.code == 2
    assert done.out.count(", predicted") == 5
    assert "not periodic" in done.err
    assert "o.h5 holds all 60000 samples" in done.err
    assert samples() == 60_000
