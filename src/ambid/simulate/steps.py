"""One sample of a plant, compiled: for loops of other rooms whose controller is another one than `physics.loop`'s.

Import it only from a module that is itself imported inside a function: it loads the compiler.
"""

from __future__ import annotations

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.simulate._kernels import advance_linear, advance_nonlinear, stop


@compiled
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

    `linear`: which equations: the matrices, or magnet and body; `x`: (n_states,), SI, state; position and velocity come
    first where the plant has them; `centre`: (n_states,), SI, where the matrices hold; `voltages`: before and after the
    delay's fraction has passed, and that at `centre`, V; `disturbance`: (n_disturbances,), SI, held over the sample; of
    the nonlinear plant force, then voltage; `matrices`: a (n_states, n_states), B and B_late (n_states,), E (n_states,
    n_disturbances), as `Standing.matrices` has them; `magnet`, `body`: as `Standing.nonlinear` has them; `stops`: where
    the rotor is stopped, m; `room`: (n_states,), to work in. Returns whether the rotor touched a stop.
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
