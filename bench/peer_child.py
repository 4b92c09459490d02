"""The side of a peer: it reads one job a line, fits, and answers one line of JSON. Needs NumPy and the peer alone.

A job is ``{"structure", "orders", "mode", "data"}``; data is an .npz file with u and y of shape (n_samples,). Answers
hold polynomials in q^-1 (A, B with nk zeros, C, D, F) or state-space matrices. What the peers print is thrown away.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

Fit = Callable[[str, dict[str, int], str, np.ndarray, np.ndarray], dict[str, Any]]

MEMORY = 6 * 2**30  # bytes of address space: a peer that wants more is told so, and the machine stays alive


def one_early(fit: Fit) -> Fit:
    """For a program that knows no immediate effect of the input: let it see the input one sample early."""

    def job(structure: str, orders: dict[str, int], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
        if orders.get("nk", 1) > 0:
            return fit(structure, orders, mode, u, y)
        found = fit(structure, {**orders, "nk": 1}, mode, u[1:], y[:-1])
        return {**found, "B": np.asarray(found["B"])[1:]}

    return job


def serve(fit: Fit) -> None:
    """Answer jobs until the input ends; an exception is an answer too."""
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answers:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        for line in sys.stdin:
            answers.write(json.dumps(_answer(fit, json.loads(line))) + "\n")
            answers.flush()


def _answer(fit: Fit, job: dict[str, Any]) -> dict[str, Any]:
    with np.load(job["data"]) as data:
        u, y = data["u"], data["y"]
    before = time.perf_counter()
    try:
        found = fit(job["structure"], job["orders"], job["mode"], u, y)
        seconds = time.perf_counter() - before
    except (Exception, SystemExit) as problem:  # some peers leave by sys.exit
        return {"seconds": time.perf_counter() - before, "problem": f"{type(problem).__name__}: {problem}"[:200]}
    plain = {k: np.asarray(v, dtype=np.float64) for k, v in found.items() if v is not None}
    if not all(np.all(np.isfinite(v)) for v in plain.values()):
        return {"seconds": seconds, "problem": "coefficients are not finite"}
    return {"seconds": seconds, "found": {k: v.tolist() for k, v in plain.items()}}
