"""Prediction and simulation with any model in innovations form, its initial state estimated from the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.state_space import StateSpaceModel

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


def states(F: Array, G: Array, z: Array) -> Array:
    """Run x+ = F x + G z from rest.

    `F`: (n, n); `G`: (n, n_z); `z`: (n_samples, n_z). Returns (n_samples, n), states before each sample.
    """
    from ambid.estimation.kernels import state_scan

    n = F.shape[0]
    work = np.hstack([np.zeros((z.shape[0], n)), z])
    state_scan(np.ascontiguousarray(np.hstack([F, G])), work, np.zeros(n))
    return work[:, :n]


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
    out = states(F, G, z) @ model.C.T + z[:, : model.n_inputs] @ model.D.T
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
