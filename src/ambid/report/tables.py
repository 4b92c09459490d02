"""Further tables for the terminal: what a record holds, structures side by side, how much each coefficient matters."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from ambid.errors import counted
from ambid.report.numbers import prefixed
from ambid.report.text import WIDTH, Paint, columns, fraction, joined, plain, pure, wrapped
from ambid.settings.caller import setting
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.validation.comparison import Comparison, Entry
    from ambid.validation.inspection import ChannelLook, Inspection
    from ambid.validation.sensitivity import SensitivityAnalysis

_SHOWN = 24  # coefficients of a sensitivity analysis


def inspection_text(found: Inspection, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write what a record holds, below its verdict: its channels, the columns for each role, its history."""
    about = found.record
    samples, rate_hz = int(str(about["samples"])), float(str(about["rate_hz"]))
    head = (
        f"{paint(str(about['file'] or 'record'), 'strong')}: {counted(samples, 'sample')} at {rate_hz:.6g} Hz, "
        f"{samples / rate_hz:.6g} s from {float(str(about['start_s'])):g} s"
    )
    rows: list[tuple[str, ...]] = [("channel", "unit", "min", "max", "mean", "sd", "step", "SNR")]
    rows += [_row(c) for c in found.channels]
    mark = [] if found.faults else [f"{paint('✓', 'good')} no saturation, drop-outs or outliers"]
    likely: list[str] = []
    for role, names in found.roles.items():
        likely += names and [f"{paint(f'{role}: likely', 'strong')} {names[0]}", *(f"  or {x}" for x in names[1:])]
    steps = about["history"]
    history = "; ".join(map(str, steps)) if isinstance(steps, (list, tuple)) else ""
    blocks = [[head], columns(rows, right=(2, 3, 4, 5, 6, 7)), [*mark, *found.notes], likely]
    blocks.append([f"history: {history}"] if history else [])
    return joined(
        [[x for line in b for x in (wrapped([line], width, "  ") if len(line) > width else [line])] for b in blocks]
    )


def _row(c: ChannelLook) -> tuple[str, ...]:
    size = max(abs(c.least), abs(c.most))
    scale, unit = (1.0, c.source_unit) if c.unit in (UNKNOWN, "1") else prefixed(size, c.unit)
    numbers = [f"{v / scale:.5g}" for v in (c.least, c.most, c.mean, c.sd)]
    return c.name, f"[{unit}]", *numbers, "–" if c.step is None else f"{c.step / scale:.3g}", c.snr


def comparison_text(comparison: Comparison, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a comparison for people, best structure first; colour does not change the layout."""
    name = comparison.record.get("file") or "record"
    signals = f"{', '.join(comparison.inputs)} → " if comparison.inputs else ""
    n, where = comparison.judged_samples, comparison.judged_on
    on = f"a second record ({n})" if where == "second record" else f"the {where} ({n})"
    header = (
        f"{paint(str(name), 'strong')}: {signals}{', '.join(comparison.outputs)}; "
        f"{counted(comparison.fitted_samples, 'sample')} fitted, validated on {on}"
    )
    least = min((x.fit.criteria["bic"] for x in comparison.entries if x.fit and "bic" in x.fit.criteria), default=0.0)
    head = ("structure", "orders", "d", "BIC", "one-step", "simulation", "s", "checks")
    rows = [head, *(_entry(x, least) for x in comparison.entries if x.fit is not None)]
    table = columns(rows, right=(2, 3, 4, 5, 6))
    shown = [x for x in comparison.entries if x.fit is not None]
    painted = [table[0], *(paint(t, "dim") if x.failed else t for t, x in zip(table[1:], shown, strict=True))]
    remarks = [
        f"{x.structure} was not fitted: {x.refusal}"
        if x.fit is None
        else f"{x.structure} failed: {', '.join(x.failed)}"
        for x in comparison.entries
        if x.fit is None or x.failed
    ]
    meaning = (
        "d: estimated parameters; BIC: above the smallest, on the data fitted; one-step, simulation: fit on data "
        f"not used, 1 - |e|/|y - mean|; s: seconds, choice of orders included. {comparison.meaning}."
    )
    first = wrapped([header], width) if paint is plain else [header]
    return joined([first, painted, wrapped(remarks, width, "  "), wrapped([meaning], width)])


def _entry(entry: Entry, least: float) -> tuple[str, ...]:
    fit = entry.fit
    if fit is None:
        return (entry.structure,)
    bic = fit.criteria.get("bic")
    return (
        entry.structure,
        " ".join(f"{k}={_order(v)}" for k, v in entry.orders.items()),
        str(fit.n_estimated),
        "–" if bic is None else f"+{bic - least:.1f}" if abs(bic - least) < 1e5 else f"+{bic - least:.3g}",
        fraction(entry.one_step),
        fraction(entry.simulation),
        f"{entry.seconds:.2f}",
        f"{len(entry.failed)} failed" if entry.failed else "passed",
    )


def _order(value: object) -> str:
    return "/".join(str(v) for v in value) if isinstance(value, tuple) else str(value)


def sensitivity_text(found: SensitivityAnalysis, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a sensitivity analysis for people: the numbers that matter most first, then which belong together."""
    rows = [("", "value ± sd", "fit alone", "fit free", "poles", "response")]
    rows += [
        (
            x.name,
            pure(x.value, x.sd),
            f"{x.fit_alone:.3g}",
            f"{x.fit_free:.3g}",
            _percent(x.poles),
            _percent(x.response),
        )
        for x in found.influences[:_SHOWN]
    ]
    rest = len(found.influences) - _SHOWN
    more = [f"… and {rest} more of less effect; {setting('json')} has them all"] if rest > 0 else []
    index = "infinite" if not np.isfinite(found.collinearity) else f"{found.collinearity:.3g}"
    pairs = "; ".join(f"{a} with {b} ({r:+.3f})" for a, b, r in found.pairs[:6]) or "none above 0.9"
    weakest = ", ".join(f"{name} {100 * part:+.3g} %" for name, part in found.weakest)
    notes = [
        "for a change of one coefficient by 1 %: rise of -2 log L with the others kept, and with the others "
        "refitted (below 4: within 2 sd); largest move of a pole; change of the frequency response",
        f"collinearity of all coefficients {index} (below 10 is good); correlated: {pairs}",
        *([f"least identifiable, relative to each other: {weakest}"] if weakest else []),
    ]
    text = [line for note in notes for line in textwrap.wrap(note, width)]
    return "\n".join([paint("sensitivity", "strong"), *columns(rows), *more, *text])


def _percent(x: float | None) -> str:
    return "–" if x is None or not np.isfinite(x) else f"{100 * x:.3g} %"
