"""Every result of every verb: verdict first in text, file, page and figure; the same names; back from its file."""

import json
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import ambid
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.session import Course, acquire
from ambid.errors import AmbidError
from ambid.estimation.estimate import Check
from ambid.estimation.result import Reason, Result, Verdict
from ambid.job import presentation
from ambid.job.files import Files
from ambid.signals import excitation
from ambid.simulation import simulate_preset
from ambid.validation.inspection import inspect
from tests.bearing.magnet.estimates import by_hand, seen
from tests.job.benches import prototype
from tests.tracking.tracks import track_of

SUFFIX = {"track": ".jsonl"}
ARX = {"na": 2, "nb": 2, "nk": 1}


@pytest.fixture(scope="module")
def record():
    bench = ambid.preset("thesis")
    u = excitation("multisine", 2000, bench.rate_hz, amplitude=10.0, band=(5.0, 2000.0), seed=3)
    return simulate_preset(bench, u, seed=3).record


@pytest.fixture(scope="module")
def results(record, tmp_path_factory):
    """One result of each kind, small."""
    words = {"input": "voltage", "output": "current"}
    estimate = ambid.identify(record)
    settings = {"ny": 2, "nu": 2, "ne": 0, "degree": 1}
    fit = ambid.fit(record, structure="arx", orders=ARX, **words)
    device = SimulatedDevice(prototype())
    with device:
        course = Course(mode="levitate", seconds=0.5, settle_s=0.2)
        acquired = acquire(device, prototype(), tmp_path_factory.mktemp("run") / "run.h5", course)
    return {
        "estimate": estimate,
        "bearing": by_hand({"one.csv": seen(1)}),
        "fit": fit,
        "nonlinear fit": ambid.fit(record, structure="narmax", orders=settings, **words),
        "validation": ambid.validate(estimate, record),
        "validation of a fit": ambid.validate(fit, record),
        "response": ambid.frf(record, band=(20.0, 1500.0), orders={"nf": 2, "nb": 2}, open_loop=True, **words),
        "comparison": ambid.compare(record, [("arx", ARX), ("fir", {"nb": 3, "nk": 1})], **words),
        "track": track_of(seconds=2.0, every_s=0.05),
        "inspection": inspect(record),
        "acquisition": acquired,
        "experiment": ambid.design_experiment("prototype", seconds=1.0, lines=10),
    }


KINDS = (
    "estimate", "bearing", "fit", "nonlinear fit", "validation", "validation of a fit", "response", "comparison",
    "track", "inspection", "acquisition", "experiment",
)  # fmt: skip


@pytest.fixture(params=KINDS)
def result(request, results):
    return results[request.param]


@pytest.fixture
def again(request, results, tmp_path):
    """A result, and itself back from its file."""
    name = request.param
    path = tmp_path / f"result{SUFFIX.get(name, '.json')}"
    results[name].save(path)
    return results[name], ambid.load(path), path


def test_the_register_knows_every_kind(results):
    assert {type(r).__name__ for r in results.values()} <= set(presentation._KINDS)
    assert all(isinstance(r, Result) for r in results.values())


def test_the_verdict_is_the_first_line(result):
    word = {"usable": "usable", "caution": "use with caution", "unusable": "do not use"}[result.verdict.word]
    lines = result.summary().splitlines()
    assert lines[0] == f"verdict: {word}"
    assert max(map(len, lines)) <= 80
    for r in result.verdict.reasons:
        assert r.text.split()[0] in result.summary()
    assert result.passed == (result.verdict.word == "usable")


def test_a_short_repr_names_it_and_a_notebook_shows_a_table(result):
    assert "\n" not in repr(result)
    assert len(repr(result)) < 400
    assert type(result).__name__ in repr(result)
    page = result._repr_html_()
    assert page.startswith("<div>")
    assert "<table>" in page


@pytest.mark.parametrize("again", KINDS, indirect=True)
def test_it_comes_back_from_its_file(again):
    before, after, path = again
    first = json.loads(
        path.read_text(encoding="utf-8").splitlines()[-1] if path.suffix == ".jsonl" else path.read_text()
    )
    assert first["verdict"]["word"] == before.verdict.word
    assert after.used is None
    assert after.verdict == before.verdict
    assert presentation.document(after) == presentation.document(before)
    assert after.summary().splitlines()[0] == before.summary().splitlines()[0]
    assert list(after.to_dataframe()) == list(before.to_dataframe())


@pytest.mark.parametrize("again", KINDS, indirect=True)
def test_it_is_drawn_with_and_without_its_record(again, monkeypatch):
    monkeypatch.setattr("ambid.report.page.picture", lambda *_: ("<svg></svg>", {}))  # drawing is slow
    before, after, path = again
    for r in (before, after):
        figure = r.plot()
        assert "verdict" in [t.get_text().strip(": ") for box in figure.artists for t in _texts(box)]
    page = path.with_suffix(".html")
    after.report(page)
    text = page.read_text(encoding="utf-8")
    place = text.index('<p class="verdict">')
    assert text.index("<h1>") < place < text.index("<h2>")
    assert re.search(r"verdict: <span class=\"(good|doubt|bad)\">", text)
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", text)


def _texts(artist):
    from matplotlib.text import Text

    return artist.findobj(Text)


def test_parameters_are_asked_for_by_name(results):
    assert results["fit"]["a1"].sd > 0
    assert results["response"]["num[0,0]z1"].value
    course = results["track"]["k_i"]
    assert course.values[-1] == course.value
    assert course.values.shape == course.t.shape == course.sds.shape
    assert course.ci95 == pytest.approx((course.value - 1.96 * course.sd, course.value + 1.96 * course.sd), rel=1e-4)
    assert results["inspection"]["current"].unit == "A"
    for kind in ("estimate", "fit", "track"):
        with pytest.raises(AmbidError, match="k_j"):
            results[kind]["k_j"]


def test_models_predict_simulate_and_are_validated(results, record):
    u = record["voltage"].values
    for kind in ("estimate", "fit", "nonlinear fit"):
        one, ten = (results[kind].predict(record, ahead=k)["current"] for k in (1, 10))
        y = record["current"].values
        known = np.isfinite(ten)
        spread = np.std(y)
        assert np.std((y - one)[known]) <= np.std((y - ten)[known]) < 0.2 * spread, kind
        free = results[kind].simulate(u)["current"]
        assert np.std((y - free)[500:]) < 0.2 * spread, kind
        assert results[kind].validate(record).verdict.word in ("usable", "caution")
    assert not hasattr(results["track"], "simulate")
    assert not hasattr(results["comparison"], "predict")
    with pytest.raises(AmbidError, match="shape"):
        results["estimate"].simulate(np.zeros((5, 2)))


@pytest.mark.parametrize("ahead", [0, -1, 1.5, True, None, "3", 10**9])
def test_what_is_no_number_of_samples_ahead_is_refused(results, record, ahead):
    with pytest.raises(AmbidError, match="ahead is"):
        results["estimate"].predict(record, ahead=ahead)


@pytest.mark.parametrize("u", [[], "voltage", 1j * np.ones(9), [np.nan], np.ones((9, 2)), [[1], [1, 2]], {"u": [1.0]}])
def test_what_are_no_inputs_is_refused(results, u):
    with pytest.raises(AmbidError, match="voltage in SI units, are needed"):
        results["estimate"].simulate(u)


def test_a_table_without_time_is_predicted_and_judged_at_the_rate_that_is_said(results, record):
    table, words = {name: record[name].values for name in record}, {"units": {"voltage": "V", "current": "A"}}
    words["units"]["position"] = "m"
    wanted = results["estimate"].predict(record)["current"]
    found = results["estimate"].predict(table, rate_hz=record.rate_hz, **words)["current"]
    np.testing.assert_array_equal(found, wanted)
    with pytest.raises(AmbidError, match="rates must agree"):
        results["estimate"].validate(table, rate_hz=2 * record.rate_hz, **words)


def test_what_it_does_not_have_is_refused_under_any_key(results):
    for key in ("nope", 0, None):
        for kind in ("estimate", "fit", "track", "inspection"):
            with pytest.raises(AmbidError, match="has no"):
                results[kind][key]
    assert "R" in results["estimate"]
    assert list(results["estimate"]) == [p.name for p in results["estimate"].parameters]


@pytest.mark.parametrize(
    ("at", "value"),
    [(("schema",), []), (("record", "samples"), None), (("continuous", "A"), []), (("parameters", "R", "sd"), -1.0)],
)
def test_a_file_that_was_edited_is_refused_on_reading(results, tmp_path, at, value):
    document = json.loads(presentation.document(results["estimate"]))
    part = document
    for key in at[:-1]:
        part = part[key]
    part[at[-1]] = value
    (tmp_path / "e.json").write_text(json.dumps(document))
    with pytest.raises(AmbidError, match=r"has schema|is not a complete estimate"):
        ambid.load(tmp_path / "e.json")


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ({}, "'sensitivity.x.peak_db' is missing"),
        ({"peak_db": None, "frequency_hz": 16.0, "zone": "A", "measured_peak_db": None}, "sensitivity.x.peak_db"),
        (3.0, "sensitivity.x is 3.0 instead of an object"),
    ],
)
def test_a_sensitivity_that_was_edited_is_refused_in_one_line(results, tmp_path, entry, why):
    document = json.loads(presentation.document(results["estimate"]))
    (tmp_path / "e.json").write_text(json.dumps({**document, "sensitivity": {"x": entry}}))
    with pytest.raises(AmbidError) as refused:
        ambid.load(tmp_path / "e.json")
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("factor", [1e160, 1e-310])
def test_values_whose_squares_overflow_or_vanish_are_refused_without_a_warning(record, factor):
    table = {f"{c.name} [{c.unit}]": c.values for c in record.channels}
    table["voltage [V]"] = factor * table["voltage [V]"]
    with pytest.raises(AmbidError, match="no sensor shows"):
        ambid.identify(table, rate_hz=record.rate_hz)
    if factor < 1:
        assert ambid.info(table, rate_hz=record.rate_hz)["voltage"].unit == "V"


def test_linear_plants_go_to_python_control(results):
    control = pytest.importorskip("control")
    plant = results["estimate"].to_control()
    assert isinstance(plant, control.StateSpace)
    assert plant.poles() == pytest.approx(results["estimate"].continuous.poles)
    assert plant.input_labels == ["voltage"]
    assert plant.state_labels == ["position", "velocity", "current"]
    assert results["fit"].to_control().dt == results["fit"].dt
    assert results["fit"].to_control().output_labels == list(results["fit"].outputs)
    assert results["bearing"].to_control().nstates == 3
    assert not hasattr(results["nonlinear fit"], "to_control")


def test_grave_reasons_come_first_and_make_it_unusable():
    minor, grave = Reason(check="a", text="x"), Reason(check="b", text="y", grave=True)
    assert Verdict.of(()).word == "usable"
    assert Verdict.of((minor,)).word == "caution"
    assert Verdict.of((minor, grave)) == Verdict(word="unusable", reasons=(grave, minor))


def test_what_makes_each_kind_doubtful_or_useless(results):
    bad = Check(passed=False, detail="as it is")
    useless = {"current": {"one_step": {"fit": -0.1, "rmse": 1.0}, "simulation": None}}
    said = {
        "fit": ({"checks": {"residuals_white": bad}}, "caution"),
        "estimate": ({"checks": {"units": bad}}, "unusable"),
        "nonlinear fit": ({"status": "stalled"}, "unusable"),
        "validation": ({"checks": {"residuals_white": bad}}, "caution"),
        "validation of a fit": ({"fit": useless}, "unusable"),
        "comparison": ({"entries": (replace(results["comparison"].entries[0], one_step=-1.0),)}, "unusable"),
        "inspection": ({"faults": (Reason(check="saturation", text="there"),)}, "caution"),
        "acquisition": ({"recorded": None}, "unusable"),
    }  # fmt: skip
    for kind, (change, word) in said.items():
        assert replace(results[kind], **change).verdict.word == word, kind
    response = results["response"]
    noisy = replace(response.response, covariance=response.response.covariance * 1e12)
    assert replace(response, response=noisy).verdict.word == "unusable"
    assert replace(response, open_loop=False).verdict.reasons[0].check == "feedback"


def test_a_measured_record_is_never_written_over(results, tmp_path):
    taken = tmp_path / "run.csv"
    taken.write_text("voltage [V]\n1\n", encoding="utf-8")
    for write in (results["fit"].save, lambda path: Files().claim(path, "path")):
        with pytest.raises(AmbidError, match="not a result of ambid"):
            write(taken)
    with pytest.raises(AmbidError, match=r"must end in \.html"):
        results["fit"].report(taken)
    assert taken.read_text(encoding="utf-8") == "voltage [V]\n1\n"


def test_the_layout_of_a_file_reaches_its_reader(results, record, tmp_path):
    path, estimate = tmp_path / "r.csv", results["estimate"]
    values = zip(*(c.values for c in record.channels), strict=True)
    rows = [";".join(f"{x:.9g}".replace(".", ",") for x in row) for row in values]
    path.write_text("\n".join([";".join(f"{c.name} [{c.unit}]" for c in record.channels), *rows]))
    verbs = [partial(ambid.validate, results[name]) for name in ("estimate", "fit")]
    for verb in (*verbs, partial(ambid.margins, estimate=estimate)):
        with pytest.raises(AmbidError, match="layout decimal='coma'"):
            verb(path, rate_hz=record.rate_hz, layout={"decimal": "coma"})
    same = ambid.validate(estimate, path, rate_hz=record.rate_hz, layout={"decimal": "comma"})
    shares = [x.fit["current"]["simulation"] for x in (same, results["validation"])]
    assert shares[0] == pytest.approx(shares[1], rel=1e-6)
