"""The Laguerre operator w = (s - p)/(s + p): powers that are well-conditioned on the imaginary axis (thesis eq. 1.8).

On s = j omega, |w| = 1: its powers are as good as those of a discrete-time system's z, where powers of j omega grow
with omega^k and are nearly parallel (Van Overschee and De Moor 1996; McKelvey, Akcay and Ljung 1996).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError

Complex = NDArray[np.complex128]


def laguerre_operator(omega: Array, p: float) -> Complex:
    """Return w = (j omega - p)/(j omega + p).

    `omega`: (n_frequencies,), rad/s; `p`: positive. Returns (n_frequencies,), complex, on the unit circle: -1 at 0, j
    at p, towards 1 far above it.
    """
    if not (np.isfinite(p) and p > 0):
        raise EstimationError(f"the Laguerre operator's p is {p} rad/s; it must be positive. Give one inside the band")
    return np.asarray((1j * omega - p) / (1j * omega + p))


def block_rows_condition(omega: Array, order: int, p: float | None = None) -> float:
    """Return the condition number of the rows 1, v, v^2 ... v^order that a subspace method works on.

    Parameters
    ----------
    omega : ndarray, shape (n_frequencies,), rad/s
    order : int
        Highest power.
    p : float, optional, rad/s
        v is the Laguerre operator with this p; without, v = j omega over the median of omega, so that it is not the
        unit of time that makes the number large.

    Returns
    -------
    float
        Of the real matrix of real and imaginary parts, shape (order + 1, 2 n_frequencies).

    Raises
    ------
    EstimationError
        If there are fewer lines than rows need.
    """
    if not 1 <= order < 2 * omega.size:
        raise EstimationError(f"powers up to {order} on {omega.size} lines; give an order from 1 to twice the lines")
    v = 1j * omega / np.median(omega) if p is None else laguerre_operator(omega, p)
    rows = v[None, :] ** np.arange(order + 1)[:, None]
    s = np.linalg.svd(np.concatenate([rows.real, rows.imag], axis=1), compute_uv=False)
    return float(s[0] / max(s[-1], 1e-300))


def best_conditioned(omega: Array, order: int) -> float:
    """Return the p for which the powers of the operator are best conditioned, in rad/s.

    Parameters
    ----------
    omega : ndarray, shape (n_frequencies,), rad/s
    order : int

    Returns
    -------
    float
        Within 1 % of the best between the slowest and ten times the fastest line.
    """
    from scipy.optimize import minimize_scalar

    low, high = np.log(np.min(omega[omega > 0])), np.log(np.max(omega)) + np.log(10.0)
    grid = np.linspace(low, high, 25)
    size = [np.log(block_rows_condition(omega, order, float(np.exp(x)))) for x in grid]
    k, step = int(np.argmin(size)), grid[1] - grid[0]
    found = minimize_scalar(
        lambda x: np.log(block_rows_condition(omega, order, float(np.exp(x)))),
        bounds=(grid[k] - step, grid[k] + step),
        method="bounded",
        options={"xatol": 0.01},
    )
    return float(np.exp(found.x if found.fun < size[k] else grid[k]))
