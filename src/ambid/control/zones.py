"""The zone of ISO 14839-3 of a sensitivity: that of its peak at a position signal, measured where it was measured, as
far as the peak is known. Every zone that is shown or judged is made here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from ambid.estimation.result import NORMAL_95

ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"))
"""Largest peak of the sensitivity of each zone of ISO 14839-3, as a ratio (9.54, 12.04, 13.98 dB); beyond is zone D."""
STANDARD = "ISO 14839-3:2006"
"""The edition that `ZONES` are of; users are asked to check them against its text."""
LONG_TERM = "AB"
"""Zones for operation without limit of time."""
_SURE = 0.99  # probability that is not told more exactly


def zone_of(peak_db: float) -> str:
    """Return the zone of a peak of the sensitivity that is known exactly, dB: ``"A"`` to ``"D"``."""
    return next((zone for most, zone in ZONES if peak_db < 20.0 * math.log10(most)), "D")


class _Peak(NamedTuple):
    decibel: float
    sd: float  # dB; 0: nothing is said of it; inf: it is not known, nor is the zone

    @property
    def ends(self) -> tuple[float, float]:
        return self.decibel - NORMAL_95 * self.sd, self.decibel + NORMAL_95 * self.sd


def _peak(decibel: float, sd: float) -> _Peak:
    return _Peak(decibel, math.inf if math.isnan(sd) else sd)


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """The zone of one axis, by the peak that counts."""

    peak_db: float
    sd_db: float  # 0: how well the peak is known is not known
    source: Literal["measured", "predicted"]

    @classmethod
    def of(cls, predicted: _Peak | tuple[float, float], measured: _Peak | tuple[float, float] | None = None) -> Zone:
        """Judge the measured peak, (dB, sd), where there is one; the predicted one where it is surely higher (it may
        stand where nothing was excited) or where the measured one has no sd and is lower.
        """
        p, m = _peak(*predicted), None if measured is None else _peak(*measured)
        if m is None or p.ends[0] > m.ends[1] or (m.sd == 0.0 and p.ends[1] > m.decibel):
            return cls(peak_db=p.decibel, sd_db=p.sd, source="predicted")
        return cls(peak_db=m.decibel, sd_db=m.sd, source="measured")

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Zone:
        """Judge an axis of ``sensitivity`` as an estimate has it in JSON."""
        peak, measured = entry["peak_db"], entry["measured_peak_db"]
        pair = None if measured is None else _Peak(measured, entry.get("measured_sd_db") or 0.0)
        return cls.of(_Peak(peak["value"], math.inf if peak["sd"] is None else peak["sd"]), pair)

    @property
    def upper_db(self) -> float:
        """The upper end of the peak's 95 % interval."""
        return _Peak(self.peak_db, self.sd_db).ends[1]

    @property
    def worst(self) -> str:
        """The zone of that upper end, by which a loop is accepted or not."""
        return zone_of(self.upper_db)

    @property
    def letters(self) -> str:
        """``"A"``; where the 95 % interval holds a limit, ``"A or B"``, or ``"A to C"`` with one between."""
        first = zone_of(_Peak(self.peak_db, self.sd_db).ends[0])
        if first == self.worst:
            return first
        return f"{first} {'or' if ord(self.worst) - ord(first) == 1 else 'to'} {self.worst}"

    @property
    def probability(self) -> dict[str, float] | None:
        """How probable each zone is, the peak in dB normal; None where it is not known how well that is known."""
        if not 0.0 < self.sd_db < math.inf:
            return None
        below = [0.0, *(self._below(20.0 * math.log10(most)) for most, _ in ZONES), 1.0]
        return {letter: below[k + 1] - below[k] for k, letter in enumerate("ABCD")}

    def _below(self, decibel: float) -> float:
        return 0.5 * math.erfc((self.peak_db - decibel) / (self.sd_db * math.sqrt(2.0)))

    @property
    def words(self) -> str:
        """``"A (98 %)"`` with the probability, or the two letters."""
        probability = self.probability
        if len(self.letters) > 1 or probability is None:
            return self.letters
        p = probability[self.letters]
        return f"{self.letters} ({f'{100.0 * p:.0f}' if p < _SURE else '> 99'} %)"
