"""Units placed on training rows, as it was told: which regressors they see, where they stand, how wide they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.rbf.centres import k_means, neighbour_widths, ols_order, typical_size
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.rbf.units import value
from ambid.nonlinear.rbf.weights import Weights, fitted_weights
from ambid.nonlinear.records import Parts

NEURONS = (2, 4, 8, 16, 32, 48)  # that are compared
MIDDLE = 1.4  # width, where it is not the question
_NEIGHBOURS = 2
_MOST_ROWS = 4000  # that are looked at
_CANDIDATES = 200  # of the data that may become a centre
_NARROW = 1e-3  # part of the widest direction below which the whitened metric counts a direction as that wide


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """What was told about the units; None where it is left open."""

    ny: int | None
    nu: int | None
    neurons: int | None
    width: float | None  # in typical sizes of the data, or in distances of neighbours
    seen: str | None  # as in the register; taken as "all" while it is open
    nk: int
    linear: bool
    unit: str  # as in the register
    centres: str
    widths: str
    metric: str
    choice: str
    prior: float | None
    share: float  # held out
    free: bool  # compare free runs


def rows_of(shape: RbfShape, parts: Parts) -> tuple[Array, Array]:
    """Return regressors and outputs of all parts."""
    lags = shape.lags
    return (
        np.concatenate([lags.regressors(y, u) for y, u in parts]),
        np.concatenate([y[lags.lag :] for y, _ in parts]),
    )


def shape_of(told: Told, parts: Parts, ny: int, nu: int, neurons: int) -> RbfShape:
    """Return the shape with a metric made from the data."""
    p, m = parts[0][0].shape[1], parts[0][1].shape[1]
    lags = NarxShape(n_outputs=p, n_inputs=m, ny=ny, nu=nu if m else 0, nk=told.nk, neurons=0)
    outputs = lags.tables[0] < p
    seen = {"all": np.ones(outputs.size, dtype=bool), "outputs": outputs, "inputs": ~outputs}[told.seen or "all"]
    M = np.eye(outputs.size)[seen]
    if told.metric == "whitened" and M.shape[0]:
        x = np.concatenate([lags.regressors(y, u) for y, u in parts]) @ M.T
        _, s, Vt = np.linalg.svd(np.linalg.qr(x - x.mean(axis=0), mode="r"))
        wide = np.zeros(x.shape[1])
        wide[: s.size] = s
        M = (Vt / (np.maximum(wide, _NARROW * max(s[0], 1e-300)) / np.sqrt(x.shape[0]))[:, None]) @ M
    return RbfShape(lags=lags, metric=M, linear=told.linear, neurons=neurons, unit=told.unit)


class Placing:
    """Units on some training rows: centres, widths, weights. Centres are found once for each question.

    `shape`: its number of units is not looked at; `most`: units that will be asked for at most.

    `z`: the rows looked at: all, or some spread evenly over the records where they are many; `y`: the rows looked at:
    all, or some spread evenly over the records where they are many; `x`: (n, n_seen), what the units see; `size`:
    typical distance of the data from their middle.
    """

    def __init__(self, told: Told, shape: RbfShape, parts: Parts, seed: int, *, most: int) -> None:
        self.told, self.shape, self.seed, self.most = told, shape, seed, most
        z, y = rows_of(shape, parts)
        step = -(-z.shape[0] // _MOST_ROWS)
        self.z, self.y = z[::step], y[::step]
        self.x = self.z @ shape.metric.T
        self.size = typical_size(self.x)
        self._found: dict[tuple[int, float], Array] = {}

    def theta(self, neurons: int, width: float) -> tuple[RbfShape, Array]:
        """Return units with weights of zero; fewer than asked for where the data have no place for more.

        Returns `theta`: (n_theta,).
        """
        C = self._centres(neurons, width)
        shape = self.shape.with_neurons(C.shape[0])
        if self.told.widths == "common":
            widths = np.full(C.shape[0], width * self.size)
        else:
            widths = width * neighbour_widths(C, _NEIGHBOURS, self.size)
        return shape, np.concatenate([np.zeros(shape.n_weights), C.ravel(), np.log(widths)])

    def solved(self, neurons: int, width: float) -> tuple[RbfShape, Weights]:
        """Return units with their weights on the rows looked at."""
        shape, theta = self.theta(neurons, width)
        return shape, fitted_weights(shape, theta, self.z, self.y, self.told.prior)

    def _centres(self, neurons: int, width: float) -> Array:
        neurons = min(neurons, max((self.z.shape[0] - sum(self.shape.sizes[:2])) // 2, 0))  # two samples for each
        if not neurons or not self.shape.n_seen:
            return np.empty((0, self.shape.n_seen))
        rng = np.random.default_rng([self.seed, 2])
        if self.told.centres == "kmeans":
            key = (neurons, 0.0)
            if key not in self._found:
                self._found[key] = k_means(self.x, neurons, rng)
            return self._found[key]
        key = (0, width if self.told.widths == "common" else MIDDLE)
        if key not in self._found:
            self._found[key] = self._by_ols(self.most, key[1], rng)
        return self._found[key][:neurons]

    def _by_ols(self, most: int, width: float, rng: np.random.Generator) -> Array:
        n = self.x.shape[0]
        at = np.sort(rng.permutation(n)[: max(_CANDIDATES, 2 * most)])
        C = self.x[at]
        squares = np.zeros((n, C.shape[0]))
        for j in range(C.shape[1]):
            squares += (self.x[:, j, None] - C[:, j]) ** 2
        known = np.hstack([self.z if self.told.linear else self.z[:, :0], np.ones((n, 1))])
        order, _ = ols_order(value(self.told.unit, squares / (width * self.size) ** 2), known, self.y, most)
        return C[order]
