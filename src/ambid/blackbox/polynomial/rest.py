"""Records that begin at rest at zero: whether what the user says of them agrees with the data.

A user who knows that everything was zero before the first sample spares the initial states and the constant, and all
samples count. Setting them free (and leaving out the first residuals, which need samples from before) gives a larger
model that holds the first. One Gauss-Newton step from the one to the other tells by how much the squared residual would
fall: divided by its expectation F distributed where the record is at rest (score test; Söderström & Stoica 1989,
sec. 11.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from ambid.arrays import Array
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.scaled import Scaled
from ambid.blackbox.polynomial.search import Fitted

_LEVEL = 1e-3  # of a record at rest, so many are flagged
_ROUNDING = 1e-22  # squared residual over squared output that is nothing but rounding


def not_at_rest(layouts: Sequence[Layout], fits: Sequence[Fitted], scaled: Scaled) -> list[str]:
    """Return a warning for each output whose record does not begin at rest at zero.

    `layouts`: at rest; `fits`: one for each output.
    """
    found = []
    for o, (layout, fit) in enumerate(zip(layouts, fits, strict=True)):
        p = rest_probability(layout, fit, scaled.y[o], scaled.u)
        if p < _LEVEL:
            found.append(
                f"{f'output {o}: ' if len(fits) > 1 else ''}the record does not begin at rest at zero (initial state "
                f"and constant, set free, explain more than chance would: p = {p:.1g}): coefficients are biased. Leave "
                "at_rest (--at-rest) out"
            )
    return found


def rest_probability(layout: Layout, fit: Fitted, y: Array, u: Array) -> float:
    """Return how probable it is that a record at rest asks so much for an initial state and a constant.

    `layout`: at rest; `fit`: its fit; `y`: (n_samples,), scaled; `u`: (n_inputs, n_samples). Returns 1 where the fit
    leaves nothing but rounding.
    """
    free = replace(layout, at_rest=False)
    p = predictor(free)
    rows = y.size - free.first_row
    freedom = rows - p.n_nuisance - free.free.size
    if freedom < 1 or fit.cost <= _ROUNDING * float(y @ y):
        return 1.0
    left = float(p.triangle(y, u, fit.theta, np.zeros(p.n_nuisance))[-1, -1] ** 2)
    numbers = p.n_nuisance + free.first_row
    ratio = (fit.cost - left) / numbers / max(left / freedom, 1e-300)
    return float(fdtrc(numbers, freedom, max(ratio, 0.0)))
