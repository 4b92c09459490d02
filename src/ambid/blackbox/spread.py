"""Standard deviations of everything that follows from the coefficients, by the delta method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.model import BlackBoxModel

Complex = NDArray[np.complex128]


def complex_covariance(derivative: Complex, covariance: Array) -> Array:
    """Propagate a covariance of coefficients to complex numbers.

    `derivative`: (..., n_theta), complex; `covariance`: (n_theta, n_theta). Returns (..., 2, 2), of real and imaginary
    part.
    """
    parts = np.stack([derivative.real, derivative.imag], axis=-2)
    return np.asarray(parts @ covariance @ np.swapaxes(parts, -1, -2))


def pole_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance of real and imaginary part of every pole, shape (n_poles, 2, 2).

    `covariance`: (n_theta, n_theta). Returns (n_poles, 2, 2), in the order of ``model.poles()``. Not finite at multiple
    poles, where no first-order spread exists.
    """
    return complex_covariance(model.pole_derivative(), covariance)


def zero_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance of real and imaginary part of every zero, shape (n_zeros, 2, 2).

    `covariance`: (n_theta, n_theta). Returns (n_zeros, 2, 2), in the order of ``model.zeros()``.
    """
    return complex_covariance(model.zero_derivative(), covariance)


def response_covariance(model: BlackBoxModel, covariance: Array, omega: Array) -> Array:
    """Return the covariance of real and imaginary part of the frequency response.

    `covariance`: (n_theta, n_theta); `omega`: (n_frequencies,), rad/s. Returns (n_frequencies, n_outputs, n_inputs, 2,
    2).
    """
    return complex_covariance(model.frequency_response_derivative(omega), covariance)
