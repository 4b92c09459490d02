"""How the rotor may move between two samples: what fusion knows of the position without any sensor.

Free: white acceleration. Levitated: m x¨ = k_i i - k_x x - c x˙ + force, the current measured (thesis eq. 2.1, 2.14).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.physics.discretise import zero_order_hold
from ambid.recursive.kalman import LinearState, constant_velocity, linear_state


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """A sampled linear motion with one position, and what is known of it when fusion begins.

    Attributes
    ----------
    state : LinearState
        Its one output is the position in m; R is not used. Inputs, if any, are measured signals.
    start : ndarray, shape (n_states,)
    start_sd : ndarray, shape (n_states,)
        All positive.
    """

    state: LinearState
    start: Array
    start_sd: Array

    def __post_init__(self) -> None:
        """Refuse what fusion cannot start from."""
        n = self.state.A.shape[0]
        start, sd = np.array(self.start, dtype=np.float64), np.array(self.start_sd, dtype=np.float64)
        if self.state.C.shape[0] != 1:
            raise EstimationError(f"motion: {self.state.C.shape[0]} outputs; fusion wants one, the position. Give one")
        if start.shape != (n,) or sd.shape != (n,) or not (np.isfinite(start).all() and np.isfinite(sd).all()):
            raise EstimationError(
                f"motion: start and start_sd must be {n} finite numbers each. Give one for each state"
            )
        if not (sd > 0.0).all():
            raise EstimationError("motion: start_sd must be positive. Give what is not known of each state")
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "start_sd", sd)


def free_motion(
    rate_hz: float, *, q: float, start_sd: ArrayLike = (1e-3, 1.0), start: ArrayLike = (0.0, 0.0)
) -> Motion:
    """Return position and velocity under white acceleration.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    q : float
        Intensity of the acceleration, (m/s²)²s. A motion of amplitude a and angular frequency ω needs about a² ω³.
    start_sd : array_like, shape (2,)
        In m and m/s.
    start : array_like, shape (2,)

    Returns
    -------
    Motion

    Raises
    ------
    EstimationError
        If a number is not positive.
    """
    state = constant_velocity(rate_hz, q=q, r=1.0)
    return Motion(state=state, start=np.asarray(start), start_sd=np.asarray(start_sd))


def levitated_motion(
    rate_hz: float,
    *,
    m: float,
    k_i: float,
    k_x: float,
    c: float = 0.0,
    force: float,
    force_walk: float,
    start_sd: ArrayLike = (1e-3, 1.0, 100.0),
    start: ArrayLike = (0.0, 0.0, 0.0),
) -> Motion:
    """Return the bench's own motion with the measured current as input, exactly sampled (held from sample to sample).

    The third state is a slow force per mass, m/s²: gravity, the bias of the current, a load. Without it the model
    would take the offset that all sensors share for an unbalanced force.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    m, k_i, k_x, c : float
        Mass kg, N/A, N/m (negative for an attracting magnet), N s/m.
    force : float
        Density of the white force that the model does not know, N/√Hz (two-sided), from inaccurate parameters too.
    force_walk : float
        The slow force walks: standard deviation after one second, N/√s; over 0.
    start_sd, start : array_like, shape (3,)
        In m, m/s, m/s².

    Returns
    -------
    Motion

    Raises
    ------
    EstimationError
        If a number is not finite, or mass or noise not positive.
    """
    numbers = np.array([rate_hz, m, k_i, k_x, c, force, force_walk])
    if not (np.isfinite(numbers).all() and min(rate_hz, m, force, force_walk) > 0.0):
        raise EstimationError(
            "levitated motion: rate, m, force and force_walk must be positive, k_i, k_x and c finite. Mend them"
        )
    F = np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, 1.0], [0.0, 0.0, 0.0]])
    A, B, Q = _sampled(F, np.array([[0.0], [k_i / m], [0.0]]), np.diag([0.0, force**2, force_walk**2]) / m**2, rate_hz)
    state = linear_state(A, [[1.0, 0.0, 0.0]], Q, [[1.0]], B=B)
    return Motion(state=state, start=np.asarray(start), start_sd=np.asarray(start_sd))


def _sampled(F: Array, G: Array, intensity: Array, rate_hz: float) -> tuple[Array, Array, Array]:
    """Exact step, held input and noise covariance (Van Loan 1978)."""
    from scipy.linalg import expm

    n = F.shape[0]
    A, B = zero_order_hold(F, G, 1.0 / rate_hz)
    both = expm(np.block([[-F, intensity], [np.zeros((n, n)), F.T]]) / rate_hz)
    Q = A @ both[:n, n:]
    return A, B, (Q + Q.T) / 2.0
