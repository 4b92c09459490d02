"""SciPy by hand: prediction error by lfilter and least_squares (Levenberg-Marquardt, differences), started at ARX.

Assumes a start at rest. Run: PYTHON peer_scipy.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

import peer_child

LETTERS = {"arx": "ab", "oe": "bf", "armax": "abc", "bj": "bcdf"}


def unpacked(theta: np.ndarray, letters: str, orders: dict[str, int]) -> dict[str, np.ndarray]:
    out, first = {k: np.ones(1) for k in "acdf"}, 0
    for letter in letters:
        part = theta[first : first + orders[f"n{letter}"]]
        out[letter] = np.concatenate([np.zeros(orders["nk"]) if letter == "b" else [1.0], part])
        first += part.size
    return out


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:  # noqa: ARG001
    letters = LETTERS[structure]
    na, nb, nk = orders.get("na", orders.get("nf", 0)), orders["nb"], orders["nk"]
    skip = max(na, nb + nk - 1)
    rows = [-y[skip - k : y.size - k] for k in range(1, na + 1)]
    rows += [u[skip - k : u.size - k] for k in range(nk, nk + nb)]
    arx = np.linalg.lstsq(np.stack(rows, axis=1), y[skip:], rcond=None)[0]
    start = {"a": arx[:na], "f": arx[:na], "b": arx[na:]}
    theta = np.concatenate([start.get(k, np.zeros(orders[f"n{k}"])) for k in letters])

    def residual(vector: np.ndarray) -> np.ndarray:
        p = unpacked(vector, letters, orders)
        error = lfilter(p["a"], [1.0], y) - lfilter(p["b"], p["f"], u)
        error = lfilter(p["d"], p["c"], error)
        return np.where(np.isfinite(error), np.clip(error, -1e50, 1e50), 1e50)

    if structure != "arx":
        theta = least_squares(residual, theta, method="lm", x_scale="jac").x
    return {k.upper(): v for k, v in unpacked(theta, letters, orders).items()}


if __name__ == "__main__":
    peer_child.serve(fit)
