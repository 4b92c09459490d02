"""Data without means, in units of their standard deviations: results do not depend on the user's units.

Where a record begins at rest at zero, zero is its level: no mean is taken off, and the unit is the root mean square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.polynomial.orders import Layout
from ambid.errors import EstimationError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaled:
    """Data without means, in units of their standard deviations."""

    u: Array  # (n_inputs, n_samples), (n_outputs, n_samples)
    y: Array
    u_mean: Array  # (n_inputs,)
    u_scale: Array
    y_mean: Array  # (n_outputs,)
    y_scale: Array
    at_rest: bool = False  # whether the user says that everything was zero before the first sample


def scaled_data(name: str, data: IOData, *, at_rest: bool = False) -> Scaled:
    """Take off means and divide by standard deviations."""
    out = []
    for values, names in ((data.u, data.inputs), (data.y, data.outputs)):
        mean = np.zeros(len(names)) if at_rest else np.mean(values, axis=0)
        centred = np.subtract(values.T, mean[:, None], order="C")
        scale = np.sqrt(np.array([x @ x for x in centred]) / max(values.shape[0], 1))
        for k, channel in enumerate(names):
            if not scale[k] > 1e-13 * abs(mean[k]):
                raise EstimationError(
                    f"{name}: {channel!r} does not move (constant at {values[0, k]:g}); nothing can be learnt from it. "
                    "Excite it, or leave it out"
                )
        centred /= scale[:, None]
        out.append((centred, mean, scale))
    (u, u_mean, u_scale), (y, y_mean, y_scale) = out
    return Scaled(u=u, y=y, u_mean=u_mean, u_scale=u_scale, y_mean=y_mean, y_scale=y_scale, at_rest=at_rest)


def unit(layout: Layout, scaled: Scaled, o: int) -> Array:
    """Return what one scaled coefficient is worth in SI, shape (n_theta,).

    `o`: output. Returns (n_theta,).
    """
    out = np.ones(layout.n_theta)
    for i in range(layout.n_inputs):
        out[layout.places["B", i]] = scaled.y_scale[o] / scaled.u_scale[i]
    return out


def liveliest(u: Array, size: int) -> slice:
    """Return the piece of a long record in which the inputs move most, for a start or a first choice.

    `u`: (n_inputs, n_samples); `size`: of the piece; records up to twice as long are taken whole.
    """
    n = u.shape[1]
    if n <= 2 * size:
        return slice(0, n)
    energy = np.add.reduceat(np.sum(u * u, axis=0), np.arange(0, n - size + 1, size))
    first = int(np.argmax(energy[:-1])) * size
    return slice(first, first + size)
