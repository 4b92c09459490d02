"""Estimators of physical parameters for the conformance suite."""

from __future__ import annotations

import numpy as np

from ambid.tracking.rpem import PhysicalRpem
from tests.recursive.cases import Case
from tests.tracking.starts import bearing, bearing_start, columns

_N, _START = 3000, 4000


def _start():
    return bearing_start(_START, 1)


def _signals(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    u, y = columns(bearing(2 * _N, seed), 0, n)
    return u, y


def _quiet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The rotor at rest at its operating point, noise of the sensors."""
    rng, at = np.random.default_rng(n), _start().operating_point
    y = np.array([at["position"], at["current"]]) + np.array([1e-7, 2e-3]) * rng.standard_normal((n, 2))
    return np.full((n, 1), at["voltage"]), y


CASES = [
    *(
        Case(
            name=f"physical RPEM, memory {memory}",
            make=lambda memory=memory: PhysicalRpem(_start(), memory=memory),
            signals=_signals,
            quiet=_quiet,
            n=_N,
        )
        for memory in ("auto", "all", 0.5)
    ),
]
