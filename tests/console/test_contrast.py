"""Colours of the console's page and of reports: text and marks that stand out from what is behind (WCAG 2.2, AA)."""

import re
from importlib.resources import files

import pytest


def sheet(*place):
    """A style sheet, and its colours in light and dark."""
    text = files("ambid").joinpath(*place).read_text(encoding="utf-8")
    light, dark, *_ = (
        dict(re.findall(r"(--[\w-]+): (#\w+)", block)) for block in re.findall(r":root[^{]*\{([^}]*)\}", text)
    )
    return text, (light, {**light, **dark})


SHEET, CONSOLE = sheet("console", "static", "console.css")
REPORT = sheet("data", "report.css")[1]
BEHIND = ("--page", "--card", "--grid")  # of the page, of cards, of rows under the pointer
DRAW = "".join(
    f.read_text(encoding="utf-8") for f in files("ambid").joinpath("console/static").iterdir() if f.name[-3:] == ".js"
)
PLOTS = files("ambid").joinpath("console/static/plot.css").read_text(encoding="utf-8")
TEXT = [(ink, back) for ink in ("--ink", "--dim", "--accent", "--good", "--doubt", "--bad") for back in BEHIND]
TEXT += [("--on-stop", "--stop"), ("--page", "--doubt")]  # banners
MARKS = [("--edge", "--card"), ("--edge", "--page"), ("--stop", "--page")]  # borders of what is operated
PRINTED = [(ink, "--paper") for ink in ("--ink", "--dim", "--measured", "--good", "--doubt", "--bad", "--predicted")]
PRINTED += [("--ink", "--shade"), ("--ink", "--warn"), ("--ink", "--second")]
DRAWN = [(line, "--paper") for line in ("--edge", "--bound")]


def luminance(colour):
    """Relative luminance of WCAG 2.2: https://www.w3.org/TR/WCAG22/#dfn-relative-luminance."""
    digits = colour[1:] if len(colour) == 7 else "".join(2 * d for d in colour[1:])
    parts = [int(digits[k : k + 2], 16) / 255.0 for k in (0, 2, 4)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_ratio_is_that_of_the_standard():
    assert contrast("#000", "#fff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)


@pytest.mark.parametrize("colours", [*CONSOLE, *REPORT], ids=["light", "dark", "report", "dark report"])
def test_text_and_marks_stand_out(colours):
    text, marks = (TEXT, MARKS) if "--card" in colours else (PRINTED, DRAWN)
    found = {pair: contrast(*(colours[c] for c in pair)) for pair in (*text, *marks)}
    assert {pair: round(x, 2) for pair, x in found.items() if x < (4.5 if pair in text else 3.0)} == {}
    assert not re.search(r"color: #|background: #|solid #", SHEET.split("* {", 1)[1] + PLOTS)  # no colour beside these


def test_what_scripts_draw_is_of_colours_that_stand_out():
    used = set(re.findall(r"\"(--[\w-]+)\"", DRAW))
    lines = set(re.findall(r"--[\w-]+", re.search(r"COLOURS = \[([^\]]*)\]", DRAW)[1]))
    assert lines == {ink for ink, _ in TEXT} - {"--on-stop", "--page"}  # curves, on cards: as text
    assert used - lines == {"--card", "--grid", "--line"}  # behind, beside and between
    assert not re.search(r"#[0-9a-f]{3,6}\"|rgb\(\d|(fill|stroke)Style = \"", DRAW)
