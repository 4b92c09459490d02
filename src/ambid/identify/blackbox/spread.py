"""Standard deviations of everything that follows from the coefficients, by the delta method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.identify.blackbox.model import BlackBoxModel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def complex_covariance(derivative: Complex, covariance: Array) -> Array:
    """Propagate a covariance of coefficients to complex numbers.

    Parameters
    ----------
    derivative : ndarray, shape (..., n_theta), complex
    covariance : ndarray, shape (n_theta, n_theta)

    Returns
    -------
    ndarray, shape (..., 2, 2)
        Of real and imaginary part.
    """
    parts = np.stack([derivative.real, derivative.imag], axis=-2)
    return np.asarray(parts @ covariance @ np.swapaxes(parts, -1, -2))


def pole_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance of real and imaginary part of every pole, shape (n_poles, 2, 2).

    Parameters
    ----------
    model : BlackBoxModel
    covariance : ndarray, shape (n_theta, n_theta)

    Returns
    -------
    ndarray, shape (n_poles, 2, 2)
        In the order of ``model.poles()``. Not finite at multiple poles, where no first-order spread exists.
    """
    return complex_covariance(model.pole_derivative(), covariance)


def zero_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance of real and imaginary part of every zero, shape (n_zeros, 2, 2).

    Parameters
    ----------
    model : BlackBoxModel
    covariance : ndarray, shape (n_theta, n_theta)

    Returns
    -------
    ndarray, shape (n_zeros, 2, 2)
        In the order of ``model.zeros()``.
    """
    return complex_covariance(model.zero_derivative(), covariance)


def response_covariance(model: BlackBoxModel, covariance: Array, omega: Array) -> Array:
    """Return the covariance of real and imaginary part of the frequency response.

    Parameters
    ----------
    model : BlackBoxModel
    covariance : ndarray, shape (n_theta, n_theta)
    omega : ndarray, shape (n_frequencies,), rad/s

    Returns
    -------
    ndarray, shape (n_frequencies, n_outputs, n_inputs, 2, 2)
    """
    return complex_covariance(model.frequency_response_derivative(omega), covariance)
