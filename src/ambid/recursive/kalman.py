"""Kalman filter over the square-root core, for samples and blocks with gaps, of a linear state x⁺ = A x + B u + w, y =
C x + v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, as_block, covariance_of, factors_of, kernels, root_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearState:
    """A sampled linear state and its noises.

    Attributes
    ----------
    A : ndarray, shape (n_states, n_states)
    B : ndarray, shape (n_states, n_inputs)
        No columns where there is no input.
    C : ndarray, shape (n_outputs, n_states)
    Q : ndarray, shape (n_states, n_states)
        Covariance of the process noise of one sample, positive semidefinite.
    R : ndarray, shape (n_outputs, n_outputs)
        Covariance of the measurement noise, positive definite; need not be diagonal.
    """

    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array


def linear_state(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike, *, B: ArrayLike | None = None) -> LinearState:
    """Check and keep the matrices of a sampled state, a `LinearState`.

    Parameters
    ----------
    A, Q : array_like, shape (n_states, n_states)
    C : array_like, shape (n_outputs, n_states)
    R : array_like, shape (n_outputs, n_outputs)
    B : array_like, shape (n_states, n_inputs), optional

    Returns
    -------
    LinearState

    Raises
    ------
    EstimationError
        If shapes do not fit, a number is not finite, Q is not positive semidefinite or R not positive definite.
    """
    a, c, q, r = (np.atleast_2d(np.array(M, dtype=np.float64)) for M in (A, C, Q, R))
    n, m = a.shape[0], c.shape[0]
    b = np.zeros((n, 0)) if B is None else np.array(B, dtype=np.float64).reshape(n, -1)
    shapes = {"A": (a, (n, n)), "C": (c, (m, n)), "Q": (q, (n, n)), "R": (r, (m, m))}
    for name, (M, shape) in shapes.items():
        if M.shape != shape or not np.isfinite(M).all():
            raise EstimationError(
                f"linear state: {name} has shape {M.shape}; it must be {shape} and finite. Correct it"
            )
    for name, M, least in (("Q", q, -1e-12), ("R", r, 0.0)):
        values = np.linalg.eigvalsh((M + M.T) / 2)
        bad = values[0] < least * max(values[-1], 0.0) or (name == "R" and values[0] <= 0)
        if bad or not np.allclose(M, M.T, rtol=1e-10, atol=0):
            raise EstimationError(
                f"linear state: {name} must be a covariance, {'positive' if name == 'R' else 'semi'}definite; its "
                f"eigenvalues reach from {values[0]:.3g} to {values[-1]:.3g}. Give another"
            )
    return LinearState(A=a, B=b, C=c, Q=(q + q.T) / 2, R=(r + r.T) / 2)


def constant_velocity(rate_hz: float, *, q: float, r: float) -> LinearState:
    """Return position and velocity under white acceleration, position measured; noise discretised exactly.

    Q = q [[T³/3, T²/2], [T²/2, T]] (Bar-Shalom, Li and Kirubarajan 2001, sec. 6.2.2).

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    q : float
        Intensity of the acceleration, (m/s²)²s; over 0.
    r : float
        Variance of a position sample, m².

    Returns
    -------
    LinearState, of position in m and velocity in m/s

    Raises
    ------
    EstimationError
        If a number is not positive.
    """
    if not all(0 < x < np.inf for x in (rate_hz, q, r)):
        raise EstimationError(
            f"constant velocity: rate {rate_hz:g} Hz, q = {q:g}, r = {r:g}; all must be positive. Give others"
        )
    T = 1.0 / rate_hz
    return linear_state(
        [[1.0, T], [0.0, 1.0]], [[1.0, 0.0]], q * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]), [[r]]
    )


class KalmanFilter(Copied):
    """Kalman filter of a `LinearState`.

    Without a start covariance it begins in the stationary one (Riccati equation), and its gain is constant as long as
    nothing is missing. With one, the gain follows the covariance, which is not computed further once it stands still
    to rounding. A measurement that is not finite is missing: its outputs are left out, the others are used; where all
    are missing, the state is predicted only. Splitting a stream in another way does not change any number.

    Parameters
    ----------
    model : LinearState
    start : array_like, shape (n_states,), optional
        State at the first sample, before it is measured; 0 by default.
    start_covariance : array_like, shape (n_states, n_states), optional
        Of its error, positive definite.

    Attributes
    ----------
    n_samples : int
        Taken in.

    Raises
    ------
    EstimationError
        If shapes do not fit, or there is no stationary filter and no start covariance.
    """

    def __init__(
        self,
        model: LinearState,
        *,
        start: ArrayLike | None = None,
        start_covariance: ArrayLike | None = None,
    ) -> None:
        self.model = model
        n, m, n_u = model.A.shape[0], model.C.shape[0], model.B.shape[1]
        self._n, self._m, self._n_u = n, m, n_u
        parts = (model.A, model.B, model.C, root_of(model.Q), model.R)
        self._model = np.concatenate([np.ravel(part) for part in parts])
        x = np.array(np.zeros(n) if start is None else start, dtype=np.float64).reshape(-1)
        if x.size != n or not np.isfinite(x).all():
            raise EstimationError(f"Kalman filter: start has {x.size} numbers for {n} states; give {n} that are finite")
        self._memory = np.zeros(n * n + n + m * (2 * n + m + 2))
        self._memory[: n * n] = factors_of(_start_covariance(model, start_covariance)).ravel()
        self._memory[n * n :][:n] = x
        self._work = np.zeros(3 * n * n + 3 * n)
        self._tally = np.zeros(2)
        self._none = np.empty((1, 0))
        self._one = (np.empty((1, m)), np.empty((1, n)))
        self.n_samples = 0

    def update(self, measurement: ArrayLike, inputs: ArrayLike | None = None) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        measurement : array_like, shape (n_outputs,), or (n_samples, n_outputs) for a block
            A number, or (n_samples,), where there is one output. NaN where it is missing.
        inputs : array_like, shape (n_inputs,) or (n_samples, n_inputs), optional
            Held from each sample to the next; wanted where the model has inputs.

        Returns
        -------
        ndarray, shape (n_states,), or (n_samples, n_states) for a block
            State at the instants of the samples, these included.

        Raises
        ------
        EstimationError
            If shapes do not fit, or an input is missing or not finite.
        """
        if isinstance(measurement, float) and self._m == 1 and inputs is None and self._n_u == 0:
            y, out = self._one
            y[0, 0] = measurement
            self._run(y, self._none, out)
            return out[0].copy()
        raw = np.asarray(measurement, dtype=np.float64)
        y, u = as_block(raw, self._m), self._none
        n = y.shape[0]
        if self._n_u or inputs is not None:
            given = np.asarray([] if inputs is None else inputs, dtype=np.float64)
            if given.size != n * self._n_u or not np.isfinite(given).all():
                raise EstimationError(
                    f"Kalman filter: inputs of shape {given.shape}; {n} samples of {self._n_u} finite inputs are "
                    "needed. Give all of them"
                )
            u = as_block(given.reshape(n, self._n_u), self._n_u)
        out = np.empty((n, self._n))
        self._run(y, u, out)
        return out[0] if raw.ndim == 0 or (raw.ndim == 1 and self._m > 1) else out

    def _run(self, y: Array, u: Array, out: Array) -> None:
        kernels("kalman").state_scan(y, u, out, self._model, self._memory, self._work, self._tally)
        self.n_samples += y.shape[0]

    @property
    def state(self) -> Array:
        """State predicted for the next sample, shape (n_states,)."""
        return self._memory[self._n**2 :][: self._n].copy()

    @property
    def covariance(self) -> Array:
        """Covariance of the error of `state`, shape (n_states, n_states)."""
        return covariance_of(self._memory[: self._n**2].reshape(self._n, self._n))

    @property
    def n_missing(self) -> int:
        """Single measured values that were missing."""
        return int(self._tally[1])


def _start_covariance(model: LinearState, covariance: ArrayLike | None) -> Array:
    """Return the covariance (n_states, n_states) to begin with, the stationary one where none is given."""
    if covariance is None:
        from ambid.estimation.predictor import predictor_gain

        try:
            P = predictor_gain(model.A, model.C, model.Q, model.R).P
            np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            raise EstimationError(
                "Kalman filter: no stationary filter has a positive definite covariance: a state is not "
                "observable, or not driven by noise. Give start_covariance, or another model"
            ) from None
        return np.asarray(P)
    n = model.A.shape[0]
    P = np.array(covariance, dtype=np.float64).reshape(-1)
    if P.size != n * n:
        raise EstimationError(f"Kalman filter: start_covariance has {P.size} numbers for {n} states. Give {n} x {n}")
    P = P.reshape(n, n)
    try:
        np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        raise EstimationError(
            "Kalman filter: start_covariance is not positive definite. Give every state a positive variance"
        ) from None
    return P
