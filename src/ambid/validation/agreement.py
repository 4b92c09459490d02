"""Whether several estimates are of one machine: their differences, with the covariances of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.calibration import moved_by_sd
from ambid.estimation.estimate import Check
from ambid.estimation.result import Reason, Result
from ambid.estimation.uncertainty import chi_squared_tail, p_text
from ambid.validation.residuals import P_LEAST

_RANK = 1e-10  # of the largest eigenvalue of differences on their own scale, below which a direction is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One parameter of two estimates, SI."""

    name: str
    unit: str
    of: str  # names of the estimates
    than: str
    value: float
    before: float
    sd: float  # of the difference
    in_sd: float  # value - before, in `sd`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Agreement(Result):
    """Estimates compared, file schema ``ambid.agreement/1``."""

    names: tuple[str, ...]  # of the estimates
    rows: tuple[Compared, ...]  # what two estimated: of each but the first, beside those of the first
    # ``one_machine``: chi-squared of all differences with all covariances. Errors of calibration that two estimates
    # through one rig share move both, and count by what they move them apart
    checks: Mapping[str, Check]
    verdicts: Mapping[str, str]  # of each estimate, its word

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Estimates that are not to be used, and differences beyond what chance explains."""
        unusable = [n for n, word in self.verdicts.items() if word == "unusable"]
        grave = [
            Reason(check=n, text=f"{n} is not to be used, and so is no comparison with it", grave=True)
            for n in unusable
        ]
        return (*grave, *(Reason(check=k, text=c.detail) for k, c in self.checks.items() if not c.passed))


def agreement(estimates: Mapping[str, Any]) -> Agreement:
    """Compare estimates by name, the first with the others, and test whether all are of one machine."""
    (first, reference), *others = estimates.items()
    names = [p.name for p in reference.parameters if all(_sd(e, p.name) > 0 for e in estimates.values())]
    if not names:
        raise EstimationError("the estimates have no parameter in common that each estimated. Compare others")
    rows = list[Compared]()
    for other, e in others:
        sds = np.sqrt(np.diag(_covariance([reference, e], names, [-1.0, 1.0])))
        for name, sd in zip(names, sds.tolist(), strict=True):
            a, b = reference[name], e[name]
            rows.append(Compared(name=name, unit=a.unit, of=other, than=first, value=b.value, before=a.value, sd=sd,
                                 in_sd=(b.value - a.value) / sd))  # fmt: skip
    check = _one_machine(list(estimates.values()), names, rows)
    words = {name: e.verdict.word for name, e in estimates.items()}
    return Agreement(names=tuple(estimates), rows=tuple(rows), checks={"one_machine": check}, verdicts=words)


def _sd(estimate: Any, name: str) -> float:
    matrix = estimate.covariance
    return 0.0 if matrix is None or name not in matrix.names else float(np.sqrt(matrix[name, name]))


def _one_machine(estimates: Sequence[Any], names: list[str], rows: Sequence[Compared]) -> Check:
    """Test all differences to the first at once: d' C^-1 d is chi-squared."""
    k = len(names)
    moves = [np.eye(len(estimates))[j] - np.eye(len(estimates))[0] for j in range(1, len(estimates))]
    d = np.concatenate([[e[n].value - estimates[0][n].value for n in names] for e in estimates[1:]])
    C = np.empty((d.size, d.size))
    for i, a in enumerate(moves):
        for j, b in enumerate(moves):
            C[i * k : (i + 1) * k, j * k : (j + 1) * k] = _covariance(estimates, names, a, b)
    size = np.sqrt(np.diag(C))
    values, vectors = np.linalg.eigh(C / np.outer(size, size))
    kept = values > _RANK * values[-1]
    z = (vectors.T @ (d / size))[kept] / np.sqrt(values[kept])
    p = chi_squared_tail(z.size, float(z @ z))
    far = max(rows, key=lambda r: abs(r.in_sd))
    passed = p >= P_LEAST
    said = "the differences are what chance explains" if passed else "the records do not show one machine, or not alike"
    remedy = "" if passed else ". Compare operating points and rigs; or it has changed"
    text = f"{said} ({p_text(p)}); largest in {far.name} of {far.of}, {far.in_sd:+.1f} sd{remedy}"
    return Check(passed=passed, p=p, detail=text, values={"chi_squared": float(z @ z), "freedom": float(z.size)})


def _covariance(
    estimates: Sequence[Any], names: list[str], a: Sequence[float] | Array, b: Sequence[float] | Array | None = None
) -> Array:
    """Return the covariance of two weighted sums of estimates (weights a and b): of the records and of calibrations."""
    b = a if b is None else b
    total = np.zeros((len(names), len(names)))
    moves: dict[tuple[str, str], tuple[Array, Array]] = {}  # by rig and channel: of both sums by one sd
    for e, x, y in zip(estimates, a, b, strict=True):
        at = [e.covariance.names.index(n) for n in names]
        total += x * y * np.asarray(e.covariance)[np.ix_(at, at)]
        rig = str(getattr(e, "rig", {}).get("text", ""))
        for channel, per_sd in moved_by_sd(e, names).items():
            u, v = moves.get((rig, channel), (0.0, 0.0))
            moves[rig, channel] = (u + x * per_sd, v + y * per_sd)
    return total + sum((np.outer(u, v) for u, v in moves.values()), np.zeros_like(total))
