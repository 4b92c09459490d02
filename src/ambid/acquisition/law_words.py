"""A state-space law as the controller's 16-bit words (``firmware/amb_daq/law.h``) and back: A less one in blocks of two
states at most, so that a slow pole costs no digits, a power of two before each row; states scaled, then rounded.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.scales import PWM_TOP
from ambid.arrays import Array, Complex
from ambid.errors import RigError
from ambid.physics.law import StateLaw, l1_norms

LAW_STATES = 6
"""States that the controller has room for."""
LAW_ROW = 49151
"""Sum of the sizes of a row's words at most: no sum of products can then overflow."""
HEAD, D0, D1, OF_A_STATE = 0, 1, 2, 3
"""Places of the words; from the last one seven of each state: shift, self, other, b0, b1, g, c."""
Y_BITS, E_BITS, SHARE_BITS, SUM_BITS = 5, 3, 14, 12
"""Binary places of what multiplies of inputs and of what the limits took; of a row with shift 0; of w with shift 0."""
BEGIN = 1 << 13
"""A state of zero: half a step of what multiplies, so that this is the nearest."""
WATCH_MS = 100
"""For which a law only watches before its output goes on, ms: else its filters would see a step to the rotor's stop."""
LARGEST_SHIFT = 15
LARGEST_STATE = 32767
"""Full scale of what multiplies of a state."""

_WORD = 2**15 - 1
_IN, _LIMITED = 2.0**Y_BITS, 2.0**E_BITS
_INPUT = 512.0  # counts of both inputs for which a state must have room, whatever their course
_CARRIED = 4096.0  # counts of pulse width that an integrator must have room for
_INTEGRATES = 1e-9  # of its pole's distance from 1
_WORST_CONDITION = 1e8  # of the way to blocks


@dataclass(frozen=True, slots=True, kw_only=True)
class LawWords:
    """A law as the messages ``law`` and ``arm`` have it."""

    words: tuple[int, ...]

    def __post_init__(self) -> None:
        if fault := _fault(self.words):
            raise RigError(f"the words of a law {fault}. Make them by ambid.acquisition.law_words")

    @property
    def order(self) -> int:
        """Number of states."""
        return self.words[HEAD] & 0xFF

    @property
    def checksum(self) -> int:
        """CRC-16/XMODEM over the words, low bytes first."""
        return crc_hqx(np.array(self.words, dtype="<i2").tobytes(), 0)

    @property
    def rows(self) -> NDArray[np.int64]:
        """Words of each state: shift, self, other, b0, b1, g, c; (n, 7)."""
        return np.array(self.words[OF_A_STATE:], dtype=np.int64).reshape(self.order, -1)

    def law(self, rate_hz: float) -> StateLaw:
        """Return the law that these words are, from counts to counts of pulse width, but for the rounding of states."""
        rows, n = self.rows.astype(np.float64), self.order
        share = 2.0 ** -(SHARE_BITS + rows[:, 0])
        out = 2.0 ** -(SUM_BITS + (self.words[HEAD] >> 8))
        a = np.eye(n) + np.diag(share * rows[:, 1])
        for i in range(n):
            if i ^ 1 < n:
                a[i, i ^ 1] = share[i] * rows[i, 2]
        return StateLaw(
            A=a,
            B=_IN * share[:, None] * rows[:, 3:5],
            C=out * rows[None, :, 6],
            D=_IN * out * np.array([self.words[D0 : D1 + 1]]),
            G=_LIMITED * share[:, None] * rows[:, 5:6],
            rate_hz=rate_hz,
        )


def _fault(words: tuple[int, ...]) -> str | None:
    """Say what the controller would refuse."""
    if len(words) < OF_A_STATE or any(not -_WORD - 1 <= w <= _WORD for w in words):
        return "are too few, or not of 16 bits"
    n, shift = words[HEAD] & 0xFF, words[HEAD] >> 8
    if not 1 <= n <= LAW_STATES or len(words) != OF_A_STATE + 7 * n:
        return f"are not those of 1 to {LAW_STATES} states"
    rows = np.abs(np.array(words[OF_A_STATE:], dtype=np.int64).reshape(n, 7))
    shifts = np.array([shift, *words[OF_A_STATE::7]])
    if shifts.min() < 0 or shifts.max() > LARGEST_SHIFT:
        return f"shift by other than 0 to {LARGEST_SHIFT} places"
    sums = [*rows[:, 1:6].sum(axis=1), rows[:, 6].sum() + abs(words[D0]) + abs(words[D1])]
    if max(sums) > LAW_ROW:
        return f"have a row of sum {max(sums)}, above {LAW_ROW}"
    return "couple a state with one that is not there" if n % 2 and rows[-1, 2] else None


def law_words(law: StateLaw) -> LawWords:
    """Bring a law of one axis, from counts (position, current) to counts of pulse width, to the controller's words.

    Where G tracks the states back, so that they are stable with the command given, they have room for any course of
    inputs within 512 counts and any pulse width; else for such inputs alone, an integrator for 4096 counts of pulse
    width.
    """
    if law.D.shape != (1, 2):
        raise RigError(
            f"loop.law has {law.D.shape[0]} commands and {law.D.shape[1]} signals fed back; the controller drives one"
            " axis by its position and current. Give the law of one axis"
        )
    if not 1 <= law.order <= LAW_STATES:
        raise RigError(
            f"loop.A has {law.order} states; the controller has room for 1 to {LAW_STATES}. Reduce the law's order"
        )
    tracked = np.abs(np.linalg.eigvals(law.A - law.windup @ law.C)).max() < 1.0
    if not tracked and np.abs(np.linalg.eigvals(law.A)).max() > 1.0 + _INTEGRATES:
        raise RigError(
            "loop.A has a pole outside the unit circle, and loop.G does not track its states back: they grow where the "
            "command is limited. Give G, so that A - G C is stable, or design another"
        )
    return rounded(_with_room(_in_blocks(law)))


def rounded(law: StateLaw) -> LawWords:
    """Round a law that is in blocks, its states scaled to at most 32767."""
    share, n = 2.0**SHARE_BITS, law.order
    less = law.A - np.eye(n)
    inputs = np.hstack([law.B / _IN, law.windup / _LIMITED])
    words: list[int] = []
    for i in range(n):
        other = less[i, i ^ 1] if i ^ 1 < n else 0.0
        row = share * np.array([less[i, i], other, *inputs[i]])
        shift = _shift(row, f"row {i} of loop.A, B and G")
        words += [shift, *np.rint(row * 2.0**shift).astype(int).tolist()]
        words.append(0)  # of C, below
    out = 2.0**SUM_BITS * np.hstack([law.D[0] / _IN, law.C[0]])
    shift = _shift(out, "the row of loop.C and D")
    d0, d1, *c = np.rint(out * 2.0**shift).astype(int).tolist()
    words[6::7] = c
    return LawWords(words=(n | shift << 8, d0, d1, *words))


def _shift(row: Array, what: str) -> int:
    """Return the largest shift whose rounded words still fit."""
    for shift in range(LARGEST_SHIFT, -1, -1):
        sizes = np.abs(np.rint(row * 2.0**shift))
        if sizes.max() <= _WORD and sizes.sum() <= LAW_ROW:
            return shift
    raise RigError(
        f"{what} sums up to {np.abs(row).sum():.4g} steps of the controller, whose limit is {LAW_ROW}: one count of a "
        "sensor would demand too much. Use a sensor of a smaller range, or reduce the law's gain at high frequency"
    )


def _in_blocks(law: StateLaw) -> StateLaw:
    """Return the law in blocks of two states at most: of pairs of poles, on bases of their invariant subspaces."""
    bases = []
    for poles in _pairs(np.linalg.eigvals(law.A).astype(np.complex128)):
        kernel = np.linalg.multi_dot([np.eye(law.order), *(law.A - p * np.eye(law.order) for p in poles)])
        bases.append(np.linalg.svd(kernel.real)[2][-len(poles) :].T)
    to = np.hstack(bases)
    if (condition := np.linalg.cond(to)) > _WORST_CONDITION:
        raise RigError(
            f"loop.A has more than two poles so close that no block of two holds them (condition {condition:.1g}"
            "). Reduce the law's order, or move a pole of the design"
        )
    back = np.linalg.inv(to)
    a, edge = np.zeros_like(law.A), 0
    for basis in bases:
        block = slice(edge, edge + basis.shape[1])
        a[block, block] = (back @ law.A @ to)[block, block]
        edge = block.stop
        if basis.shape[1] == 1 and abs(a[edge - 1, edge - 1] - 1.0) < _INTEGRATES:
            a[edge - 1, edge - 1] = 1.0
    return replace(law, A=a, B=back @ law.B, C=law.C @ to, G=back @ law.windup)


def _pairs(poles: Complex) -> list[list[complex]]:
    """Return conjugate pairs, then real poles two and two, then what is alone: a last one, and integrators."""
    paired = [[p, p.conjugate()] for p in poles if p.imag > 0.0]
    real = sorted(float(p.real) for p in poles if p.imag == 0.0)
    alone = [[p] for p in real if abs(p - 1.0) < _INTEGRATES]
    real = [p for p in real if abs(p - 1.0) >= _INTEGRATES]
    if len(real) % 2:  # the one that is farthest from its neighbours stays alone
        gaps = [min((abs(p - q) for j, q in enumerate(real) if j != i), default=0.0) for i, p in enumerate(real)]
        alone.insert(0, [real.pop(int(np.argmax(gaps)))])
    paired += [[complex(a), complex(b)] for a, b in list(pairwise(real))[::2]]
    return paired + [[complex(p) for p in one] for one in alone]


def _with_room(law: StateLaw) -> StateLaw:
    """Return the law with states that fill their words."""
    peaks = _peaks(law)
    for _ in range(4):  # a row that is too large for its words needs states in larger units
        scaled = _scaled(law, LARGEST_STATE / peaks)
        rows = np.abs(np.hstack([scaled.A - np.eye(law.order), scaled.B / _IN, scaled.windup / _LIMITED]))
        peaks = peaks * np.maximum(
            1.0, 1.01 * 2.0**SHARE_BITS * np.maximum(rows.sum(axis=1) / LAW_ROW, rows.max(axis=1) / _WORD)
        )
    return _scaled(law, LARGEST_STATE / peaks)


def _scaled(law: StateLaw, factors: Array) -> StateLaw:
    return replace(
        law,
        A=factors[:, None] * law.A / factors,
        B=factors[:, None] * law.B,
        C=law.C / factors,
        G=factors[:, None] * law.windup,
    )


def _peaks(law: StateLaw) -> Array:
    """Return the largest value of each state: with the command v given, z+ = (A - G C) z + (B - G D) y + G v; where
    that is not stable, for inputs alone, and of an integrator what pulse width asks of it.
    """
    G = law.windup
    peaks = l1_norms(law.A - G @ law.C, np.hstack([law.B - G @ law.D, G])) @ [_INPUT, _INPUT, PWM_TOP]
    if not np.all(np.isfinite(peaks)):
        integrates = (np.eye(law.order) == law.A).all(axis=1)
        others = np.flatnonzero(~integrates)
        peaks = _CARRIED / np.maximum(np.abs(law.C[0]), 1e-300)
        peaks[others] = _INPUT * l1_norms(law.A[np.ix_(others, others)], law.B[others]).sum(axis=1)
    return np.where((peaks > 0.0) & np.isfinite(peaks), peaks, 1.0)
