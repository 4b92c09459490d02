"""Errors of a radial basis network over records, weighted, with the rows of its prior: what Levenberg-Marquardt sees.

The unknown are the first numbers of theta: the output weights alone, or all with centres and widths.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.records import Parts

_BLOCK = 4096
_OPEN = 1e-4  # one over the standard deviation of the linear part and the constant before the data: next to no prior


@dataclass(frozen=True, kw_only=True, eq=False)
class RbfProblem:
    """Weighted errors of a radial basis network."""

    shape: RbfShape
    parts: Parts
    weight: Array  # (n_outputs,), one over the errors' standard deviation
    mean: Array  # (n_theta,), of the prior; one over its standard deviation
    precision: Array
    n_active: int  # numbers that are searched for, the first of theta
    fixed: Array  # (n_theta - n_active,), the others
    free: bool = False  # errors of the free run instead of the predictions
    _rows: list[tuple[Array, Array]] = field(default_factory=list)

    def rows(self) -> list[tuple[Array, Array]]:
        """Return regressors and outputs of each part, made once: (n_rows, n_regressors) and (n_rows, n_outputs)."""
        if not self._rows:
            lags = self.shape.lags
            self._rows.extend((lags.regressors(y, u), y[lags.lag :]) for y, u in self.parts)
        return self._rows

    @property
    def n_errors(self) -> int:
        """Errors in all."""
        return sum((y.shape[0] - self.shape.lags.lag) * y.shape[1] for y, _ in self.parts)

    def whole(self, v: Array) -> Array:
        """Return all numbers.

        `v`: (n_active,). Returns (n_theta,).
        """
        return np.concatenate([v, self.fixed])

    def errors(self, v: Array) -> list[Array]:
        """Return the errors of each part, from sample `lag` on, scaled; NaN from where a free run diverges on.

        `v`: (n_active,). Returns (n_rows, n_outputs).
        """
        s, theta = self.shape, self.whole(v)
        if not self.free:
            return [target - s.values(theta, z) for z, target in self.rows()]
        return [(y - s.free_run(theta, y, u)[:, : s.n_outputs])[s.lags.lag :] for y, u in self.parts]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors and of the prior's rows.

        `theta`: (n_active,). Returns infinite where the model diverges.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = float(np.sum(self._prior(theta) ** 2))
            found += sum(float(np.sum((e * self.weight) ** 2)) for e in self.errors(theta))
        return found if np.isfinite(found) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], the prior's rows included.

        `theta`: (n_active,). Returns (n_active + 1, n_active + 1).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            found = [triangle_of([block.reshape(-1, self.n_active + 1)]) for _, block in self._blocks(theta)]
        found.append(np.hstack([np.diag(self.precision[: self.n_active]), self._prior(theta)[:, None]]))
        return triangle_of([np.concatenate(found)])

    def scores(self, theta: Array) -> list[Array]:
        """Return the slope of every sample's weighted error times that error, for the sandwich.

        `theta`: (n_active,). Returns (n_rows, n_active), of each part.
        """
        found: list[list[Array]] = [[] for _ in self.parts]
        for k, block in self._blocks(theta):
            found[k].append(np.einsum("tok,to->tk", block[:, :, :-1], block[:, :, -1]))
        return [np.concatenate(x) for x in found]

    def across(self, theta: Array, noise: Array) -> Array:
        """Return what the information of the scores has beyond that of the slopes where outputs' errors hang
        together.

        `theta`: (n_active,); `noise`: (n_outputs, n_outputs), scaled, covariance of the errors. Returns (n_active,
        n_active), zero where it is diagonal.
        """
        extra = noise * self.weight[:, None] * self.weight
        np.fill_diagonal(extra, 0.0)
        out = np.zeros((self.n_active, self.n_active))
        for _, block in self._blocks(theta) if np.any(extra) else ():
            J = block[:, :, :-1]
            out += np.tensordot(J, np.matmul(extra, J), axes=([0, 1], [0, 1]))
        return (out + out.T) / 2.0

    def _blocks(self, v: Array) -> Iterator[tuple[int, Array]]:
        """Yield weighted slopes and errors, shape (n, n_outputs, n_active + 1), with the number of their part."""
        s, theta, lag, active = self.shape, self.whole(v), self.shape.lags.lag, slice(0, self.n_active)
        for k, (y, u) in enumerate(self.parts):
            if self.free:
                z = s.free_run(theta, y, u)
                steep = s.free_slopes(theta, z, self.n_active)[lag:]
                left = (y - z[:, : s.n_outputs])[lag:]
            else:
                rows, target = self.rows()[k]
                left = target - s.values(theta, rows)
            for first in range(0, left.shape[0], _BLOCK):
                part = slice(first, first + _BLOCK)
                J = steep[part] if self.free else s.slopes(theta, rows[part])[:, :, active]
                yield k, np.concatenate([J, left[part, :, None]], axis=2) * self.weight[:, None]

    def _prior(self, v: Array) -> Array:
        out: Array = self.precision[: self.n_active] * (self.mean[: self.n_active] - v)
        return out


def problem_at(
    shape: RbfShape,
    parts: Parts,
    theta: Array,
    prior: Array,
    start: Array,
    *,
    everything: bool,
    free: bool = False,
    noise: Array | None = None,
) -> RbfProblem:
    """Return the problem whose errors have unit variance at given numbers.

    `theta`: (n_theta,); `prior`: (n_outputs,), standard deviation of the units' weights before the data; `start`:
    (n_theta,); `everything`: whether centres and widths are searched for as well; `free`: errors of the free run;
    `noise`: (n_outputs,), variance of the errors, where it is known better than from the errors themselves.
    """
    n_line = sum(shape.sizes[:2])
    widths = np.exp(shape.parts(start)[4])
    precision = np.concatenate(
        [
            np.full(n_line, _OPEN),
            np.repeat(1.0 / prior, shape.neurons),
            np.repeat(1.0 / widths, shape.n_seen),
            np.ones(shape.neurons),
        ]
    )
    mean = np.concatenate([np.zeros(shape.n_weights), start[shape.n_weights :]])
    n = shape.n_theta if everything else shape.n_weights
    one = RbfProblem(
        shape=shape,
        parts=parts,
        weight=np.ones(shape.n_outputs),
        mean=mean,
        precision=precision,
        n_active=n,
        fixed=theta[n:],
        free=free,
    )
    if noise is None:
        with np.errstate(over="ignore", invalid="ignore"):
            noise = np.mean(np.concatenate(one.errors(theta[:n])) ** 2, axis=0)
    size = np.sqrt(np.where(np.isfinite(noise), np.maximum(noise, 1e-14), 1.0))
    return RbfProblem(
        shape=shape,
        parts=parts,
        weight=1.0 / size,
        mean=mean,
        precision=precision,
        n_active=n,
        fixed=theta[n:],
        free=free,
        _rows=one._rows,
    )
