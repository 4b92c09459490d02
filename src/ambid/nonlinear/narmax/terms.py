"""Terms of a NARMAX model: products of lagged outputs, inputs and innovations, and lists of candidates.

A factor is one lagged signal, a term the product of the factors (repeated ones are powers; none makes the constant).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

from ambid.errors import EstimationError

KINDS = ("y", "u", "e")
MOST_CANDIDATES = 20_000


@dataclass(frozen=True, slots=True, order=True)
class Factor:
    """One lagged signal."""

    kind: str  # output, input, innovation
    channel: int  # column
    lag: int  # samples back; at least 1 for outputs and innovations


Term = tuple[Factor, ...]
"""Product of its factors, sorted; the empty product is the constant."""


def lagged(n_outputs: int, n_inputs: int, *, ny: int, nu: int, nk: int, ne: int) -> tuple[Factor, ...]:
    """Return all lagged signals that terms are made of, up to the largest lags of each kind."""
    out = [Factor("y", c, lag) for c in range(n_outputs) for lag in range(1, ny + 1)]
    out += [Factor("u", c, lag) for c in range(n_inputs) for lag in range(nk, nk + nu)]
    out += [Factor("e", c, lag) for c in range(n_outputs) for lag in range(1, ne + 1)]
    return tuple(out)


def products(factors: tuple[Factor, ...], degree: int, *, constant: bool = True, odd: bool = False) -> tuple[Term, ...]:
    """Return all products of the factors up to a degree, by degree: the candidates of a polynomial (thesis eq. 3.4)."""
    out: list[Term] = [()] if constant and not odd else []
    for d in range(1, degree + 1, 2 if odd else 1):
        for term in combinations_with_replacement(factors, d):
            out.append(tuple(sorted(term)))
            if len(out) > MOST_CANDIDATES:
                raise EstimationError(
                    f"{len(factors)} lagged signals to degree {degree} make more than {MOST_CANDIDATES} candidate "
                    "terms. Lower ny, nu, ne or degree"
                )
    return tuple(out)


def noise_terms(n_outputs: int, n_inputs: int, *, ny: int, nu: int, nk: int, ne: int, degree: int) -> tuple[Term, ...]:
    """Return the candidates that hold at least one innovation; above degree 1 these are multiplied with all signals."""
    if not ne:
        return ()
    if degree == 1:
        return tuple((f,) for f in lagged(n_outputs, n_inputs, ny=0, nu=0, nk=nk, ne=ne))
    factors = lagged(n_outputs, n_inputs, ny=ny, nu=nu, nk=nk, ne=ne)
    return tuple(t for t in products(factors, degree, constant=False) if any(f.kind == "e" for f in t))


def term_name(term: Term, n_outputs: int, n_inputs: int) -> str:
    """Return how a term is written, such as ``y(t-1)^2*u(t-3)``; several channels carry numbers, from 1."""
    if not term:
        return "1"
    parts = []
    for f in dict.fromkeys(term):
        several = (n_inputs if f.kind == "u" else n_outputs) > 1
        at = f"t-{f.lag}" if f.lag else "t"
        power = f"^{term.count(f)}" if term.count(f) > 1 else ""
        parts.append(f"{f.kind}{f.channel + 1 if several else ''}({at}){power}")
    return "*".join(parts)


def term_to_json(term: Term) -> list[list[Any]]:
    """Return a term as JSON-able values."""
    return [[f.kind, f.channel, f.lag] for f in term]


def term_from_json(found: Any) -> Term:
    """Read a term back."""
    out = []
    for f in found:
        kind, channel, lag = f
        whole = all(isinstance(x, int) and not isinstance(x, bool) and x >= 0 for x in (channel, lag))
        if kind not in KINDS or not whole or (kind != "u" and lag < 1):
            raise EstimationError(f"{f!r} is no factor of a term; a factor is [y, u or e, channel, lag]")
        out.append(Factor(kind, channel, lag))
    return tuple(sorted(out))
