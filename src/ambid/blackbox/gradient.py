"""Exact derivatives of the one-step predictions of an innovations form along directions of its coefficients.

Solves: with y^ = C x + D u, x+ = A x + B u + K e, e = y - y^ and F = A - K C, a change (dA, dB, dC, dD, dK) moves the
state by s+ = F s + (dA - K dC) x + (dB - K dD) u + dK e and the prediction by dy^ = C s + dC x + dD u.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.state_space import StateSpaceModel
from ambid.estimation.kernels import sensitivity_scan


class Sensitivities:
    """Sensitivities that move along a record block by block.

    `model`: discrete; `directions`: (n_theta, n_directions), changes of ``model.theta``, one a column; `initial`:
    whether the states at the first sample follow as n further directions.
    """

    def __init__(self, model: StateSpaceModel, directions: Array, *, initial: bool = False) -> None:
        n, n_u, n_y, d = model.order, model.n_inputs, model.n_outputs, directions.shape[1]
        ends = np.cumsum([n * n, n * n_u, n_y * n, n_y * n_u, n * n_y])
        shapes = ((n, n), (n, n_u), (n_y, n), (n_y, n_u), (n, n_y))
        dA, dB, dC, dD, dK = (
            part.reshape(*shape, d) for part, shape in zip(np.split(directions, ends[:-1]), shapes, strict=True)
        )
        extra = n if initial else 0
        push = [dA - np.tensordot(model.K, dC, 1), dB - np.tensordot(model.K, dD, 1), dK]
        self._forcing = np.zeros((n, n + n_u + n_y, d + extra + 1))  # the last column belongs to the kernel
        self._forcing[:, :, :d] = np.concatenate(push, axis=1)
        self._direct = np.zeros((n_y, n + n_u, d + extra))
        self._direct[:, :, :d] = np.concatenate([dC, dD], axis=1)
        self._F = np.ascontiguousarray(model.A - model.K @ model.C)
        self._C = model.C
        self._state = np.zeros((n, d + extra + 1))
        self._state[:, d : d + extra] = np.eye(n, extra)

    def block(self, signals: Array) -> Array:
        """Return the derivatives of the predictions over the next samples.

        `signals`: (block, n + n_inputs + n_outputs), states before each sample, inputs, and one-step errors without a
        constant taken off. Returns (n_outputs, block, n_directions), n more directions where the states at the first
        sample are among them.
        """
        n, n_y, width = self._C.shape[1], self._C.shape[0], self._state.shape[1]
        block = signals.shape[0]
        rows = np.ascontiguousarray(signals @ self._forcing)
        none = np.zeros((block, n))
        sensitivity_scan(self._F, none, none, self._state, rows, width - 1)
        self._state[:, -1] = 0.0
        known = np.ascontiguousarray(signals[:, : self._direct.shape[1]])
        out = (self._C @ rows.reshape(n, block * width)).reshape(n_y, block, width)[:, :, :-1]
        return np.asarray(out + known @ self._direct)
