"""statsmodels: its compiled Kalman filter, and recursive least squares on it; whole records only.

Run: PYTHON peer_statsmodels.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from statsmodels.regression.recursive_ls import RecursiveLS
from statsmodels.tsa.statespace.kalman_filter import MEMORY_CONSERVE, MEMORY_NO_FILTERED_MEAN, KalmanFilter

import peer_child


def fit(structure: str, orders: dict[str, Any], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """`structure` is rls (no forgetting; u the regressors) or kalman (orders: A, C, Q, R, P0)."""
    del mode
    if structure == "rls":
        return {"estimate": RecursiveLS(y, u).fit().params}
    A, C, Q, R, P0 = (np.array(orders[k], dtype=np.float64) for k in ("A", "C", "Q", "R", "P0"))
    found = KalmanFilter(k_endog=1, k_states=A.shape[0])
    found.bind(y)
    found["transition"], found["design"], found["obs_cov"] = A, C, R
    found["selection"], found["state_cov"] = np.eye(A.shape[0]), Q
    found.initialize_known(np.zeros(A.shape[0]), P0)
    found.set_conserve_memory(MEMORY_CONSERVE & ~MEMORY_NO_FILTERED_MEAN)
    return {"estimate": found.filter().filtered_state[:, -1]}


if __name__ == "__main__":
    peer_child.serve(fit)
