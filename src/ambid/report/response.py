"""Frequency response and poles of the identified plant with their uncertainty, by the delta method.

The covariance of the parameters is carried through exact derivatives of the model: with Φ = (jω - A)⁻¹,
G = C Φ B and dG = C Φ (dA Φ B + dB) + dC Φ B; a simple pole moves by dλ = wᴴ dA v / (wᴴ v), v and w its right and left
eigenvectors. Real and imaginary part of d(ln G) are the changes of the logarithm of the magnitude and of the phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.estimate import Estimate
from ambid.physics.linear_model import StateSpace
from ambid.physics.models import model

_LOWEST_HZ = 0.1
_DEFECTIVE = 1e-6  # |wᴴ v| of unit vectors under which a pole counts as multiple: its derivative does not exist


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Response:
    """Frequency response from one input to one output."""

    source: str  # roles
    output: str
    frequency_hz: Array  # (n_frequencies,), Hz
    value: NDArray[np.complex128]  # (n_frequencies,), complex, output unit per input unit
    log_sd: Array  # (n_frequencies,), dimensionless, standard deviation of the natural logarithm of the magnitude
    phase_sd: Array  # (n_frequencies,), rad, standard deviation of the phase


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pole:
    """A pole of the identified plant."""

    value: complex
    covariance: Array | None  # (2, 2), (rad/s)^2, or None, of its real and imaginary part; None for a multiple pole


def responses(estimate: Estimate, *, n_frequencies: int = 600) -> tuple[Response, ...]:
    """Compute the frequency response from the input to every output, from 0.1 Hz to half the sampling rate.

    `estimate`: its continuous-time plant; the delay of the input is not in it; `n_frequencies`: spaced evenly in the
    logarithm, with more points at lightly damped poles. Returns in the order of the model's outputs, for each of its
    inputs.
    """
    plant = model(estimate.model)
    space = plant.matrices(estimate.values)
    slopes = [plant.derivative(estimate.values, name) for name in estimate.covariance_names]
    frequency = frequency_grid(estimate, n_frequencies)
    s = 2j * np.pi * frequency[:, None, None]
    resolvent = np.linalg.inv(s * np.eye(space.A.shape[0]) - space.A)
    states = resolvent @ space.B
    G = space.C @ states
    dG = [space.C @ resolvent @ (d.A @ states + d.B) + d.C @ states for d in slopes]
    found = []
    for i, source in enumerate(plant.inputs):
        for o, output in enumerate(plant.outputs):
            relative = np.stack([d[:, o, i] / G[:, o, i] for d in dG], axis=1) if dG else np.zeros((frequency.size, 0))
            found.append(
                Response(
                    source=source,
                    output=output,
                    frequency_hz=frequency,
                    value=G[:, o, i],
                    log_sd=_spread(relative.real, estimate.covariance),
                    phase_sd=_spread(relative.imag, estimate.covariance),
                )
            )
    return tuple(found)


def frequency_grid(estimate: Estimate, n_frequencies: int = 600) -> Array:
    """Return frequencies from 0.1 Hz to half the sampling rate that do not miss a resonance.

    `estimate`: gives the rate and the poles; `n_frequencies`: spaced evenly in the logarithm. Returns (n_frequencies +
    41 n_resonances,), Hz, in rising order.
    """
    nyquist = 0.5 * float(str(estimate.record["rate_hz"]))
    grid = [np.geomspace(min(_LOWEST_HZ, 0.01 * nyquist), nyquist, n_frequencies)]
    for pole in estimate.continuous.poles:
        centre, width = abs(pole) / (2 * np.pi), abs(pole.real) / (2 * np.pi)
        if pole.imag > 0 and _LOWEST_HZ < centre < nyquist:
            grid.append(np.clip(centre + width * np.linspace(-5, 5, 41), grid[0][0], nyquist))
    return np.unique(np.concatenate(grid))


def poles(estimate: Estimate) -> tuple[Pole, ...]:
    """Compute the poles of the identified plant with the covariance of their real and imaginary parts.

    `estimate`: any. Returns sorted by real part, the slowest last.
    """
    plant = model(estimate.model)
    space = plant.matrices(estimate.values)
    slopes = [plant.derivative(estimate.values, name) for name in estimate.covariance_names]
    scale = _balance(space)
    A = space.A * scale / scale[:, None]
    values, right = np.linalg.eig(A)
    # rows of the inverse are the left eigenvectors, scaled so that wᴴ v = 1; a multiple pole has none
    angle = np.linalg.cond(right)
    left = np.linalg.inv(right) if angle < 1 / _DEFECTIVE else None
    found = []
    for k in np.argsort(values.real):
        covariance = None
        if left is not None:
            slope = np.array([left[k] @ (d.A * scale / scale[:, None]) @ right[:, k] for d in slopes])
            J = np.array([slope.real, slope.imag]).reshape(2, len(slopes))
            covariance = J @ estimate.covariance @ J.T
        found.append(Pole(value=complex(values[k]), covariance=covariance))
    return tuple(found)


def _balance(space: StateSpace) -> Array:
    """Scale states by powers of two so that A has rows and columns of like size."""
    from scipy.linalg import matrix_balance

    _, (scale, _) = matrix_balance(space.A, permute=False, separate=True)
    return np.asarray(scale, dtype=np.float64)


def _spread(J: Array, covariance: Array) -> Array:
    """Standard deviations of J times parameters of that covariance, row by row."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", J, covariance, J), 0.0)))
