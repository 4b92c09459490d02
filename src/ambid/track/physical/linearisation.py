"""The predictor at one point of the tracked numbers, with its exact derivatives, in the layout of the compiled loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.predictor import assemble
from ambid.estimation.threads import one_thread
from ambid.track.physical.numbers import TrackedNumbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """x+ = M [x; inputs at their lags; y; 1; unbalance forcing], and dM/dq."""

    at: Array  # (p,), the point
    M: Array  # (n, n_l)
    D: Array  # (n_l, n, p), derivative of M by the tracked numbers, first by column
    C: Array  # (n_outputs, n)
    gain: Array  # (n, n_outputs), starts the next solution of the Riccati equation
    memory: float  # samples after which the predictor has forgotten all but a part 1/e of its state


def linearise(numbers: TrackedNumbers, q: Array, near: Array | None = None) -> Linearisation | None:
    """Assemble the predictor and its derivatives at a point.

    `q`: (p,); `near`: (n, n_outputs), predictor gain of a point near this one. Returns none where there is no stable
    predictor or no physical plant.
    """
    problem = numbers.problem
    with one_thread():  # matrices of a few rows, and the next block waits
        found = assemble(problem, numbers.vector(q), near=near)
    if found is None:
        return None
    n, count = found.x0.size, problem.slices["initial"].start
    M, dM = found.M, found.dM[:, :, :count]
    if numbers.synchronous:
        force = problem.model.disturbances.index("force")
        a, b = q[count:]
        M = np.hstack([M, a * found.E[:, force, None], b * found.E[:, force, None]])
        wide = np.zeros((n, M.shape[1], count + 2))
        wide[:, :-2, :count] = dM
        wide[:, -2, :count], wide[:, -1, :count] = a * found.dE[:, force, :count], b * found.dE[:, force, :count]
        wide[:, -2, count], wide[:, -1, count + 1] = found.E[:, force], found.E[:, force]
        dM = wide
    radius = float(np.abs(np.linalg.eigvals(M[:, :n])).max())
    return Linearisation(
        at=q.copy(),
        M=np.ascontiguousarray(M),
        D=np.ascontiguousarray(np.moveaxis(dM, 0, 1)),
        C=found.C,
        gain=found.gain,
        memory=1.0 / (1.0 - radius),
    )
