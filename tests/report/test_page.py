"""A page holds the record's samples and what pointers read, runs no other script than its own, and is a PDF too."""

import base64
import hashlib
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from ambid.report.document import Document, Preformatted, Section, grid, page_sections
from ambid.report.estimate import estimate_document
from ambid.report.estimate_figures import responses
from ambid.report.page import page_html, page_pdf
from ambid.report.picture import _needed, picture
from ambid.report.signals import EVERY_SAMPLE, Traces, strips_of

PLANTED = "</script><script>document.title = 'planted'</script><img src=x onerror=\"document.title = 'planted'\">"
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def page(unstable):
    return estimate_document(unstable.estimate, lambda: unstable)


@pytest.fixture(scope="module")
def text(page, unstable):
    return page_html(page, unstable.estimate.verdict, made="2001-01-01")


def data_of(text):
    return [json.loads(x) for x in re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)]


def array(found, k):
    return np.frombuffer(base64.b64decode(found["arrays"][k]), dtype="<f4")


def long_traces(n, name="position"):
    rng = np.random.default_rng(1)
    y = rng.standard_normal((n, 1)) + np.linspace(0, 3, n)[:, None]
    y[n // 3] = 50.0
    return Traces(
        time_s=2 + np.arange(n) / 1000.0, names=(name,), units=("m",), measured=y, predicted=0.9 * y, sd=np.ones(1),
        inputs=y, input_names=(name,), input_units=("V",), title=name,
    )  # fmt: skip


def test_the_page_holds_every_sample_to_more_digits_than_it_shows(text, unstable):
    (found,) = [x for x in data_of(text) if "strips" in x]
    traces = unstable.traces
    assert found["every"] == 1
    assert found["samples"] == traces.time_s.size
    at = found["start_s"] + found["step_s"] * np.arange(found["samples"])
    np.testing.assert_allclose(at, traces.time_s, rtol=1e-12)
    assert [s["title"] for s in found["strips"]] == [
        "position", "position: innovation", "current", "current: innovation", "voltage",
    ]  # fmt: skip
    for j, strip in enumerate(found["strips"][0:4:2]):
        measured, predicted = strip["lines"]
        y, e = array(found, measured["values"]), array(found, predicted["less"])
        assert predicted["values"] == measured["values"]
        np.testing.assert_allclose(y, traces.measured[:, j], rtol=6e-8)
        np.testing.assert_allclose(e, traces.errors[:, j], rtol=6e-8)
        near = 2e-7 * np.max(np.abs(y))
        np.testing.assert_allclose(y.astype(float) - e, traces.predicted[:, j], rtol=0, atol=near)
        bound = found["strips"][2 * j + 1]["bound"]
        assert np.mean(np.abs(e) > bound) == pytest.approx(0.05, abs=0.02)
    np.testing.assert_allclose(array(found, found["strips"][4]["lines"][0]["values"]), traces.inputs[:, 0], rtol=6e-8)


def test_a_long_record_is_shown_by_extremes_and_its_largest_errors_in_full():
    n = EVERY_SAMPLE + 1
    traces = long_traces(n)
    whole, close = strips_of(traces).packed()
    y, line = traces.measured[:, 0], whole["strips"][0]["lines"][0]
    low, high, every = array(whole, line["low"]), array(whole, line["high"]), whole["every"]
    for k in range(low.size):
        part = y[k * every : (k + 1) * every].astype("<f4")
        assert (low[k], high[k]) == (part.min(), part.max())
    first = round((close["start_s"] - 2) * 1000)
    assert close["every"] == 1
    assert first <= n // 3 < first + close["samples"]
    shown = array(close, close["strips"][0]["lines"][0]["values"])
    np.testing.assert_array_equal(shown, y[first : first + close["samples"]].astype("<f4"))
    assert first + close["worst"][0] <= n // 3 < first + close["worst"][1]
    assert len(strips_of(long_traces(EVERY_SAMPLE)).packed()) == 1


def test_a_pointer_reads_the_values_of_a_bode_diagram(text, unstable):
    r = responses(unstable.estimate)
    panels = [(x, p) for x in data_of(text) if "panels" in x for p in x["panels"]]
    (found,) = [(x, p) for x, p in panels if p["names"] == ["frequency [Hz]", "magnitude [m/V]"]]
    line = next(q for q in found[1]["points"] if q["label"] == "identified plant")
    np.testing.assert_allclose(array(found[0], line["x"]), r.frequency_hz, rtol=1e-7)
    np.testing.assert_allclose(array(found[0], line["y"]), np.abs(r.G[:, 0, 0]), rtol=1e-7)
    marks = {q["label"] for _, p in panels if p["names"][0] == "real part [rad/s]" for q in p["points"]}
    assert marks == {"pole", "unstable pole"}


def test_points_lie_where_the_picture_draws_them():
    figure = Figure(figsize=(4, 3))
    axes = figure.subplots()
    axes.loglog([1.0, 10.0, 100.0], [0.1, 5.0, 1e3], label=f"a{PLANTED}")
    svg, read = picture(figure, PLANTED, "p-")
    assert PLANTED not in svg
    assert read["panels"][0]["points"][0]["label"] == f"a{PLANTED}"
    (left, top, width, height), (x0, x1, log), (y0, y1, _) = (read["panels"][0][k] for k in ("box", "x", "y"))
    assert log
    place = [
        (left + width * np.log(x / x0) / np.log(x1 / x0), top + height * (1 - np.log(y / y0) / np.log(y1 / y0)))
        for x, y in ((1, 0.1), (10, 5), (100, 1e3))
    ]
    drawn = re.search(r' d="(M\S+ \S+l[^"]*)"[^>]* stroke="#1f77b4"', svg)[1]
    steps = np.array([float(x) for x in re.findall(r"-?[\d.]+", drawn)]).reshape(-1, 2)
    np.testing.assert_allclose(np.cumsum(steps, axis=0), place, atol=0.02)


def test_a_long_line_keeps_its_shape_in_fewer_points():
    x = np.linspace(0, 700, 2000)
    line = np.column_stack([x, 100 * np.sin(x / 50)])
    kept = _needed(line)
    assert kept.sum() < 400
    assert np.max(np.abs(np.interp(x, x[kept], line[kept, 1]) - line[:, 1])) < 0.5  # 0.2 across, where it is steepest


def test_no_script_but_its_own_may_run(text):
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
    assert policy.startswith("default-src 'none'; img-src data:; ")
    assert "unsafe" not in policy
    for tag in ("script", "style"):
        (own,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        said = base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{said}'" in policy
    assert not re.findall(r"<[^>]* (?:style|on\w+)=", text.split("<script>")[0])


def test_the_page_is_small(text):
    """What hides in it: 75 kB of script and sheet, 27 bytes for a sample of five signals, 40 kB for a figure."""
    assert len(text) < 75_000 + 27 * 3000 + 6 * 40_000


def test_the_pdf_has_the_same_sections(page, unstable):
    drawn = [x for x in page_sections(page) if x.figure is not None]
    few = replace(page, drawings=lambda: drawn[-2:])
    made = [page_pdf(few, unstable.estimate.verdict, made="2001-01-01") for _ in range(2)]
    assert made[0] == made[1]
    assert made[0].startswith(b"%PDF")
    assert len(re.findall(rb"/Type /Page\b", made[0])) == 2 + 2 + 1  # tables, figures, where it comes from


@pytest.mark.skipif(BROWSER is None, reason="there is no Chromium here")
def test_a_browser_draws_the_signals_and_runs_nothing_that_names_hold(unstable, tmp_path):
    traces = long_traces(EVERY_SAMPLE + 1, PLANTED)

    def figure(_):
        found = Figure()
        found.subplots().plot([0, 1], label=PLANTED)
        return found

    parts = [Preformatted(text=PLANTED), grid([[PLANTED], [PLANTED]])]
    section = Section(title=PLANTED, figure=figure, signals=[strips_of(traces)], parts=parts)
    sections = [section, replace(section, signals=())]
    page = Document(
        title="sound", subtitle=PLANTED, sections=sections, figure=figure, frame=parts[1].frame, drawings=tuple
    )
    text = page_html(page, unstable.estimate.verdict)
    for name, more in (("page", ""), ("foreign", "<script>document.title = 'planted'</script>")):
        (tmp_path / f"{name}.html").write_text(text.replace("</body>", f"{more}</body>"), encoding="utf-8")
        command = (
            BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom",
            f"--user-data-dir={tmp_path / 'profile'}", (tmp_path / f"{name}.html").as_uri(),
        )  # fmt: skip
        found = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
        assert "<title>sound</title>" in found
        assert '<div class="drawn">' in found
        assert found.count("<canvas") == 2 * 3
        assert "extremes of 11 samples each" in found
        assert '<img src="x"' not in found
