"""Several structures on the same data, judged on data that none of them has seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ambid.blackbox.data import IOData, Orders
from ambid.blackbox.fit import BlackBoxFit, fit_from_json, fit_to_json, structure
from ambid.errors import EstimationError
from ambid.estimation.estimate import fields_json, read_as, read_whole
from ambid.estimation.result import Reason, Result
from ambid.validation.fits import judge
from ambid.validation.orders import HELD_OUT, hold_out, select


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entry:
    """One structure in a comparison."""

    structure: str
    orders: Orders  # as used; as asked for, or empty, where it could not be fitted
    fit: BlackBoxFit | None  # judged, with its validation; None where the estimator refused
    # NRMSE fit on data not used in the estimation, mean over the outputs; None where there is none
    one_step: float | None
    simulation: float | None
    seconds: float  # time of the fit, choice of orders included
    refusal: str = ""  # why there is no fit

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the checks that failed."""
        return () if self.fit is None else tuple(k for k, c in self.fit.checks.items() if not c.passed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Comparison(Result):
    """Structures compared, best first, file schema ``ambid.comparison/1``."""

    entries: tuple[Entry, ...]  # sorted by the one-step fit on unseen data; those without one last
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    fitted_samples: int
    judged_samples: int
    judged_on: str  # ``"second record"`` or ``"last 30 % of the record"``
    meaning: str  # one line: what the differences mean
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What speaks against the best, and structures that could not be fitted."""
        best, reasons = self.entries[0], list[Reason]()
        sound = [x.structure for x in self.entries if x.fit is not None and x.fit.passed]
        if best.one_step is None or not best.one_step > 0:
            text = "no structure predicts better than the mean. Check columns, delay and orders"
            reasons.append(Reason(check="one_step", text=text, grave=True))
        if best.failed:
            remedy = f"{sound[0]} passes all checks" if sound else "none passes all: try others, or other orders"
            text = f"{best.structure}, the best, fails {', '.join(best.failed)}; {remedy}"
            reasons.append(Reason(check="best", text=text))
        reasons += [Reason(check=x.structure, text=x.refusal) for x in self.entries if x.fit is None]
        return tuple(reasons)

    def as_dict(self) -> dict[str, object]:
        """Return the table, ready for JSON: ``entries`` (structure, orders, n_estimated, criteria, one_step,
        simulation, failed_checks, seconds, refusal, fit), ``judged_on``, ``fitted_samples``, ``judged_samples``,
        ``summary``.
        """
        entries = [
            {
                **fields_json(x, without=("fit",)),
                "n_estimated": None if x.fit is None else x.fit.n_estimated,
                "criteria": {} if x.fit is None else dict(x.fit.criteria),
                "failed_checks": list(x.failed),
                "refusal": x.refusal or None,
                "fit": None if x.fit is None else fit_to_json(x.fit),
            }
            for x in self.entries
        ]
        fields = fields_json(self, without=("entries", "record", "meaning"))
        return {**fields, "summary": self.meaning, "entries": entries}


def comparison_from_json(document: Mapping[str, Any], where: str) -> Comparison:
    """Read a comparison back; `where` is the name of its file, for messages."""

    def entry(d: Mapping[str, Any], at: str) -> Entry:
        fit = None if d["fit"] is None else fit_from_json(d["fit"], at)
        return read_as(Entry, {**d, "fit": fit, "refusal": d["refusal"] or ""}, at)

    def read() -> Comparison:
        entries = tuple(entry(d, f"entries[{k}]") for k, d in enumerate(document["entries"]))
        whole = {**document, "entries": (), "meaning": document["summary"], "record": {"file": document["record"]}}
        return replace(read_as(Comparison, whole), entries=entries)

    return read_whole(read, where, "comparison", "compare")


def compare(
    data: IOData,
    candidates: Sequence[tuple[str, Orders | None]],
    *,
    holdout: float = HELD_OUT,
    second: IOData | None = None,
    criterion: str = "bic",
    tick: Callable[[str], None] | None = None,
) -> Comparison:
    """Fit `candidates`, structures with orders (None: by `criterion`, see `ambid.validation.orders.select`), to the
    same samples and judge them on others: `second`, which lets all of `data` be fitted. One that cannot be fitted is in
    the result with the reason. `tick`: called with the structure before each fit; may raise to interrupt.
    """
    if not candidates:
        raise EstimationError("nothing to compare; name at least one structure")
    for name, _ in candidates:
        structure(name)
    if second is None:
        fold = hold_out(data, holdout)
        fitted, other, where = fold.fitted, fold.judged, f"last {100 * holdout:.3g} % of the record"
    else:
        fitted, other, where = data, second, "second record"
    entries = list[Entry]()
    for name, orders in candidates:
        if tick is not None:
            tick(name)
        entries.append(_entry(name, orders, fitted, other, criterion))
    if all(x.fit is None for x in entries):
        raise EstimationError(f"none of the structures could be fitted; {entries[0].structure}: {entries[0].refusal}")
    ranked = tuple(sorted(entries, key=lambda x: -np.inf if x.one_step is None else x.one_step, reverse=True))
    return Comparison(
        used=other,
        entries=ranked,
        inputs=data.inputs,
        outputs=data.outputs,
        fitted_samples=fitted.n_samples,
        judged_samples=other.n_samples,
        judged_on=where,
        meaning=_summary(ranked),
        record=dict(data.record),
    )


def _entry(name: str, orders: Orders | None, fitted: IOData, other: IOData, criterion: str) -> Entry:
    start, fit, refusal = time.perf_counter(), None, ""
    try:
        if orders is None:
            orders = select(name, fitted, criterion=criterion).orders
        result = structure(name).estimator(fitted, orders)
        seconds = time.perf_counter() - start
        fit = judge(result, fitted, second=other)
    except EstimationError as error:
        seconds, refusal = time.perf_counter() - start, str(error)
    return Entry(
        structure=name,
        orders=dict(orders or {}) if fit is None else fit.orders,
        fit=fit,
        one_step=_mean(fit, "one_step"),
        simulation=_mean(fit, "simulation"),
        seconds=seconds,
        refusal=refusal,
    )


def _mean(fit: BlackBoxFit | None, kind: str) -> float | None:
    """Mean over the outputs of a fit on the second record; None where an output has none."""
    values = list[float]()
    judged = None if fit is None else fit.validation
    for fits in (judged or {}).values():
        part = fits.get(kind) if isinstance(fits, dict) else None
        if part is None or not np.isfinite(part["fit"]):
            return None
        values.append(float(part["fit"]))
    return float(np.mean(values)) if values else None


def _summary(entries: Sequence[Entry]) -> str:
    """Say in one line what the differences of BIC mean: twice the log of the odds (Kass and Raftery 1995)."""
    scored = sorted((x for x in entries if x.fit is not None and "bic" in x.fit.criteria), key=_bic)
    if len(scored) < 2:
        return "only one structure was fitted"
    gap = _bic(scored[1]) - _bic(scored[0])
    strength = "negligible" if gap < 2 else "positive" if gap < 6 else "strong" if gap < 10 else "very strong"
    return (
        f"BIC of {scored[0].structure} is {gap:.3g} below that of {scored[1].structure}: {strength} evidence for it "
        "(Kass and Raftery: below 2 negligible, above 10 very strong)"
    )


def _bic(x: Entry) -> float:
    return float("inf") if x.fit is None else x.fit.criteria["bic"]
