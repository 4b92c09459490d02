"""A comparison of black-box structures as a table for the terminal."""

from __future__ import annotations

import textwrap

from ambid.report.text import WIDTH, Paint, columns, plain
from ambid.validate.comparison import Comparison, Entry


def text(comparison: Comparison, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a comparison for people, best structure first.

    `comparison`: any; `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns
    header, table, what failed, and what the differences mean, without a final line feed.
    """
    name = comparison.record.get("file") or "record"
    signals = f"{', '.join(comparison.inputs)} → " if comparison.inputs else ""
    header = (
        f"{paint(str(name), 'strong')}: {signals}{', '.join(comparison.outputs)}; {comparison.fitted_samples} samples "
        f"fitted, judged on {comparison.judged_samples} of the {comparison.judged_on}"
        if comparison.judged_on != "second record"
        else f"{paint(str(name), 'strong')}: {signals}{', '.join(comparison.outputs)}; {comparison.fitted_samples} "
        f"samples fitted, judged on the {comparison.judged_samples} of a second record"
    )
    least = min((x.fit.criteria["bic"] for x in comparison.entries if x.fit and "bic" in x.fit.criteria), default=0.0)
    head = ("structure", "orders", "d", "BIC", "one-step", "simulation", "s", "checks")
    rows = [head, *(_row(x, least) for x in comparison.entries if x.fit is not None)]
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
    notes = [line for r in remarks for line in textwrap.wrap(r, width, subsequent_indent="  ")]
    meaning = textwrap.wrap(
        "d: numbers estimated; BIC: above the least, on the data fitted; one-step, simulation: fit on data not used, "
        "1 - |e|/|y - mean|; s: seconds with the choice of orders. "
        f"{comparison.summary}.",
        width,
    )
    blocks = [textwrap.wrap(header, width) if paint is plain else [header], painted, notes, meaning]
    return "\n\n".join("\n".join(b) for b in blocks if b)


def _row(entry: Entry, least: float) -> tuple[str, ...]:
    fit = entry.fit
    if fit is None:
        return (entry.structure,)
    bic = fit.criteria.get("bic")
    return (
        entry.structure,
        " ".join(f"{k}={_order(v)}" for k, v in entry.orders.items()),
        str(fit.n_estimated),
        "–" if bic is None else f"+{bic - least:.1f}" if abs(bic - least) < 1e5 else f"+{bic - least:.3g}",
        _share(entry.one_step),
        _share(entry.simulation),
        f"{entry.seconds:.2f}",
        f"{len(entry.failed)} failed" if entry.failed else "passed",
    )


def _order(value: object) -> str:
    return "/".join(str(v) for v in value) if isinstance(value, tuple) else str(value)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"
