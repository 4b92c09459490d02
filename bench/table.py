"""A table of results that is not only times: its columns are its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of text for the page, and the numbers behind them for the file of results."""

    group: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    before: str = ""
    remarks: tuple[str, ...] = ()
    data: dict[str, object] = field(default_factory=dict)

    def as_json(self) -> dict[str, object]:
        return asdict(self)

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> Table:
        lists = {k: tuple(found[k]) for k in ("columns", "remarks")}
        return cls(**{**found, **lists, "rows": tuple(map(tuple, found["rows"]))})

    def as_markdown(self) -> str:
        lines = [f"## {self.group}", ""]
        if self.before:
            lines += [self.before, ""]
        lines += [_row(self.columns), "|" + "---|" * len(self.columns), *map(_row, self.rows), ""]
        lines += [f"- {remark}" for remark in self.remarks]
        return "\n".join(lines).rstrip() + "\n"


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cells) + " |"
