"""What the LPV estimator may be told, checked and completed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.lpv.schedule import BASES, LEVEL, schedule_column
from ambid.nonlinear.settings import checked

_RANGES: Mapping[str, tuple[float, float]] = {
    "order": (1, 10),
    "error_order": (0, 20),
    "nb": (0, 50),
    "nk": (0, 1000),
    "degree": (0, 8),
    "error_degree": (0, 8),
    "time_constant": (0.0, 1e9),
    "iterations": (1, 2000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "error_form": ("auto", "white", "ar", "ma", "arma"),
    "form": ("auto", "equation", "output"),
    "basis": BASES,
    "exciting": ("no", "yes"),
    "criterion": ("aicc", "aic", "bic"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvSettings:
    """Settings of an LPV fit; described in the register of structures. None: to be chosen."""

    order: int
    error_order: int
    nb: int
    nk: int
    degree: int | None
    error_degree: int
    error_form: str
    form: str
    basis: str
    schedule: str
    exciting: str
    criterion: str
    time_constant: float | None
    iterations: int
    column: int  # which input the schedule names; -1 for the output
    columns: tuple[int, ...]  # which inputs excite

    def as_mapping(self) -> dict[str, object]:
        """Return the settings by the names that the register has for them; those left open are missing."""
        names = (*_RANGES, *_CHOICES, "schedule")
        return {k: v for k in names if (v := getattr(self, k)) is not None}


def lpv_settings(given: Mapping[str, object], first: IOData) -> LpvSettings:
    """Check settings and complete them.

    `first`: one of the records.
    """
    name = given.get("schedule", LEVEL)
    s: dict[str, Any] = checked("lpv", given, _RANGES, {**_CHOICES, "schedule": (str(name),)})
    if first.n_outputs != 1:
        raise EstimationError(
            f"lpv takes one output, not {', '.join(first.outputs)}; fit them one after the other, with the same "
            "schedule. Name one"
        )
    name = str(name)
    column = schedule_column(name, first)
    if s.get("exciting") == "yes" and column < 0:
        raise EstimationError(
            f"lpv: exciting = yes says that the scheduling input excites, but schedule = {name} is none. Leave it out"
        )
    if s.get("time_constant") and name != LEVEL:
        raise EstimationError(
            f"lpv: time_constant is that of schedule = level; with schedule = {name} the column is taken as it is. "
            "Leave it out"
        )
    error_order, error_form = _error_model(s)
    excites = s.get("exciting", "no") == "yes"
    order = int(s.get("order", 2))
    return LpvSettings(
        order=order,
        error_order=error_order,
        nb=int(s.get("nb", order)),
        nk=int(s.get("nk", 1)),
        degree=s.get("degree"),
        error_degree=int(s.get("error_degree", 0)),
        error_form=error_form,
        form=str(s.get("form", "auto")),
        basis=str(s.get("basis", "legendre")),
        schedule=name,
        exciting="yes" if excites else "no",
        criterion=str(s.get("criterion", "aicc")),
        time_constant=s.get("time_constant") if name == LEVEL else 0.0,
        iterations=int(s.get("iterations", 60)),
        column=column,
        columns=tuple(k for k in range(first.n_inputs) if k != column or excites),
    )


def _error_model(s: Mapping[str, Any]) -> tuple[int, str]:
    """Order and form of the error model; any form of order 0 is white noise."""
    form = str(s.get("error_form", "auto"))
    order = int(s.get("error_order", 0 if form == "white" else 5))
    if order > 0 and form == "white":
        raise EstimationError(f"lpv: error_form = white has no coefficients, but error_order = {order}. Leave one out")
    if order == 0 and s.get("error_degree"):
        raise EstimationError(
            f"lpv: error_degree = {s['error_degree']} is of the error model's coefficients, and error_order = 0 leaves "
            "none. Leave one out"
        )
    return order, form
