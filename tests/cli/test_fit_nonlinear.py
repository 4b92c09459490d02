"""``ambid fit`` with nonlinear structures: from words to file, table and exit code."""

from __future__ import annotations

import json
import os
import signal
from contextlib import contextmanager

import numpy as np
import pytest

from ambid.blackbox.data import settings_of
from ambid.cli import fit as verb
from ambid.nonlinear.fit import NONLINEAR_STRUCTURES

WORDS = ("--input", "u", "--output", "y", "--open-loop")


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    at = tmp_path_factory.mktemp("records")
    for k in range(3):
        rng = np.random.default_rng(20 + k)
        u, y = rng.uniform(-1, 1, 500), np.zeros(500)
        for t in range(2, 500):
            y[t] = 0.6 * y[t - 1] + 0.9 * u[t - 2] + 0.3 * u[t - 1] ** 2 + 0.02 * rng.standard_normal()
        table = np.column_stack([np.arange(500) / 100, u, y])
        np.savetxt(at / f"r{k}.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="")
    return at


@pytest.fixture
def at(records, monkeypatch, tmp_path):
    """The folder with the records; what is written goes elsewhere."""
    monkeypatch.chdir(records)
    return tmp_path


def test_several_records_to_file_figure_and_table(at, ambid) -> None:
    out, figure = at / "fit.json", at / "fit.png"
    found = ambid(
        "fit", "r0.csv", "r1.csv", "--structure", "narmax", *WORDS, "--orders", "ne=0,degree=2", "--validate",
        "r2.csv", "--json", out, "--plot", figure, "--strict",
    )  # fmt: skip
    assert found.code == 0, found.out
    assert max(map(len, found.out.splitlines())) <= 80
    lines = found.out.splitlines()
    assert lines[0] == "verdict: usable"
    assert lines[2].startswith("2 records: narmax, 1000 samples")
    assert any(x.startswith("u(t-1)^2 ") and x.endswith("%") and "±" in x for x in lines)
    assert "on the second record" in found.out
    document = json.loads(out.read_text())
    assert document["schema"] == "ambid.fit/1"
    assert document["orders"]["degree"] == 2
    assert len(document["records"]) == 2
    assert document["fit"]["y"]["simulation"] > 0.9
    assert figure.read_bytes().startswith(b"\x89PNG")
    again = ambid("validate", out, "r2.csv", "--json", "-")
    assert json.loads(again.out)["fit"]["y"] == document["validation"]["y"]
    shown = ambid("validate", out, "r2.csv")
    assert shown.code == 0
    assert "outside the training data" in shown.out


def test_the_former_name_of_orders_says_the_new_one(at, ambid) -> None:
    refused = ambid("fit", "r0.csv", "--structure", "narmax", *WORDS, "--settings", "ny=1")
    assert refused.code == 2
    assert "now --orders" in refused.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--structure", "narmax", "--at-rest"), "--at-rest is for linear structures"),
        (("--structure", "narmax", "--criterion", "aic"), "--criterion is for linear"),
        (("--structure", "narmax", "--orders", "degree"), "not NAME=VALUE"),
        (("--structure", "narmax", "--orders", "ny=1,ny=2"), "ny is given twice"),
        (("--structure", "narmax", "--orders", "degree=high"), "degree"),
        (("--structure", "narmax", "--orders", "dgree=2"), "Did you mean 'degree'"),
        (("--structure", "arx", "--seed", "1"), "--seed is for nonlinear structures"),
        (("--structure", "narmaxx"), "Did you mean 'narmax'"),
        (("r1.csv", "--structure", "arx"), "takes one record"),
        (("--structure", "narmax", "--plot", "fit.txt"), "must end in"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(at, ambid, words, said) -> None:
    refused = ambid("fit", "r0.csv", *words, *WORDS)
    assert refused.code == 2
    assert said in refused.err
    assert len(refused.err.splitlines()) == 1


def test_ctrl_c_keeps_the_best_so_far(at, ambid, monkeypatch) -> None:
    ticks = []

    @contextmanager
    def pressed(title):
        def tick(stage, done=None):
            ticks.append(stage)
            if len(ticks) == 5:
                os.kill(os.getpid(), signal.SIGINT)

        yield tick

    monkeypatch.setattr(verb, "progress", pressed)
    out = at / "fit.json"
    found = ambid("fit", "r0.csv", "--structure", "narx", *WORDS, "--json", out)
    assert found.code == 130
    document = json.loads(out.read_text())
    assert document["status"] == "stalled"
    assert document["model"] is not None
    assert "interrupted" in found.out
    assert ticks[-1] == "check"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_failed_fit_says_why_and_ends_with_three(at, ambid, monkeypatch) -> None:
    from dataclasses import replace

    from ambid import job

    real = job.fit

    def failing(*args, **options):
        fit = real(*args, **options)
        return replace(fit, model=None, covariance=None, status="failed", reason="it broke", checks={}, fit={})

    monkeypatch.setattr(job, "fit", failing)
    out = at / "fit.json"
    found = ambid("fit", "r0.csv", "--structure", "narmax", *WORDS, "--json", out, "--plot", at / "none.png")
    assert found.code == 3
    assert "no model: it broke" in found.out
    assert json.loads(out.read_text())["status"] == "failed"
    assert (at / "none.png").exists()  # with the verdict and the reason
    assert ambid("validate", out, "r0.csv").code == 2


def test_models_list_every_structure_with_its_settings(ambid) -> None:
    found = ambid("models")
    assert found.code == 0
    part = found.out[found.out.index("nonlinear structures") :]
    for s in NONLINEAR_STRUCTURES.values():
        assert f"\n  {s.name}" in part
        for name in s.settings:
            assert f"\n    {name} " in part
    assert max(map(len, part.splitlines())) <= 80


def test_settings_as_they_are_written() -> None:
    read = settings_of
    assert read("auto") == {}
    assert read("ny=2, nu=2/3,prior=0.5,criterion=bic,neurons=auto,x=1e-3") == {
        "ny": 2, "nu": (2, 3), "prior": 0.5, "criterion": "bic", "x": 1e-3,
    }  # fmt: skip


def test_data_do_not_count_twice_nor_judge_themselves(at, ambid) -> None:
    words = ("fit", "r0.csv", "--structure", "narmax", *WORDS, "--orders", "ne=0")
    for more, said in (
        (("./r0.csv",), "record r0.csv is given twice and would count twice. Omit one"),
        (("--validate", "r0.csv"), "--validate r0.csv is used for fitting too"),
        (("--validate", "r0.csv", "--to", "3"), "--validate r0.csv is used for fitting too"),
    ):
        found = ambid(*words, *more)
        assert (found.code, said in found.err) == (2, True), found.err
    assert ambid(*words, "--to", "3", "--json", at / "fit.json").code == 0
    found = ambid("validate", at / "fit.json", "r0.csv", "--from", "3")
    assert found.code == 0, found.err


@pytest.mark.parametrize(("place", "value"), [(("units",), []), (("model", "cloud", "marks", 0, 1), float("nan"))])
def test_a_damaged_fit_is_refused_in_one_line(at, ambid, place, value) -> None:
    out = at / "fit.json"
    assert ambid("fit", "r0.csv", "--structure", "narx", *WORDS, "--orders", "iterations=1", "--json", out).code == 0
    document = inside = json.loads(out.read_text())
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    out.write_text(json.dumps(document), encoding="utf-8")
    found = ambid("validate", out, "r1.csv")
    assert found.code == 2, found.err
    assert "is not a complete fit" in found.err


def test_strict_looks_at_the_second_record(at, ambid) -> None:
    rng = np.random.default_rng(7)
    u, y = rng.uniform(-1, 1, 300), rng.standard_normal(300)
    table = np.column_stack([np.arange(300) / 100, u, y])
    np.savetxt(at / "noise.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="")
    fit = at / "held.json"
    told = ambid("fit", "r0.csv", "--structure", "narmax", *WORDS, "--orders", "ne=0,degree=2", "--json", fit,
                 "--validate", at / "noise.csv", "--strict")  # fmt: skip
    assert told.code == 3
    assert "it does not hold on the second record: one-step errors of y" in told.out
    judged = ambid("validate", fit, at / "noise.csv", "--strict")
    assert judged.code == 3
    assert "times as large as at identification" in judged.out
    assert json.loads(ambid("validate", fit, at / "noise.csv", "--json", "-").out)["passed"] is False
    assert ambid("validate", fit, "r2.csv", "--strict").code == 0
    linear = at / "linear.json"
    ambid("fit", "r0.csv", "--structure", "arx", *WORDS, "--orders", "na=2,nb=2,nk=1", "--json", linear)
    assert ambid("validate", linear, "r2.csv", "--strict").code == 0
    assert ambid("validate", linear, at / "noise.csv", "--strict").code == 3
