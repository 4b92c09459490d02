"""What a run tells: a result before its report, names that are free, the page's words, and that the output is off."""

import json
import re
import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from ambid import preset, simulate
from ambid.console.folder import Folder
from ambid.console.runs import Run, Runs, usual_times
from ambid.console.worker import JOBS, Worker
from ambid.errors import AmbidError
from ambid.job import acquiring, identify, load
from ambid.job import presentation as room
from ambid.record import write_record
from ambid.rig import draft_rig, preset_text, rig_from_text
from tests.console.pages import LIVE, prototype_rig, told, until


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A record, its rig and an estimate."""
    folder = tmp_path_factory.mktemp("bench")
    record = simulate("thesis", duration=0.5, seed=1)
    write_record(record, folder / "rec.csv")
    (folder / "rig.toml").write_text(draft_rig(record), encoding="utf-8")
    identify(folder / "rec.csv", folder / "rig.toml").save(folder / "known.json")
    return folder


@pytest.fixture
def folder(bench, tmp_path):
    for file in bench.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


def order(frames):
    return [m["kind"] for m in frames if m["kind"] in ("result", "report", "end")]


def test_the_verdict_and_its_table_come_before_the_report(folder):
    spec = {"job": "identify", "record": "rec.csv", "rig": "rig.toml", "out": "found"}
    frames = until(Runs(folder).start(spec))
    assert order(frames) == ["result", "report", "end"]
    found, content = load(folder / "found.json"), told(frames, "result")[0]["content"]
    assert content == json.loads(json.dumps(room.content(found)))
    assert told(frames, "report")[0] == {"kind": "report", "name": "found.html", "pictures": [], "why": ""}
    assert (folder / "found.html").exists()
    again = Runs(folder).start(spec)  # of the same name: the next that is free, and a time that is known
    second = until(again)
    assert told(second, "result")[0]["name"] == "found-2"
    assert load(folder / "found-2.json").values == found.values
    first_s, whole_s = usual_times(again)
    assert 0.0 < first_s < whole_s
    lefts = [m["left"] for m in told(second, "progress")]
    assert all(left is not None for left in lefts)
    assert told(frames, "progress")[0]["left"] is None


def test_the_table_says_value_sd_interval_unit_role_and_meaning(bench):
    e = load(bench / "known.json")
    (table,) = [p for p in room.content(e)["sections"][0]["parts"] if p["kind"] == "table"]
    labels, *rows = table["content"]
    assert labels == ["", "meaning", "role", "value ± sd", "95 % interval", "in SI", "verdict"]
    assert labels[table["about"]] == "meaning"
    assert [r[0] for r in rows] == [p.name for p in e.parameters]
    texts = [[c if isinstance(c, str) else c[0] for c in r] for r in rows]
    assert all(all(r[k] for k in (1, 2, 3, 5, 6)) for r in texts)
    for p, row in zip(e.parameters, texts, strict=True):
        assert row[2] == p.role
        assert not p.sd or re.search(r"[A-Za-z]$", row[4])  # an interval has its unit, too


def test_a_loop_is_told_with_its_figure_afterwards(folder):
    write_record(simulate("rmit-axis", duration=0.5, seed=1), folder / "loop.csv")
    (folder / "loop.toml").write_text(preset_text(preset("rmit-axis")), encoding="utf-8")
    frames = until(Runs(folder).start({"job": "margins", "record": "loop.csv", "rig": "loop.toml", "out": "loop"}))
    assert order(frames) == ["result", "report", "end"], told(frames, "end")
    assert "sensitivity" in json.dumps(told(frames, "result")[0]["content"])
    (picture,) = told(frames, "report")[0]["pictures"]
    assert picture["image"].startswith("data:image/")


@pytest.fixture
def worker(tmp_path):
    place = tmp_path / "run"
    place.mkdir()
    (place / "spec.json").write_text(json.dumps({"job": "live", "out": "found", "folder": str(tmp_path)}))
    made = Worker(Run(place))
    yield made
    made.feed.close()


def test_a_report_that_cannot_be_drawn_is_told_and_changes_nothing(worker, bench):
    estimate = load(bench / "known.json")

    def fails(*_args):
        raise ValueError("no room for a legend")

    name = worker.give(estimate)
    worker.draw(SimpleNamespace(report=fails), name)
    frames = until(worker.run, "report")
    assert told(frames, "report")[0]["why"] == "the report could not be drawn: no room for a legend"
    assert load(worker.folder / "found.json").values == estimate.values


@pytest.mark.parametrize("taken", ["found.json", "found.html", "found.toml"])
def test_a_result_takes_a_name_of_its_own(tmp_path, taken):
    (tmp_path / taken).write_text("x")
    assert Folder(tmp_path).free("found") == "found-2"
    assert Folder(tmp_path).free("found") == "found-3"  # by another run, meanwhile
    assert (tmp_path / taken).read_text() == "x"


def test_an_output_is_told_to_be_off_once_its_device_has_confirmed_it(worker):
    stops = []
    device = SimpleNamespace(stop=lambda: stops.append(1), port="here")
    with worker.minded(device) as minded:
        assert minded.port == "here"
        minded.stop()  # at the end of a course that nobody wished to end
        assert worker.desk._state.get("off") is None
        worker.wished.set()
        minded.stop()
        assert worker.desk._state["off"] is True
    assert len(stops) == 3
    assert len(told(until(worker.run, "off"), "off")) == 1


def test_an_output_whose_line_is_lost_is_not_told_to_be_off(worker):
    def lost():
        raise AmbidError("the line is lost")

    with worker.minded(SimpleNamespace(stop=lost)):
        worker.wished.set()
    worker.end("failed", "the line is lost")
    assert not told(until(worker.run), "off")


def test_an_output_whose_line_is_lost_in_a_trial_is_not_told_to_be_off(worker, monkeypatch):
    def lost(*_args, **_more):
        raise AmbidError("the line is lost")

    prototype_rig(worker.folder)
    worker.spec.update(LIVE, out="run.h5", pace="fastest")
    monkeypatch.setattr(acquiring, "opened", lambda *_args, **_more: nullcontext(SimpleNamespace(stop=lost)))
    monkeypatch.setattr(acquiring.Request, "course", lost)
    with pytest.raises(AmbidError, match="the line is lost"):
        JOBS["live"](worker)
    worker.end("refused", "the line is lost")
    assert not told(until(worker.run), "off")


def test_a_live_run_that_is_stopped_tells_that_its_output_is_off(folder):
    prototype_rig(folder)
    run = Runs(folder).start({**LIVE, "out": "run.h5"})
    until(run, "line")
    run.say("stop")
    frames = until(run)
    kinds = [m["kind"] for m in frames if m["kind"] in ("stopping", "off", "end")]
    assert (sorted(kinds[:-1]), kinds[-1]) == (["off", "stopping"], "end")  # of two threads
    assert run.status["off"] is True


SOLID = {"job": "identify", "record": "rec.csv", "rig": "rig.toml", "out": "x"}


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ({"job": "preview", "record": "untimed.csv"}, "or give Rate"),
        ({"job": "preview", "record": "gap.csv"}, "give Gaps = interpolate or Gaps = cut"),
        ({**SOLID, "record": "gap.csv"}, "give gaps in [record] of the rig = interpolate"),
        ({**SOLID, "record": "untimed.csv"}, "give rate_hz in [record] of the rig"),
        ({"job": "margins", "estimate": "known.json", "rig": "rig.toml", "out": "x"}, None),
        ({"job": "result", "estimate": "edited.json"}, "Write it again with 'Identify'"),
        ({"job": "live", "port": "simulated", "rig": "rig.toml", "seconds": 1e-9, "out": "x.h5"}, None),
        ({"job": "live", "port": "replay:rec.csv", "rig": "rig.toml", "out": "x.h5", "excitation": "prbs"}, "Excitat"),
        ({"job": "commission", "port": "simulated", "rig": "rig.toml", "out": "x"}, None),
    ],
)  # fmt: skip
def test_a_refusal_is_in_the_words_of_the_page(folder, spec, words):
    lines = (folder / "rec.csv").read_text(encoding="utf-8").splitlines()
    head, rows = next(k for k, x in enumerate(lines) if x.startswith("time")), lines
    (folder / "untimed.csv").write_text("\n".join(x.partition(",")[2] for x in rows[head:]), encoding="utf-8")
    cells = rows[head + 40].split(",")
    (folder / "gap.csv").write_text(
        "\n".join([*rows[: head + 40], ",".join([*cells[:-1], ""]), *rows[head + 41 :]]), encoding="utf-8"
    )
    document = json.loads((folder / "known.json").read_text(encoding="utf-8"))
    (folder / "edited.json").write_text(json.dumps({**document, "covariance": []}), encoding="utf-8")
    port = str(spec.get("port", "")).replace("replay:", f"replay:{folder}/")
    (end,) = told(until(Runs(folder).start({**spec, **({"port": port} if port else {})})), "end")
    assert end["how"] == "refused", end
    assert words is None or words in end["why"]
    assert not re.search(r"--\w|'ambid |ambid\.\w+\(", end["why"]), end["why"]


def test_a_record_is_read_with_a_rate_and_gaps_which_its_rig_keeps(folder):
    lines = (folder / "rec.csv").read_text(encoding="utf-8").splitlines()
    head = next(k for k, x in enumerate(lines) if x.startswith("time"))
    (folder / "untimed.csv").write_text("\n".join(x.partition(",")[2] for x in lines[head:]), encoding="utf-8")
    spec = {"job": "preview", "record": "untimed.csv", "rate_hz": 5000.0, "gaps": "interpolate"}
    said = until(Runs(folder).start(spec))
    (shown,), (seen,) = told(said, "preview"), told(said, "look")
    rig = rig_from_text(shown["draft"], folder / "draft.toml")
    assert (rig.record.rate_hz, rig.record.gaps) == (5000.0, "interpolate")
    assert np.allclose(np.diff(seen["t"])[0] * 5000.0 % 1.0, 0.0, atol=1e-6)


def test_a_result_that_was_edited_is_refused_in_words(folder):
    document = json.loads((folder / "known.json").read_text(encoding="utf-8"))
    (folder / "edited.json").write_text(json.dumps({**document, "validation": {"x": [1]}}), encoding="utf-8")
    (end,) = told(until(Runs(folder).start({"job": "result", "estimate": "edited.json"})), "end")
    assert end["how"] == "refused"
    assert "edited.json is not a complete result (KeyError: 'samples')" in end["why"]
