"""Predictions, simulations and exact sensitivities of any model in innovations form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.model import StateSpaceModel
from ambid.estimation.sensitivity import run

Numbers = Any  # arrays of real numbers, or of complex ones for complex steps

_FORGOTTEN = 1e-9  # what is left of an initial state when it no longer counts
_RUNAWAY = 30.0  # log of the growth of an unstable predictor over the record from which nothing is left of its digits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offsets:
    """What is taken off inputs and outputs before a model is used, SI."""

    u: Array  # (n_inputs,)
    y: Array  # (n_outputs,)


def one_step(model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array:
    """Predict every output from all samples before it (thesis eq. 3.12), the initial state by least squares.

    `model`: discrete; `u`: (n_samples, n_inputs), SI; `y`: (n_samples, n_outputs), SI. Returns (n_samples, n_outputs),
    SI, not a number throughout where an unstable predictor (A - K C) runs away over the record.
    """
    F = model.A - model.K @ model.C
    if _runs_away(F, y.shape[0]):
        return np.full(y.shape, np.nan)
    G = np.hstack([model.B - model.K @ model.D, model.K])
    return _response(F, G, model, u, y, offsets)


def simulation(model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array | None:
    """Simulate the outputs from the inputs alone; the initial state that fits `y` best is the only use of `y`.

    `model`: discrete; `u`: (n_samples, n_inputs), SI; `y`: (n_samples, n_outputs), SI. Returns (n_samples, n_outputs),
    SI, or None, none for an unstable model: its simulation runs away and says nothing. None without inputs.
    """
    if not model.n_inputs or not stable(model):
        return None
    G = np.hstack([model.B, np.zeros_like(model.K)])
    return _response(model.A, G, model, u, y, offsets)


def run_states(F: Array, G: Array, z: Array, x0: Array | None = None) -> Array:
    """Run x+ = F x + G z, from rest if no first state is given, and return the states before each sample."""
    return run(np.ascontiguousarray(np.hstack([F, G])), z, np.zeros(F.shape[0]) if x0 is None else x0)[:-1]


def stable(model: StateSpaceModel) -> bool:
    """Return whether all poles are inside the unit circle (or the left half plane)."""
    if not model.order:
        return True
    values = np.linalg.eigvals(model.A)
    return bool(np.max(np.abs(values)) < 1.0 if model.dt is not None else np.max(values.real) < 0.0)


def _runs_away(F: Array, n_samples: int) -> bool:
    """Whether x+ = F x grows beyond all digits."""
    radius = float(np.max(np.abs(np.linalg.eigvals(F)), initial=0.0)) if F.size else 0.0
    return radius > 1 and n_samples * np.log(radius) > _RUNAWAY


def _response(F: Array, G: Array, model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array:
    """Run x+ = F x + G [u; y] from rest and add the free response that fits y best."""
    z = np.hstack([u - offsets.u, y - offsets.y])
    n = model.order
    out = run_states(F, G, z) @ model.C.T + z[:, : model.n_inputs] @ model.D.T
    if n:
        free = _free_responses(F, model.C, z.shape[0])
        m, n_y = free.shape[0], model.n_outputs
        scale = np.maximum(np.std(y, axis=0), 1e-300)
        rows = (free / scale[:, None]).reshape(m * n_y, n)
        error = ((y - offsets.y - out)[:m] / scale).reshape(-1)
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        x0 = np.linalg.lstsq(rows / size, error, rcond=1e-8)[0] / size
        out[:m] += free @ x0
    return np.asarray(out + offsets.y)


def _free_responses(F: Array, C: Array, n_samples: int) -> Array:
    """Return C F^k for as long as it counts, shape (m, n_outputs, n)."""
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    m = n_samples if radius >= 1 else min(n_samples, 20 + F.shape[0] + int(np.log(_FORGOTTEN) / np.log(radius + 1e-30)))
    out = np.empty((m, *C.shape))
    row = C
    for k in range(m):
        out[k] = row
        row = row @ F
    return out


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
        from ambid.estimation.kernels import sensitivity_scan

        n, n_y, width = self._C.shape[1], self._C.shape[0], self._state.shape[1]
        block = signals.shape[0]
        rows = np.ascontiguousarray(signals @ self._forcing)
        none = np.zeros((block, n))
        sensitivity_scan(self._F, none, none, self._state, rows, width - 1)
        self._state[:, -1] = 0.0
        known = np.ascontiguousarray(signals[:, : self._direct.shape[1]])
        out = (self._C @ rows.reshape(n, block * width)).reshape(n_y, block, width)[:, :, :-1]
        return np.asarray(out + known @ self._direct)


def companion(den: Numbers) -> Numbers:
    """Return the companion matrix whose state k is p^k/F(p) times the input, shape (n, n).

    `den`: (n + 1,), F, highest power first, monic; complex for a complex step. Returns (n, n).
    """
    n = den.size - 1
    out = np.eye(n, k=1, dtype=den.dtype)
    out[-1:] = -den[:0:-1]
    return out


def filter_states(den: Array, step: float, x: Array) -> Array:
    """Return p^k/F(p) x for k = 0 ... n - 1, x straight between samples, from rest.

    `den`: (n + 1,); `step`: sampling interval in units of 1/w0; `x`: (n_samples,). Returns (n_samples, n).
    """
    from scipy.linalg import expm

    n = den.size - 1
    M = np.zeros((n + 2, n + 2))
    M[:n, :n] = companion(den) * step
    M[n - 1, n] = step
    M[n, n + 1] = 1.0
    E = expm(M)
    z = np.stack([x, np.append(np.diff(x), 0.0)], axis=1)
    return run_states(E[:n, :n], E[:n, n:], z)


def free_response(den: Array, step: float, n_samples: int) -> Array:
    """Return n responses of 1/F(p) without input that span all of them, shape (n_samples, n).

    `den`: (n + 1,); `step`: sampling interval in units of 1/w0. Returns (n_samples, n).
    """
    from scipy.linalg import expm

    n = den.size - 1
    transition = expm(companion(den) * step)
    first = np.zeros(n)
    first[0] = 1.0
    return run_states(transition.T, np.empty((n, 0)), np.empty((n_samples, 0)), first)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Responses:
    """What one denominator makes of its inputs."""

    y: Array  # (n_samples,), sum of B_i/F u_i
    of_inputs: Array  # (n_samples, n_inputs, n), p^k/F u_i
    of_output: Array  # (n_samples, n), p^k/F y


def responses(den: Array, num: Array, step: float, u: Array) -> Responses:
    """Simulate B_i/F u_i and its derivatives by the coefficients, inputs held over a sample, from rest.

    `den`: (n + 1,); `num`: (n_inputs, n + 1), highest power first; `step`: sampling interval in units of 1/w0; `u`:
    (n_samples, n_inputs).
    """
    from ambid.physics.discretise import zero_order_hold

    n, n_u = den.size - 1, u.shape[1]
    size = n * (n_u + 1)
    A, B, F = np.zeros((size, size)), np.zeros((size, n_u)), companion(den)
    c = num[:, :0:-1] - num[:, :1] * den[:0:-1]  # output from the states p^0 ... p^(n-1) of each input
    for i in range(n_u):
        A[i * n : (i + 1) * n, i * n : (i + 1) * n] = F
        B[(i + 1) * n - 1, i] = 1.0
        A[-1, i * n : (i + 1) * n] = c[i]
        B[-1, i] = num[i, 0]
    A[-n:, -n:] = F
    states = run_states(*zero_order_hold(A, B, step), u)
    of_inputs = states[:, :-n].reshape(-1, n_u, n)
    y = np.einsum("tik,ik->t", of_inputs, c) + u @ num[:, 0]
    return Responses(y=y, of_inputs=of_inputs, of_output=states[:, -n:])
