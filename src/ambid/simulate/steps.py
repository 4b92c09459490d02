"""One sample of a plant, compiled: for loops of other rooms whose controller is another one than `physics.loop`'s.

Import it only from a module that is itself imported inside a function: it loads the compiler.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ambid.simulate._kernels import advance_linear, advance_nonlinear, stop

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def advance_plant(
    linear: bool,
    x: Array,
    centre: Array,
    voltages: tuple[float, float, float],
    disturbance: Array,
    matrices: tuple[Array, Array, Array, Array],
    magnet: Array,
    body: Array,
    timing: tuple[float, float, int],
    stops: tuple[float, float],
    room: Array,
) -> bool:
    """Carry the state of a plant over one sample, in place.

    Parameters
    ----------
    linear : bool
        Which equations: the matrices, or magnet and body.
    x : ndarray, shape (n_states,), SI
        State; position and velocity come first where the plant has them.
    centre : ndarray, shape (n_states,), SI
        Where the matrices hold.
    voltages : (float, float, float)
        Before and after the delay's fraction has passed, and that at `centre`, V.
    disturbance : ndarray, shape (n_disturbances,), SI
        Held over the sample; of the nonlinear plant force, then voltage.
    matrices : tuple of ndarray
        A (n_states, n_states), B and B_late (n_states,), E (n_states, n_disturbances), as `Standing.matrices` has them.
    magnet, body : ndarray, shapes (7,) or (12,), and (10,)
        As `Standing.nonlinear` has them.
    timing : (float, float, int)
        Fraction of the period in which the earlier voltage acts, period in s, Runge-Kutta steps.
    stops : (float, float)
        Where the rotor is stopped, m.
    room : ndarray, shape (n_states,)
        To work in.

    Returns
    -------
    bool
        Whether the rotor touched a stop.
    """
    late, now, rest = voltages
    if not linear:
        fraction, period, substeps = timing
        return bool(
            advance_nonlinear(x, late, now, fraction, disturbance, period, substeps, magnet, body, stops[0], stops[1])
        )
    a, b, b_late, e = matrices
    advance_linear(x, centre, late - rest, now - rest, disturbance, a, b, b_late, e, room)
    if x.size < 3:
        return False
    x[0], x[1], touched = stop(x[0], x[1], stops[0], stops[1])
    return bool(touched)
