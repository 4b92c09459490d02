"""How much each coefficient matters, as a table for the terminal."""

from __future__ import annotations

import textwrap

import numpy as np

from ambid.report.numbers import quantity
from ambid.report.text import WIDTH, Paint, columns, plain
from ambid.validate.sensitivity import SensitivityAnalysis

_SHOWN = 24


def sensitivity_text(found: SensitivityAnalysis, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a sensitivity analysis for people.

    `width`: columns of the terminal; `paint`: adds colour. Returns a line for each number, those that matter most to
    the fit first; which belong together; what is seen least.
    """
    rows = [("", "value ± sd", "fit alone", "fit free", "poles", "response")]
    for x in found.influences[:_SHOWN]:
        value = quantity(x.value, x.sd, "1").text.removesuffix(" 1")
        rows.append((x.name, value, f"{x.fit_alone:.3g}", f"{x.fit_free:.3g}", _percent(x.poles), _percent(x.response)))
    rest = len(found.influences) - _SHOWN
    more = [f"… and {rest} more, which matter less; --json has them all"] if rest > 0 else []
    index = "infinite" if not np.isfinite(found.collinearity) else f"{found.collinearity:.3g}"
    pairs = "; ".join(f"{a} with {b} ({r:+.3f})" for a, b, r in found.pairs[:6]) or "none above 0.9"
    weakest = ", ".join(f"{name} {100 * part:+.3g} %" for name, part in found.weakest)
    notes = [
        "if a number moves by 1 %: rise of -2 log L alone, and with all others fitted again (under 4: within 2 sd); "
        "largest move of a pole; move of the frequency response",
        f"collinearity of all together {index} (under 10 is good); correlated: {pairs}",
        *([f"seen least, relative to each other: {weakest}"] if weakest else []),
    ]
    text = [line for note in notes for line in textwrap.wrap(note, width)]
    return "\n".join([paint("sensitivity", "strong"), *columns(rows), *more, *text])


def _percent(x: float | None) -> str:
    return "–" if x is None or not np.isfinite(x) else f"{100 * x:.3g} %"
