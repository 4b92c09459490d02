"""Training a neural NARX model: least squares of one-step or of simulation errors, with a weak prior on its weights.

Weights of the hidden layer are N(0, prior^2) for scaled signals: where the data speak it does not count; where they do
not (units that do the same thing), it makes the information matrix regular.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.records import Parts

_BLOCK = 4096
_LINEAR_PRIOR = 1e3  # times that of the hidden layer: next to none


@dataclass(frozen=True, kw_only=True, eq=False)
class NarxProblem:
    """Weighted errors of a neural NARX model over parts of records."""

    shape: NarxShape
    parts: Parts
    weight: Array  # (n_outputs,), one over the errors' standard deviation
    prior: float  # standard deviation of the hidden layer's weights before the data
    free: bool = False  # errors of the free run instead of the predictions
    _rows: list[tuple[Array, Array]] = field(default_factory=list)

    def rows(self) -> list[tuple[Array, Array]]:
        """Return regressors and outputs of each part, made once: (n_rows, n_regressors) and (n_rows, n_outputs)."""
        if not self._rows:
            self._rows.extend((self.shape.regressors(y, u), y[self.shape.lag :]) for y, u in self.parts)
        return self._rows

    @property
    def n_errors(self) -> int:
        """Errors in all."""
        return sum((y.shape[0] - self.shape.lag) * y.shape[1] for y, _ in self.parts)

    def errors(self, theta: Array) -> list[Array]:
        """Return the errors of each part, from sample `lag` on, scaled; NaN from where a free run diverges on.

        `theta`: (n_theta,). Returns (n_rows, n_outputs).
        """
        s = self.shape
        if not self.free:
            return [target - s.values(theta, z) for z, target in self.rows()]
        return [(y - s.free_run(theta, y, u)[:, : s.n_outputs])[s.lag :] for y, u in self.parts]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors and of the prior's rows.

        `theta`: (n_theta,). Returns infinite where the model diverges.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = float(np.sum(self._prior(theta) ** 2))
            for e in self.errors(theta):
                found += float(np.sum((e * self.weight) ** 2))
        return found if np.isfinite(found) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], the prior's rows included.

        `theta`: (n_theta,). Returns (n_theta + 1, n_theta + 1).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = [triangle_of([block]) for _, block in self._blocks(theta)]
        found.append(self.prior_rows(theta))
        return triangle_of([np.concatenate(found)])

    def _blocks(self, theta: Array) -> Iterator[tuple[int, Array]]:
        s = self.shape
        for k, (y, u) in enumerate(self.parts):
            if self.free:
                z = s.free_run(theta, y, u)
                whole = s.free_slopes(theta, z)[s.lag :]
                left = (y - z[:, : s.n_outputs])[s.lag :]
            else:
                rows, target = self.rows()[k]
                left = target - s.values(theta, rows)
            for first in range(0, left.shape[0], _BLOCK):
                part = slice(first, first + _BLOCK)
                J = whole[part] if self.free else s.slopes(theta, rows[part])
                w = self.weight
                yield k, np.hstack(
                    [(J * w[:, None]).reshape(-1, s.n_theta), (left[part] * w).reshape(-1, 1)]
                )  # fmt: skip

    @property
    def n_linear(self) -> int:
        """Leading numbers that one-step errors are linear in: L, c, W2; 0 for a free run."""
        return 0 if self.free else sum(self.shape.sizes[:3])

    def solved(self, theta: Array) -> Array:
        """Return the weights with L, c and W2 at their best for these hidden units; of one-step errors alone.

        `theta`: (n_theta,). Returns (n_theta,), as given where the units are not finite.
        """
        s = self.shape
        _, _, _, W1, b1 = s.parts(theta)
        blocks = []
        for z, target in self.rows():
            for k in range(0, z.shape[0], _BLOCK):
                part = z[k : k + _BLOCK]
                known = [part, np.ones((part.shape[0], 1)), np.tanh(part @ W1.T + b1)]
                blocks.append(np.hstack([*known, target[k : k + _BLOCK]]))
        R, p, d = triangle_of(blocks), s.n_outputs, s.n_regressors
        if not np.all(np.isfinite(R)):
            return theta
        width = R.shape[1] - p
        pull = np.full(width, 1.0 / self.prior)
        pull[: d + 1] /= _LINEAR_PRIOR
        found = np.empty((width, p))
        for o in range(p):
            rows = np.concatenate([R[:, :width], np.diag(pull / self.weight[o])])
            found[:, o] = np.linalg.lstsq(rows, np.concatenate([R[:, width + o], np.zeros(width)]), rcond=1e-15)[0]
        return np.concatenate([found[:d].T.ravel(), found[d], found[d + 1 :].T.ravel(), theta[self.n_linear :]])

    def sample_rows(self, theta: Array) -> list[Array]:
        """Return slopes and errors of every sample, of unit variance.

        `theta`: (n_theta,). Returns (n_samples - lag, n_outputs, n_theta + 1), of each part.
        """
        found: list[list[Array]] = [[] for _ in self.parts]
        for k, block in self._blocks(theta):
            found[k].append(block.reshape(-1, self.shape.n_outputs, block.shape[1]))
        return [np.concatenate(x) for x in found]

    def prior_rows(self, theta: Array) -> Array:
        """Return slopes and rows of the prior.

        `theta`: (n_theta,). Returns (n_theta, n_theta + 1).
        """
        return np.hstack([np.diag(self._precision()), self._prior(theta)[:, None]])

    def _precision(self) -> Array:
        """One over the prior's standard deviation of every weight."""
        n_linear = sum(self.shape.sizes[:2])
        out = np.full(self.shape.n_theta, 1.0 / self.prior)
        out[:n_linear] /= _LINEAR_PRIOR
        return out

    def _prior(self, theta: Array) -> Array:
        out: Array = -self._precision() * theta
        return out


def linear_start(shape: NarxShape, parts: Parts) -> Array:
    """Return the weights of the best linear model, the hidden layer's zero.

    Returns (n_theta,).
    """
    z = np.concatenate([shape.regressors(y, u) for y, u in parts])
    target = np.concatenate([y[shape.lag :] for y, _ in parts])
    known = np.hstack([z, np.ones((z.shape[0], 1))])
    found = np.linalg.lstsq(known, target, rcond=1e-12)[0]
    theta = np.zeros(shape.n_theta)
    L, c, *_ = shape.parts(theta)
    L[:], c[:] = found[:-1].T, found[-1]
    return np.concatenate([L.ravel(), c, theta[L.size + c.size :]])


def random_start(shape: NarxShape, linear: Array, rng: np.random.Generator) -> Array:
    """Return weights with a random hidden layer whose units bend inside the data.

    `linear`: (n_theta,), of `linear_start`. Returns (n_theta,).
    """
    theta = linear.copy()
    n_l, n_c, n_2, n_1, n_b = shape.sizes
    hidden = rng.standard_normal(n_1) / np.sqrt(max(shape.n_regressors, 1))
    bias = rng.standard_normal(n_b)
    theta[n_l + n_c + n_2 :] = np.concatenate([hidden, bias])
    theta[n_l + n_c : n_l + n_c + n_2] = 0.01 * rng.standard_normal(n_2)
    return theta
