"""What a black-box model is: coefficients, frequency response, poles and zeros, each with its derivatives.

Derivatives are by *all* coefficients, fixed ones included: a coefficient that was not estimated has a row and a column
of zeros in the covariance. So every standard deviation follows by the delta method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

if TYPE_CHECKING:
    from ambid.blackbox.state_space import StateSpaceModel

Complex = NDArray[np.complex128]


class BlackBoxModel(Protocol):
    """A linear model y = G u + H e, discrete (`dt` in s) or continuous (`dt` None).

    `dt`: sampling interval in s; `names`: of all coefficients, in the order of `theta`; `theta`: (n_theta,), all
    coefficients.
    """

    @property
    def dt(self) -> float | None: ...  # noqa: D102
    @property
    def n_inputs(self) -> int: ...  # noqa: D102
    @property
    def n_outputs(self) -> int: ...  # noqa: D102
    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def theta(self) -> Array: ...  # noqa: D102

    def frequency_response(self, omega: Array) -> Complex:
        """Return G at `omega` (n_frequencies,) in rad/s.

        `omega`: (n_frequencies,), rad/s. Returns (n_frequencies, n_outputs, n_inputs), complex.
        """
        ...

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta.

        `omega`: (n_frequencies,), rad/s. Returns (n_frequencies, n_outputs, n_inputs, n_theta), complex.
        """
        ...

    def noise_response(self, omega: Array) -> Complex:
        """Return H.

        `omega`: (n_frequencies,), rad/s. Returns (n_frequencies, n_outputs, n_outputs), complex.
        """
        ...

    def poles(self) -> Complex:
        """Return the poles of G (of H for a time series) in z, or in rad/s for a continuous model.

        Returns (n_poles,), complex.
        """
        ...

    def pole_derivative(self) -> Complex:
        """Return d(pole)/dtheta.

        Returns (n_poles, n_theta), complex.
        """
        ...

    def zeros(self) -> Complex:
        """Return the (transmission) zeros of G.

        Returns (n_zeros,), complex.
        """
        ...

    def zero_derivative(self) -> Complex:
        """Return d(zero)/dtheta.

        Returns (n_zeros, n_theta), complex.
        """
        ...

    def plant(self) -> StateSpaceModel:
        """Return G alone, without the states of the noise.

        Returns with K = 0.
        """
        ...

    def state_space(self) -> StateSpaceModel:
        """Return the model in innovations form."""
        ...


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
