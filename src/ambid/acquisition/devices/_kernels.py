"""Controller and bench, tick by tick, bit by bit as ``firmware/amb_daq`` has it: laws, excitations, trips; compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.law_words import BEGIN, D0, D1, E_BITS, HEAD, OF_A_STATE, SHARE_BITS, SUM_BITS, Y_BITS
from ambid.acquisition.program import MASKS
from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.simulation.kernels import Linear, Nonlinear, advance_plant

Integers = NDArray[np.int64]

_STATES, _E = 1 << 29, 4095
_ONE = 1 << 12  # a count in the law's fixed point
_TERM, _INTEGRAL, _SUM = 1 << 28, 1 << 27, (1 << 26) - 1  # where the firmware limits its terms
_MASKS = np.array([MASKS.get(bits, 0) for bits in range(max(MASKS) + 1)], dtype=np.int64)


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
    """Return the pulse width of a tick from position (from set point) and current (from rest), in counts, and move the
    states `z` (n,) on; `offset`: bias and excitation.
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


# States and causes: as in messages.toml; a test compares them.
IDLE, SAMPLING, DRIVING, LEVITATING, FAULT = 0, 1, 2, 3, 4
OVER_CURRENT, OUT_OF_GAP = 3, 4
NONE, STEP, PRBS, TABLE = 0, 1, 2, 3

# Places in `settings`.
KP, KI, KD, POLE, KC, SETPOINT, REST, BIAS = range(8)
POSITION_LOW, POSITION_HIGH, CURRENT_LOW, CURRENT_HIGH, DUTY_LOW, DUTY_HIGH, DUTY_OFF, LIFT = range(8, 16)
KIND, AMPLITUDE, HOLD, LENGTH, CYCLES, TOP, TOP_DUTY = 16, 17, 18, 19, 20, 21, 22
SETTLED = 23  # ticks inside its limits after which the position counts
N_SETTINGS = 24

# Places in `memory`.
STATE, CAUSE, INTEGRAL, DERIVATIVE, LAST, FRESH, TICK, FAULT_TICK, LIFTED = 0, 1, 2, 3, 4, 5, 6, 7, 8
PLAYING, ELEMENT, HELD, PLAYED, SHIFT, DUTY, INSIDE, WATCHING = 9, 10, 11, 12, 13, 14, 15, 16
N_MEMORY = 17


@compiled
def mapped(value: float, x: Array, y: Array) -> float:
    """Return y at `value` on the polyline through (x, y), its ends continued; x increases."""
    k = min(max(int(np.searchsorted(x, value)) - 1, 0), x.size - 2)
    return float(y[k] + (y[k + 1] - y[k]) / (x[k + 1] - x[k]) * (value - x[k]))


@compiled
def converted(value: float, x: Array, y: Array, top: int) -> int:
    """Return the counts of a quantity, limited as a converter limits them."""
    return int(min(max(math.floor(mapped(value, x, y) + 0.5), 0.0), float(top)))


@compiled
def parity(word: int) -> int:
    """Return 1 for an odd number of ones."""
    odd = 0
    while word:
        odd ^= 1
        word &= word - 1
    return odd


@compiled
def played(settings: Integers, memory: Integers, table: Integers) -> int:
    """Return the excitation of this tick in counts, and move on."""
    if memory[PLAYING] == 0:
        return 0
    kind, amplitude, length = settings[KIND], settings[AMPLITUDE], settings[LENGTH]
    if kind == STEP:
        value, elements = (amplitude if memory[ELEMENT] == 0 else -amplitude), 2
    elif kind == PRBS:
        value, elements = (amplitude if memory[SHIFT] & 1 else -amplitude), (1 << length) - 1
    else:
        product, elements = amplitude * table[memory[ELEMENT]], length
        value = (2 * abs(product) + 127) // 254 * (1 if product >= 0 else -1)
    memory[HELD] += 1
    if memory[HELD] >= settings[HOLD]:
        memory[HELD] = 0
        memory[ELEMENT] += 1
        if kind == PRBS:
            s = memory[SHIFT]
            memory[SHIFT] = s >> 1 | parity(s & _MASKS[length]) << (length - 1)
        if memory[ELEMENT] >= elements:
            memory[ELEMENT] = 0
            memory[PLAYED] += 1
            if settings[CYCLES] and memory[PLAYED] >= settings[CYCLES]:
                memory[PLAYING] = 0
    return int(value)


@compiled
def ordered(
    position: int, current: int, excitation: int, settings: Integers, memory: Integers, words: Integers, z: Integers
) -> int:
    """Return the pulse width that the law orders, in counts: the firmware's fixed point, number by number."""
    low, high = settings[DUTY_LOW], settings[DUTY_HIGH]
    if memory[STATE] == DRIVING:
        return int(min(max(settings[BIAS] + excitation, low), high))
    error = settings[SETPOINT] - position
    if z.size:
        return law_tick(words, z, -error, current - settings[REST], settings[BIAS] + excitation, low, high)
    growth = settings[KI] * error
    derivative = (memory[DERIVATIVE] * settings[POLE] + 0x8000) >> 16
    if memory[FRESH] == 0:
        derivative -= settings[KD] * (position - memory[LAST])
    memory[DERIVATIVE], memory[LAST], memory[FRESH] = limited(derivative, _TERM), position, 0
    wanted = settings[KP] * error + (memory[INTEGRAL] >> 4) + memory[DERIVATIVE]
    wanted = limited(wanted - settings[KC] * (current - settings[REST]), _SUM) + (settings[BIAS] + excitation) * _ONE
    duty, beyond = (wanted + _ONE // 2) >> 12, 0
    if wanted > high * _ONE:
        duty, beyond = high, 1
    elif wanted < low * _ONE:
        duty, beyond = low, -1
    # Anti-windup: while the pulse width is limited the integral may only move back.
    if beyond * growth <= 0:
        memory[INTEGRAL] = limited(memory[INTEGRAL] + growth, _INTEGRAL)
    return int(duty)


@compiled
def tripped(position: int, current: int, settings: Integers, memory: Integers) -> int:
    """Return the cause of a fault that this tick's inputs are, 0 for none."""
    if memory[STATE] != DRIVING and memory[STATE] != LEVITATING:
        return 0
    if not settings[CURRENT_LOW] <= current <= settings[CURRENT_HIGH]:
        return OVER_CURRENT
    outside = not settings[POSITION_LOW] <= position <= settings[POSITION_HIGH]
    if memory[TICK] - memory[LIFTED] < settings[LIFT]:
        memory[INSIDE] = 0 if outside else memory[INSIDE] + 1
        if memory[INSIDE] >= settings[SETTLED]:
            memory[LIFTED] = memory[TICK] - settings[LIFT]
        return 0
    return OUT_OF_GAP if outside else 0


@compiled
def tick_on(
    counts: Integers,
    noise: Array,
    noise_size: Array,
    settings: Integers,
    memory: Integers,
    table: Integers,
    words: Integers,
    z: Integers,
    x: Array,
    line: Array,
    roles: tuple[int, int],
    maps: tuple[Array, Array, Array, Array, Array, Array],
    centre: Array,
    centre_input: float,
    equations: Linear | Nonlinear,
    stops: tuple[float, float],
    room: Array,
) -> int:
    """Carry controller and plant over some ticks into counts (n, 6): position, current, pulse width, excitation, set
    point, state; return the first tick whose state is not finite, -1 for none.

    `noise` (n, 2 + n_disturbances) is standard normal, times `noise_size`: position, current, disturbances. `maps`: x
    and y of position to counts, current to counts, pulse width to volts; `roles`: states of position and current (-1:
    none); `words`, `z`: a law and its states, empty for gains; `line` (whole delay + 2,): the newest voltages.
    """
    disturbance = np.empty(noise_size.size - 2)
    whole = line.size - 2
    for k in range(counts.shape[0]):
        position = current = 0
        if roles[0] >= 0:
            if not math.isfinite(x[roles[0]]):
                return k
            position = converted(x[roles[0]] + noise[k, 0] * noise_size[0], maps[0], maps[1], settings[TOP])
        if roles[1] >= 0:
            if not math.isfinite(x[roles[1]]):
                return k
            current = converted(x[roles[1]] + noise[k, 1] * noise_size[1], maps[2], maps[3], settings[TOP])
        cause = tripped(position, current, settings, memory)
        if cause:
            memory[STATE], memory[CAUSE], memory[FAULT_TICK] = FAULT, cause, memory[TICK]
            memory[PLAYING] = 0
        on = memory[STATE] == DRIVING or memory[STATE] == LEVITATING
        excitation, duty = 0, settings[DUTY_OFF]
        if on and memory[WATCHING]:
            on = False
            memory[WATCHING] -= 1
            watch(
                words, z, position - settings[SETPOINT], current - settings[REST], settings[BIAS], duty,
                memory[WATCHING] == 0,
            )  # fmt: skip
        elif on:
            excitation = played(settings, memory, table)
            duty = ordered(position, current, excitation, settings, memory, words, z)
        memory[DUTY] = duty
        counts[k, 0], counts[k, 1], counts[k, 2], counts[k, 3] = position, current, duty, excitation
        counts[k, 4], counts[k, 5] = settings[SETPOINT], memory[STATE]
        for j in range(whole + 1, 0, -1):
            line[j] = line[j - 1]
        # Output off: the bridge is open and the coil is taken to see no voltage.
        line[0] = mapped(float(duty), maps[4], maps[5]) if on else 0.0
        for j in range(disturbance.size):
            disturbance[j] = noise[k, 2 + j] * noise_size[2 + j]
        voltages = (line[whole + 1], line[whole], centre_input)
        advance_plant(x, centre, voltages, disturbance, equations, stops, room)
        memory[TICK] += 1
    return -1
