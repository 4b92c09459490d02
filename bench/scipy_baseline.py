"""The same job written straight with SciPy: `lfilter` and finite differences.

This is what an engineer would write: discretise with `cont2discrete`, get the Kalman gain from `solve_discrete_are`,
filter with `lfilter`, and let forward differences make the Jacobian. The predictor is filtered in one of two ways:

- `by_modes`: split into its three modes, one complex first-order filter each (the better one: fast and accurate);
- `by_transfer_functions`: `ss2tf` and third-order filters, the textbook way. It takes longer, and at high sampling
  rates rounding in the polynomials spoils the differences.

`fit` gives either to `scipy.optimize.least_squares`.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.optimize import least_squares
from scipy.signal import cont2discrete, lfilter, ss2tf


def discrete_plant(theta, period):
    m, k_x, k_i, r, ell = theta
    a = np.array([[0, 1, 0], [-k_x / m, 0, k_i / m], [0, -k_i / ell, -r / ell]])
    b = np.array([[0, 0, 0], [0, 1 / m, 0], [1 / ell, 0, 1 / ell]])  # voltage, force, voltage disturbance
    c = np.array([[1.0, 0, 0], [0, 0, 1.0]])
    a_d, b_d, *_ = cont2discrete((a, b, c, np.zeros((2, 3))), period)
    return a_d, b_d[:, :1], b_d[:, 1:], c


def predictor(vector, period, scale):
    """Return F, the matrix of the drive [u, y, 1], C and the initial state at 13 estimated numbers.

    The numbers are 5 physical ones, 3 log noise ratios, 2 offsets, 3 initial states, each over its scale.
    """
    theta, noise, offset, x0 = vector[:5] * scale["theta"], vector[5:8], vector[8:10], vector[10:13] * scale["state"]
    a, b, e, c = discrete_plant(theta, period)
    # micrometres beside amperes: without scales the Riccati solver fails at some levels of noise
    unit, out = scale["state"], scale["output"]
    f, g, h = a * unit / unit[:, None], e / unit[:, None], c * unit / out[:, None]
    q = (g * np.exp(2 * noise[:2]) * scale["disturbance"] ** 2) @ g.T
    r = np.diag([1.0, np.exp(2 * noise[2])])
    p = solve_discrete_are(f.T, h.T, q, r)
    gain = unit[:, None] * np.linalg.solve(h @ p @ h.T + r, h @ p @ f.T).T / out
    return a - gain @ c, np.hstack([b, gain, (e @ (offset * scale["disturbance"]))[:, None]]), c, x0


def by_modes(f, matrix, c, x0, u, y):
    modes, vectors = np.linalg.eig(f)
    drive = np.column_stack([u, y, np.ones(len(y))])
    forced = drive @ np.linalg.solve(vectors, matrix).T
    forced[1:], forced[0] = forced[:-1].copy(), np.linalg.solve(vectors, x0.astype(complex))
    state = np.column_stack([lfilter([1.0], [1.0, -pole], forced[:, j]) for j, pole in enumerate(modes)])
    return (state @ (c @ vectors).T).real


def by_transfer_functions(f, matrix, c, x0, u, y):
    impulse = np.zeros(len(y))
    impulse[0] = 1.0
    # the initial state is an impulse at the first sample: C x0, then C F (F x0), ...
    drive = np.column_stack([u, y, np.ones(len(y)), impulse])
    b, d = np.column_stack([matrix, f @ x0]), np.zeros((2, drive.shape[1]))
    d[:, -1] = c @ x0
    predicted = np.zeros_like(y)
    for j, signal in enumerate(drive.T):
        numerators, denominator = ss2tf(f, b, c, d, input=j)
        for o, numerator in enumerate(numerators):
            predicted[:, o] += lfilter(numerator, denominator, signal)
    return predicted


def residual(vector, filtered, u, y, period, scale, weight):
    """Weighted innovations at 13 estimated numbers; infinite where there is no predictor: a step gets shorter."""
    try:
        recursion = predictor(vector, period, scale)
    except np.linalg.LinAlgError:
        return np.full(y.size, np.inf)
    return ((y - filtered(*recursion, u, y)) @ weight.T).ravel()


def jacobian(vector, at, *arguments):
    """Forward differences of the residual, one column for each number."""
    step = np.sqrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(vector))
    columns = []
    for j, h in enumerate(step):
        moved = vector.copy()
        moved[j] += h
        columns.append((residual(moved, *arguments) - at) / h)
    return np.stack(columns, axis=1)


def fit(start, *arguments, evaluations=None):
    """Least squares by `scipy.optimize.least_squares`, which makes its own forward differences."""
    return least_squares(
        residual, start, jac="2-point", method="trf", x_scale="jac", max_nfev=evaluations, args=arguments
    )
