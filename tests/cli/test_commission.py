"""``ambid commission``: a paragraph a step, where it stopped and what to do next, an exit code for each way to end."""

import html
import json
import os
import shlex
import signal
from functools import partial

import pytest

from ambid import job
from ambid.acquisition.device import DeviceInfo
from ambid.console.runs import Run
from ambid.console.worker import Worker, _commission
from ambid.job.commissioning import FILES, REDESIGNED
from ambid.job.presentation import page
from tests.firmware.conftest import avr_gcc, bench_program, firmware_elf, native_cc
from tests.job.benches import COIL, PROTOTYPE_FILE, Spoiled, prototype

__all__ = ["avr_gcc", "bench_program", "firmware_elf", "native_cc"]

QUICK = ("--seconds", "4", "--track-seconds", "2", "--amplitude", "1.4")


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ambid.job.commissioning.page", lambda found: "<html>2001</html>")
    (tmp_path / "rig.toml").write_text(PROTOTYPE_FILE.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "coil.toml").write_text(COIL, encoding="utf-8")
    return tmp_path


@pytest.fixture
def commission(ambid, place):
    def call(*words, port="simulated", rig="rig.toml", folder="out"):
        return ambid("commission", "--port", port, "--rig", rig, "-o", folder, *words)

    return call


def bench(monkeypatch, device):
    monkeypatch.setattr("ambid.acquisition.devices.open_device", lambda *_, **__: device)


def files(folder="out"):
    return set(os.listdir(folder))


def told(folder="out"):
    with open(f"{folder}/commission.json", encoding="utf-8") as file:
        return json.load(file)


def words_of(text):
    return " ".join(text.split())


def test_a_good_bench_ends_with_0_and_a_line_that_runs_next(commission, ambid):
    done = commission(*QUICK, "--json", "told.json")
    assert done.code == 0
    with open("told.json", encoding="utf-8") as file:
        assert json.load(file) == told()
    for number, name in enumerate(
        ("self-test", "rest", "polarity", "levitate", "excite", "record", "identify", "validate", "track"), 1
    ):
        assert f"{number}/9 {name}" in done.out
    assert "commissioned; out holds rig, records, estimate, report and track" in words_of(done.out)
    assert files() == set(FILES) - {"experiment.json"}
    assert told()["passed"] is True
    assert told()["verdict"]["word"] in ("usable", "caution")
    following = shlex.split(done.out.splitlines()[-1])  # pasted into a shell
    assert following[:2] == ["ambid", "acquire"]
    done = ambid(*following[1:])
    assert done.code == 0, done.err
    assert "out/next.h5: 20000 samples" in done.out


@pytest.mark.usefixtures("bench_program", "firmware_elf")
def test_the_firmware_on_the_emulated_bench_is_commissioned_and_its_loop_made_better(commission, monkeypatch):
    few = partial(job.design_controller, plants=12)  # what a design is worth its own tests say
    monkeypatch.setattr("ambid.job.commissioning.design_controller", few)
    monkeypatch.setattr("ambid.job.controller_design._JUDGES", 12)
    done = commission(*QUICK, "--redesign", port="emulated")
    assert done.code == 0, done.out + done.err
    assert set(REDESIGNED) < files()
    steps = {s["name"]: s for s in told()["steps"]}
    load = steps["load"]["numbers"]
    assert load["peak_after_db"] < load["peak_before_db"] - 0.5
    assert load["measured_after_db"] < load["measured_before_db"]
    assert load["voltage_sd_after"] < 1.1 * load["voltage_sd_before"]
    assert "--rig out/redesigned.toml" in done.out.splitlines()[-1]
    assert told()["device"]["kind"] == "emulated"
    truth = {"m": 0.3, "k_i": 20.1, "R": 6.0, "L": 0.0803}
    with open("out/estimate.json", encoding="utf-8") as file:
        found = json.load(file)["parameters"]
    for name, value in truth.items():
        assert abs(found[name]["value"] / value - 1.0) < 0.05


def test_one_that_is_not_good_enough_ends_with_3_where_why_and_what_next(commission, ambid):
    done = commission("--seconds", "4", "--amplitude", "0.05")
    assert done.code == 3
    text = words_of(done.out)
    assert "stopped: m is" in text
    assert "stopped at identify, step 7 of 9; the output is off, and out holds what was found, out/report.html" in text
    tried = ambid(*shlex.split(done.out.splitlines()[-1])[1:])
    assert tried.out.startswith("verdict: "), tried.err
    assert "Next: record longer (--seconds)" in text
    assert "Then commission again, into another folder." in text
    assert told()["passed"] is False
    assert files() == {"rig.toml", "record.h5", "second.h5", "estimate.json", "report.html", "commission.json"}


def reasons_of(text):
    """The verdict and its reasons as a terminal has them, each on one line."""
    lines = text[text.index("verdict: ") :].splitlines()
    reasons = []
    for line in lines[1:]:
        if line.startswith("  ✗ "):
            reasons.append(line.removeprefix("  ✗ "))
        elif line.startswith("    "):
            reasons[-1] += " " + line.strip()
        else:
            break
    return lines[0].removeprefix("verdict: "), reasons


@pytest.mark.parametrize(("kp", "code"), [(15532.0, 3), (19415.0, 0)])
def test_terminal_file_page_and_console_say_one_verdict_with_the_same_reasons(
    commission, ambid, place, monkeypatch, kp, code
):
    monkeypatch.setattr("ambid.job.commissioning.page", page)
    monkeypatch.setattr(Worker, "agreed", lambda *_: True)
    rig = (place / "rig.toml").read_text(encoding="utf-8").replace("kp = 19415.0", f"kp = {kp}")
    (place / "rig.toml").write_text(rig, encoding="utf-8")
    done = commission("--seconds", "4", "--track-seconds", "2")
    assert done.code == code, done.err
    verdict = told()["verdict"]
    word = {"usable": "usable", "caution": "use with caution", "unusable": "do not use"}[verdict["word"]]
    reasons = [f"{r['check']}: {r['text']}" for r in verdict["reasons"]]
    assert reasons_of(done.out) == (word, reasons)
    above = html.unescape((place / "out" / "report.html").read_text(encoding="utf-8")).split("<h2>")[0]
    assert f">{word}</span>" in above
    assert all(r["text"] in " ".join(above.split()) for r in verdict["reasons"])
    seen = []
    run = Run(place / "run")
    run.place.mkdir()
    spec = {"job": "commission", "folder": str(place), "rig": "rig.toml", "port": "simulated", "out": "shown"}
    (run.place / "spec.json").write_text(json.dumps({**spec, "seconds": 4.0, "track_seconds": 2.0}))
    worker = Worker(run)
    worker.feed.tell = lambda kind, content=None, **_: seen.append((kind, content))
    _commission(worker)
    shown = next(content for kind, content in seen if kind == "commissioned")
    own = told("shown")["verdict"]  # settings have the console's names there
    assert (shown["verdict"], shown["reasons"]) == (own["word"], [f"{r['check']}: {r['text']}" for r in own["reasons"]])
    assert own["word"] == verdict["word"]
    assert [r["text"].replace("redesign", "--redesign") for r in own["reasons"]] == [
        r["text"] for r in verdict["reasons"]
    ]
    if code:
        assert "zone D" in reasons[0]
        better = ambid(*shlex.split(done.out.splitlines()[-1])[1:], "--help")  # the line is a command's
        assert better.code == 0
        assert "ambid design controller" in done.out.splitlines()[-1]


def test_the_folder_of_an_earlier_one_is_refused_before_the_bench_is_opened(commission, place, monkeypatch):
    (place / "out").mkdir()
    (place / "out" / "record.h5").write_text("precious")
    monkeypatch.setattr("ambid.acquisition.devices.open_device", lambda *_, **__: pytest.fail("opened"))
    done = commission()
    assert done.code == 2
    assert "out holds record.h5 of an earlier commissioning" in done.err
    assert (place / "out" / "record.h5").read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "options", "said"),
    [
        (("--seconds", "0"), {}, "--seconds is 0"),
        (("--track-seconds", "inf"), {}, "--track-seconds is inf"),
        (("--widest", "-1"), {}, "--widest is -1"),
        (("--amplitude", "nan"), {}, "--amplitude is nan"),
        (("--band", "9"), {}, "--band is '9'"),
        (("--seconds", "0.5"), {}, "the record: a multisine from 2 Hz needs 2 s"),
        (("--band", "2:1200"), {}, "a trial of the amplitude: "),
        (("--band", "2:900"), {}, "designed up to 800 Hz"),
        ((), {"port": "replay:o.h5"}, "nothing can be levitated"),
        ((), {"port": "/dev/ttyNONE"}, "no terminal to ask"),
        (("--yes",), {"port": "/dev/ttyNONE"}, "does not exist"),
        ((), {"rig": "coil.toml"}, "no [loop] with a gain"),
        ((), {"rig": "none.toml"}, "none.toml"),
        ((), {"folder": "rig.toml"}, "rig.toml is a file"),
        ((), {"folder": "no/where"}, "there is no folder no"),
        ((), {"folder": "."}, "holds rig.toml of an earlier commissioning"),
    ],
)
def test_wrong_words_are_refused_in_one_line_and_leave_nothing(commission, place, monkeypatch, words, options, said):
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115 - closed with the test's process
    done = commission(*words, **options)
    assert done.code == 2
    last = done.err.splitlines()[-1]
    assert last.startswith("ambid: ")
    assert said in last
    assert not (place / "out").exists()
    assert done.out == ""


def test_a_folder_of_the_users_own_is_left_although_it_is_empty(commission, place):
    (place / "out").mkdir()
    assert commission("--seconds", "0.5").code == 2
    assert (place / "out").is_dir()


@pytest.mark.parametrize(("what", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_leaves_what_was_found_and_the_output_off(commission, monkeypatch, what, code):
    def press(values, device):
        if device.lifts == 3 and device.blocks == 250:
            os.kill(os.getpid(), what)

    device = Spoiled(prototype(), spoil=press)
    bench(monkeypatch, device)
    before = signal.getsignal(what)
    done = commission(*QUICK)
    assert done.code == code
    assert "interrupted; the output is off, and out holds what was found before" in done.err
    assert "Next:" not in done.out
    assert told()["steps"][-1]["name"] == "record"
    assert "interrupted" in told()["steps"][-1]["reasons"][0]
    assert "record.h5" in files()
    assert device._state == "idle"
    assert signal.getsignal(what) is before


def serial(monkeypatch, answer):
    """A bench that says that it is hardware, and an operator."""

    class Hardware(Spoiled):
        @property
        def info(self):
            known = super().info
            return DeviceInfo(kind="serial", port=known.port, rate_hz=known.rate_hz, columns=known.columns)

    device = Hardware(prototype())
    bench(monkeypatch, device)
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", lambda text: asked.append(text) or answer)
    return device, asked


def test_an_operator_is_asked_before_a_real_bench_moves_and_may_decline(commission, monkeypatch):
    device, asked = serial(monkeypatch, answer=False)
    done = commission(*QUICK, port="/dev/ttyBENCH")
    assert done.code == 2
    assert len(asked) == 1
    assert "switch its output on" in asked[0]
    assert "not agreed to; the output stayed off" in done.err
    assert device.starts == 1
    assert [s["name"] for s in told()["steps"]] == ["self-test", "rest"]


def test_nobody_is_asked_where_yes_was_said(commission, monkeypatch):
    device, asked = serial(monkeypatch, answer=False)
    done = commission("--seconds", "2.5", "--amplitude", "0.05", "--yes", port="/dev/ttyBENCH")
    assert done.code == 3
    assert asked == []
    assert device.starts > 2


def test_the_help_says_what_it_does_and_how_it_ends(ambid):
    done = ambid("commission", "--help")
    assert done.code == 0
    text = words_of(done.out)
    for word in (
        "self-test, rest, polarity, levitate, excite, record, identify, validate, track",
        "exit code 3",
        "--yes",
    ):
        assert word in text
