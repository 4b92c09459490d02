"""A law in whole numbers, as firmware/amb_daq/law.h computes it: scaling, words, what rounding does, and the same sums.

The law of one axis is brought to blocks of one real or two complex poles, which have the least sums and no overflow
oscillation in their normal form (Mills, Mullis and Roberts 1978), in counts of converter and pulse width. With v what
is ordered, z+ = (A - G C) z + (B - G D) y + G v: y and v are limited, so that the l1 norms of this system, which
anti-windup makes stable, bound every state for all times. The scale of a state is that bound; shift and words follow.

Rounding of a state to its upper 16 bits enters as an error of at most half a unit: by its variance the noise in the
command and by the l1 norms of the closed loop the largest limit cycle (Gevers and Li 1993; Jackson 1996, ch. 11).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.control.knobs import Family
from ambid.control.lqg import SampledPlant
from ambid.errors import ModelError
from ambid.physics.law import StateLaw

STATES = 6
BELOW = 14  # bits of a state below what multiplies
_STATE = (1 << 29) - (1 << 13) - 1  # largest state
_ROW = 49151  # largest sum of sizes of the words of a row
_SHIFT = 15  # largest
_Y_BITS, _E_BITS, _W_BITS = 5, 3, 12  # binary places of y, e and w
_Y, _E, _SUM = 1023, 4095, (1 << 26) - 1  # largest y and e in counts, w in 2^-12 counts
_FULL = 32000  # of 32767: upper part of a state at its bound
_INTEGRAL = 1e-9  # distance of a pole from 1 that is that of a pure integrator
_SPLIT = 1e8  # condition of the poles' directions, beyond which they cannot be told apart
_UNSEEN = 0.05  # counts of command at most, below which a state is left out
_STEPS = 256
_TAIL = 1e-4  # of an l1 norm that is left out


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What a count is, in SI with its sign, and how far the pulse width may go from rest."""

    position: float  # m
    current: float  # A
    command: float  # V
    largest: int  # counts of pulse width


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixedPointLaw:
    """A law as whole numbers, and what they do to the loop."""

    shift: int  # of the command
    d: tuple[int, int]
    rows: NDArray[np.int64]  # (n, 7): shift, self, other, b0, b1, g, c
    realised: StateLaw  # what the words say, in SI
    bounds: Array  # (n,), largest upper part of each state, whatever position and current do; 32767 is full
    # largest sensitivity, at position signal or command, with the words less that of the law
    peak_shift_db: float
    largest_pole: float  # of the closed loop with the words
    noise: float  # V rms in the command by the rounding of states
    # m: no limit cycle at rest is larger, by rounding of the states alone, and of converter and pulse width too
    cycle_of_states: float
    cycle: float

    @property
    def words(self) -> tuple[int, ...]:
        """The words of message ``law``."""
        return (len(self.rows) + 256 * self.shift, *self.d, *(int(x) for x in self.rows.ravel()))

    def run(
        self, y: Sequence[Sequence[int]], *, offset: int = 0, low: int = -_E, high: int = _E, z: list[int] | None = None
    ) -> Iterator[int]:
        """Give the pulse width of each pair of counts (position less set point, current less rest), bit by bit.

        `offset`: pulse width at rest; `low`, `high`: its limits; `z`: the states, moved on in place.
        """
        rows, z = [[int(x) for x in row] for row in self.rows], [0] * len(self.rows) if z is None else z
        for pair in y:
            a, b = (int(x) << _Y_BITS for x in pair)
            h = [(x + (1 << (BELOW - 1))) >> BELOW for x in z]
            total = sum(row[6] * x for row, x in zip(rows, h, strict=True)) + self.d[0] * a + self.d[1] * b
            w = _within(_shifted(total, self.shift), _SUM)
            wanted = _shifted(w, _W_BITS) + offset
            duty = min(max(wanted, low), high)
            e = _within(duty - wanted, _E) << _E_BITS
            for k, (shift, own, other, b0, b1, g, _) in enumerate(rows):
                beside = h[k ^ 1] if (k ^ 1) < len(h) else 0
                moved = own * h[k] + other * beside + b0 * a + b1 * b + g * e
                z[k] = _within(z[k] + _shifted(moved, shift), _STATE)
            yield duty


def _shifted(value: int, shift: int) -> int:
    return (value + ((1 << shift) >> 1)) >> shift


def _within(value: int, largest: int) -> int:
    return min(max(value, -largest), largest)


def fixed_point(law: StateLaw, plant: Plant, counts: Counts, *, word_bits: int = 16) -> FixedPointLaw:
    """Return a law of one axis in words, with what they do to its loop on a plant.

    `word_bits`: of the coefficients, at most 16. ModelError where the law does not fit the controller.
    """
    if law.D.shape != (1, 2) or law.order > STATES:
        raise ModelError(
            f"the law has {law.D.shape[0]} commands, {law.D.shape[1]} signals and {law.order} states; the controller "
            f"runs one command of position and current with at most {STATES} states. Reduce its order"
        )
    per = np.array([counts.position, counts.current])
    modal, T = _blocks(law.A)
    A, B, C, D = modal, np.linalg.solve(T, law.B) * per, law.C @ T / counts.command, law.D * per / counts.command
    G = np.linalg.solve(T, law.windup) * counts.command
    largest = np.array([_Y, _Y, counts.largest])
    bound = l1_norms(A - G @ C, np.hstack([B - G @ D, G])) @ largest
    if not np.all(np.isfinite(bound)):
        raise ModelError(
            "with a limited command some state of the law grows without bound. Give G, which tracks it back (A - G C "
            "must be stable)"
        )
    kept = _seen(A, np.abs(C[0]) * bound)
    A, B, C, G, bound = A[np.ix_(kept, kept)], B[kept], C[:, kept], G[kept], bound[kept]
    rows, size = _rows(np.hstack([A - np.eye(bound.size), B, G]), bound / _FULL, word_bits)
    shift, head = _head(np.concatenate([C[0] * size, D[0]]), word_bits)
    words = np.column_stack([rows, head[: bound.size]])
    d = (int(head[-2]), int(head[-1]))
    realised = _realised(words, shift, d, counts, law.rate_hz)
    family = Family(plants=(plant,))
    peaks = [float(np.max(family.peaks(x))) for x in (law, realised)]
    poles = [float(family.poles(x)[0]) for x in (law, realised)]
    noise, states, cycle = _rounding(SampledPlant.of(plant), realised, counts)
    return FixedPointLaw(
        shift=shift, d=d, rows=words, realised=realised, bounds=bound / size,
        peak_shift_db=20.0 * math.log10(peaks[1] / peaks[0]) if max(poles) < 1.0 else math.inf, largest_pole=poles[1],
        noise=noise, cycle_of_states=states, cycle=cycle,
    )  # fmt: skip


def _blocks(A: Array) -> tuple[Array, Array]:
    """Return A in normal blocks, complex poles before real ones, and the states' directions."""
    values, vectors = np.linalg.eig(A)
    blocks = np.zeros(A.shape)
    columns: list[Array] = []
    for k in np.flatnonzero(values.imag > 0.0):
        v, j = vectors[:, k] / np.linalg.norm(vectors[:, k]), len(columns)
        columns += [v.real, v.imag]
        a, b = float(values[k].real), float(values[k].imag)
        blocks[j : j + 2, j : j + 2] = [[a, b], [-b, a]]
    for k in np.flatnonzero(values.imag == 0.0):
        value, j = float(values[k].real), len(columns)
        columns.append(vectors[:, k].real)
        blocks[j, j] = 1.0 if abs(value - 1.0) < _INTEGRAL else value
    T = np.column_stack(columns)
    if not np.linalg.cond(T / np.linalg.norm(T, axis=0)) < _SPLIT:
        raise ModelError(
            "two poles of the law are equal: it has no form in separate blocks. Change the design a little"
        )
    return blocks, T


def _seen(A: Array, share: Array) -> NDArray[np.int64]:
    """Return the states without the blocks that never move the command by a part of a count, as delays do.

    `share`: counts of command, at most.
    """
    block = (A != 0.0) | np.eye(share.size, dtype=bool)
    return np.asarray(np.flatnonzero(block @ share > _UNSEEN))


def l1_norms(A: Array, B: Array, C: Array | None = None) -> Array:
    """Return the sums over all samples of |C A^k B|, (n_outputs, n_inputs); infinite where A is not stable."""
    C = np.eye(A.shape[0]) if C is None else C
    shape = (C.shape[0], B.shape[1])
    if np.max(np.abs(np.linalg.eigvals(A)), initial=0.0) >= 1.0:
        return np.full(shape, math.inf)
    powers = [np.eye(A.shape[0])]
    for _ in range(_STEPS):
        powers.append(A @ powers[-1])
    stack, total, last = C @ np.stack(powers[:-1]), np.zeros(shape), math.inf
    while True:
        part = np.abs(stack @ B).sum(axis=0)
        total, B = total + part, powers[-1] @ B
        now = float(np.max(part / np.where(total > 0.0, total, 1.0)))
        ratio = now / last if math.isfinite(last) and last > 0.0 else 1.0
        if now == 0.0 or (ratio < 1.0 and now * ratio / (1.0 - ratio) < _TAIL):
            return np.asarray(total * (1.0 + _TAIL))
        last = now


def _rows(table: Array, size: Array, word_bits: int) -> tuple[NDArray[np.int64], Array]:
    """Return shift, self, other, b0, b1 and g of each state, and the sizes of a unit of its upper part.

    Each row takes the largest shift, so the most binary places, at which it fits.
    """
    n = table.shape[0]
    coarse = 1 << (16 - word_bits)
    for _ in range(40):
        scaled = table.copy()
        scaled[:, :n] *= size[None, :]
        scaled /= size[:, None]
        found, short = [], np.zeros(n, dtype=bool)
        for k in range(n):
            other = scaled[k, k ^ 1] if (k ^ 1) < n else 0.0
            exact = np.array([scaled[k, k], other, *scaled[k, n : n + 2] / 2**_Y_BITS, scaled[k, n + 2] / 2**_E_BITS])
            for shift in range(_SHIFT, -1, -1):
                words = coarse * np.rint(exact * 2.0 ** (BELOW + shift) / coarse)
                if np.max(np.abs(words)) <= 32767 and np.sum(np.abs(words)) <= _ROW:
                    found.append([shift, *words.astype(np.int64).tolist()])
                    break
            else:
                short[k] = True
        if not short.any():
            return np.array(found, dtype=np.int64).reshape(n, 6), size
        size = np.where(short, 2.0 * size, size)
    raise ModelError("the law moves faster than its words can say. Lower its bandwidth")


def _head(exact: Array, word_bits: int) -> tuple[int, NDArray[np.int64]]:
    """Return the shift of the command, and the words c and d."""
    coarse = 1 << (16 - word_bits)
    places = np.concatenate([np.full(exact.size - 2, _W_BITS), np.full(2, _W_BITS - _Y_BITS)])
    for shift in range(_SHIFT, -1, -1):
        words = coarse * np.rint(exact * 2.0 ** (places + shift) / coarse)
        if np.max(np.abs(words)) <= 32767 and np.sum(np.abs(words)) <= _ROW:
            return shift, words.astype(np.int64)
    raise ModelError(
        "the law's command is larger than its words can say: a count of position or current moves it too far. Lower "
        "its bandwidth"
    )


def _realised(
    words: NDArray[np.int64], shift: int, d: tuple[int, int], counts: Counts,
    rate_hz: float,
) -> StateLaw:  # fmt: skip
    """Return what words say, in SI, the states in units of their upper parts."""
    n, per = words.shape[0], np.array([counts.position, counts.current])
    unit, volt = 2.0 ** (BELOW + words[:, :1]), counts.command
    A = np.eye(n)
    for k in range(n):
        A[k, k] += words[k, 1] / unit[k, 0]
        if (k ^ 1) < n:
            A[k, k ^ 1] = words[k, 2] / unit[k, 0]
    head = 2.0 ** (_W_BITS + shift)
    return StateLaw(
        A=A, B=words[:, 3:5] * 2**_Y_BITS / unit / per, C=words[None, :, 6] / head * volt,
        D=np.array([d]) * 2**_Y_BITS / head / per * volt, G=words[:, 5:6] * 2**_E_BITS / unit / volt,
        rate_hz=rate_hz,
    )  # fmt: skip


def _rounding(of: SampledPlant, law: StateLaw, counts: Counts) -> tuple[float, float, float]:
    """Return V rms in the command by rounding of states, m of a limit cycle by that, and by all that rounds.

    The upper part of a state differs from it by half a unit at most: (A - 1) and C see that difference; then there is
    the last bit of the state itself. The converter rounds position and current, the pulse width the command.
    """
    from scipy.linalg import solve_discrete_lyapunov

    z, n = of.closed(law), law.order
    if np.max(np.abs(np.linalg.eigvals(z))) >= 1.0:
        return math.inf, math.inf, math.inf
    last = np.vstack([np.zeros((of.A.shape[0], n)), 2.0**-BELOW * np.eye(n)])
    states = np.hstack([np.vstack([of.B @ law.C, law.A - np.eye(n)]), last])
    seen = np.vstack([of.B @ law.D, law.B]) * np.array([counts.position, counts.current])
    ordered = np.vstack([of.B * counts.command, np.zeros((n, 1))])
    command = np.hstack([law.D @ of.C, law.C])
    P = solve_discrete_lyapunov(z, states @ states.T / 12.0, method="bilinear")
    noise = float(np.sqrt((command @ P @ command.T)[0, 0] + np.sum(law.C**2) / 12.0))
    position = np.concatenate([of.C[of.kinds[0]], np.zeros((1, n))], axis=1)
    sums = l1_norms(z, np.hstack([states, seen, ordered]), position)[0] / 2.0
    return noise, float(np.sum(np.abs(sums[: 2 * n]))), float(np.sum(np.abs(sums)))
