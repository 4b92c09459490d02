"""All ARX models up to given orders from one look at the data, for the choice of orders.

The triangle of the largest model's regressors holds every smaller one: leaving out columns leaves out regressors
(Ljung 1999, sec. 16.4). All are fitted to the same rows, so that their losses can be compared.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.polynomial.orders import Layout
from ambid.identify.polynomial.predictor import predictor
from ambid.identify.polynomial.scaled import scaled_data
from ambid.identify.threads import one_thread


@dataclass(frozen=True, slots=True, kw_only=True)
class ArxLoss:
    """How well one ARX model fits one output.

    Attributes
    ----------
    na, nb, nk : int
        The same nb and nk for every input.
    loss : float
        Mean squared residual, in the output's unit squared.
    n_estimated : int
        Coefficients, the constant not counted.
    n_rows : int
        Samples that were fitted, the same for all models.
    """

    na: int
    nb: int
    nk: int
    loss: float
    n_estimated: int
    n_rows: int


def arx_family(data: IOData, output: int, na: Iterable[int], nb: Iterable[int], nk: Iterable[int]) -> list[ArxLoss]:
    """Fit ARX models of all combinations of orders.

    Parameters
    ----------
    data : IOData
    output : int
        Column of ``data.y``.
    na, nb, nk : iterable of int
        At least 0, 1 and 0.

    Returns
    -------
    list of ArxLoss
        In the order of ``itertools.product(na, nb, nk)``.

    Raises
    ------
    EstimationError
        If an order is out of range or the record too short for the largest model.
    """
    all_a, all_b, all_k = tuple(na), tuple(nb), tuple(nk)
    if not (all_a and all_b and all_k) or min(all_a) < 0 or min(all_b) < 1 or min(all_k) < 0 or not data.n_inputs:
        raise EstimationError(
            "arx: orders need an input, na >= 0, nb >= 1 and nk >= 0, at least one of each. Correct them"
        )
    scaled, n_u = scaled_data("arx", data), data.n_inputs
    first, taps = min(all_k), max(all_k) - min(all_k) + max(all_b)
    largest = Layout(na=max(all_a), nb=(taps,) * n_u, nc=0, nd=0, nf=(0,) * n_u, nk=(first,) * n_u)
    p, rows = predictor(largest), data.n_samples - largest.first_row
    if rows < 2 * largest.free.size:
        raise EstimationError(f"arx: {data.n_samples} samples for {largest.free.size} coefficients. Lower the orders")
    with one_thread():
        R = p.triangle(scaled.y[output], scaled.u, largest.start(), np.zeros(p.n_nuisance))[
            p.n_nuisance :, p.n_nuisance :
        ]
        found = []
        for a, b, k in product(all_a, all_b, all_k):
            keep = [*range(a)]
            for i in range(n_u):
                at = largest.na + i * taps + k - first
                keep += range(at, at + b)
            rest = np.asarray(np.linalg.qr(R[:, np.array([*keep, -1])], mode="r"))[-1, -1]
            loss = float(rest**2 * scaled.y_scale[output] ** 2 / rows)
            found.append(ArxLoss(na=a, nb=b, nk=k, loss=loss, n_estimated=len(keep), n_rows=rows))
    return found
