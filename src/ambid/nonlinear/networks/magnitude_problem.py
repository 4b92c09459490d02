"""Errors of a state-space network that is measured without sign, over records, with their exact slopes.

Unknown are the weights and the first state of each record. Rows -w / prior keep the hidden layer's weights small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of

Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples,) and inputs (n_samples, n_inputs) of each record, scaled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FoldedLayout:
    """How many weights there are, and what they are."""

    n: int  # states without the sensor's
    n_inputs: int
    neurons: int
    step: float  # what each state enters the one before it with

    @property
    def n_linear(self) -> int:
        """Weights without those of the hidden layer."""
        return self.n + self.n * self.n_inputs + 1

    @property
    def n_theta(self) -> int:
        """All weights."""
        return self.n_linear + self.neurons * (2 * self.n + self.n_inputs)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all weights."""
        n, m, h = self.n, self.n_inputs, range(self.neurons)
        out = [f"a{n}{j + 1}" for j in range(n)]
        out += [f"b{i + 1}{j + 1}" if m > 1 else f"b{i + 1}" for i in range(n) for j in range(m)]
        seen = [f"x{j + 1}" for j in range(n)] + [f"u{j + 1}" for j in range(m)]
        out += ["sensor pole", *(f"unit {k + 1}: {x}" for k in h for x in seen)]
        return (*out, *(f"x{i + 1}: unit {k + 1}" for i in range(n) for k in h))

    def split(self, theta: Array) -> tuple[Array, Array, float, Array, Array]:
        """Return a, B, the sensor's pole, W1, W2.

        `theta`: (n_theta,), scaled. Returns arrays of shapes (n,), (n, n_inputs), a float, (neurons, n + n_inputs), (n,
        neurons).
        """
        n, m, h, k = self.n, self.n_inputs, self.neurons, self.n_linear
        W1, W2 = np.split(theta[k:], [h * (n + m)])
        return (
            theta[:n].copy(), theta[n : n + n * m].reshape(n, m).copy(), float(theta[k - 1]),
            W1.reshape(h, n + m).copy(), W2.reshape(n, h).copy(),
        )  # fmt: skip

    def A(self, theta: Array) -> Array:
        """Return the matrix of the linear part.

        `theta`: (n_theta,), scaled. Returns (n, n), scaled.
        """
        out = np.eye(self.n) + np.diag(np.full(self.n - 1, self.step), 1)
        out[-1] = theta[: self.n]
        return out


def states(layout: FoldedLayout, theta: Array, u: Array, x0: Array) -> Array:
    """Run the network.

    `theta`: (n_theta,); `u`: (n_samples, n_inputs), scaled; `x0`: (n + 1,). Returns (n_samples + 1, n + 1), the last
    column is the output; NaN from a divergence on.
    """
    from ambid.nonlinear.networks._magnitude_kernels import run_magnitude

    X = np.empty((u.shape[0] + 1, layout.n + 1))
    X[0] = x0
    run_magnitude(*layout.split(theta), layout.step, np.ascontiguousarray(u), X)
    return X


def slopes(layout: FoldedLayout, theta: Array, u: Array, X: Array) -> Array:
    """Return the slopes of the output by the weights, then by the first state.

    `theta`: (n_theta,); `u`: (n_samples, n_inputs), scaled; `X`: (n_samples + 1, n + 1), that `states` returned.
    Returns (n_samples, n_theta + n + 1).
    """
    from ambid.nonlinear.networks._magnitude_kernels import slope_magnitude

    n, P = layout.n + 1, layout.n_theta
    out = np.empty((u.shape[0], P + n))
    s = np.hstack([np.zeros((n, P)), np.eye(n)])
    a, _, rho, W1, W2 = layout.split(theta)
    slope_magnitude(a, rho, W1, W2, layout.step, np.ascontiguousarray(u), X, s, out)
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoldedProblem:
    """Errors of unit variance; unknown are (weights, first state of every record)."""

    layout: FoldedLayout
    parts: Parts
    noise: float  # standard deviation of the errors
    prior: float  # that of the hidden layer's weights before the data
    # whether W1 stays as it is: as long as W2 is zero the data say nothing of it, and the prior would take it away
    held: bool = False

    def split(self, v: Array) -> tuple[Array, Array]:
        """Return weights and first states.

        `v`: (n_theta + n_records (n + 1), ). Returns `theta`: (n_theta,); `x0`: (n_records, n + 1).
        """
        return v[: self.layout.n_theta], v[self.layout.n_theta :].reshape(len(self.parts), self.layout.n + 1)

    def errors(self, v: Array) -> list[Array]:
        """Return the errors of every record.

        `v`: (n_theta + n_records (n + 1), ). Returns (n_samples,), scaled.
        """
        theta, x0 = self.split(v)
        return [y - states(self.layout, theta, u, x)[:-1, -1] for (y, u), x in zip(self.parts, x0, strict=True)]

    def cost(self, theta: Array) -> float:
        """Return the sum of squares of all rows.

        `theta`: (n_theta + n_records (n + 1), ). Returns infinite where the network diverges.
        """
        if not np.all(np.isfinite(theta)) or np.max(np.abs(theta)) > 1e12:
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            found = sum(float(e @ e) for e in self.errors(theta)) / self.noise**2
            found += float(np.sum(theta[self.layout.n_linear : self.layout.n_theta] ** 2)) / self.prior**2
        return found if np.isfinite(found) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r] of all rows.

        `theta`: (n_theta + n_records (n + 1), ). Returns (at most n_columns, n_columns).
        """
        layout, P, n = self.layout, self.layout.n_theta, self.layout.n + 1
        weights, x0 = self.split(theta)
        rows = []
        for k, ((y, u), x) in enumerate(zip(self.parts, x0, strict=True)):
            X = states(layout, weights, u, x)
            J = slopes(layout, weights, u, X)
            wide = np.zeros((y.size, theta.size + 1))
            wide[:, :P], wide[:, P + k * n : P + (k + 1) * n] = J[:, :P], J[:, P:]
            wide[:, -1] = y - X[:-1, -1]
            rows.append(wide / self.noise)
        kept = range(layout.n_linear, P)
        small = np.zeros((len(kept), theta.size + 1))
        small[range(len(kept)), kept] = 1.0 / self.prior
        small[:, -1] = -weights[layout.n_linear :] / self.prior
        if self.held:
            for part in (*rows, small):
                part[:, layout.n_linear : layout.n_linear + layout.neurons * (layout.n + layout.n_inputs)] = 0.0
        return triangle_of([*rows, small] if len(kept) else rows)
