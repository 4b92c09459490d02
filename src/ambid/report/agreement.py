"""Estimates compared as people see them: differences in standard deviations."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.estimation.result import NORMAL_95
from ambid.report.document import Checks, Column, Document, Lines, Section, Table
from ambid.report.drawing import BOUND, CYCLE, Block, panel, stacked
from ambid.report.numbers import sized
from ambid.validation.agreement import Agreement

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def agreement_document(agreement: Agreement, _: Any) -> Document:
    """Describe a comparison of estimates."""
    a, title = agreement, f"{', '.join(agreement.names)} compared"
    columns = [
        Column(label="", cell=lambda r: r.name, frame={"parameter": lambda r: r.name}),
        Column(label="estimate", cell=lambda r: r.of, frame={"estimate": lambda r: r.of}),
        Column(label="value", cell=lambda r: sized(r.value, r.unit), frame={"value": lambda r: r.value}),
        Column(label=a.names[0], cell=lambda r: sized(r.before, r.unit), frame={"before": lambda r: r.before}),
        Column(label="difference", cell=lambda r: f"{100 * (r.value / r.before - 1):+.2f} %", right=True),
        Column(label="in sd", cell=lambda r: f"{r.in_sd:+.1f}", right=True,
               frame={"sd": lambda r: r.sd, "in_sd": lambda r: r.in_sd, "unit": lambda r: r.unit}),
    ]  # fmt: skip
    table = Table(columns=columns, rows=a.rows)
    sections = [
        Section(parts=[Lines(lines=[[(title, "strong")]])]),
        Section(title="Differences", parts=[table]),
        Section(parts=[Checks(checks=a.checks)]),
    ]
    numbers = [(r.name, f"{r.in_sd:+.1f} sd") for r in a.rows]
    return Document(
        title=title, sections=sections, figure=partial(_figure, a, title), frame=table.frame, numbers=numbers
    )


def _figure(a: Agreement, title: str, width: float) -> Figure:
    """Draw each difference in its standard deviations."""
    names = list(dict.fromkeys(r.name for r in a.rows))

    def differences(axes: Axes) -> None:
        for k, of in enumerate(a.names[1:]):
            rows = [r for r in a.rows if r.of == of]
            axes.plot([r.in_sd for r in rows], np.arange(len(rows)), "o", color=CYCLE[k % len(CYCLE)], label=of)
        for end in (-NORMAL_95, NORMAL_95):
            axes.axvline(end, color=BOUND, linestyle=":")
        axes.set_yticks(np.arange(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlabel(f"difference to {a.names[0]} [sd], 95 % bounds")

    return stacked(title, [Block(columns=[[panel(differences, height=max(2.0, 0.3 * len(names)))]])], width)
