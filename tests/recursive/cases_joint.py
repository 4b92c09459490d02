"""Joint filters for the conformance suite."""

from __future__ import annotations

from functools import cache

import numpy as np

from ambid.recursive.joint import JointEkf, JointUkf
from tests.bearing.benches import Bench, run
from tests.recursive.cases import Case
from tests.recursive.joint_starts import start_of

_N = 1000


@cache
def _bench(seed: int) -> Bench:
    return run("bearing", _N, seed)


def _signals(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    signals = _bench(seed).signals
    return signals.u[:n].copy(), signals.y[:n].copy()


_RATES = {"m": 0.02, "k_i": 0.3, "R": 0.01, "force_offset": 0.5}
CASES = [
    Case(name="joint EKF", make=lambda: JointEkf(start_of(_bench(1), 0.02)), signals=_signals, n_quiet=8000),
    Case(
        name="joint EKF that follows",
        make=lambda: JointEkf(start_of(_bench(1), 0.05, seed=2, rates=_RATES)),
        signals=_signals,
        n_quiet=8000,
    ),
    Case(
        name="joint UKF",
        make=lambda: JointUkf(start_of(_bench(1), 0.05, seed=2, rates=_RATES)),
        signals=_signals,
        n_quiet=8000,
    ),
]
