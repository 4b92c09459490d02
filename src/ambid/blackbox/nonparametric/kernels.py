"""Prior covariances of impulse responses: smooth and fading.

Pillonetto and De Nicolao 2010; Chen, Ohlsson and Ljung 2012.

K[i, j] for taps i, j = 1 to n, with a decay lambda from tap to tap:
DC: lambda^((i+j)/2) rho^|i-j|; TC: lambda^max(i,j), which is DC with rho = sqrt(lambda);
SS (stable spline): lambda^(i+j+max(i,j))/2 - lambda^(3 max(i,j))/6.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ambid.arrays import Array

Kernel = Literal["tc", "dc", "ss"]

SHAPES: dict[Kernel, int] = {"tc": 1, "dc": 2, "ss": 1}  # numbers beside the size


def kernel_matrix(kernel: Kernel, n: int, shape: Array) -> tuple[Array, list[Array]]:
    """Return a kernel and its derivatives by the logarithms of its shape.

    `n`: taps; `shape`: lambda, and rho for DC; both between 0 and 1. Returns `K`: (n, n); `derivatives`: by log lambda,
    and log rho.
    """
    i = np.arange(1, n + 1)
    most, both, apart = np.maximum.outer(i, i), np.add.outer(i, i), np.abs(np.subtract.outer(i, i))
    log = np.log(shape)
    if kernel == "tc":
        K = np.exp(log[0] * most)
        return K, [most * K]
    if kernel == "dc":
        K = np.exp(log[0] * both / 2 + log[1] * apart)
        return K, [both / 2 * K, apart * K]
    first, second = np.exp(log[0] * (both + most)) / 2, np.exp(log[0] * 3 * most) / 6
    return first - second, [(both + most) * first - 3 * most * second]


def kernel_root(kernel: Kernel, n: int, shape: Array) -> Array:
    """Return L with L L^T = K; exact for TC and DC, to rounding for SS.

    `n`: taps. Returns (n, n).
    """
    i = np.arange(n)
    apart = np.abs(np.subtract.outer(i, i))
    if kernel == "ss":  # smooth, so nearly singular: a trace of roughness on every tap makes it definite
        alike = 1.5 * shape[0] ** (0.5 * apart) - 0.5 * shape[0] ** (1.5 * apart)
        size = shape[0] ** (1.5 * (i + 1)) / np.sqrt(3.0)
        return np.asarray(size[:, None] * np.linalg.cholesky(alike + 1e-10 * np.eye(n)))
    decay, rho = (shape[0], shape[1]) if kernel == "dc" else (shape[0], np.sqrt(shape[0]))
    lower = np.tril(rho**apart)
    lower[:, 1:] *= np.sqrt(max(1.0 - rho**2, 0.0))
    return np.asarray(decay ** ((i + 1) / 2)[:, None] * lower)
