"""Linear differential equations between signals, of which some are noisy: what the weak form solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ambid.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signal:
    """One signal of the equations."""

    values: Array  # (n_samples,)
    sd: float = 0.0  # white noise of its samples, relative to the other signals'; 0: exact
    held: bool = False  # held over a sample (an input), else smooth between samples
    delay: float = 0.0  # samples by which it acts late; only for a held one


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """factor * parameter * (d/dt)^order signal, in one equation."""

    equation: int
    signal: str
    order: int
    parameter: str | None = None  # none: just the factor
    factor: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kink:
    """What sampling leaves out of a signal: parameter^power * pattern is added to its samples."""

    signal: str
    pattern: Array  # (n_samples,)
    parameter: str | None  # none: just the pattern
    power: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class System:
    """Equations sum of terms = 0."""

    terms: tuple[Term, ...]
    signals: Mapping[str, Signal]
    names: tuple[str, ...]  # parameters
    dt: float
    prior_mean: Array  # (n_names,), infinite sd: no prior
    prior_sd: Array
    kinks: tuple[Kink, ...] = ()  # of outputs whose slope jumps with a held input
