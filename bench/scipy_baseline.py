"""The same job written straight with SciPy: modes of the predictor, `lfilter`, finite differences.

This is what an engineer would write: discretise with `cont2discrete`, get the Kalman gain from `solve_discrete_are`, split
the predictor into its modes, filter with `lfilter`, and let forward differences make the Jacobian. (With `ss2tf` and
third-order filters instead of modes it takes longer, and at 20 kHz rounding in the polynomials spoils the differences.)
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import cont2discrete, lfilter


def discrete_plant(theta, period):
    m, k_x, k_i, r, ell = theta
    a = np.array([[0, 1, 0], [-k_x / m, 0, k_i / m], [0, -k_i / ell, -r / ell]])
    b = np.array([[0, 0, 0], [0, 1 / m, 0], [1 / ell, 0, 1 / ell]])  # voltage, force, voltage disturbance
    c = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    a_d, b_d, *_ = cont2discrete((a, b, c, np.zeros((2, 3))), period)
    return a_d, b_d[:, :1], b_d[:, 1:], c


def residual(vector, u, y, period, scale, weight):
    """Weighted innovations at 13 numbers: 5 physical, 3 log noise ratios, 2 offsets, 3 initial states."""
    theta, noise, offset, x0 = vector[:5] * scale["theta"], vector[5:8], vector[8:10], vector[10:13] * scale["state"]
    a, b, e, c = discrete_plant(theta, period)
    q = (e * np.exp(2 * noise[:2]) * scale["disturbance"] ** 2) @ e.T
    r = np.diag(scale["output"] ** 2 * [1.0, np.exp(2 * noise[2])])
    p = solve_discrete_are(a.T, c.T, q, r)
    gain = np.linalg.solve(c @ p @ c.T + r, c @ p @ a.T).T
    f = a - gain @ c
    modes, vectors = np.linalg.eig(f)
    drive = np.column_stack([u, y, np.ones(len(y))])
    matrix = np.hstack([b, gain, (e @ (offset * scale["disturbance"]))[:, None]])
    forced = drive @ np.linalg.solve(vectors, matrix).T
    forced[1:], forced[0] = forced[:-1].copy(), np.linalg.solve(vectors, x0.astype(complex))
    state = np.column_stack([lfilter([1.0], [1.0, -pole], forced[:, j]) for j, pole in enumerate(modes)])
    predicted = (state @ (c @ vectors).T).real
    return ((y - predicted) @ weight.T).ravel()


def jacobian(vector, at, *arguments):
    """Forward differences of the residual, one column for each number."""
    step = np.sqrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(vector))
    columns = []
    for j, h in enumerate(step):
        moved = vector.copy()
        moved[j] += h
        columns.append((residual(moved, *arguments) - at) / h)
    return np.stack(columns, axis=1)
