"""A NARMAX model in scaled signals as tables, and its predictions, free runs and sensitivities over one record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.nonlinear.narmax.terms import Factor, Term

Table = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tables:
    """Terms as whole numbers, for the compiled recursions."""

    n_outputs: int
    n_inputs: int
    lag: int
    column: Table  # (n_factors,), column of the array of all signals, and lag, of each factor
    back: Table
    terms: Table  # (n_terms, most factors), factor numbers, -1 behind the last
    place: Table  # (n_terms, 2), output, and 1 for a term of the denominator
    noisy: bool  # whether a term holds innovations
    # 1 where only the magnitude of the outputs is measured, 2 where it is its mean over a sampling interval
    folded: int = 0

    def shape(self, free: bool) -> Table:
        """Return what the recursions are told beside the tables.

        `free`: whether the model runs on its own outputs. Returns (5,).
        """
        return np.array([self.lag, self.n_outputs, self.n_inputs, int(free), self.folded], dtype=np.int64)


def tables(
    numerators: Sequence[Sequence[Term]], denominators: Sequence[Sequence[Term]], n_inputs: int, *, folded: int = 0
) -> Tables:
    """Return the tables of a model; coefficients stand output by output, numerator before denominator.

    `numerators`, `denominators`: by output; `folded`: as in `Tables`.
    """
    n_y = len(numerators)
    rows: list[tuple[int, int, Term]] = []
    for o in range(n_y):
        rows += [(o, 0, x) for x in numerators[o]] + [(o, 1, x) for x in denominators[o]]
    factors: dict[Factor, int] = {}
    for _, _, x in rows:
        for f in x:
            factors.setdefault(f, len(factors))
    first = {"y": 0, "u": n_y, "e": n_y + n_inputs}
    width = max((len(x) for _, _, x in rows), default=0)
    numbers = np.full((len(rows), max(width, 1)), -1, dtype=np.int64)
    for k, (_, _, x) in enumerate(rows):
        numbers[k, : len(x)] = [factors[f] for f in x]
    return Tables(
        n_outputs=n_y,
        n_inputs=n_inputs,
        lag=max((f.lag for f in factors), default=0) or int(folded == 2),
        column=np.array([first[f.kind] + f.channel for f in factors], dtype=np.int64),
        back=np.array([f.lag for f in factors], dtype=np.int64),
        terms=numbers,
        place=np.array([(o, d) for o, d, _ in rows], dtype=np.int64).reshape(-1, 2),
        noisy=any(f.kind == "e" for f in factors),
        folded=folded,
    )


def signals(t: Tables, y: Array, u: Array) -> Array:
    """Return the array of all signals, innovations zero.

    `y`: (n_given, n_outputs), with fewer samples than `u`, the rest is zero; `u`: (n_samples, n_inputs). Returns
    (n_samples, 2 n_outputs + n_inputs).
    """
    n = u.shape[0]
    z = np.zeros((n, 2 * t.n_outputs + t.n_inputs))
    given = y[:n]
    z[: given.shape[0], : t.n_outputs] = given
    z[:, t.n_outputs : t.n_outputs + t.n_inputs] = u
    return z


def predicted(t: Tables, theta: Array, y: Array, u: Array, *, free: bool = False) -> tuple[Array, Array]:
    """Return predictions or a free run, and all signals behind them.

    `theta`: (n_terms,); `y`: (n_samples, n_outputs), scaled; `u`: (n_samples, n_inputs), scaled; `free`: run on the
    model's own outputs from sample `lag` on. Returns `predictions`: (n_samples, n_outputs), naN before `lag`, and from
    where the recursion diverges on; `signals`: (n_samples, 2 n_outputs + n_inputs).
    """
    from ambid.nonlinear.narmax._kernels import run

    z = signals(t, y[: t.lag] if free else y, u)
    if t.folded:
        z[: t.lag, : t.n_outputs] *= _first_sign(t, theta, u)
    out = np.empty((z.shape[0], t.n_outputs))
    run(z, t.column, t.back, t.terms, t.place, theta, t.shape(free), out)
    return out, z


def _first_sign(t: Tables, theta: Array, u: Array) -> float:
    """Sign of the first outputs, of which only the magnitude is known: where the linear part is driven to at first."""
    width = np.count_nonzero(t.terms >= 0, axis=1)
    pushed, kept = 0.0, 1.0
    for k in np.flatnonzero((width == 1) & (t.place[:, 1] == 0)):
        c = int(t.column[t.terms[k, 0]])
        if c < t.n_outputs:
            kept -= float(theta[k])
        elif c < t.n_outputs + t.n_inputs:
            pushed += float(theta[k] * np.mean(u[: max(t.lag, 1), c - t.n_outputs]))
    return -1.0 if pushed * kept < 0 else 1.0


def sensitivities(t: Tables, theta: Array, z: Array, *, free: bool = False) -> Array:
    """Return the exact derivative of `predicted` by theta.

    `theta`: (n_terms,); `z`: (n_samples, 2 n_outputs + n_inputs), the signals that `predicted` returned. Returns
    (n_samples, n_outputs, n_terms).
    """
    from ambid.nonlinear.narmax._kernels import slopes

    out = np.empty((z.shape[0], t.n_outputs, theta.size))
    slopes(z, t.column, t.back, t.terms, t.place, theta, t.shape(free), out)
    return out
