"""Records that the suite over all nonlinear structures is run on, and settings that keep it short."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ambid.blackbox.data import IOData

SETTINGS: Mapping[str, Mapping[str, object]] = {
    "narmax": {},
    "hybrid": {"neurons": 2},
}
"""By structure: what it is told here; its own choice where nothing stands."""


def smooth(
    n: int = 600, *, seed: int = 0, n_inputs: int = 1, noise: float = 0.02, scale_u: float = 1.0, scale_y: float = 1.0
) -> IOData:
    """A stable first-order lag behind a gentle saturation, driven by slow and fast noise; open loop."""
    rng = np.random.default_rng(seed)
    u = (
        0.6 * rng.standard_normal((n, n_inputs))
        + 0.6 * np.repeat(rng.standard_normal((n // 10 + 1, n_inputs)), 10, 0)[:n]
    )
    y, x = np.zeros(n), 0.0
    gain = np.array([1.0, -0.5])[:n_inputs]
    for t in range(1, n):
        x = 0.8 * x + 0.4 * np.tanh(float(u[t - 1] @ gain)) - 0.05 * x**2 + noise * rng.standard_normal()
        y[t] = x
    names = tuple(f"u{k + 1}" for k in range(n_inputs))
    return IOData(
        u=u * scale_u,
        y=y[:, None] * scale_y,
        dt=0.01,
        inputs=names,
        outputs=("y",),
        units={**dict.fromkeys(names, "V"), "y": "m"},
        open_loop=True,
        record={"samples": n, "rate_hz": 100.0, "sha256": "0" * 64, "file": "made.csv"},
    )


def runaway(n: int = 300) -> IOData:
    """A record that overflows any model: alternates between sizes that differ by a hundred orders of magnitude."""
    rng = np.random.default_rng(5)
    size = np.where(np.arange(n) % 7 == 0, 1e58, 1e-40)
    return IOData(
        u=rng.standard_normal((n, 1)) * size[:, None],
        y=rng.standard_normal((n, 1)) * size[::-1, None],
        dt=0.01,
        inputs=("u1",),
        outputs=("y",),
        units={"u1": "V", "y": "m"},
        open_loop=True,
    )


class MatrixCandidates:
    """Candidates for `select_terms` that are columns of a matrix (n_rows, n_candidates)."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix, self.n_rows, self.terms = matrix, matrix.shape[0], range(matrix.shape[1])

    def blocks(self, which: Sequence[int] | None = None) -> Iterator[tuple[slice, np.ndarray]]:
        """As `Candidates.blocks`."""
        chosen = self.matrix if which is None else self.matrix[:, list(which)]
        yield slice(0, self.n_rows), np.array(chosen.T, order="C")

    def columns(self, which: Sequence[int]) -> np.ndarray:
        """As `Candidates.columns`."""
        return self.matrix[:, list(which)]
