"""What keeps the meaning of physical weights beside a network G(x, u) that is added to them (thesis eq. 4.9).

Ridge: the hidden layer's weights are N(0, prior^2), its output 1 being the size of the linear part of its row. Then
either units are anchored (no value, no slope at the operating point: A and B are the linearisation there), or the
network is kept orthogonal, over the training data, to all that the free weights of its row could explain: then A and B
are the best linear approximation on these data, as they are without the network.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.networks.layout import Layout

STIFF = (3.0, 30.0)  # weight of what is left of the projection, in errors' deviations over the record, by round
_POINTS = 2000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ridge:
    """Rows -w / prior for each weight w of the hidden layer."""

    layout: Layout
    prior: float

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return slopes and rows.

        `theta`: (n_theta,). Returns `J`: (n_hidden, n_theta); `r`: (n_hidden,).
        """
        k = self.layout.n_directions
        J = np.eye(self.layout.n_theta)[k:] / self.prior
        return J, -theta[k:] / self.prior


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Orthogonal:
    """Rows: the projection of the network on what the free weights of its rows explain, over points of the data."""

    layout: Layout
    z: Array  # (n_points, n + n_inputs), scaled
    bases: tuple[Array, ...]  # (n_points, n_explained), orthonormal, by row that the network acts on
    strength: Array  # (n_rows,), by such row

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return slopes and rows.

        `theta`: (n_theta,). Returns `J`: (n_rows, n_theta); `r`: (n_rows,).
        """
        layout, h, q, d = self.layout, self.layout.neurons, len(self.layout.rows), self.z.shape[1]
        k = layout.n_directions
        W1, b1, W2 = np.split(theta[k:], [h * d, h * (d + 1)])
        W2 = W2.reshape(q, h)
        phi, by_a, by_b = units(self.z, W1.reshape(h, d), b1, layout.anchored)
        J_all, r_all = [], []
        for j in range(q):
            Q, s = self.bases[j], self.strength[j]
            J = np.zeros((Q.shape[1], layout.n_theta))
            for i in range(h):
                J[:, k + i * d : k + (i + 1) * d] = W2[j, i] * (Q.T @ (by_a[:, i, None] * self.z))
            J[:, k + h * d : k + h * (d + 1)] = (Q.T @ by_b) * W2[j]
            J[:, k + h * (d + 1) + j * h : k + h * (d + 1) + (j + 1) * h] = Q.T @ phi
            J_all.append(s * J)
            r_all.append(-s * (Q.T @ (phi @ W2[j])))
        return np.concatenate(J_all), np.concatenate(r_all)


def units(z: Array, W1: Array, b1: Array, anchored: bool) -> tuple[Array, Array, Array]:
    """Return the outputs of hidden units with their derivatives.

    `z`: (n, n_regressors); `W1`: (neurons, n_regressors); `b1`: (neurons,). Returns `value, by_activation, by_bias`:
    (n, neurons).
    """
    a = z @ W1.T
    value = np.tanh(a + b1)
    by_a = 1.0 - value**2
    by_b = by_a.copy()
    if anchored:
        tb = np.tanh(b1)
        db = 1.0 - tb**2
        value = value - tb - db * a
        by_a, by_b = by_a - db, by_b - db + 2.0 * tb * db * a
    return value, by_a, by_b


def orthogonal_to_physics(
    layout: Layout, states: list[Array], inputs: list[Array], noise: Array, stiff: float = STIFF[-1]
) -> Orthogonal:
    """Return the penalty for the data at hand.

    `states`: (n_samples, n), scaled; `inputs`: (n_samples, n_inputs), scaled; `noise`: (n,), size of the one-step
    errors of the states; `stiff`: too stiff from the beginning holds the network at zero.
    """
    whole = np.hstack([np.concatenate(states), np.concatenate(inputs)])
    z = whole[:: max(1, whole.shape[0] // _POINTS)]
    known = np.hstack([z, np.ones((z.shape[0], 1))])
    bases, strength = [], []
    for r, rate in zip(layout.rows, layout.rates, strict=True):
        columns = [c for row, c in layout.entries if row == r]
        bases.append(np.linalg.qr(known[:, columns])[0])
        step = rate * (layout.dt if layout.form == "one-axis" else 1.0)
        strength.append(stiff * step / max(float(noise[r]), 1e-12) * np.sqrt(whole.shape[0] / z.shape[0]))
    return Orthogonal(layout=layout, z=z, bases=tuple(bases), strength=np.array(strength))
