"""How much of a long test runs: its short form in ``make test``, the whole in ``make test-all`` (``AMBID_TESTS=all``).

A Monte Carlo test states its limits for its full number of runs; on fewer runs they are as much wider as its figures
scatter more. Tests marked ``long`` have a short form beside them and run in ``make test-all`` alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import pytest

ALL = os.environ.get("AMBID_TESTS", "") == "all"
long = pytest.mark.long


class Runs(int):
    """A number of runs, and by how much figures of so many scatter more than those of all."""

    widened: float

    def limit(self, of_all: float, centre: float = 0.95) -> float:
        """Return the limit of a figure about `centre` that lies at `of_all` for the full number of runs."""
        return centre + (of_all - centre) * self.widened


def runs(full: int, *, short: int) -> Runs:
    """Return how many runs an experiment has."""
    number = Runs(full if ALL else short)
    number.widened = float(full / number) ** 0.5
    return number


def sample(cases: Iterable[Any], *short: int) -> list[Any]:
    """Return the cases of a test; all but those at the places `short` are long ones."""
    return [case if k in short else _long(case) for k, case in enumerate(cases)]


def _long(case: Any) -> Any:
    if hasattr(case, "marks"):
        return pytest.param(*case.values, marks=[*case.marks, long], id=case.id)
    return pytest.param(*case, marks=long) if isinstance(case, tuple) else pytest.param(case, marks=long)
