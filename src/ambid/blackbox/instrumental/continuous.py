"""Continuous-time filters of sampled signals, exact between the samples.

Time is measured in units of 1/w0 inside (p = s/w0), which keeps the coefficients of stiff plants near one. The filter
p^k/F(p) is state k of the companion form of F; its matrix exponential is exact for an input that is held over a sample
(zero-order hold) or runs straight between samples (first-order hold).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.sensitivity import run
from ambid.physics.discretise import zero_order_hold

Numbers = Any  # arrays of real numbers, or of complex ones for complex steps


def companion(den: Numbers) -> Numbers:
    """Return the companion matrix whose state k is p^k/F(p) times the input, shape (n, n).

    `den`: (n + 1,), F, highest power first, monic; complex for a complex step. Returns (n, n).
    """
    n = den.size - 1
    out = np.eye(n, k=1, dtype=den.dtype)
    out[-1:] = -den[:0:-1]
    return out


def filtered(den: Array, step: float, x: Array) -> Array:
    """Return p^k/F(p) x for k = 0 ... n - 1, x straight between samples, from rest.

    `den`: (n + 1,); `step`: sampling interval in units of 1/w0; `x`: (n_samples,). Returns (n_samples, n).
    """
    from scipy.linalg import expm

    n = den.size - 1
    M = np.zeros((n + 2, n + 2))
    M[:n, :n] = companion(den) * step
    M[n - 1, n] = step
    M[n, n + 1] = 1.0
    E = expm(M)
    z = np.stack([x, np.append(np.diff(x), 0.0)], axis=1)
    return run(np.ascontiguousarray(E[:n]), z, np.zeros(n))[:-1]


def free_response(den: Array, step: float, n_samples: int) -> Array:
    """Return n responses of 1/F(p) without input that span all of them, shape (n_samples, n).

    `den`: (n + 1,); `step`: sampling interval in units of 1/w0. Returns (n_samples, n).
    """
    from scipy.linalg import expm

    n = den.size - 1
    transition = expm(companion(den) * step)
    first = np.zeros(n)
    first[0] = 1.0
    return run(np.ascontiguousarray(transition.T), np.empty((n_samples, 0)), first)[:-1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Responses:
    """What one denominator makes of its inputs."""

    y: Array  # (n_samples,), sum of B_i/F u_i
    of_inputs: Array  # (n_samples, n_inputs, n), p^k/F u_i
    of_output: Array  # (n_samples, n), p^k/F y


def responses(den: Array, num: Array, step: float, u: Array) -> Responses:
    """Simulate B_i/F u_i and its derivatives by the coefficients, inputs held over a sample, from rest.

    `den`: (n + 1,); `num`: (n_inputs, n + 1), highest power first; `step`: sampling interval in units of 1/w0; `u`:
    (n_samples, n_inputs).
    """
    n, n_u = den.size - 1, u.shape[1]
    size = n * (n_u + 1)
    A, B, F = np.zeros((size, size)), np.zeros((size, n_u)), companion(den)
    c = num[:, :0:-1] - num[:, :1] * den[:0:-1]  # output from the states p^0 ... p^(n-1) of each input
    for i in range(n_u):
        A[i * n : (i + 1) * n, i * n : (i + 1) * n] = F
        B[(i + 1) * n - 1, i] = 1.0
        A[-1, i * n : (i + 1) * n] = c[i]
        B[-1, i] = num[i, 0]
    A[-n:, -n:] = F
    states = run(np.hstack(zero_order_hold(A, B, step)), u, np.zeros(size))[:-1]
    of_inputs = states[:, :-n].reshape(-1, n_u, n)
    y = np.einsum("tik,ik->t", of_inputs, c) + u @ num[:, 0]
    return Responses(y=y, of_inputs=of_inputs, of_output=states[:, -n:])
