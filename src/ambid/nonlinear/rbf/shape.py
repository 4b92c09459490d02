"""The function of a network of radial basis functions in scaled signals, with its exact slopes.

yhat(t) = L z + c + W phi, phi_k = f(|M z - C_k|^2 / width_k^2), z = [y(t-1), .., y(t-ny), u(t-nk), .., u(t-nk-nu+1)]
(thesis eqs 1.13, 1.14; Billings 2013, sec. 8.3). L may be left out. M says which regressors the units see, and in which
metric; it is no parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.rbf import units


@dataclass(frozen=True, kw_only=True, eq=False)
class RbfShape:
    """Sizes of a network of radial basis functions."""

    lags: NarxShape  # channels and lags; without neurons of its own
    metric: Array  # (n_seen, n_regressors), M
    linear: bool  # whether there is a linear part L z beside the units; the constant c is always there
    neurons: int  # units
    unit: str  # one of `units.UNITS`

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.lags.n_outputs

    @property
    def n_seen(self) -> int:
        """Length of M z."""
        return int(self.metric.shape[0])

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Numbers in L, c, W, C and the logarithms of the widths."""
        p, d, h = self.n_outputs, self.lags.n_regressors, self.neurons
        return p * d * int(self.linear), p, p * h, h * self.n_seen, h

    @property
    def n_weights(self) -> int:
        """Numbers in L, c and W: those in which the function is linear. They come first."""
        return sum(self.sizes[:3])

    @property
    def n_theta(self) -> int:
        """Numbers in all."""
        return sum(self.sizes)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers, in their order."""
        p, d, h = self.n_outputs, self.lags.n_regressors, self.neurons
        out = list(self.lags.names[0 if self.linear else p * d :])
        channel = [f"y{o + 1}" if p > 1 else "y" for o in range(p)]
        out += [f"{x}: unit {k + 1}" for x in channel for k in range(h)]
        out += [f"unit {k + 1}: centre {j + 1}" for k in range(h) for j in range(self.n_seen)]
        return (*out, *(f"unit {k + 1}: log width" for k in range(h)))

    def with_neurons(self, neurons: int) -> Self:
        """Return the same with another number of units."""
        return replace(self, neurons=neurons)

    def parts(self, theta: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        """Split all numbers.

        `theta`: (n_theta,). Returns `L, c, W, C, log_width`: of shapes (n_outputs, n_regressors), (n_outputs,),
        (n_outputs, neurons), (neurons, n_seen), (neurons,).
        """
        p, d, h = self.n_outputs, self.lags.n_regressors, self.neurons
        L, c, W, C, s = np.split(np.ascontiguousarray(theta), np.cumsum(self.sizes)[:-1])
        whole = L.reshape(p, d) if self.linear else np.zeros((p, d))
        return whole, c, W.reshape(p, h), C.reshape(h, self.n_seen), s

    def squared(self, theta: NDArray[Any], x: Array) -> NDArray[Any]:
        """Return squared distances from the centres, in widths.

        `theta`: (n_theta,); `x`: (n, n_seen), what the units see, M z. Returns (n, neurons).
        """
        *_, C, s = self.parts(theta)
        q = np.zeros((x.shape[0], self.neurons), dtype=C.dtype)
        for j in range(self.n_seen):
            q += (x[:, j, None] - C[:, j]) ** 2
        found: NDArray[Any] = q * np.exp(-2.0 * s)
        return found

    def activations(self, theta: NDArray[Any], z: Array) -> NDArray[Any]:
        """Return phi.

        `theta`: (n_theta,); `z`: (n, n_regressors). Returns (n, neurons).
        """
        return units.value(self.unit, self.squared(theta, z @ self.metric.T))

    def values(self, theta: NDArray[Any], z: Array) -> NDArray[Any]:
        """Return the function.

        `theta`: (n_theta,); `z`: (n, n_regressors). Returns (n, n_outputs).
        """
        L, c, W, *_ = self.parts(theta)
        out: NDArray[Any] = z @ L.T + c + self.activations(theta, z) @ W.T
        return out

    def slopes(self, theta: Array, z: Array) -> Array:
        """Return the derivative of the function by theta.

        `theta`: (n_theta,); `z`: (n, n_regressors). Returns (n, n_outputs, n_theta).
        """
        p, d, h, n = self.n_outputs, self.lags.n_regressors, self.neurons, z.shape[0]
        _, _, W, C, s = self.parts(theta)
        x = z @ self.metric.T
        q = self.squared(theta, x)
        phi, by_q = units.value(self.unit, q), units.slope(self.unit, q)
        by_C = -2.0 * (by_q * np.exp(-2.0 * s))[:, :, None] * (x[:, None, :] - C)
        by_s = -2.0 * by_q * q
        out = np.zeros((n, p, self.n_theta))
        at = np.cumsum((0, *self.sizes))
        for o in range(p):
            if self.linear:
                out[:, o, o * d : (o + 1) * d] = z
            out[:, o, at[1] + o] = 1.0
            out[:, o, at[2] + o * h : at[2] + (o + 1) * h] = phi
            out[:, o, at[3] : at[4]] = (W[o, :, None] * by_C).reshape(n, -1)
            out[:, o, at[4] :] = W[o] * by_s
        return out

    def free_run(self, theta: Array, y: Array, u: Array) -> Array:
        """Run freely from the first `lag` outputs on.

        `theta`: (n_theta,); `y`: (n_samples, n_outputs), scaled, only the first `lag` rows are looked at; `u`:
        (n_samples, n_inputs), scaled. Returns (n_samples, n_outputs + n_inputs), outputs and inputs; outputs are NaN
        from a divergence on.
        """
        from ambid.nonlinear.rbf._kernels import run_rbf

        z = np.hstack([y, u])
        run_rbf(*self._plain(theta), *self.lags.tables, self.lags.lag, z)
        return z

    def free_slopes(self, theta: Array, z: Array, n_active: int) -> Array:
        """Return the exact derivative of a free run by the first numbers of theta.

        `theta`: (n_theta,); `z`: (n_samples, n_outputs + n_inputs), that `free_run` returned; `n_active`: how many
        numbers: `n_weights` or `n_theta`. Returns (n_samples, n_outputs, n_active), the first `lag` rows are zero.
        """
        from ambid.nonlinear.rbf._kernels import slope_rbf

        out = np.empty((z.shape[0], self.n_outputs, n_active))
        slope_rbf(*self._plain(theta), int(self.linear), *self.lags.tables, self.lags.lag, z, out)
        return out

    def _plain(self, theta: Array) -> tuple[Any, Any, Any, Any, Any, Array, int]:
        L, c, W, C, s = self.parts(theta)
        return L, c, W, C, s, np.ascontiguousarray(self.metric), units.UNITS.index(self.unit)
