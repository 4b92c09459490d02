"""SIPPY (sippy-unipi): least squares, iterated least squares, IPOPT on the predictor as constraints, N4SID.

Run: PYTHON peer_sippy.py, see peer_child.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sippy_unipi import system_identification

import peer_child

ITERATIONS = 1000  # its own 200 are not always enough


def fit(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """`mode`, where there is a choice: "OPT" (IPOPT), "ILLS" (iterated) or "RLLS" (recursive least squares)."""
    if structure == "n4sid":
        model = system_identification(
            y,
            u,
            "N4SID",
            SS_fixed_order=orders["n"],
            SS_f=orders["horizon"],
            SS_D_required=orders.get("feedthrough", 0) > 0,
        )
        return {k: getattr(model, k) for k in "ABCDK"}
    name, theta = structure.upper(), orders["nk"] - 1
    letters = {"arx": "na nb", "oe": "nb nf", "armax": "na nb nc", "bj": "nb nc nd nf"}[structure]
    options: dict[str, Any] = {f"{name}_orders": [*(orders[k] for k in letters.split()), theta]}
    if mode:
        options |= {f"{name}_mod": mode} if structure != "bj" else {}
        options |= {"max_iterations": ITERATIONS}
    model = system_identification(y, u, name, **options)
    return polynomials(model, structure, orders)


def polynomials(model: Any, structure: str, orders: dict[str, int]) -> dict[str, Any]:
    """Its transfer functions are in falling powers of z, filled up to equal length, numerators from q^-1 on."""
    b = np.ravel(model.NUMERATOR)[orders["nk"] - 1 :][: orders["nb"]]
    denominator = np.ravel(model.DENOMINATOR)
    found: dict[str, Any] = {"B": np.concatenate([np.zeros(orders["nk"]), b])}
    if structure in ("arx", "armax"):
        found["A"] = denominator[: orders["na"] + 1]
    else:
        found["F"] = denominator[: orders["nf"] + 1]
    if "nc" in orders:
        noise = model.H.num[0][0] if structure == "armax" else np.ravel(model.NUMERATOR_H)
        found["C"] = np.concatenate([[1.0], np.ravel(noise)[1 : orders["nc"] + 1]])
    if "nd" in orders:
        found["D"] = np.ravel(model.DENOMINATOR_H)[: orders["nd"] + 1]
    return found


if __name__ == "__main__":
    peer_child.serve(peer_child.one_early(fit))
