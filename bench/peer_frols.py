"""sysidentpy: terms of a polynomial NARX model by its FROLS, their number by an information criterion.

Run: PYTHON peer_frols.py, see peer_child.py. The answer holds the chosen terms as rows of its codes (1000 + lag of the
output, 2000 + lag of the input, 0 for no factor) in the order of its choice, and their error reduction ratios.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

import peer_child


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:  # noqa: ARG001
    model = FROLS(
        order_selection=True,
        n_info_values=orders["values"],
        info_criteria=mode,
        xlag=orders["lags"],
        ylag=orders["lags"],
        basis_function=Polynomial(degree=orders["degree"]),
        estimator=LeastSquares(),
        err_tol=None,
    )
    model.fit(X=u[:, None], y=y[:, None])
    return {"terms": np.asarray(model.final_model), "err": np.asarray(model.err)[: model.n_terms]}


if __name__ == "__main__":
    peer_child.serve(fit)
