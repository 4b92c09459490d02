"""``ambid identify --nonlinear``: from words to files, table and exit code; Ctrl-C keeps the best so far."""

import json
import os
import signal
from contextlib import contextmanager
from pathlib import Path

import pytest

from ambid.cli import identify
from ambid.record import write_record
from tests.bearing.magnet.estimates import ball, by_hand, seen

RIG = """schema = "ambid.rig/1"
name = "ball"
model = "one-axis"
[channels.voltage]
delay = 1
[channels.current]
[channels.position]
[parameters]
m = { value = 60, unit = "g", role = "fixed" }
[loop.limits]
voltage = [0.0, 12.0]
[magnet]
kind = "single"
gap = "hyperbolic"
rise = false
[magnet.parameters]
s = { value = 0.0, unit = "mm", role = "fixed" }
"""


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    at = tmp_path_factory.mktemp("balls")
    for seed in (1, 2, 3):
        write_record(ball(seed).record, at / f"r{seed}.csv")
    write_record(ball(5, n=400, rate_scale=2).record, at / "fast.csv")
    (at / "ball.toml").write_text(RIG, encoding="utf-8")
    return at


@pytest.fixture
def at(records, monkeypatch, tmp_path):
    """The folder with the records; what is written goes elsewhere."""
    monkeypatch.chdir(records)
    return tmp_path


def test_several_records_to_files_and_table(at, ambid) -> None:
    out, figure = at / "ball.json", at / "ball.png"
    found = ambid(
        "identify", "r1.csv", "r2.csv", "--rig", "ball.toml", "--nonlinear", "--validate", "r3.csv", "--json", out,
        "--plot", figure, "--strict",
    )  # fmt: skip
    assert found.code == 0, found.out + found.err
    lines = found.out.splitlines()
    assert [x for x in lines if len(x) > 80] == []
    assert lines[0] == "verdict: usable"
    assert lines[2] == "2 records: hyperbolic single magnet, 4 s"
    assert any(x.startswith("k ") and "±" in x and x.endswith("identified") for x in lines)
    assert any(x.startswith("k_i [N/A]") for x in lines)
    assert any(x.startswith("✓ carries_its_weight") for x in lines)
    assert "on the second record" in found.out
    document = json.loads(out.read_text())
    assert document["status"] == "converged"
    assert len(document["records"]) == 2
    assert figure.read_bytes().startswith(b"\x89PNG")
    again = json.loads(ambid("validate", out, "r3.csv", "--json", "-").out)
    assert again["fit"] == document["validation"]["fit"]
    for name, check in again["checks"].items():
        assert check == {k: v for k, v in document["validation"]["checks"][name].items() if v is not None}


def test_the_rig_says_what_is_known_and_the_options_change_it(at, ambid) -> None:
    words = ("identify", "r1.csv", "--rig", "ball.toml", "--nonlinear", "--to", "0.7", "--json", "-")
    of_rig = json.loads(ambid(*words, "--report", at / "ball.html").out)
    assert (at / "ball.html").read_text(encoding="utf-8").count('<div class="picture">') == 4
    assert of_rig["law"]["gap"] == "hyperbolic"
    assert of_rig["parameters"]["s"]["role"] == of_rig["parameters"]["m"]["role"] == "fixed"
    assert of_rig["delay"]["voltage"]["how"] == "given"
    changed = json.loads(ambid(*words, "--eddy", "--drift").out)
    assert changed["law"]["eddy"]
    assert changed["law"]["drift"]
    assert changed["parameters"]["a"]["unit"] == "rad/s"
    assert "eddy = true" in changed["rig"]["text"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("r1.csv", "r2.csv"), "2 records are given; the linear model takes one"),
        (("r1.csv", "--held", "r2.csv"), "--held is for the nonlinear magnet"),
        (("r1.csv", "--eddy"), "--eddy is for the nonlinear magnet"),
        (("r1.csv", "--magnet", "pair"), "--magnet of 'ambid identify' is now magnet.kind of the rig. Give that"),
        (("r1.csv", "--nonlinear", "--off-below=0.1"), "is now magnet.off_below of the rig. Give that"),
        (("r1.csv", "--nonlinear", "--rig", "triple.toml"), "magnet.kind is 'triple'"),
        (("r1.csv", "--nonlinear", "--rig", "exponential.toml"), "a pair has the hyperbolic law"),
        (("r1.csv", "--nonlinear", "--rig", "off.toml"), "magnet.off_below is inf"),
        (("r1.csv", "./r1.csv", "--nonlinear"), "given twice"),
        (("r1.csv", "--nonlinear", "--held", "r1.csv"), "given twice"),
        (("r1.csv", "--nonlinear", "--validate", "fast.csv"), "fast.csv, for validation, is sampled at 4000 Hz"),
        (("r1.csv", "--nonlinear", "--to", "0.02"), "has 40 samples"),
        (("r1.csv", "none.csv", "--nonlinear"), "none.csv does not exist"),
        (("r1.csv", "--nonlinear", "--rig", "coil.toml"), "a nonlinear bearing needs 'one-axis'"),
        (("r1.csv", "--nonlinear", "--rig", "wrong.toml"), "unknown parameter 'L_leek'"),
        (("r1.csv", "--nonlinear", "--json", "r1.csv"), "is also an input"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line_and_nothing_is_written(at, ambid, words, said) -> None:
    rigs = {
        "coil": 'model = "coil"',
        "wrong": 'model = "one-axis"\n[magnet.parameters]\nL_leek = { unit = "H" }',
        "exponential": 'model = "one-axis"\n[magnet]\nkind = "pair"\ngap = "exponential"',
        "triple": 'model = "one-axis"\n[magnet]\nkind = "triple"',
        "off": 'model = "one-axis"\n[magnet]\noff_below = inf',
    }
    for name, text in rigs.items():
        (at / f"{name}.toml").write_text(f'schema = "ambid.rig/1"\n{text}\n', encoding="utf-8")
    words = [at / w if w.removesuffix(".toml") in rigs else w for w in words]
    refused = ambid("identify", *words, *(() if "--json" in words else ("--json", at / "x.json")))
    assert refused.code == 2
    assert said in refused.err
    assert len(refused.err.splitlines()) == 1
    assert not [path for path in at.iterdir() if path.suffix != ".toml"]


def test_other_verbs_refuse_a_nonlinear_estimate(at, ambid) -> None:
    (at / "ball.json").write_text(by_hand({"ball.csv": seen(1)}).dumps(), encoding="utf-8")
    refused = ambid("track", "r1.csv", "--rig", "ball.toml", "--start", at / "ball.json")
    assert refused.code == 2
    assert "without --nonlinear" in refused.err
    assert ambid("validate", at / "ball.json", "r1.csv").code == 2  # it remembers no rig
    shown = ambid("validate", at / "ball.json", "r1.csv", "--rig", "ball.toml", "--strict")
    assert shown.code == 0, shown.out
    assert "innovations_consistent" in shown.out


@contextmanager
def _interrupting(title):
    """Progress that presses Ctrl-C at the third step of the search."""
    steps = 0

    def tick(stage, done=None, /):
        nonlocal steps
        steps += stage == "identify"
        if stage == "identify" and steps == 3:
            os.kill(os.getpid(), signal.SIGINT)

    yield tick


def test_ctrl_c_keeps_the_best_so_far(at, ambid, monkeypatch) -> None:
    monkeypatch.setattr(identify, "progress", _interrupting)
    out = at / "ball.json"
    found = ambid("identify", "r1.csv", "--rig", "ball.toml", "--nonlinear", "--to", "0.7", "--json", out)
    assert found.code == 130
    document = json.loads(out.read_text())
    assert document["status"] == "stalled"
    assert any("did not converge" in w for w in document["warnings"])
    assert found.out.splitlines()[0] == "verdict: do not use"
    assert "– stalled" in found.out


def test_data_do_not_count_twice_nor_judge_themselves(at, ambid) -> None:
    copy = at / "copy.csv"
    copy.write_bytes(Path("r1.csv").read_bytes())
    off = at / "off.toml"
    off.write_text(RIG.replace("[magnet]\n", "[magnet]\noff_below = 1e300\n"), encoding="utf-8")
    words = ("identify", "r1.csv", "--rig", "ball.toml", "--nonlinear")
    for more, said in (
        ((copy,), "r1.csv and copy.csv hold the same samples and would count twice. Omit one"),
        (("--held", copy), "r1.csv and copy.csv hold the same samples"),
        (("--validate", copy), "copy.csv, for validation, holds samples that the estimate is fitted to"),
        (("--rig", off), "every voltage is at or below off_below"),
    ):
        found = ambid(*words, *more)
        assert found.code == 2, found.out + found.err
        assert said in found.err
        assert found.err.count("\n") == 1


def test_a_second_ctrl_c_writes_nothing_even_if_the_search_took_it_for_the_first(at, ambid, monkeypatch) -> None:
    def takes_all(*_, tick, **__):
        for _ in range(2):
            try:
                os.kill(os.getpid(), signal.SIGINT)
                tick("search")
            except KeyboardInterrupt:
                pass  # as a search does, which then goes on with its best

    monkeypatch.setattr("ambid.job.identification.identify_nonlinear", takes_all)
    found = ambid("identify", "r1.csv", "--rig", "ball.toml", "--nonlinear", "--json", at / "ball.json")
    assert found.code == 130, found.out + found.err
    assert found.err == "ambid: interrupted; nothing was written\n"
    assert not list(at.iterdir())


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("fit_by_record", "r1.csv", "current", "innovation_sd"), {}),
        (("fit_by_record", "r1.csv", "current", "innovation_sd"), "x"),
        (("fit_by_record", "r1.csv"), {}),
        (("noise", "r1.csv"), {}),
        (("rig",), None),
    ],
)
def test_a_damaged_estimate_is_refused_in_one_line(at, ambid, place, value) -> None:
    document = json.loads(by_hand({"ball.csv": seen(1)}).dumps())
    names = list(document["noise"])
    inside = document
    for key in place[:-1]:
        inside = inside[names[0] if key == "r1.csv" else key]
    inside[names[0] if place[-1] == "r1.csv" else place[-1]] = value
    (at / "damaged.json").write_text(json.dumps(document), encoding="utf-8")
    found = ambid("validate", at / "damaged.json", "r1.csv")
    assert found.code == 2, found.err
    assert "is not a complete estimate" in found.err
