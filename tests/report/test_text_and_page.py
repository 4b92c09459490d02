"""The table and the report say what the estimate holds, no more and no less."""

import re
from dataclasses import replace

import pytest

from ambid.estimation.estimate import Check
from ambid.job.presentation import text as estimate_text
from ambid.report.estimate import estimate_document
from ambid.report.page import page_html
from ambid.report.parameters import ParameterRow
from ambid.report.text import check_lines, columns


def line_of(text, name):
    (line,) = [x for x in text.splitlines() if x.startswith(f"{name} ")]
    return line


def test_a_parameter_that_is_not_shown_is_never_called_identified(unstable):
    e = unstable.estimate
    parameters = tuple(replace(p, identifiable=p.name != "k_x") for p in e.parameters)
    text = estimate_text(replace(e, parameters=parameters))
    assert line_of(text, "k_x").endswith("not identifiable")
    assert line_of(text, "R").endswith("identified")


def test_priors_say_how_much_came_from_the_data(unstable):
    p = replace(unstable.estimate.parameter("R"), role="prior", data_share=0.873)
    assert ParameterRow(parameter=p).judged[0] == "prior, 87 % data"
    assert ParameterRow(parameter=replace(p, identifiable=False)).judged[0] == "prior, not identifiable, 87 % data"


def test_too_wide_a_table_loses_its_si_column_only(unstable):
    wide, narrow = estimate_text(unstable.estimate, width=80), estimate_text(unstable.estimate, width=60)
    assert "in SI" in wide
    assert "in SI" not in narrow
    assert line_of(narrow, "m").endswith("identified")


def test_failed_checks_and_warnings_are_shown_once(unstable):
    failed = Check(passed=False, detail="the coil gives energy out. Check signs " + "and wires " * 12)
    e = replace(
        unstable.estimate,
        status="stalled",
        checks={"plausible": failed},
        warnings=("the search did not converge: treat the values as a first guess", failed.detail),
    )
    text = estimate_text(e)
    assert text.splitlines()[0] == "verdict: do not use"
    assert text.splitlines()[1].startswith("  ✗ status: the search did not converge")
    assert text.splitlines()[3].startswith("  ✗ plausible: the coil gives energy out")
    assert "✗ plausible  see the verdict" in text
    assert "– stalled" in text
    assert line_of(text, "k_x").endswith("do not use")
    assert text.count("the coil gives energy out") == 1
    assert "warning: the search did not converge" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_failed_check_leaves_no_parameter_identified(unstable):
    failed = Check(passed=False, detail="white they are not. Excite less")
    e = replace(unstable.estimate, checks={"residuals_white": failed})
    assert e.verdict.word == "caution"
    assert not e.passed
    text = estimate_text(e, paint=lambda text, style: f"<{style}>{text}</>")
    assert "verdict: <doubt>use with caution</>" in text
    assert "<good>identified</>" not in text
    assert '"verdict": {\n  "word": "caution"' in e.dumps()
    unseen = replace(
        e, checks={"identifiable": failed}, parameters=(replace(e.parameters[0], identifiable=False), *e.parameters[1:])
    )
    text = estimate_text(unseen)
    assert text.splitlines()[0] == "verdict: use with caution"
    assert line_of(text, unseen.parameters[0].name).endswith("not identifiable")
    assert "identified" in text  # what the record does show


def test_a_failed_second_record_is_in_the_verdict(judged):
    e = judged.estimate
    assert [r.check for r in e.verdict.reasons] == ["validation.residuals_white"]


def test_colour_changes_no_letter(unstable):
    plain = estimate_text(unstable.estimate)
    painted = estimate_text(unstable.estimate, paint=lambda text, style: f"<{style}>{text}</>")
    assert "<good>" in painted
    assert re.sub(r"<\w*/?>|</>", "", painted) == plain


def test_columns_and_checks_line_up():
    assert columns([("a", "1"), ("bcd", "22")], right=(1,)) == ["a     1", "bcd  22"]
    lines = check_lines({"ab": Check(passed=True, detail="fine"), "abcd": Check(passed=False, detail="wrong")})
    assert lines == ["✓ ab    fine", "✗ abcd  wrong"]


@pytest.fixture(scope="module")
def judged(unstable):
    """The estimate with a second record, and a file name that holds markup."""
    fit = {"one_step": 0.9, "simulation": None, "innovation_rms": 1.0, "k_step": {"1": 0.9, "10": 0.8}}
    validation = {
        "fit": {"position": fit, "current": fit},
        "checks": {"residuals_white": {"passed": False, "detail": "as it is", "p": 0.5}},
        "passed": False,
        "samples": 100,
    }
    record = {**unstable.estimate.record, "file": "<script>alert(1)</script>.csv"}
    return replace(unstable, estimate=replace(unstable.estimate, validation=validation, record=record))


@pytest.fixture(scope="module")
def page(judged):
    return page_html(estimate_document(judged.estimate, lambda: judged), judged.estimate.verdict, made="2001-01-01")


def test_the_report_holds_everything_and_needs_nothing_else(page, judged):
    assert not re.findall(r"""(?:src|srcset|href)=["'](?!data:|#)""", page)
    assert page.count("http") == page.count('http-equiv="Content-Security-Policy"') + page.count(
        "/*! https://github.com"
    )
    assert page.count("<svg ") == 5
    for p in judged.estimate.parameters:
        assert f"<th>{p.name}</th>" in page
    for name in judged.estimate.checks:
        assert name in page
    for words in ("ambid 1.", "numpy ", "made", "2001-01-01", "Correlations", "unstable, time constant", "k_x &lt; 0"):
        assert words in page


def test_the_second_record_is_shown(page, judged):
    text = estimate_text(judged.estimate)
    assert page.count("<script>") == 1  # what comes from files is escaped
    assert "On the second record" in page
    assert "✗ residuals_white" in page
    assert "✗ residuals_white  as it is" in text
    assert "on the second record (100 samples)" in text
    assert "10 ahead" in text
