"""What people see of a nonlinear bearing: every number, every record, and where the law extrapolates."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.job.presentation import text as estimate_text
from ambid.report.estimate import curve_rows, estimate_document
from ambid.report.estimate_figures import bearing_evidence, figures, overview
from ambid.report.page import page_html
from tests.bearing.magnet.estimates import by_hand, seen


@pytest.fixture(scope="module")
def records():
    moving, coil = {"one.csv": seen(1), "two.csv": seen(2)}, replace(seen(3), held=True)
    return {**moving, "held.csv": coil}


@pytest.fixture(scope="module")
def estimate(records):
    e = by_hand(records)
    fits = {**e.fit, "held.csv": {"current": e.fit["held.csv"]["current"]}}
    return replace(e, fit=fits)


@pytest.fixture(scope="module")
def evidence(estimate, records):
    return bearing_evidence(estimate, [(r, 2.0) for r in records.values()])


@pytest.fixture(scope="module")
def drawn(evidence):
    return figures(evidence)


def test_the_text_holds_all_and_keeps_its_width(estimate):
    text = estimate_text(estimate)
    assert max(map(len, text.splitlines())) <= 80
    for p in estimate.parameters:
        assert any(line.startswith(f"{p.name} ") for line in text.splitlines())
    assert "moving: one.csv, two.csv" in text
    assert "held: held.csv" in text
    assert text.index("warning: one thing") < text.index("value ± sd")
    (row,) = [x.split() for x in text.splitlines() if x.startswith("held.csv ")]
    assert row[1] == "held"
    unfinished = estimate_text(replace(estimate, status="stalled"))
    assert unfinished.splitlines()[0] == "verdict: do not use"
    assert "– stalled" in unfinished
    assert next(x for x in unfinished.splitlines() if x.startswith("R ")).endswith("do not use")
    assert "identified" not in unfinished


def test_values_of_the_tables_are_those_of_the_curves(estimate):
    x, i = np.array([9e-3, 11e-3]), np.array([0.9, 1.0])
    k_i, _, ell = curve_rows(estimate, x, i)
    assert k_i[0] == ("k_i [N/A]", "at 0.9 A", "at 1 A")
    assert k_i[2][0].strip() == "11 mm"
    at = estimate.curves(11e-3, 1.0)
    value, sd = k_i[2][2].split(" ± ")
    assert float(value) == pytest.approx(at.k_i.value[0], abs=0.6 * float(sd))
    assert float(sd) == pytest.approx(at.k_i.sd[0], rel=0.06)
    assert ell[0][0] == "L [mH]"


def test_extrapolation_is_marked(estimate):
    _, k_x, _ = curve_rows(estimate, np.array([10e-3, 30e-3]), np.array([0.95]))
    assert not k_x[1][1].endswith("*")
    assert k_x[2][1].endswith("*")
    apart = replace(estimate, coil_hull=estimate.coil_hull * [3.0, 1.0])
    (_, k_x, ell) = curve_rows(apart, np.array([30e-3]), np.array([0.95]))
    assert k_x[1][1].endswith("*")
    assert not ell[1][1].endswith("*")  # a held rotor shows the coil there


def test_every_record_is_drawn(evidence, estimate, drawn):
    assert set(drawn) == {"force", "curves", "map", "records"}
    titles = [a.get_title(loc="left") for a in drawn["records"].axes]
    assert [t for t in titles if t and "%" not in t] == list(estimate.noise)
    first, held = evidence.records[0], evidence.records[2]
    assert first.time_s[0] > 2.0
    assert np.all(np.isfinite(first.predicted))
    assert np.all(np.isnan(held.predicted[:, 0]))
    assert np.mean((first.measured - first.predicted)[:, 1] ** 2 / first.sd[:, 1] ** 2) == pytest.approx(1.0, abs=0.1)
    page = overview(evidence)
    assert page.get_size_inches()[1] > sum(1.0 for _ in estimate.noise)


def test_the_line_of_balance_is_drawn_for_one_magnet(drawn):
    (legend,) = drawn["force"].legends
    assert "carries the weight" in [t.get_text() for t in legend.get_texts()]


def test_the_force_is_drawn_over_position_and_current_with_the_samples(evidence, estimate, drawn):
    axes = drawn["force"].axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("position [mm]", "current [A]")
    assert axes.get_title(loc="left").startswith("force [")
    low, high = estimate.range["position"]
    left, right = axes.get_xlim()
    assert left < 1e3 * low < 1e3 * high < right
    points = np.concatenate([np.asarray(x.get_xdata()) for x in axes.lines if x.get_marker() == "."])
    assert 1e3 * low <= points.min() < points.max() <= 1e3 * high


def test_the_page_holds_all_and_escapes_names(evidence, estimate):
    bad = "<b>one.csv"
    renamed = {bad if n == "one.csv" else n: levels for n, levels in estimate.noise.items()}
    fits = {bad if n == "one.csv" else n: f for n, f in estimate.fit.items()}
    e = replace(estimate, noise=renamed, fit=fits)
    page = page_html(estimate_document(e, lambda: replace(evidence, estimate=e)), e.verdict, made="2001-02-03")
    assert "&lt;b&gt;one.csv" in page
    assert bad not in page
    assert page.count("<svg ") + page.count("<img ") == 4  # a cloud of samples is smaller as pixels
    assert "Curves over position and current" in page
    assert "2001-02-03" in page
    assert "hyperbolic law" in page  # what each number means
