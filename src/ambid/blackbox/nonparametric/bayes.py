"""Linear regression with fading, smooth coefficients: sizes of the prior by marginal likelihood (empirical Bayes).

y = Phi theta + c + e, theta ~ N(0, P(eta)) block by block, c free. All that the data say stands in the triangle of
[1 Phi y], taken once, by pieces; every evaluation is then a QR of that size (Chen and Ljung 2013). The noise variance
is profiled out; the gradient is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.nonparametric.kernels import SHAPES, Kernel, kernel_matrix, kernel_root
from ambid.signals.delay import lagged_triangle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Triangle:
    """Triangle of [Phi y] with the constant taken out."""

    R: Array  # (p, p)
    r: Array  # (p, n_outputs), the part of y within the columns of Phi
    left: Array  # (n_outputs, n_outputs), squares of y outside them
    head: Array  # (1 + p + n_outputs,), first row: means times sqrt(rows)
    rows: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Posterior:
    """Coefficients given the data."""

    mean: Array  # (p,)
    covariance: Array  # (p, p)
    noise_variance: float
    constant: float
    freedom: float  # effective number of coefficients
    kernel: Kernel
    hyper: Array  # (n_hyper,), block by block: size over noise variance, then shape
    evidence: float  # -2 log marginal likelihood, up to a constant


def triangle(regressors: Sequence[tuple[Array, int]], outputs: Array, first: int) -> Triangle:
    """Reduce a regression on lagged signals and a constant to a triangle.

    `regressors`: (n_samples,), and int), signal and lag of every column of Phi; `outputs`: (n_samples, n_outputs);
    `first`: first row, at least the largest lag.
    """
    rows, p = outputs.shape[0], len(regressors)
    R = lagged_triangle([(np.ones(rows), 0), *regressors, *((y, 0) for y in outputs.T)], first)
    phi, y = slice(1, 1 + p), slice(1 + p, None)
    return Triangle(R=R[phi, phi], r=R[phi, y], left=R[y, y].T @ R[y, y], head=R[0], rows=rows - first)


def posterior(t: Triangle, output: int, blocks: Sequence[int], kernels: Sequence[Kernel]) -> Posterior:
    """Choose sizes, shapes and the kernel by marginal likelihood.

    `output`: column of y; `kernels`: to choose from.
    """
    found = [_fitted(t, output, blocks, k) for k in kernels]
    return min(found, key=lambda f: f.evidence)


def _fitted(t: Triangle, output: int, blocks: Sequence[int], kernel: Kernel) -> Posterior:
    from scipy.optimize import minimize

    search = _Evidence(t, output, blocks, kernel)
    best, lowest = search.start(0.9), np.inf
    for decay in (0.5, 0.8, 0.95):
        v = search.start(decay)
        value = search(v)[0]
        if value < lowest:
            best, lowest = v, value
    done = minimize(search, best, jac=True, method="L-BFGS-B", bounds=search.bounds, options={"maxiter": 60})
    return search.posterior(done.x)


def _triangle(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r"))


class _Evidence:
    """-2 log p(y) at v: for each block log(size / noise variance), then log(-log shape) of each number of its shape."""

    def __init__(self, t: Triangle, output: int, blocks: Sequence[int], kernel: Kernel) -> None:
        self.t, self.kernel, self.blocks = t, kernel, list(blocks)
        self.output, self.r, self.left = output, t.r[:, output], float(t.left[output, output])
        self.count = t.rows - 1
        self.each = 1 + SHAPES[kernel]
        edges = np.cumsum([0, *blocks])
        self.places = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        power = [max(float(np.mean(np.sum(t.R[:, p] ** 2, axis=0))) / t.rows, 1e-300) for p in self.places]
        self.center = -np.log(power)  # a coefficient of this variance over the noise's changes y by about the noise
        self.bounds = [b for c in self.center for b in [(c - 25, c + 40), *[(-9.0, 1.1)] * SHAPES[kernel]]]

    def start(self, decay: float) -> Array:
        inner = [np.log(-np.log(decay)), *([np.log(-np.log(0.98))] if self.kernel == "dc" else [])]
        return np.concatenate([[c + 4.0, *inner] for c in self.center])

    def _prior(self, v: Array) -> tuple[Array, list[tuple[slice, Array]]]:
        """Root of P over the noise variance, and dP/dv, block by block."""
        p = self.t.R.shape[1]
        L, slopes = np.zeros((p, p)), []
        for b, place in enumerate(self.places):
            part = v[b * self.each : (b + 1) * self.each]
            shape = np.exp(-np.exp(part[1:]))
            K, by_log = kernel_matrix(self.kernel, self.blocks[b], shape)
            size = np.exp(part[0])
            L[place, place] = np.sqrt(size) * kernel_root(self.kernel, self.blocks[b], shape)
            slopes.append((place, size * K))
            # d log(shape) / dv = log(shape)
            slopes += [(place, size * d * np.log(s)) for d, s in zip(by_log, shape, strict=True)]
        return L, slopes

    def __call__(self, v: Array) -> tuple[float, Array]:
        from scipy.linalg import solve_triangular

        L, slopes = self._prior(v)
        p = L.shape[0]
        M = self.t.R @ L
        T = _triangle(np.vstack([M.T, np.eye(p)]))  # M M^T + I = T^T T
        white = solve_triangular(T, np.column_stack([self.r, self.t.R]), trans="T")
        z, X = white[:, 0], white[:, 1:]
        quadratic = self.left + float(z @ z)
        value = self.count * np.log(quadratic / self.count) + 2 * float(np.sum(np.log(np.abs(np.diag(T)))))
        g = X.T @ z
        weight = X.T @ X - np.outer(g, g) * (self.count / quadratic)
        return value, np.array([float(np.sum(weight[place, place] * d)) for place, d in slopes])

    def posterior(self, v: Array) -> Posterior:
        L, _ = self._prior(v)
        p, M = L.shape[0], self.t.R @ L
        T = _triangle(np.vstack([M, np.eye(p)]))  # M^T M + I = T^T T
        half = np.linalg.solve(T.T, L.T).T  # covariance = noise variance * half half^T
        inner = np.linalg.solve(T.T, M.T)
        w = inner @ self.r
        quadratic = self.left + float(self.r @ self.r - w @ w)
        noise = max(quadratic, 0.0) / self.count
        mean = half @ w
        head = self.t.head
        constant = (head[1 + p + self.output] - head[1 : 1 + p] @ mean) / head[0]
        return Posterior(
            mean=mean,
            covariance=noise * half @ half.T,
            noise_variance=noise,
            constant=float(constant),
            freedom=float(np.sum(inner**2)),
            kernel=self.kernel,
            hyper=np.concatenate(
                [[np.exp(part[0]), *np.exp(-np.exp(part[1:]))] for part in v.reshape(len(self.blocks), self.each)]
            ),
            evidence=self(v)[0],
        )
