"""Prediction errors of a hybrid model over records, as a least-squares problem with a prior on the network's weights.

The hidden layer's weights are N(0, prior^2) before the data (scaled signals), coefficients of the polynomial and of C
have no prior: what the polynomial can do costs nothing, so that it is not left to the network.

C keeps its roots inside the unit circle because a vector with a root outside has an infinite cost: such a step is
refused, and a shorter one tried. Nothing is clipped or reflected. With innovations inside the network the roots of C
alone say nothing; there only a divergence over the records is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.hybrid.function import HybridShape, Rows

Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples, n_outputs) and inputs (n_samples, n_inputs) of each record, scaled."""

_BLOCK = 4096
_LEAST = 1e-7  # standard deviation of errors, scaled
_APART = 1e-8  # of correlation: errors of two outputs are never taken as the same
_DRAWS = 40  # of a random hidden layer
_DRAWN_ON = 1000  # rows by which they are compared


@dataclass(frozen=True, kw_only=True, eq=False)
class HybridProblem:
    """Weighted one-step errors and the prior's rows; what is searched is `theta` where `live`."""

    shape: HybridShape
    parts: Parts
    # (n_outputs, n_outputs), by which errors are multiplied, so that they have unit variance and do not hang together
    weight: Array
    prior: float  # standard deviation of the network's weights before the data
    base: Array  # (n_theta,), all numbers; those that are not searched stay as they are here
    live: NDArray[np.bool_]  # (n_theta,), what is searched
    # (n_samples,), or None, samples of each record whose errors count, of those from `lag` on; all of them without
    counted: tuple[NDArray[np.bool_], ...] | None = None
    _rows: list[Rows] = field(default_factory=list)

    def rows(self) -> list[Rows]:
        """Return the regressors of each record, made once."""
        if not self._rows:
            self._rows.extend(self.shape.rows(y, u) for y, u in self.parts)
        return self._rows

    def counts(self, record: int) -> NDArray[np.bool_]:
        """Return which rows of a record count.

        Returns (n_rows,).
        """
        y = self.parts[record][0]
        every = np.ones(y.shape[0], dtype=np.bool_) if self.counted is None else self.counted[record]
        return every[self.shape.lag :]

    @property
    def n_errors(self) -> int:
        """Errors in all."""
        return self.shape.n_outputs * sum(int(np.count_nonzero(self.counts(r))) for r in range(len(self.parts)))

    def whole(self, x: Array) -> Array:
        """Return all numbers.

        `x`: (n_live,). Returns (n_theta,).
        """
        out = self.base.copy()
        out[self.live] = x
        return out

    def errors(self, theta: Array) -> list[Array]:
        """Return the one-step errors of each record that count, scaled.

        `theta`: (n_theta,), all numbers. Returns (n_rows, n_outputs), naN from a divergence on.
        """
        return [self.shape.innovations(theta, rows)[0][self.counts(r)] for r, rows in enumerate(self.rows())]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors and of the prior's rows.

        `theta`: (n_live,). Returns infinite where the predictor diverges, or does not forget how it began.
        """
        whole = self.whole(theta)
        if not self.shape.deep and self.shape.noise_radius(whole) >= 1.0:
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            found = float(np.sum((self.precision * whole)[self.live] ** 2))
            found += sum(float(np.sum((e @ self.weight.T) ** 2)) for e in self.errors(whole))
        return found if np.isfinite(found) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], the prior's rows included.

        `theta`: (n_live,). Returns (n_live + 1, n_live + 1).
        """
        whole, found = self.whole(theta), []
        with np.errstate(over="ignore", invalid="ignore"):
            for r, rows in enumerate(self.rows()):
                found += self._reduced(whole, rows, self.counts(r))
        hidden = np.flatnonzero(self.live & (self.precision > 0))
        prior = np.zeros((hidden.size, whole.size + 1))
        prior[np.arange(hidden.size), hidden] = self.precision[hidden]
        prior[:, -1] = -self.precision[hidden] * whole[hidden]
        found.append(prior[:, np.append(self.live, True)])
        return triangle_of([np.concatenate(found)])

    def _reduced(self, theta: Array, rows: Rows, counts: NDArray[np.bool_]) -> list[Array]:
        """Triangles of blocks of one record; slopes go on from block to block."""
        s, out, before = self.shape, [], None
        E, T = s.innovations(theta, rows)
        columns = np.append(self.live, True)
        for k in range(0, E.shape[0], _BLOCK):
            part = slice(k, min(k + _BLOCK, E.shape[0]))
            D = s.slopes(theta, rows, E, T, part, before)
            before = D[D.shape[0] - s.ne :].copy() if s.ne else None
            J = np.matmul(self.weight, D[counts[part]])
            r = (E[part][counts[part]] @ self.weight.T).reshape(-1, 1)
            both = np.hstack([J.reshape(r.size, -1), r])[:, columns]
            if both.shape[0]:
                out.append(triangle_of([both]))
        return out

    @cached_property
    def precision(self) -> Array:
        """One over the prior's standard deviation of every number, shape (n_theta,); 0 for the polynomial and C."""
        out = np.full(self.shape.n_theta, 1.0 / self.prior)
        out[: self.shape.n_linear] = 0.0
        return out

    def at(self, theta: Array, live: NDArray[np.bool_] | None = None) -> Self:
        """Return the problem around other numbers, its errors there of unit covariance.

        `theta`: (n_theta,); `live`: (n_theta,), what is searched; as it was without.
        """
        live = self.live if live is None else live
        return replace(self, base=theta, live=live, weight=weight_of(self.errors(theta)))


def problem_at(
    shape: HybridShape,
    parts: Parts,
    theta: Array,
    prior: float,
    *,
    live: NDArray[np.bool_] | None = None,
    counted: tuple[NDArray[np.bool_], ...] | None = None,
) -> HybridProblem:
    """Return the problem whose errors have unit covariance at given numbers.

    `theta`: (n_theta,); `live`: (n_theta,), what is searched; everything without; `counted`: (n_samples,), samples of
    each record whose errors count; all of them without.
    """
    every = np.ones(shape.n_theta, dtype=np.bool_)
    one = HybridProblem(
        shape=shape, parts=parts, weight=np.eye(shape.n_outputs), prior=prior, base=theta, live=every, counted=counted
    )
    return one.at(theta, every if live is None else live)


def weight_of(errors: list[Array]) -> Array:
    """Return what makes errors of unit covariance; the identity where they are not finite.

    `errors`: (n_rows, n_outputs). Returns (n_outputs, n_outputs).
    """
    whole = np.concatenate(errors)
    with np.errstate(over="ignore", invalid="ignore"):
        noise = whole.T @ whole / max(whole.shape[0], 1)
    return whitening(noise) if np.all(np.isfinite(noise)) else np.eye(whole.shape[1])


def whitening(noise: Array) -> Array:
    """Return W, lower triangular, with W noise W' = 1.

    `noise`: (n_outputs, n_outputs), scaled. Returns (n_outputs, n_outputs), finite also where errors vanish, or are the
    same in several outputs.
    """
    size = np.maximum(np.sqrt(np.diag(noise)), _LEAST)
    alike = (1.0 - _APART) * noise / size[:, None] / size
    np.fill_diagonal(alike, 1.0)
    out: Array = np.linalg.inv(np.linalg.cholesky(alike)) / size
    return out


def random_start(problem: HybridProblem, rng: np.random.Generator) -> Array:
    """Return numbers with a random hidden layer whose units bend inside the data.

    Of several draws the one is taken whose units explain most of the errors, passed through 1/C as they will be; their
    output weights are those of least squares, and so are coefficients of the polynomial that are searched too.

    `problem`: around numbers whose polynomial and C are taken. Returns (n_theta,).
    """
    shape = problem.shape
    n_p, n_c, n_2, n_1, n_b = shape.sizes
    place = np.arange(shape.n_theta)
    columns = np.flatnonzero(problem.live & ((place < n_p) | ((place >= n_p + n_c) & (place < n_p + n_c + n_2))))
    prior = np.diag(problem.precision[columns])
    best, least = np.empty(0), np.inf
    for _ in range(_DRAWS):
        theta = np.concatenate([problem.base[: n_p + n_c], np.zeros(n_2), _hidden_layer(n_b, n_1 // n_b, rng)])
        A, r = _linear_rows(problem, theta, columns)
        A, r = np.vstack([A, prior]), np.append(r, np.zeros(columns.size))
        step = np.linalg.lstsq(A, r, rcond=1e-12)[0]
        left = float(np.sum((r - A @ step) ** 2))
        theta[columns] += step
        if not best.size or left < least:
            best, least = theta, left
    return best


def _hidden_layer(h: int, d: int, rng: np.random.Generator) -> Array:
    """Weights and offsets of units that look at some regressors each and bend gently or hard."""
    W1 = rng.standard_normal((h, d)) * (rng.random((h, d)) < rng.uniform(0.2, 1.0, (h, 1)))
    empty = np.flatnonzero(~np.any(W1, axis=1))
    W1[empty, rng.integers(0, d, empty.size)] = 1.0
    W1 *= rng.uniform(0.7, 3.0, (h, 1)) / np.linalg.norm(W1, axis=1, keepdims=True)
    return np.concatenate([W1.ravel(), rng.standard_normal(h)])


def _linear_rows(problem: HybridProblem, theta: Array, columns: NDArray[np.intp]) -> tuple[Array, Array]:
    """Slopes by some numbers and errors, weighted, over the first rows of each record."""
    s, A, r = problem.shape, [], []
    some = slice(0, _DRAWN_ON // len(problem.parts))
    for k, rows in enumerate(problem.rows()):
        E, T = s.innovations(theta, rows)
        D, counts = s.slopes(theta, rows, E, T, some)[:, :, columns], problem.counts(k)[some]
        A.append(np.matmul(problem.weight, D[counts]).reshape(-1, columns.size))
        r.append((E[some][counts] @ problem.weight.T).ravel())
    return np.concatenate(A), np.concatenate(r)
