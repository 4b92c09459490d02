"""What the stages of a NARMAX fit take, so that its progress can be told; guesses, right within a factor of some."""

from __future__ import annotations

from math import comb

from ambid.nonlinear.narmax.settings import NarmaxSettings

_CHOSEN = 12  # terms of one output that a choice usually ends with
_ITERATIONS = 12  # of a search
_ROUNDS = 5  # of extended least squares
_PASSES = 2  # of a choice of terms over the data
_DEEP = 10  # scalar products per sample take so much less in a choice of terms: large matrices, short of the cache
_STEPS = 60  # of a recursion per coefficient, in the same unit


def stage_costs(s: NarmaxSettings, n_outputs: int, n_inputs: int) -> tuple[float, float, float, float, float]:
    """Guess what each stage takes, per sample.

    Returns choice of terms, denominators, noise terms, pruning, simulation errors; in one unit, 0 for what is left out.
    """
    lagged = n_outputs * s.ny + n_inputs * s.nu
    candidates = comb(lagged + s.degree, s.degree)
    size = n_outputs * (candidates if s.selection == "all" else min(_CHOSEN, candidates, s.terms))
    choice = _PASSES * n_outputs * candidates**2 / _DEEP
    search = _ITERATIONS * size * (size + _STEPS)
    only_free = s.selection == s.focus == "simulation"
    by_free_run = s.selection == "simulation"
    terms = 2 * _CHOSEN * search if by_free_run else choice
    below = 4 * 4 * choice + search if s.kind == "rational" else 0.0
    noise = _ROUNDS * n_outputs * size**2 + search if s.ne and not only_free else 0.0
    pruning = {"none": 0.0, "prediction": 1.5 if s.ne else 0.0, "simulation": 2.0}[s.pruning] * search
    free = search if s.focus == "simulation" else 0.0
    return max(terms, 1.0), below, noise, 0.0 if only_free else pruning, free
