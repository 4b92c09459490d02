"""The function of a neural NARX model in scaled signals: a linear part and one hidden layer of tanh units.

yhat(t) = L z + c + W2 tanh(W1 z + b1), z = [y(t-1), .., y(t-ny), u(t-nk), .., u(t-nk-nu+1)] (Billings 2013, sec. 8.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Table = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class NarxShape:
    """Sizes of a neural NARX model."""

    n_outputs: int
    n_inputs: int
    ny: int  # lags of every output, of every input, and the first lag of the inputs
    nu: int
    nk: int
    neurons: int

    @cached_property
    def tables(self) -> tuple[Table, Table]:
        """Column in [y, u] and lag of every regressor."""
        of = [(o, k) for o in range(self.n_outputs) for k in range(1, self.ny + 1)]
        of += [(self.n_outputs + i, self.nk + k) for i in range(self.n_inputs) for k in range(self.nu)]
        return np.array([c for c, _ in of], dtype=np.int64), np.array([b for _, b in of], dtype=np.int64)

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return max(int(self.tables[1].max(initial=0)), 1)

    @property
    def n_regressors(self) -> int:
        """Length of z."""
        return self.n_outputs * self.ny + self.n_inputs * self.nu

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Numbers in L, c, W2, W1, b1."""
        p, d, h = self.n_outputs, self.n_regressors, self.neurons
        return p * d, p, p * h, h * d, h

    @property
    def n_theta(self) -> int:
        """Numbers in all."""
        return sum(self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers, in their order."""
        p, m = self.n_outputs, self.n_inputs
        channel = [f"y{o + 1}" if p > 1 else "y" for o in range(p)] + [f"u{i + 1}" if m > 1 else "u" for i in range(m)]
        z = [f"{channel[c]}(t-{b})" if b else f"{channel[c]}(t)" for c, b in zip(*self.tables, strict=True)]
        out = [f"{channel[o]}: {x}" for o in range(p) for x in z]
        out += [f"{channel[o]}: 1" for o in range(p)]
        out += [f"{channel[o]}: unit {k + 1}" for o in range(p) for k in range(self.neurons)]
        out += [f"unit {k + 1}: {x}" for k in range(self.neurons) for x in z]
        return (*out, *(f"unit {k + 1}: 1" for k in range(self.neurons)))

    def parts(self, theta: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Split all numbers into L (p, d), c (p,), W2 (p, h), W1 (h, d), b1 (h,).

        `theta`: (n_theta,). Returns of shapes (n_outputs, n_regressors), (n_outputs,), (n_outputs, neurons), (neurons,
        n_regressors) and (neurons,).
        """
        p, d, h = self.n_outputs, self.n_regressors, self.neurons
        L, c, W2, W1, b1 = np.split(np.ascontiguousarray(theta), np.cumsum(self.sizes)[:-1])
        return L.reshape(p, d), c, W2.reshape(p, h), W1.reshape(h, d), b1

    def regressors(self, y: Array, u: Array) -> Array:
        """Return z of every sample from `lag` on.

        `y`: (n_samples, n_outputs), scaled; `u`: (n_samples, n_inputs), scaled. Returns (n_samples - lag,
        n_regressors).
        """
        both, n = np.hstack([y, u]), y.shape[0]
        out = np.empty((max(n - self.lag, 0), self.n_regressors))
        for d, (c, b) in enumerate(zip(*self.tables, strict=True)):
            out[:, d] = both[self.lag - b : max(n - b, self.lag - b), c]
        return out

    def values(self, theta: Array, z: Array) -> Array:
        """Return the function.

        `theta`: (n_theta,); `z`: (n, n_regressors). Returns (n, n_outputs).
        """
        L, c, W2, W1, b1 = self.parts(theta)
        out: Array = z @ L.T + c + np.tanh(z @ W1.T + b1) @ W2.T
        return out

    def slopes(self, theta: Array, z: Array) -> Array:
        """Return the derivative of the function by theta.

        `theta`: (n_theta,); `z`: (n, n_regressors). Returns (n, n_outputs, n_theta).
        """
        p, d, h, n = self.n_outputs, self.n_regressors, self.neurons, z.shape[0]
        _, _, W2, W1, b1 = self.parts(theta)
        T = np.tanh(z @ W1.T + b1)
        out = np.zeros((n, p, self.n_theta))
        at = np.cumsum((0, *self.sizes))
        for o in range(p):
            back = (1.0 - T**2) * W2[o]
            out[:, o, o * d : (o + 1) * d] = z
            out[:, o, at[1] + o] = 1.0
            out[:, o, at[2] + o * h : at[2] + (o + 1) * h] = T
            out[:, o, at[3] : at[4]] = (back[:, :, None] * z[:, None, :]).reshape(n, h * d)
            out[:, o, at[4] :] = back
        return out

    def free_run(self, theta: Array, y: Array, u: Array) -> Array:
        """Run freely from the first `lag` outputs on.

        `theta`: (n_theta,); `y`: (n_samples, n_outputs), scaled, only the first `lag` rows are looked at; `u`:
        (n_samples, n_inputs), scaled. Returns (n_samples, n_outputs + n_inputs), outputs and inputs; outputs are NaN
        from a divergence on.
        """
        from ambid.nonlinear.networks._kernels import run_narx

        z = np.hstack([y, u])
        L, c, W2, W1, b1 = self.parts(theta)
        run_narx(L, c, W2, W1, b1, *self.tables, self.lag, z)
        return z

    def free_slopes(self, theta: Array, z: Array) -> Array:
        """Return the exact derivative of a free run by theta.

        `theta`: (n_theta,); `z`: (n_samples, n_outputs + n_inputs), that `free_run` returned. Returns (n_samples,
        n_outputs, n_theta), the first `lag` rows are zero.
        """
        from ambid.nonlinear.networks._kernels import slope_narx

        out = np.empty((z.shape[0], self.n_outputs, self.n_theta))
        L, _, W2, W1, b1 = self.parts(theta)
        slope_narx(L, W2, W1, b1, *self.tables, self.lag, z, out)
        return out
