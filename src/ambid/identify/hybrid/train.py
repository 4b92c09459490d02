"""Prediction errors of a hybrid model over records, as a least-squares problem with a prior on the network's weights.

The hidden layer's weights are N(0, prior^2) before the data (scaled signals), coefficients of the polynomial and of C
have no prior: what the polynomial can do costs nothing, so that it is not left to the network.

C keeps its roots inside the unit circle because a vector with a root outside has an infinite cost: such a step is
refused, and a shorter one tried. Nothing is clipped or reflected. With innovations inside the network the roots of C
alone say nothing; there only a divergence over the records is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ambid.identify.hybrid.function import HybridShape, Rows
from ambid.identify.networks.search import triangle_of

Array = NDArray[np.float64]
Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples, n_outputs) and inputs (n_samples, n_inputs) of each record, scaled."""

_BLOCK = 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class HybridProblem:
    """Weighted one-step errors and the prior's rows; what is searched is `theta` where `live`.

    Attributes
    ----------
    shape : HybridShape
    parts : tuple of (outputs, inputs), scaled
    weight : ndarray, shape (n_outputs,)
        One over the errors' standard deviation.
    prior : float
        Standard deviation of the network's weights before the data.
    base : ndarray, shape (n_theta,)
        All numbers; those that are not searched stay as they are here.
    live : ndarray of bool, shape (n_theta,)
        What is searched.
    first : int
        First sample of each record whose error counts; at least `lag` counts from.
    """

    shape: HybridShape
    parts: Parts
    weight: Array
    prior: float
    base: Array
    live: NDArray[np.bool_]
    first: int = 0
    _rows: list[Rows] = field(default_factory=list)

    def rows(self) -> list[Rows]:
        """Return the regressors of each record, made once."""
        if not self._rows:
            self._rows.extend(self.shape.rows(y, u) for y, u in self.parts)
        return self._rows

    @property
    def skip(self) -> int:
        """Rows of each record that do not count."""
        return max(self.first - self.shape.lag, 0)

    @property
    def n_errors(self) -> int:
        """Errors in all."""
        first = max(self.first, self.shape.lag)
        return sum(max(y.shape[0] - first, 0) * y.shape[1] for y, _ in self.parts)

    def whole(self, x: Array) -> Array:
        """Return all numbers.

        Parameters
        ----------
        x : ndarray, shape (n_live,)

        Returns
        -------
        ndarray, shape (n_theta,)
        """
        out = self.base.copy()
        out[self.live] = x
        return out

    def errors(self, theta: Array) -> list[Array]:
        """Return the one-step errors of each record, scaled.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)
            All numbers.

        Returns
        -------
        list of ndarray, shape (n_rows, n_outputs)
            NaN from a divergence on.
        """
        return [self.shape.innovations(theta, rows)[0][self.skip :] for rows in self.rows()]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors and of the prior's rows.

        Parameters
        ----------
        theta : ndarray, shape (n_live,)

        Returns
        -------
        float
            Infinite where the predictor diverges, or does not forget how it began.
        """
        whole = self.whole(theta)
        if not self.shape.deep and self.shape.noise_radius(whole) >= 1.0:
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            found = float(np.sum((self.precision * whole)[self.live] ** 2))
            found += sum(float(np.sum((e * self.weight) ** 2)) for e in self.errors(whole))
        return found if np.isfinite(found) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r], the prior's rows included.

        Parameters
        ----------
        theta : ndarray, shape (n_live,)

        Returns
        -------
        ndarray, shape (n_live + 1, n_live + 1)
        """
        whole, found = self.whole(theta), []
        with np.errstate(over="ignore", invalid="ignore"):
            for rows in self.rows():
                found += self._reduced(whole, rows)
        hidden = np.flatnonzero(self.live & (self.precision > 0))
        prior = np.zeros((hidden.size, whole.size + 1))
        prior[np.arange(hidden.size), hidden] = self.precision[hidden]
        prior[:, -1] = -self.precision[hidden] * whole[hidden]
        found.append(prior[:, np.append(self.live, True)])
        return triangle_of([np.concatenate(found)])

    def _reduced(self, theta: Array, rows: Rows) -> list[Array]:
        """Triangles of blocks of one record; slopes go on from block to block."""
        s, out, before = self.shape, [], None
        E, T = s.innovations(theta, rows)
        columns = np.append(self.live, True)
        for k in range(0, E.shape[0], _BLOCK):
            part = slice(k, min(k + _BLOCK, E.shape[0]))
            D = s.slopes(theta, rows, E, T, part, before)
            before = D[D.shape[0] - s.ne :].copy() if s.ne else None
            low = max(self.skip - k, 0)
            J = D[low:] * self.weight[:, None]
            r = (E[part][low:] * self.weight).reshape(-1, 1)
            both = np.hstack([J.reshape(r.size, -1), r])[:, columns]
            if both.shape[0]:
                out.append(triangle_of([both]))
        return out

    @property
    def precision(self) -> Array:
        """One over the prior's standard deviation of every number, shape (n_theta,); 0 for the polynomial and C."""
        out = np.full(self.shape.n_theta, 1.0 / self.prior)
        out[: self.shape.n_linear] = 0.0
        return out

    def at(self, theta: Array, live: NDArray[np.bool_] | None = None) -> Self:
        """Return the problem around other numbers, its errors there of unit variance.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)
        live : ndarray of bool, shape (n_theta,), optional
            What is searched; as it was without.

        Returns
        -------
        HybridProblem
        """
        live = self.live if live is None else live
        return replace(self, base=theta, live=live, weight=unit_weight(self.errors(theta)))


def problem_at(
    shape: HybridShape,
    parts: Parts,
    theta: Array,
    prior: float,
    *,
    live: NDArray[np.bool_] | None = None,
    first: int = 0,
) -> HybridProblem:
    """Return the problem whose errors have unit variance at given numbers.

    Parameters
    ----------
    shape : HybridShape
    parts : tuple of (outputs, inputs)
    theta : ndarray, shape (n_theta,)
    prior : float
    live : ndarray of bool, shape (n_theta,), optional
        What is searched; everything without.
    first : int, optional
        First sample whose error counts.

    Returns
    -------
    HybridProblem
    """
    every = np.ones(shape.n_theta, dtype=np.bool_)
    one = HybridProblem(
        shape=shape, parts=parts, weight=np.ones(shape.n_outputs), prior=prior, base=theta, live=every, first=first
    )
    return one.at(theta, every if live is None else live)


def unit_weight(errors: list[Array]) -> Array:
    """Return one over the root mean square of the errors of each output; 1 where they are not finite.

    Parameters
    ----------
    errors : list of ndarray, shape (n_rows, n_outputs)

    Returns
    -------
    ndarray, shape (n_outputs,)
    """
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    out: Array = 1.0 / np.where(np.isfinite(size), np.maximum(size, 1e-7), 1.0)
    return out


def random_start(shape: HybridShape, linear: Array, rng: np.random.Generator) -> Array:
    """Return numbers with a random hidden layer whose units bend inside the data, and hardly act yet.

    Parameters
    ----------
    shape : HybridShape
    linear : ndarray, shape (n_linear,)
        Polynomial and C.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (n_theta,)
    """
    _, _, n_2, n_1, n_b = shape.sizes
    d = n_1 // max(n_b, 1)
    hidden = rng.standard_normal(n_1) / np.sqrt(max(d, 1))
    return np.concatenate([linear, 0.01 * rng.standard_normal(n_2), hidden, rng.standard_normal(n_b)])
