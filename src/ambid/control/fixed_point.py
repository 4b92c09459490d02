"""What rounding to the controller's words does to a loop: peak of the sensitivity, noise, limit cycles.

`ambid.acquisition.law_words` chooses scales and words: blocks of one real or two complex poles, and with v what is
ordered, z+ = (A - G C) z + (B - G D) y + G v, in which y and v are limited, so that l1 norms bound every state.

What multiplies of a state, its upper 16 bits, differs from it by half a unit at most: by its variance the noise in the
command, and by the l1 norms of the closed loop the largest limit cycle (Gevers and Li 1993; Jackson 1996, ch. 11).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ambid.acquisition.law_words import LawWords, law_words
from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.control.knobs import Family
from ambid.control.lqg import SampledPlant
from ambid.physics.law import StateLaw, l1_norms

_BELOW = 14  # bits of a state below what multiplies


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What a count is, in SI with its sign."""

    position: float  # m
    current: float  # A
    command: float  # V

    def of(self, law: StateLaw) -> StateLaw:
        """Return a law in counts."""
        return law.in_units((self.position, self.current), 1.0 / self.command)

    def to_si(self, law: StateLaw) -> StateLaw:
        """Return a law in counts as one in SI."""
        return law.in_units((1.0 / self.position, 1.0 / self.current), self.command)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixedPointLaw:
    """A law in words, and what they do to its loop on a plant."""

    words: LawWords
    realised: StateLaw  # what the words say, in SI
    peak_shift_db: float  # of the sensitivity, at position signal or command, by the words
    largest_pole: float  # of the closed loop with the words
    noise: float  # V rms in the command by the rounding of states
    # m: no limit cycle at rest is larger, by rounding of the states alone, and of converter and pulse width too
    cycle_of_states: float
    cycle: float


def fixed_point(law: StateLaw, plant: Plant, counts: Counts, words: LawWords | None = None) -> FixedPointLaw:
    """Return the law of one axis in words, with what they do to its loop on a plant; RigError where it does not fit.

    `words`: others than those that the controller is given.
    """
    words = words or law_words(counts.of(law))
    realised, family = counts.to_si(words.law(law.rate_hz)), Family(plants=(plant,))
    peaks = [float(np.max(family.peaks(x))) for x in (law, realised)]
    poles = [float(family.poles(x)[0]) for x in (law, realised)]
    noise, states, cycle = _rounding(family.sampled[0], realised, counts)
    return FixedPointLaw(
        words=words, realised=realised, largest_pole=poles[1], noise=noise, cycle_of_states=states, cycle=cycle,
        peak_shift_db=20.0 * math.log10(peaks[1] / peaks[0]) if max(poles) < 1.0 else math.inf,
    )  # fmt: skip


def _rounding(of: SampledPlant, law: StateLaw, counts: Counts) -> tuple[float, float, float]:
    """Return V rms in the command by rounding of states, m of a limit cycle by that, and by all that rounds.

    (A - 1) and C see the difference of a state from its upper part; then there is the last bit of the state itself. The
    converter rounds position and current, the pulse width the command.
    """
    from scipy.linalg import solve_discrete_lyapunov

    z, n = of.closed(law), law.order
    if np.max(np.abs(np.linalg.eigvals(z))) >= 1.0:
        return math.inf, math.inf, math.inf
    last = np.vstack([np.zeros((of.A.shape[0], n)), 2.0**-_BELOW * np.eye(n)])
    states = np.hstack([np.vstack([of.B @ law.C, law.A - np.eye(n)]), last])
    seen = np.vstack([of.B @ law.D, law.B]) * np.array([counts.position, counts.current])
    ordered = np.vstack([of.B * counts.command, np.zeros((n, 1))])
    command = np.hstack([law.D @ of.C, law.C])
    P = solve_discrete_lyapunov(z, states @ states.T / 12.0, method="bilinear")
    noise = float(np.sqrt((command @ P @ command.T)[0, 0] + np.sum(law.C**2) / 12.0))
    position: Array = np.concatenate([of.C[of.kinds[0]], np.zeros((1, n))], axis=1)
    sums = l1_norms(z, np.hstack([states, seen, ordered]), position)[0] / 2.0
    return noise, float(np.sum(np.abs(sums[: 2 * n]))), float(np.sum(np.abs(sums)))
