"""Zones A to D of ISO 14839: of a sensitivity (part 3) that of its peak at a position signal, measured where it was
measured; of a displacement (part 2) that of its share of the clearance; each as far as the number is known. Every zone
that is shown or judged is made here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ambid.estimation.result import NORMAL_95

ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"))
"""Largest peak of the sensitivity of each zone of ISO 14839-3, as a ratio (9.54, 12.04, 13.98 dB); beyond is zone D."""
STANDARD = "ISO 14839-3:2006"
"""The edition that `ZONES` are of; users are asked to check them against its text."""
DISPLACEMENT = ((0.3, "A"), (0.4, "B"), (0.5, "C"))
"""Largest displacement from the centre of each zone of ISO 14839-2, over the smallest clearance; beyond is zone D."""
LONG_TERM = "AB"
"""Zones for operation without limit of time."""
_SURE = 0.99  # probability that is not told more exactly


_DECIBELS = tuple(20.0 * math.log10(most) for most, _ in ZONES)


def zone_of(value: float, limits: Sequence[float] = _DECIBELS) -> str:
    """Return the zone of a number that is known exactly, by default of a peak of the sensitivity in dB: ``"A"`` to
    ``"D"``.
    """
    return next((zone for most, zone in zip(limits, "ABC", strict=True) if value < most), "D")


@dataclass(frozen=True, slots=True, kw_only=True)
class Grade:
    """A number between the limits of zones A, B and C, as far as it is known."""

    value: float
    sd: float  # 0: how well it is known is not known
    limits: tuple[float, ...] = _DECIBELS

    @classmethod
    def of_displacement(cls, share: float, sd: float) -> Grade:
        """Judge a displacement over the smallest clearance."""
        return cls(value=share, sd=sd, limits=tuple(most for most, _ in DISPLACEMENT))

    @property
    def ends(self) -> tuple[float, float]:
        """The 95 % interval of the number."""
        return self.value - NORMAL_95 * self.sd, self.value + NORMAL_95 * self.sd

    @property
    def worst(self) -> str:
        """The zone of the upper end of the 95 % interval, by which a machine is accepted or not."""
        return zone_of(self.ends[1], self.limits)

    @property
    def letters(self) -> str:
        """``"A"``; where the 95 % interval holds a limit, ``"A or B"``, or ``"A to C"`` with one between."""
        first = zone_of(self.ends[0], self.limits)
        if first == self.worst:
            return first
        return f"{first} {'or' if ord(self.worst) - ord(first) == 1 else 'to'} {self.worst}"

    @property
    def probability(self) -> dict[str, float] | None:
        """How probable each zone is, the number normal; None where it is not known how well that is known."""
        if not 0.0 < self.sd < math.inf:
            return None
        below = [0.0, *(self._below(most) for most in self.limits), 1.0]
        return {letter: below[k + 1] - below[k] for k, letter in enumerate("ABCD")}

    def _below(self, most: float) -> float:
        return 0.5 * math.erfc((self.value - most) / (self.sd * math.sqrt(2.0)))

    @property
    def words(self) -> str:
        """``"A (98 %)"`` with the probability, or the two letters."""
        probability = self.probability
        if len(self.letters) > 1 or probability is None:
            return self.letters
        p = probability[self.letters]
        return f"{self.letters} ({f'{100.0 * p:.0f}' if p < _SURE else '> 99'} %)"


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone(Grade):
    """The zone of one axis, by the peak that counts."""

    source: Literal["measured", "predicted"]

    @classmethod
    def of(cls, predicted: tuple[float, float], measured: tuple[float, float] | None = None) -> Zone:
        """Judge the measured peak, (dB, sd), where there is one; the predicted one where it is surely higher (it may
        stand where nothing was excited) or where the measured one has no sd and is lower. An sd of NaN is infinite.
        """
        p = cls(value=predicted[0], sd=_known(predicted[1]), source="predicted")
        if measured is None:
            return p
        m = cls(value=measured[0], sd=_known(measured[1]), source="measured")
        return p if p.ends[0] > m.ends[1] or (m.sd == 0.0 and p.ends[1] > m.value) else m

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Zone:
        """Judge an axis of ``sensitivity`` as an estimate has it in JSON."""
        peak, measured = entry["peak_db"], entry["measured_peak_db"]
        pair = None if measured is None else (measured, entry.get("measured_sd_db") or 0.0)
        return cls.of((peak["value"], math.inf if peak["sd"] is None else peak["sd"]), pair)

    @property
    def upper_db(self) -> float:
        """The upper end of the peak's 95 % interval."""
        return self.ends[1]


def _known(sd: float) -> float:
    return math.inf if math.isnan(sd) else sd
