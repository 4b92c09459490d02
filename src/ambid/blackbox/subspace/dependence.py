"""Inputs that move together: their effects on the outputs cannot be told apart, whatever the method.

Solves: the part of u_j(t) that neither the other inputs' samples nor its own older ones hold, from the triangular
factor. Models of n states have numerators of degree below n (n with a direct path), so that a relation between the
inputs' samples of a window this long leaves a direction of B open (Ljung 1999, sec. 13.2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.subspace.compress import Factors, triangular
from ambid.errors import EstimationError

_TOGETHER = 1e-6  # part of an input that the others do not hold: less is rounding of the record
_FORESEEN = 1e-8  # of an input that its own past does not hold: below it is smooth, and dependence is not to be seen
_TAKES_PART = 1e-3  # coefficient beside the largest from which an input is named


def told_apart(factors: Factors, total: Array, names: Sequence[str], window: int) -> None:
    """Refuse inputs of which one follows from the others, at the same sample or over a window.

    `total`: (n_columns, n_columns), all groups together; `names`: of the inputs; `window`: samples; as many as a
    numerator of the model has coefficients.
    """
    for length in sorted({1, window}):
        found = relation(factors, total, names, length)
        if found is not None:
            raise EstimationError(f"{found}: their effects cannot be told apart. Leave one out")


def relation(factors: Factors, total: Array, names: Sequence[str], window: int) -> str | None:
    """Say which inputs move together within a window.

    `total`: (n_columns, n_columns), all groups together; `names`: of the inputs; `window`: samples; at most those of
    the factors count. Returns none where every input has something of its own.
    """
    n_u, now = factors.n_inputs, factors.length - 1
    length = min(window, now + 1)
    every = factors.columns("u", now + 1 - length, now + 1)
    for j in range(n_u if n_u > 1 else 0):
        own = every[j::n_u]
        others = [c for i, c in enumerate(every) if i % n_u != j]
        r = triangular(total[:, [0, *own[:-1], *others, own[-1]]])
        target, known = r[1:, -1], length - 1
        alone, left = float(np.linalg.norm(target[known:])), abs(float(target[-1]))
        if alone <= _FORESEEN * np.linalg.norm(target) or left >= _TOGETHER * alone:
            continue
        size = np.abs(np.linalg.lstsq(r[1:-1, 1:-1], target[:-1], rcond=1e-13)[0])[known:]
        weight = np.insert(size.reshape(length, n_u - 1).max(axis=0), j, np.inf)
        largest = np.max(weight[np.isfinite(weight)])
        quoted = [repr(name) for name, w in zip(names, weight, strict=True) if w > _TAKES_PART * largest]
        within = "" if length == 1 else f" within {length} samples"
        return (
            f"inputs {', '.join(quoted[:-1])} and {quoted[-1]} move together{within} (all but {left / alone:.1g} of "
            f"one follows from the rest; {_TOGETHER:g} or more is needed)"
        )
    return None
