"""Columns that are not what the rig says: one without a signal, a reversed sign, two that are swapped.

No bearing explains such a record, and the search for one is long: it is refused, with the column's name. A column
without a signal is one of which the others explain nothing. A sign or an order is wrong where the start values fit
badly, and those of the record with that sign or order changed lead to a fit that leaves nothing unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Candidate, Delay, Signals, busiest, starts
from ambid.bearing.rescue import reason
from ambid.bearing.sizes import check_units
from ambid.errors import EstimationError
from ambid.estimation.likelihood import Fit
from ambid.physics.linear_model import LinearModel, Parameter

_LOOKED = 8192  # samples that show whether a column holds a signal
_LAGS = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)  # before and after
_RIDGE = 1e-9  # of the norm of a column: slow signals are nearly the same at neighbouring lags
_SILENT = 0.02  # part of a column's variance: where the others explain less, it holds no signal
_POOR = 2.5  # criterion per sample of a start that may be the wrong record's; good ones are below 2
_GAIN = 0.7  # fall of the criterion per sample by which a change of the record must do better

_FOLLOWED = 2  # changes that are searched from, the best first


def refuse_silent(model: LinearModel, signals: Signals) -> None:
    """Raise where a column holds nothing that the others explain: noise, or another machine's signal."""
    roles = (*model.inputs, *model.outputs)
    at = busiest(signals.u, _LOOKED)
    columns = np.column_stack([signals.u[at], signals.y[at]])
    parts = _explained(columns)
    least = int(np.argmin(parts))
    if parts[least] < _SILENT:
        role, others = roles[least], " and ".join(r for j, r in enumerate(roles) if j != least)
        raise EstimationError(
            f"channel {role!r} holds no signal that belongs to {others}: they explain "
            f"{100 * max(parts[least], 0.0):.1f} % of it. Check channels.{role}.column in the rig, and the wiring"
        )


def _explained(columns: Array) -> list[float]:
    """Part of the variance of each column that the others explain around each sample, corrected for chance."""
    most, (n, width) = _LAGS[-1], columns.shape
    moves = sorted({*_LAGS, *(-k for k in _LAGS)}, key=abs)  # a column as it is comes first
    if n - 2 * most < 4 * len(moves) * width:
        return [1.0] * width
    Z = np.hstack([columns[most + k : n - most + k] for k in moves])
    Z = Z - Z.mean(axis=0)
    Z = Z / np.maximum(np.linalg.norm(Z, axis=0), 1e-300)
    inner = Z.T @ Z + _RIDGE * np.eye(Z.shape[1])
    parts: list[float] = []
    for j in range(width):
        others = np.arange(Z.shape[1]) % width != j
        along = inner[others, j]
        left = 1.0 - float(along @ np.linalg.solve(inner[np.ix_(others, others)], along))
        parts.append(1.0 - left * len(Z) / (len(Z) - np.count_nonzero(others)))
    return parts


def refuse_mistaken(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    candidates: Sequence[Candidate],
    follow: Callable[[Sequence[Candidate]], Fit],
) -> None:
    """Raise where the record fits badly, and fits well with one sign reversed or with voltage and current swapped.

    `candidates`: start values of the record as it is, best first, or none; `follow`: searches from such.
    """
    as_is = candidates[0].criterion / candidates[0].problem.n_used if candidates else np.inf
    if model.name != "one-axis" or as_is < _POOR:
        return
    refuse_units(model, signals, parameters, delay, follow, below=as_is - _GAIN)
    better: list[tuple[float, str, str, list[Candidate]]] = []
    for text, remedy, changed in _changes(signals):
        try:
            found = starts(model, changed, parameters, delay)
        except EstimationError:
            continue
        per_sample = found[0].criterion / found[0].problem.n_used
        if per_sample < as_is - _GAIN:
            better.append((per_sample, text, remedy, found))
    for _, text, remedy, found in sorted(better, key=lambda b: b[0])[:_FOLLOWED]:
        fit = follow(found)
        if reason(fit) == "" and fit.problem.parameters(fit.vector)["R"] > 0:
            raise EstimationError(
                f"{text}: as it is no bearing explains the record, and with that changed one explains it "
                f"({_numbers(fit)}). {remedy}"
            )


def refuse_units(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    follow: Callable[[Sequence[Candidate]], Fit],
    *,
    below: float = np.inf,
) -> None:
    """Raise where only what the rig says of a parameter stands in the way, and a mistaken unit would explain that.

    `below`: criterion per sample that the start values without it have to reach.
    """
    free = [replace(p, role="free", sd=None, value=None) if p.value else p for p in parameters]
    if model.name != "one-axis" or all(p.role == "free" for p in parameters if p.value):
        return
    try:
        found = starts(model, signals, free, delay)
    except EstimationError:
        return
    if found[0].criterion / found[0].problem.n_used > below:
        return
    fit = follow(found)
    check = check_units(fit.problem.parameters(fit.vector), parameters, signals)
    if reason(fit) == "" and not check.passed:
        raise EstimationError(check.detail)


def _changes(signals: Signals) -> list[tuple[str, str, Signals]]:
    """What may be wrong, what to do about it, and the record with it changed."""
    v, (x, i) = signals.u[:, 0], signals.y.T
    bias = -float(np.mean(i)) > float(np.std(i))  # a current of one sign is positive where it is wired right
    first, second = ("current", "voltage") if bias else ("voltage", "current")
    return [
        (
            f"channel {first!r} is reversed (or else {second!r})",
            f"Turn the sensor's leads, or give channels.{first}.gain the other sign",
            replace(signals, u=-signals.u) if first == "voltage" else replace(signals, y=signals.y * [1.0, -1.0]),
        ),
        (
            "channels 'voltage' and 'current' are swapped",
            "Exchange channels.voltage.column and channels.current.column",
            replace(signals, u=i[:, None], y=np.column_stack([x, v])),
        ),
        (
            "channels 'position' and 'current' are swapped",
            "Exchange channels.position.column and channels.current.column",
            replace(signals, y=np.column_stack([i, x])),
        ),
        (
            "channels 'position' and 'voltage' are swapped",
            "Exchange channels.position.column and channels.voltage.column",
            replace(signals, u=x[:, None], y=np.column_stack([v, i])),
        ),
    ]


def _numbers(fit: Fit) -> str:
    theta = fit.problem.parameters(fit.vector)
    return ", ".join(f"{p.name} = {theta[p.name]:.3g} {p.unit}" for p in fit.problem.model.parameters if theta[p.name])
