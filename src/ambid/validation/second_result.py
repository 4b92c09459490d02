"""How a result does on a record that it has not seen, file schema ``ambid.validation/1``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ambid.estimation.estimate import Check
from ambid.estimation.result import Reason, Result

SCHEMA = "ambid.validation/1"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Validation(Result):
    """A result judged on a further record."""

    estimate: str  # names of the result and the record; empty where they have no file
    record: str
    model: str  # what was judged
    samples: int  # of the record
    fit: Mapping[str, Any]  # by output: one step, simulation and so on
    checks: Mapping[str, Check]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Each check that failed; grave where an output is predicted worse than by its mean."""
        failed = [Reason(check=k, text=c.detail) for k, c in self.checks.items() if not c.passed]
        for output, fit in self.fit.items():
            one = fit["one_step"]
            size = one.get("fit") if isinstance(one, Mapping) else one
            if size is None or not size > 0:
                text = f"{output} is predicted worse than by its mean. Check that both are of the same bench"
                failed.append(Reason(check="one_step", text=text, grave=True))
        return tuple(failed)
