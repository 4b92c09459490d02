"""The steps of a guided commissioning for the terminal, one paragraph each."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Protocol

from ambid.report.text import WIDTH, Paint, plain

_INDENT = "  "
_NEXT = {
    "self-test": "put right what the self-test names; nothing was switched on",
    "rest": "put sensors, wiring or calibrations right; nothing was switched on",
    "levitate": "put the bench right, or [loop], [daq.trip] and the calibrations of the rig",
    "excite": "give a smaller --amplitude or another --band, or put the bench right",
    "record": "see to what spoilt the record; {folder}/record.h5 holds what came",
    "identify": (
        "record longer (--seconds), excite more (--amplitude) or in a wider --band, or correct the rig;"
        " 'ambid identify {folder}/record.h5 --rig RIG' tries a corrected rig without the bench"
    ),
    "validate": (
        "look at {folder}/estimate.json: the model does not hold for the second record; excite less, or look for what"
        " changed between the two"
    ),
    "report": "see to the folder and its disk",
    "track": "look for what changed since the record: load, temperature, supply; {folder}/track.jsonl shows when",
}
"""What to do after a step that was not good enough."""


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

    `step`: done; `number`, `of`: which of how many; `width`: columns of the terminal; `paint`: adds colour; the layout
    does not depend on it. Returns lines without the last line's end.
    """
    mark = paint("✗", "bad") if step.reasons else paint("✓", "good")
    lines = [f"{mark} {number}/{of} {paint(step.name, 'strong')}"]
    lines += _wrapped(step.findings, width)
    lines += [paint(line, "dim") for line in _wrapped([f"note: {c}" for c in step.cautions], width)]
    lines += [paint(line, "bad") for line in _wrapped([f"stopped: {r}" for r in step.reasons], width)]
    return "\n".join(lines)


def next_text(passed: bool, step: str, number: int, of: int, folder: str, *, width: int = WIDTH) -> str:
    """Say where a commissioning ended, and what to do next.

    `passed`: whether it came to its end; `step`: the last one; `number`, `of`: which of how many it is; `folder`: where
    the files are; `width`: columns of the terminal. Returns lines without the last line's end.
    """
    if passed:
        said = [
            f"commissioned; {folder} holds rig, records, estimate, report and track.",
            f"Next: read {folder}/report.html; follow the running bench with 'ambid acquire --track"
            f" {folder}/estimate.json'.",
        ]
    else:
        said = [
            f"stopped at {step}, step {number} of {of}; the output is off, and {folder} holds what was found.",
            f"Next: {_NEXT.get(step, 'see the reason above').format(folder=folder)}."
            " Then commission again, into another folder.",
        ]
    return "\n".join(line for text in said for line in textwrap.wrap(text, width, break_on_hyphens=False))


def _wrapped(texts: Sequence[str], width: int) -> list[str]:
    lines: list[str] = []
    for text in texts:
        if text:
            lines += textwrap.wrap(text, width, initial_indent=_INDENT, subsequent_indent=2 * _INDENT)
    return lines
