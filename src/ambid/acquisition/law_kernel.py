"""The controller's state-space law in whole numbers, bit by bit as ``firmware/amb_daq/law.c`` has it; compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.law_words import BEGIN, D0, D1, E_BITS, HEAD, OF_A_STATE, SHARE_BITS, SUM_BITS, Y_BITS
from ambid.compiled import compiled

Integers = NDArray[np.int64]

_STATES, _E, _SUM = 1 << 29, 4095, (1 << 26) - 1


@compiled
def shifted(value: int, shift: int) -> int:
    """Return value / 2^shift to the nearest, ties up."""
    return value if shift == 0 else (value + (1 << (shift - 1))) >> shift


@compiled
def limited(value: int, largest: int) -> int:
    """Return `value` limited to both sides."""
    return min(max(value, -largest), largest)


@compiled
def law_tick(words: Integers, z: Integers, position: int, current: int, offset: int, low: int, high: int) -> int:
    """Return the pulse width of a tick, and move the states `z` (n,) on.

    `position`, `current`: from set point and rest, counts; `offset`: bias and excitation.
    """
    n, y0, y1 = words[HEAD] & 0xFF, position << Y_BITS, current << Y_BITS
    total = words[D0] * y0 + words[D1] * y1
    for i in range(n):
        total += words[OF_A_STATE + 7 * i + 6] * (z[i] >> SHARE_BITS)
    wanted = shifted(limited(shifted(total, words[HEAD] >> 8), _SUM), SUM_BITS) + offset
    duty = min(max(wanted, low), high)
    e = limited(duty - wanted, _E) << E_BITS
    for i in range(0, n, 2):
        last = i + 1 == n
        first, second = z[i] >> SHARE_BITS, 0 if last else z[i + 1] >> SHARE_BITS
        for j in range(1 if last else 2):
            own, other, at = (second, first, OF_A_STATE + 7 * (i + 1)) if j else (first, second, OF_A_STATE + 7 * i)
            total = words[at + 1] * own + words[at + 2] * other + words[at + 3] * y0 + words[at + 4] * y1
            moved = z[i + j] + shifted(total + words[at + 5] * e, words[at])
            z[i + j] = min(max(moved, -_STATES), _STATES - 1)
    return int(duty)


@compiled
def watch(words: Integers, z: Integers, position: int, current: int, bias: int, off: int, last: bool) -> None:
    """Move the states on while the pulse width is still `off`; with the last such tick integrators begin at zero."""
    law_tick(words, z, position, current, bias, off, off)
    for i in range(z.size if last else 0):
        if words[OF_A_STATE + 7 * i + 1] == 0 and words[OF_A_STATE + 7 * i + 2] == 0:
            z[i] = BEGIN
