"""The linear plant that a nonlinear bearing is about one point of position and current."""

from __future__ import annotations

import numpy as np

from ambid.bearing.magnet.result import NonlinearBearingEstimate
from ambid.estimation.estimate import Continuous


def linearised(
    estimate: NonlinearBearingEstimate, position: float | None = None, current: float | None = None
) -> Continuous:
    """Return the plant about a point: m x'' = f - c x', L i' = V - R i - k_i x', f = k_i i - k_x x (thesis eq. 4.8).

    `position`, `current`: in m and A; by default the operating point of the records. Returns with an eddy pole the
    force is a fourth state, f' = a (k_i i - k_x x - f).
    """
    x = estimate.operating_point["position"] if position is None else position
    i = estimate.operating_point["current"] if current is None else current
    at, v = estimate.curves(x, i), estimate.values
    k_x, k_i, ell = float(at.k_x.value[0]), float(at.k_i.value[0]), float(at.L.value[0])
    m, c = v["m"], v["c"]
    states: tuple[str, ...] = ("position", "velocity", "current")
    A = np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, k_i / m], [0.0, -k_i / ell, -v["R"] / ell]])
    B, C = np.array([[0.0], [0.0], [1.0 / ell]]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if estimate.eddy:
        states, a = (*states, "force"), v["a"]
        A = np.vstack([np.hstack([A, [[0.0], [1.0 / m], [0.0]]]), [-a * k_x, 0.0, a * k_i, -a]])
        A[1, 0] = A[1, 2] = 0.0
        B, C = np.vstack([B, [[0.0]]]), np.hstack([C, np.zeros((2, 1))])
    return Continuous(states=states, A=A, B=B, C=C, poles=np.linalg.eigvals(A).astype(np.complex128))
