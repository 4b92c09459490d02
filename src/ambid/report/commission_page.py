"""A commissioning for people: its steps, each with what it found and saw; the same page where it ended early."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING

from ambid.estimation.estimate import fields_json
from ambid.report.drawing import single
from ambid.report.page import Page, Section
from ambid.settings.caller import command

if TYPE_CHECKING:
    from ambid.report.commission_figures import Picture
    from ambid.report.page import Cell

_NO_NUMBERS: Mapping[str, float] = MappingProxyType({})
_SEEN = frozenset({"pictures", "text"})  # of the page, not of the file


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step, done."""

    name: str
    findings: tuple[str, ...] = ()  # what was measured, one line each
    reasons: tuple[str, ...] = ()  # why it is not good enough, and what to do, one line each; empty: it is
    cautions: tuple[str, ...] = ()  # what a reader should know although the step is good enough
    numbers: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)  # the same as numbers, SI
    pictures: tuple[Picture, ...] = ()  # what it saw
    text: str = ""  # more of it, as on a terminal

    @property
    def passed(self) -> bool:
        """Whether commissioning may go on."""
        return not self.reasons

    def as_json(self) -> dict[str, object]:
        """Return its fields and whether it ``passed``, without what is only for the page; what is not known is None."""
        return {**fields_json(self, without=tuple(_SEEN)), "passed": self.passed}


def _still() -> str:
    own_page = command("identify", "record.h5", rig="rig.toml", report="record.html")
    return (
        "Signals of this page stand still. The record's own page, in which they are zoomed down to the samples, is "
        f"written in this folder by: {own_page}"
    )


def commission_page(
    title: str,
    steps: Sequence[Step],
    names: Sequence[str],
    *,
    subtitle: str = "",
    more: Mapping[str, Sequence[Section]] = MappingProxyType({}),
    provenance: Sequence[tuple[str, str]] = (),
    rig: str = "",
) -> Page:
    """Return the page of a commissioning.

    `names`: of all steps in their order; `more`: by step, sections that follow its own; `rig`: its text.
    """
    recorded = any(step.name == "record" for step in steps)
    sections = [Section(title="Steps", tables=[_overview(steps, names)], note=_still() if recorded else "")]
    for step in steps:
        sections.append(_section(step, f"{names.index(step.name) + 1}. {step.name}"))
        sections += [
            Section(title=p.title, caption=p.caption, figure=partial(single, p.block)) for p in step.pictures[1:]
        ]
        sections += more.get(step.name, ())
    sections += [Section(title="Rig", text=rig, folded=True)] if rig else []
    return Page(title=title, subtitle=subtitle, sections=sections, provenance=provenance)


def _overview(steps: Sequence[Step], names: Sequence[str]) -> list[Sequence[Cell]]:
    """One row for each step, those that were not reached too."""
    rows: list[Sequence[Cell]] = [("", "outcome", "")]
    done = {step.name: step for step in steps}
    for k, name in enumerate(names, 1):
        step = done.get(name)
        if step is None:
            rows.append((f"{k}. {name}", ("not reached", "dim"), ""))
        elif step.passed:
            words: Cell = ("passed", "good") if not step.cautions else ("passed, see the note", "doubt")
            rows.append((f"{k}. {name}", words, (step.findings[-1] if step.findings else "", "")))
        else:
            rows.append((f"{k}. {name}", ("stopped", "bad"), (step.reasons[0], "")))
    return rows


def _section(step: Step, title: str) -> Section:
    """What a step found, why it stopped, and its first picture."""
    rows: list[Sequence[Cell]] = [("", "what stands against it")]
    rows += [("stopped", (text, "bad")) for text in step.reasons]
    rows += [("note", (text, "doubt")) for text in step.cautions]
    picture = step.pictures[0] if step.pictures else None
    return Section(
        title=f"{'✓' if step.passed else '✗'} {title}",
        paragraphs=[text for text in step.findings if text],
        tables=[rows] if len(rows) > 1 else [],
        text=step.text,
        figure=None if picture is None else partial(single, picture.block),
        note="" if picture is None else picture.caption,
    )
