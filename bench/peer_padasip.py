"""padasip: adaptive filters with p coefficients, a block by its own `run`, single samples by its `adapt`.

Run: PYTHON peer_padasip.py, see peer_child.py. u is (n_samples, p), the regressors.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from padasip.filters import FilterLMS, FilterNLMS, FilterRLS

import peer_child


def fit(structure: str, orders: dict[str, float], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """`structure` is rls, nlms or lms; `mode` single: samples one by one; mu: forgetting or step, eps: its start."""
    p, mu = u.shape[1], orders["mu"]
    if structure == "lms":
        made = FilterLMS(p, mu=mu, w="zeros")
    else:
        made = {"rls": FilterRLS, "nlms": FilterNLMS}[structure](p, mu=mu, eps=orders["eps"], w="zeros")
    if mode == "single":
        for phi, value in zip(u, y, strict=True):
            made.adapt(value, phi)
    else:
        made.run(y, u)
    return {"estimate": made.w}


if __name__ == "__main__":
    peer_child.serve(fit)
