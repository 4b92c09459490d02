"""The colours of the console's page: text and marks that can be told from what is behind them (WCAG 2.2, AA)."""

import re
from importlib.resources import files

import pytest

SHEET = files("ambid").joinpath("console", "static", "console.css").read_text(encoding="utf-8")
LIGHT, DARK = (dict(re.findall(r"(--[\w-]+): (#\w+)", block)) for block in re.findall(r":root \{([^}]*)\}", SHEET))
BEHIND = ("--page", "--card", "--grid")  # of the page, of cards, of rows under the pointer


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


@pytest.mark.parametrize("colours", [LIGHT, {**LIGHT, **DARK}], ids=["light", "dark"])
def test_text_and_marks_stand_out(colours):
    text = [(ink, back) for ink in ("--ink", "--dim", "--accent", "--good", "--doubt", "--bad") for back in BEHIND]
    text += [("--on-stop", "--stop"), ("--page", "--doubt")]  # banners
    marks = [("--edge", "--card"), ("--edge", "--page"), ("--stop", "--page")]  # borders of what is operated
    found = {pair: (contrast(*(colours[c] for c in pair)), 4.5 if pair in text else 3.0) for pair in (*text, *marks)}
    assert {pair: round(ratio, 2) for pair, (ratio, least) in found.items() if ratio < least} == {}
    assert not re.search(r"color: #|background: #|solid #", SHEET.split("* {", 1)[1])  # no colour beside these
