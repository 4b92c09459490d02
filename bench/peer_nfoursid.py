"""nfoursid: N4SID with the QR decomposition of Verhaegen and Verdult.

Run: PYTHON peer_nfoursid.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from nfoursid.nfoursid import NFourSID

import peer_child


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:  # noqa: ARG001
    method = NFourSID(pd.DataFrame({"u": u, "y": y}), ["y"], input_columns=["u"], num_block_rows=orders["horizon"])
    method.subspace_identification()
    model, covariance = method.system_identification(rank=orders["n"])
    return {"A": model.a, "B": model.b, "C": model.c, "D": model.d, "covariance": covariance}


if __name__ == "__main__":
    peer_child.serve(fit)
