"""Limits of the standards by which a machine on magnetic bearings is accepted, each with its source, its edition, and
the text in which its figure was looked up. None of these texts is the standard itself: a limit without one is shown as
unconfirmed, and all are to be checked against the standard.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from ambid.control.zones import STANDARD

API = "API 617, 9th edition (2022)"
_ROSS = "ROSS, report.py, after API RP 684 (2nd edition) SP6.8.2"
_TUTORIAL = "ROSS, tutorial on magnetic bearings"
_LATERAL = "a published calculation after API 617 (8th edition) 6.8.2 and 6.9"
_MICROMETRES, _SPEED = 25.4, 12_000.0  # of the limit of vibration: peak to peak at a speed in 1/min
CLEARANCE_SHARE = 0.75
"""Of the smallest diametral clearance, up to which the scaled response may come, peak to peak."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limit:
    """A limit of a standard."""

    figure: str  # as a formula, or as numbers
    standard: str  # with its edition
    looked_up: str = ""  # where the figure was found; empty: it is unconfirmed

    @property
    def source(self) -> str:
        """Standard and edition, and whether the figure is confirmed."""
        seen = f"confirmed by {self.looked_up}, not by its own text" if self.looked_up else "unconfirmed"
        return f"{self.standard}; {seen}"


_LIMITS = (
    ("sensitivity", "peak of the sensitivity in zone A to 3, in zone B to 4 (9.54 and 12.04 dB)", STANDARD, _TUTORIAL),
    ("sensitivity C", "in zone C to 5 (13.98 dB)", STANDARD, ""),
    (
        "displacement", "largest displacement in zone A to 0.3, in B to 0.4, in C to 0.5 of the smallest clearance",
        "ISO 14839-2:2004", "",
    ),
    ("amplification", "an amplification factor (AF) below 2.5 is critically damped", API, f"{_ROSS}.10"),
    (
        "separation", "separation above the range of operation 10 + 17 (1 - 1/(AF - 1.5)) %, at most 26 %, below it "
        "17 (1 - 1/(AF - 1.5)) %, at most 16 %; none of a critically damped one", API, f"{_ROSS}.10",
    ),
    (
        "vibration", "synchronous vibration 25.4 um (12 000/N)^(1/2), at most 25.4 um, peak to peak, N in 1/min", API,
        f"{_ROSS}.11, and an article on compressor vibration by API 617",
    ),
    ("unbalance", "unbalance 6350 W/N g mm, W in kg on the journal, N in 1/min", API, _LATERAL),
    ("scaled", "response scaled to that limit 75 % of the smallest diametral clearance, peak to peak", API, _LATERAL),
)  # fmt: skip
LIMITS: Mapping[str, Limit] = MappingProxyType(
    {name: Limit(figure=figure, standard=standard, looked_up=text) for name, figure, standard, text in _LIMITS}
)


def vibration_limit(speed: float, *, running: bool = False) -> float:
    """Return the largest vibration, peak to peak in m, at a maximum continuous speed in rad/s; `running`: as a test
    shows it, which has 25.4 um at slow speeds too.
    """
    share = math.sqrt(_SPEED / (speed * 30.0 / math.pi))
    return 1e-6 * _MICROMETRES * (min(share, 1.0) if running else share)


def residual_unbalance(load: float, speed: float) -> float:
    """Return the largest unbalance, kg m, of a plane whose journal carries a load in kg, at a speed in rad/s."""
    return 6350e-6 * load / (speed * 30.0 / math.pi)
