"""What a black-box model is: coefficients, frequency response, poles and zeros, each with its derivatives.

Derivatives are by *all* coefficients, fixed ones included: a coefficient that was not estimated has a row and a column
of zeros in the covariance. So every standard deviation follows by the delta method. The state-space model in
innovations form (thesis eq. 1.1-1.3), x+ = A x + B u + K e, y = C x + D u + e, is what every other one can become.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError

Complex = NDArray[np.complex128]


class BlackBoxModel(ABC):
    """A linear model y = G u + H e, discrete (`dt` in s) or continuous (`dt` None)."""

    __slots__ = ()
    dt: float | None

    @property
    @abstractmethod
    def n_inputs(self) -> int:
        """Number of inputs, 0 for a time series."""

    @property
    @abstractmethod
    def n_outputs(self) -> int:
        """Number of outputs."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of all coefficients, in the order of `theta`."""

    @property
    @abstractmethod
    def theta(self) -> Array:
        """All coefficients, shape (n_theta,)."""

    @abstractmethod
    def frequency_response(self, omega: Array) -> Complex:
        """Return G at `omega` in rad/s, shape (n_frequencies, n_outputs, n_inputs)."""

    @abstractmethod
    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta at `omega` in rad/s, shape (n_frequencies, n_outputs, n_inputs, n_theta)."""

    @abstractmethod
    def noise_response(self, omega: Array) -> Complex:
        """Return H at `omega` in rad/s, shape (n_frequencies, n_outputs, n_outputs)."""

    @abstractmethod
    def state_space(self) -> StateSpaceModel:
        """Return the model in innovations form."""

    @abstractmethod
    def _poles(self) -> tuple[Complex, Complex]: ...

    @abstractmethod
    def _zeros(self) -> tuple[Complex, Complex]: ...

    def poles(self) -> Complex:
        """Return the poles of G (of H for a time series) in z, or in rad/s for a continuous model, shape (n_poles,)."""
        return self._poles()[0]

    def pole_derivative(self) -> Complex:
        """Return d(pole)/dtheta, shape (n_poles, n_theta)."""
        return self._poles()[1]

    def zeros(self) -> Complex:
        """Return the (transmission) zeros of G (of H for a time series), shape (n_zeros,)."""
        return self._zeros()[0]

    def zero_derivative(self) -> Complex:
        """Return d(zero)/dtheta, shape (n_zeros, n_theta)."""
        return self._zeros()[1]

    def plant(self) -> StateSpaceModel:
        """Return G alone, without the states of the noise, as a state space with K = 0."""
        return self.state_space().plant()

    def points(self, omega: Array) -> Complex:
        """Return z, or s for a continuous model, at `omega` in rad/s, shape (n_frequencies,)."""
        return np.asarray(1j * omega if self.dt is None else np.exp(1j * omega * self.dt), dtype=np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateSpaceModel(BlackBoxModel):
    """Innovations form; with `dt` None the first line is x' = A x + B u + K e.

    Attributes
    ----------
    A : ndarray, shape (n, n)
    B : ndarray, shape (n, n_inputs)
    C : ndarray, shape (n_outputs, n)
    D : ndarray, shape (n_outputs, n_inputs)
    K : ndarray, shape (n, n_outputs)
        Gain of the innovations; zero for an output-error model.
    dt : float or None
        Sampling interval in s; None for continuous time.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    dt: float | None

    def __post_init__(self) -> None:
        for name in "ABCDK":
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64, order="C"))
        n, n_u, n_y = self.A.shape[0], self.B.shape[-1], self.C.shape[0]
        wanted = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "K": (n, n_y)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ModelError(f"state-space matrix {name} has shape {getattr(self, name).shape}; it must be {shape}")

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient names, ``A[0,1]`` and so on: A, B, C, D, K, each row by row."""
        return tuple(f"{m}[{i},{j}]" for m in "ABCDK" for i, j in np.ndindex(getattr(self, m).shape))

    @property
    def theta(self) -> Array:
        """All coefficients in the order of `names`, shape (n_theta,)."""
        return np.concatenate([getattr(self, m).ravel() for m in "ABCDK"])

    def with_theta(self, theta: Array) -> StateSpaceModel:
        """Return the same structure with other coefficients.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)

        Returns
        -------
        StateSpaceModel
        """
        parts, first = {}, 0
        for m in "ABCDK":
            rows, columns = getattr(self, m).shape
            parts[m] = theta[first : first + rows * columns].reshape(rows, columns)
            first += rows * columns
        return StateSpaceModel(dt=self.dt, **parts)

    def in_states(self, T: Array) -> StateSpaceModel:
        """Return the same model in the state T^-1 x.

        Parameters
        ----------
        T : ndarray, shape (n, n)

        Returns
        -------
        StateSpaceModel
        """
        back = np.linalg.inv(T)
        return StateSpaceModel(
            A=back @ self.A @ T, B=back @ self.B, C=self.C @ T, D=self.D, K=back @ self.K, dt=self.dt
        )

    def state_space(self) -> StateSpaceModel:
        """Return the model itself."""
        return self

    def plant(self) -> StateSpaceModel:
        """Return G alone.

        Returns
        -------
        StateSpaceModel
            With K = 0.
        """
        return StateSpaceModel(A=self.A, B=self.B, C=self.C, D=self.D, K=np.zeros_like(self.K), dt=self.dt)

    def _poles(self) -> tuple[Complex, Complex]:
        """Eigenvalues of A, and their derivative: w_i* v_j / (w* v) for A[i, j]."""
        values, left, right = self._eigen()
        n = self.order
        scale = np.sum(left.conj() * right, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_a = np.einsum("ip,jp->pij", left.conj(), right) / scale[:, None, None]
        out = np.zeros((values.size, self.theta.size), dtype=np.complex128)
        out[:, : n * n] = by_a.reshape(values.size, -1)
        return values, out

    def _zeros(self) -> tuple[Complex, Complex]:
        """Transmission zeros of G, for as many inputs as outputs; none otherwise."""
        zeros, left, right = self._zero_vectors()
        n, n_u = self.order, self.n_inputs
        out = np.zeros((zeros.size, self.theta.size), dtype=np.complex128)
        if not zeros.size:
            return zeros, out
        scale = np.sum(left[:n].conj() * right[:n], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            full = np.einsum("ip,jp->pij", left.conj(), right) / scale[:, None, None]
        blocks = (full[:, :n, :n], full[:, :n, n:], full[:, n:, :n], full[:, n:, n:])
        flat = np.concatenate([b.reshape(zeros.size, -1) for b in blocks], axis=1)
        out[:, : n * n + n * n_u + self.n_outputs * (n + n_u)] = flat
        return zeros, out

    def frequency_response(self, omega: Array) -> Complex:
        """Return G = D + C (sI - A)^-1 B.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs), complex
        """
        return np.asarray(self.D + self.C @ np.linalg.solve(self._pencil(omega), self._wide(self.B, omega)))

    def noise_response(self, omega: Array) -> Complex:
        """Return H = I + C (sI - A)^-1 K.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_outputs), complex
        """
        inner = np.linalg.solve(self._pencil(omega), self._wide(self.K, omega))
        return np.asarray(np.eye(self.n_outputs) + self.C @ inner)

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs, n_theta), complex
        """
        pencil = self._pencil(omega)
        right = np.linalg.solve(pencil, self._wide(self.B, omega))  # (f, n, u)
        left = np.swapaxes(np.linalg.solve(np.swapaxes(pencil, 1, 2), self._wide(self.C.T, omega)), 1, 2)  # (f, y, n)
        f, n, n_u, n_y = omega.size, self.order, self.n_inputs, self.n_outputs
        by_a = np.einsum("fyi,fju->fyuij", left, right).reshape(f, n_y, n_u, n * n)
        by_b = np.einsum("fyi,uv->fyuiv", left, np.eye(n_u)).reshape(f, n_y, n_u, n * n_u)
        by_c = np.einsum("yz,fju->fyuzj", np.eye(n_y), right).reshape(f, n_y, n_u, n_y * n)
        by_d = np.broadcast_to(
            np.einsum("yz,uv->yuzv", np.eye(n_y), np.eye(n_u)).reshape(n_y, n_u, n_y * n_u), (f, n_y, n_u, n_y * n_u)
        )
        return np.concatenate([by_a, by_b, by_c, by_d, np.zeros((f, n_y, n_u, n * n_y))], axis=3)

    def _pencil(self, omega: Array) -> Complex:
        return np.asarray(self.points(omega)[:, None, None] * np.eye(self.order) - self.A)

    @staticmethod
    def _wide(matrix: Array, omega: Array) -> Complex:
        return np.broadcast_to(matrix.astype(np.complex128), (omega.size, *matrix.shape))

    def _eigen(self) -> tuple[Complex, Complex, Complex]:
        from scipy.linalg import eig

        if not self.order:
            none = np.empty((0, 0), dtype=np.complex128)
            return np.empty(0, dtype=np.complex128), none, none
        values, left, right = eig(self.A, left=True, right=True)
        order = np.argsort(-(np.abs(values) if self.dt is not None else values.real), kind="stable")
        return values[order].astype(np.complex128), left[:, order], right[:, order]

    def _zero_vectors(self) -> tuple[Complex, Complex, Complex]:
        from scipy.linalg import eig

        none = np.empty(0, dtype=np.complex128)
        if self.n_inputs != self.n_outputs or not self.order:
            return none, none[None, :], none[None, :]
        n = self.order
        system = np.block([[self.A, self.B], [self.C, self.D]])
        mass = np.zeros_like(system)
        mass[:n, :n] = np.eye(n)
        values, left, right = eig(system, mass, left=True, right=True, homogeneous_eigvals=True)
        finite = np.abs(values[1]) > 1e-8 * np.abs(values[0])
        zeros = np.asarray(values[0][finite] / values[1][finite], dtype=np.complex128)
        return zeros, left[:, finite], right[:, finite]


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
