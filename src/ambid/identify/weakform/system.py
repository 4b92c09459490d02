"""Linear differential equations between signals, of which some are noisy: what the weak form solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signal:
    """One signal of the equations.

    Attributes
    ----------
    values : ndarray, shape (n_samples,)
    sd : float
        White noise of its samples, relative to the other signals'; 0: exact.
    held : bool
        Held over a sample (an input), else smooth between samples.
    delay : float
        Samples by which it acts late; only for a held one.
    """

    values: Array
    sd: float = 0.0
    held: bool = False
    delay: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """factor * parameter * (d/dt)^order signal, in one equation.

    Attributes
    ----------
    equation : int
    signal : str
    order : int
    parameter : str or None
        None: just the factor.
    factor : float
    """

    equation: int
    signal: str
    order: int
    parameter: str | None = None
    factor: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kink:
    """What sampling leaves out of a signal: parameter^power * pattern is added to its samples.

    Attributes
    ----------
    signal : str
    pattern : ndarray, shape (n_samples,)
    parameter : str or None
        None: just the pattern.
    power : int
    """

    signal: str
    pattern: Array
    parameter: str | None
    power: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class System:
    """Equations sum of terms = 0.

    Attributes
    ----------
    terms : tuple of Term
    signals : Mapping[str, Signal]
    names : tuple of str
        Parameters.
    dt : float, s
    prior_mean, prior_sd : ndarray, shape (n_names,)
        Infinite sd: no prior.
    kinks : tuple of Kink
        Of outputs whose slope jumps with a held input.
    """

    terms: tuple[Term, ...]
    signals: Mapping[str, Signal]
    names: tuple[str, ...]
    dt: float
    prior_mean: Array
    prior_sd: Array
    kinks: tuple[Kink, ...] = ()
