"""Delays of the inputs, from a long ARX model (its leading coefficients of B that the data can do without).

One triangle of all regressors serves every candidate: leaving columns out of it leaves regressors out of the fit.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial.predictor import predictor
from ambid.errors import EstimationError

LARGEST_DELAY = 20  # samples
_HISTORY = 10  # past outputs, and inputs after the delay, of the long model


def long_delays(name: str, y: Array, u: Array, least: int, *, at_rest: bool = False) -> tuple[int, ...]:
    """Return the delay of every input with the smallest BIC of a long ARX model.

    `name`: structure, for messages; `y`: (n_samples,), scaled, mean taken off; `u`: (n_inputs, n_samples).
    """
    n_u, n = u.shape[0], y.size
    history = min(_HISTORY, n // (10 * (1 + n_u)))
    largest = min(LARGEST_DELAY, n // (5 * n_u) - history)
    if history < 3 or largest < 5:
        raise EstimationError(f"{name}: {n} samples are too few to find the delay. Give nk")
    taps = largest + history
    long = Layout(na=history, nb=(taps,) * n_u, nc=0, nd=0, nf=(0,) * n_u, nk=(least,) * n_u, at_rest=at_rest)
    p = predictor(long)
    R: Array = p.triangle(y, u, long.start(), np.zeros(p.n_nuisance))[p.n_nuisance :, p.n_nuisance :]
    rows = n - long.first_row

    def bic(delays: tuple[int, ...]) -> float:
        keep = [*range(history)]
        for i, k in enumerate(delays):
            first = history + i * taps
            keep += range(first + k - least, first + taps)
        kept: Array = np.asarray(np.linalg.qr(R[:, np.array([*keep, -1])], mode="r"))
        cost = max(float(kept[-1, -1] ** 2), 1e-24 * n)
        return rows * float(np.log(cost)) + len(keep) * float(np.log(rows))

    delays: tuple[int, ...] = (least,) * n_u
    for _ in range(3):
        before = delays
        for i in range(n_u):
            tried = [(*delays[:i], k, *delays[i + 1 :]) for k in range(least, largest + 1)]
            delays = min(tried, key=bic)
        if delays == before:
            break
    return delays
