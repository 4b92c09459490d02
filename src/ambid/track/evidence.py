"""What a block of samples says of the tracked numbers: a triangle, whatever the length of the block.

At a point `at` of the tracked numbers q the weighted innovations of a block are e + Ψ (q - at) up to second order, with
unit covariance if the model is right. QR of [Ψ e] leaves J, r and the length of what no change of q explains:
-2 log-likelihood = rest + |r + J (q - at)|² + constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """One block's evidence. All tracked numbers are in units of their own magnitude, so that they are of order one."""

    names: tuple[str, ...]  # the tracked numbers: physical parameters, then offsets and the like
    at: Array  # (p,), where the predictor was linearised
    J: Array  # (p, p), upper triangle; J^T J is the information of the block
    r: Array  # (p,), explainable part of the weighted innovations at `at`, with unit covariance
    # squared length of what no change of q explains: chi-squared with `freedom` degrees if the model is right
    rest: float
    n_samples: int  # samples used, and outputs of each
    n_outputs: int
    first: int  # sample numbers of the stream: the block is first <= k < last
    last: int

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `rest`."""
        return max(self.n_samples * self.n_outputs - self.r.size, 0)

    @property
    def information(self) -> Array:
        """J^T J, shape (p, p)."""
        return np.asarray(self.J.T @ self.J)

    def residual(self, q: Array) -> Array:
        """Return r + J (q - at), shape (p,), unit covariance if `q` is the truth.

        `q`: (p,). Returns (p,).
        """
        return np.asarray(self.r + self.J @ (q - self.at))

    def loss(self, q: Array) -> float:
        """Return the sum of squared weighted innovations at `q`, to second order around `at`.

        `q`: (p,).
        """
        left = self.residual(q)
        return float(self.rest + left @ left)
