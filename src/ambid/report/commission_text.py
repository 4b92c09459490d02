"""The steps of a guided commissioning for the terminal, one paragraph each."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Protocol

from ambid.report.text import WIDTH, Paint, plain

_INDENT = "  "


class StepLike(Protocol):
    """Anything that has the lines of a step: findings, reasons and cautions."""

    @property
    def name(self) -> str:
        """Of the step."""
        ...

    @property
    def findings(self) -> tuple[str, ...]:
        """What was measured."""
        ...

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not good enough."""
        ...

    @property
    def cautions(self) -> tuple[str, ...]:
        """What to know beside it."""
        ...


def step_text(step: StepLike, number: int, of: int, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a step for people.

    Parameters
    ----------
    step : Step
        Done.
    number, of : int
        Which of how many.
    width : int
        Columns of the terminal.
    paint : callable
        Adds colour; the layout does not depend on it.

    Returns
    -------
    str
        Lines without the last line's end.
    """
    mark = paint("✗", "bad") if step.reasons else paint("✓", "good")
    lines = [f"{mark} {number}/{of} {paint(step.name, 'strong')}"]
    lines += _wrapped(step.findings, width)
    lines += [paint(line, "dim") for line in _wrapped([f"note: {c}" for c in step.cautions], width)]
    lines += [paint(line, "bad") for line in _wrapped([f"stopped: {r}" for r in step.reasons], width)]
    return "\n".join(lines)


def _wrapped(texts: Sequence[str], width: int) -> list[str]:
    lines: list[str] = []
    for text in texts:
        if text:
            lines += textwrap.wrap(text, width, initial_indent=_INDENT, subsequent_indent=2 * _INDENT)
    return lines
