"""What a guided commissioning consists of: steps, each with findings and, where it is not good enough, the reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from ambid.job.amplitude import moving_band

StepName = Literal["self-test", "rest", "levitate", "excite", "record", "identify", "validate", "report", "track"]

STEPS: tuple[StepName, ...] = (
    "self-test",
    "rest",
    "levitate",
    "excite",
    "record",
    "identify",
    "validate",
    "report",
    "track",
)
"""In their order."""

EXCITATION = "multisine"
"""What is played."""

_PERIODS = 4.0  # of the lowest line in a trial

_NO_NUMBERS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One step, done."""

    name: StepName  # one of `STEPS`
    findings: tuple[str, ...] = ()  # what was measured, one line each
    reasons: tuple[str, ...] = ()  # why it is not good enough, and what to do, one line each; empty: it is
    cautions: tuple[str, ...] = ()  # what a reader should know although the step is good enough
    numbers: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)  # the same as numbers, SI

    @property
    def passed(self) -> bool:
        """Whether commissioning may go on."""
        return not self.reasons

    def as_json(self) -> dict[str, object]:
        """Return it as a JSON object.

        Returns ``name``, ``passed``, ``findings``, ``reasons``, ``cautions``, ``numbers``; what is not known is None.
        """
        return {
            "name": self.name,
            "passed": self.passed,
            "findings": list(self.findings),
            "reasons": list(self.reasons),
            "cautions": list(self.cautions),
            "numbers": {name: x if math.isfinite(x) else None for name, x in self.numbers.items()},
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What a commissioning is to reach, and how long it may take for it."""

    # length of the record, of the one for validation, of levitation without excitation, of the look at rest, of each
    # trial of the amplitude, and of tracking, s
    record_s: float = 20.0
    second_s: float = 8.0
    hover_s: float = 2.0
    rest_s: float = 0.5
    trial_s: float = 2.0
    track_s: float = 5.0
    settle_s: float = 1.0  # time that lift-off is given, s
    amplitude_v: float | None = None  # peak of the excitation, V; None: found by trials
    band_hz: tuple[float, float] | None = None  # of the excitation; None: a thousandth to a thirtieth of the rate
    use: float = 0.3  # part of the way to the trips that the excitation may use
    # largest half width of a 95 % interval, relative to the value, of a parameter that counts as found
    widest: float = 0.10
    seed: int = 0  # of the excitation

    def band(self, rate_hz: float) -> tuple[float, float]:
        """Return the band of the excitation in Hz.

        `rate_hz`: of the device, Hz. Returns as wished, or from the rate.
        """
        return self.band_hz or moving_band(rate_hz)

    def longest_trial_s(self, rate_hz: float) -> float:
        """Return the length of a trial in s: as wished, or longer where the band is slow.

        `rate_hz`: of the device, Hz. Returns four periods of the lowest line at least.
        """
        low = self.band(rate_hz)[0]
        return max(self.trial_s, _PERIODS / low * (1 + 1e-9)) if low > 0.0 else self.trial_s
