"""sysidentpy: a linear NARMAX model of given terms by least squares, extended where the noise is coloured.

It has no output-error structure: OE is estimated as the ARMAX model that holds it (C as long as F). It keeps the noise
model to itself, and has no Box-Jenkins.

Run: PYTHON peer_sysidentpy.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sysidentpy.basis_function import Polynomial
from sysidentpy.parameter_estimation import LeastSquares
from sysidentpy.simulation import SimulateNARMAX

import peer_child

ITERATIONS = 50  # of extended least squares; its own 20 are not always enough


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:  # noqa: ARG001
    na, nb, nk = orders["nf" if structure == "oe" else "na"], orders["nb"], orders["nk"]
    noise = {"arx": 0, "oe": na, "armax": orders.get("nc", 0)}[structure]
    terms = [*(1000 + k for k in range(1, na + 1)), *(2000 + nk + k for k in range(nb))]
    model = SimulateNARMAX(
        basis_function=Polynomial(degree=1),
        estimator=LeastSquares(unbiased=noise > 0, uiter=ITERATIONS),
        elag=max(noise, 1),
    )
    x, z = u[:, None], y[:, None]
    short = slice(0, na + nb + nk + 2)  # it always simulates too: on as few samples as it takes
    model.simulate(X_train=x, y_train=z, X_test=x[short], y_test=z[short], model_code=np.array(terms)[:, None])
    found = dict(zip((int(code[0]) for code in model.final_model), np.ravel(model.theta), strict=True))
    a = np.array([1.0, *(-found[1000 + k] for k in range(1, na + 1))])
    b = np.array([*np.zeros(nk), *(found[2000 + nk + k] for k in range(nb))])
    return {"B": b, "F" if structure == "oe" else "A": a}


if __name__ == "__main__":
    peer_child.serve(peer_child.one_early(fit))
