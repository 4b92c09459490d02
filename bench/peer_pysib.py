"""pysib: prediction error by a gradient phase and Gauss-Newton steps in C, started at ARX; assumes a start at rest.

Run: PYTHON peer_pysib.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pysib

import peer_child


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """`mode` "filtered" is its own remedy for local minima: ten fits, each with less filtering than the last."""
    estimator = getattr(pysib, f"{structure}_{mode}" if mode else structure)
    letters = {"arx": "na nb", "oe": "nb nf", "armax": "na nb nc", "bj": "nb nc nd nf"}[structure]
    # arx takes the delay less one; the others take it as it is
    _, model = estimator(u, y, **{k: orders[k] for k in letters.split()}, nz=orders["nk"])
    return dict(model)


if __name__ == "__main__":
    peer_child.serve(fit)
