"""All ARX orders and delays from one triangular factor: each candidate is a choice of its columns.

With R from [past outputs, past inputs, 1, output], the least sum of squares of any subset of regressors is the last
entry of the triangle of those columns of R (Ljung 1999, sec. 16.4); the samples are the same for all candidates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.signals.delay import lagged_triangle

Bounds = Mapping[str, tuple[int, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArxCandidate:
    """One choice of orders."""

    na: int  # nb for every input
    nb: int
    nk: tuple[int, ...]  # one for each input
    n_estimated: int  # over all outputs
    log_det: float  # sum over outputs of the log of the mean squared one-step error, SI squared
    n_rows: int  # samples used

    @property
    def bic(self) -> float:
        """Schwarz's criterion, up to a constant of the data."""
        return self.n_rows * self.log_det + self.n_estimated * float(np.log(self.n_rows))


def arx_candidates(data: IOData, bounds: Bounds) -> tuple[ArxCandidate, ...]:
    """Compare ARX models of all orders within bounds.

    `bounds`: least and largest na, nb and nk. Returns for one input all combinations; for several, delays one input
    after the other, twice.
    """
    (na0, na1), (nb0, nb1), (nk0, nk1) = (bounds[k] for k in ("na", "nb", "nk"))
    first = max(na1, nk1 + nb1 - 1 if data.n_inputs else 0)
    width = na1 + data.n_inputs * (nb1 + nk1) + 2
    if data.n_samples - first < 2 * width:
        raise EstimationError(
            f"{data.n_samples} samples are too few to choose among ARX models of up to {width - 2} coefficients. "
            "Give orders, or a longer record"
        )
    triangles = [_triangle(data, o, na1, nb1 + nk1, first) for o in range(data.n_outputs)]
    n_rows = data.n_samples - first

    def candidate(na: int, nb: int, nk: tuple[int, ...]) -> ArxCandidate:
        u = [na1 + i * (nb1 + nk1) + k for i, d in enumerate(nk) for k in range(d, d + nb)]
        columns = [*range(na), *u, width - 2, width - 1]
        losses = (_loss(R[:, columns]) / n_rows for R in triangles)
        return ArxCandidate(
            na=na,
            nb=nb,
            nk=nk,
            n_estimated=data.n_outputs * (na + nb * data.n_inputs),
            log_det=float(sum(np.log(max(x, 1e-300)) for x in losses)),
            n_rows=n_rows,
        )

    found = list[ArxCandidate]()
    for na in range(na0, na1 + 1):
        if not data.n_inputs:
            found.append(candidate(na, 0, ()))
            continue
        for nb in range(nb0, nb1 + 1):
            found += [candidate(na, nb, nk) for nk in _delays(nk0, nk1, data.n_inputs)]
    if data.n_inputs > 1:
        for _ in range(2):
            for i in range(data.n_inputs):
                best = min(found, key=lambda c: c.bic)
                others = (tuple(d if j == i else k for j, k in enumerate(best.nk)) for d in range(nk0, nk1 + 1))
                sizes = {nb for nb in (best.nb - 1, best.nb, best.nb + 1) if nb0 <= nb <= nb1}
                found += [candidate(best.na, nb, nk) for nk, nb in product(others, sorted(sizes))]
    return tuple(found)


def _delays(least: int, most: int, n_inputs: int) -> Iterator[tuple[int, ...]]:
    yield from ((k,) * n_inputs for k in range(least, most + 1))


def _triangle(data: IOData, o: int, na: int, n_u_lags: int, first: int) -> Array:
    """R of [y(t-1)... y(t-na), u(t)... u(t-n+1) of each input, 1, y(t)]."""
    y, u = data.y[:, o] - data.y[:, o].mean(), data.u - data.u.mean(axis=0)
    past = [(y, k) for k in range(1, na + 1)] + [(x, k) for x in u.T for k in range(n_u_lags)]
    return lagged_triangle([*past, (np.ones(y.size), 0), (y, 0)], first)


def _loss(R: Array) -> float:
    """Sum of squares of the last column that the others leave."""
    triangle = np.asarray(np.linalg.qr(R, mode="r"), dtype=np.float64)
    return float(triangle[-1, -1] ** 2) if triangle.shape[0] == triangle.shape[1] else 0.0
