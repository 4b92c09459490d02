"""The plant of the predictor, compiled: rates of change, Jacobian, derivatives by the numbers.

Physical numbers `theta` (20): the magnet's nine, then m, R, c, g, a, x_offset, i_offset, v_offset, v_drop, i_drop, and
the delay beyond whole samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.physics.coenergy_law import coenergy_derivatives

Flags = NDArray[np.bool_]

MAGNET = 9
MASS, RESISTANCE, DAMPING, GRAVITY, POLE, X_OFF, I_OFF, V_OFF, V_DROP, I_DROP, LATE = range(MAGNET, MAGNET + 11)
N_NUMBERS = LATE + 1

# Numba looks for edits of a kernel's own file alone: after one of the co-energy, run make clean
_energy: Callable[..., None] = compiled(coenergy_derivatives)


@compiled
def drop_of(i: float, th: Array) -> tuple[float, float, float]:
    """Return what transistors and diodes take of the voltage at a current, its slope, and the slope over v_drop."""
    t = math.tanh(i / th[I_DROP])
    c = (1.0 - t * t) / th[I_DROP]
    return th[V_DROP] * t, th[V_DROP] * c, c


@compiled
def rates(z: Array, volt: Array, th: Array, flags: Flags, w: Array, dw: Array, g: Array, A: Array, G: Array) -> None:
    """Write the right-hand side g (n,), its Jacobian A (n, n), and its derivatives G (n, 20) by `theta`.

    `volt` is the voltage and its derivative by the delay. Position, velocity and current, then the force behind the
    eddy pole, then a drifting force, where `flags` (exponential, pair, eddy, drift, locked) have them.
    """
    for a in range(g.size):
        g[a] = 0.0
        for b in range(g.size):
            A[a, b] = 0.0
        for b in range(N_NUMBERS):
            G[a, b] = 0.0
    x, v, i = z[0], z[1], z[2]
    _energy(x, i, th, flags[0], flags[1], w, dw)
    m, ell = th[MASS], w[3]
    if not flags[4]:
        pull = z[3] if flags[2] else w[0]
        net = pull - th[DAMPING] * v
        last = g.size - 1
        if flags[3]:
            net += z[last]
            A[1, last] = 1.0 / m
        g[0] = v
        g[1] = net / m + th[GRAVITY]
        A[0, 1] = 1.0
        A[1, 1] = -th[DAMPING] / m
        if flags[2]:
            A[1, 3] = 1.0 / m
        else:
            A[1, 0] = w[1] / m
            A[1, 2] = w[2] / m
            for q in range(MAGNET):
                G[1, q] = dw[0, q] / m
        G[1, MASS] = -net / m**2
        G[1, DAMPING] = -v / m
        G[1, GRAVITY] = 1.0
    drop, steep, c = drop_of(i, th)
    rate = (volt[0] + th[V_OFF] - drop - th[RESISTANCE] * i - w[2] * v) / ell
    g[2] = rate
    A[2, 0] = (-w[5] * v - rate * w[6]) / ell
    A[2, 1] = -w[2] / ell
    A[2, 2] = (-th[RESISTANCE] - steep - w[6] * v - rate * w[7]) / ell
    for q in range(MAGNET):
        G[2, q] = (-dw[2, q] * v - rate * dw[3, q]) / ell
    G[2, RESISTANCE] = -i / ell
    G[2, V_OFF] = 1.0 / ell
    G[2, V_DROP] = -math.tanh(i / th[I_DROP]) / ell
    G[2, I_DROP] = th[V_DROP] * c * i / th[I_DROP] / ell
    G[2, LATE] = volt[1] / ell
    if flags[2]:
        g[3] = th[POLE] * (w[0] - z[3])
        A[3, 0], A[3, 2], A[3, 3] = th[POLE] * w[1], th[POLE] * w[2], -th[POLE]
        for q in range(MAGNET):
            G[3, q] = th[POLE] * dw[0, q]
        G[3, POLE] = w[0] - z[3]
