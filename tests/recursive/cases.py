"""What the suite over all recursive estimators needs to know of one of them.

A module ``tests/recursive/cases_*.py`` with a list ``CASES`` brings its estimators into `test_conformance.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.recursive.estimator import RecursiveEstimator

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Case:
    """One estimator, how it is made and what it is fed.

    `signals(n, seed)` gives inputs (n, n_inputs) and outputs (n,) or (n, n_outputs) that excite it; equal arguments
    give equal signals, and the first m samples do not depend on n. `quiet(n)` gives signals without excitation: zeros
    of the same shapes unless said otherwise. `tolerance` is the relative difference allowed between splits of a
    stream: 0 asks for equal bits. `n` samples are enough to leave the start behind.
    """

    name: str
    make: Callable[[], RecursiveEstimator]
    signals: Callable[[int, int], tuple[Array, Array]]
    quiet: Callable[[int], tuple[Array, Array]] | None = None
    tolerance: float = 0.0
    n: int = 400
    n_quiet: int = 20_000

    def silence(self, n: int) -> tuple[Array, Array]:
        """Return inputs and outputs without excitation."""
        if self.quiet is not None:
            return self.quiet(n)
        inputs, outputs = self.signals(2, 0)
        return np.zeros((n, *inputs.shape[1:])), np.zeros((n, *outputs.shape[1:]))
