"""Resonances of a rotor in its loop from a run-up or a coast-down: critical speeds, amplification factors, margins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ambid.arrays import Array, Complex
from ambid.estimation.modes import EstimatedNumber
from ambid.rotor.passage import Passage


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """A peak of a response over the speed, by its half-power points (API RP 684): AF = N_c/(N_2 - N_1)."""

    speed: float  # N_c, rad/s
    size: float  # in the unit of the response
    lower: float | None  # N_1, rad/s, where it is 1/√2 of the peak; None: it does not fall as far before another peak
    upper: float | None  # N_2

    @property
    def amplification(self) -> float | None:
        """AF; None where one of the half-power points is missing."""
        if self.lower is None or self.upper is None:
            return None
        return self.speed / (self.upper - self.lower)


def peaks(speed: Array, size: Array) -> tuple[Peak, ...]:
    """Return the peaks of a smooth response (n,) over the speed in rad/s, rising or falling, by rising speed."""
    raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Resonance:
    """A mode of the loop that a run-up or a coast-down passes.

    Speed and amplification are those of the response to unbalance at constant speed: what acceleration shifts and
    broadens is taken out. Intervals hold noise alone.
    """

    speed: EstimatedNumber  # critical speed, rad/s: where that response peaks; of a damped mode its natural frequency
    amplification: EstimatedNumber  # AF by the half-power points of that response, else 1/(2 damping ratio)
    half_power: bool  # whether it is by half-power points
    critically_damped: bool  # AF below the limit (2.5 in API 684): no critical speed in its sense
    frequency: EstimatedNumber  # |pole|, rad/s
    damping: EstimatedNumber  # ratio
    pole: complex  # rad/s
    shape: Mapping[str, complex]  # by position, largest 1: the motion that goes with the mode
    forward: float | None  # part of the shape's power that whirls forward; None: of one plane
    measured: Peak | None  # the peak of the tracked response itself, as it was passed
    plane: str  # whose response shows it most


@dataclass(frozen=True, kw_only=True, eq=False)
class Resonances:
    """What passages show: resonances, and the response to unbalance at constant speed that belongs to them."""

    resonances: tuple[Resonance, ...]  # by speed
    speed: Array  # (n,), rad/s, a grid over the range
    response: Complex  # (n, n_roles), to unbalance at constant speed, without run-out, m
    roles: tuple[str, ...]
    misfit: float  # mean square of the residuals over their variance
    warnings: tuple[str, ...] = ()


def resonances(passages: Sequence[Passage], *, least: float = 2.5, modes: int | None = None) -> Resonances:
    """Return the resonances of passages of one machine, up or down; `least`: AF below which a mode is critically
    damped; `modes`: how many are fitted, by default as many as the data ask for.
    """
    raise NotImplementedError


# --- margins ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationRule:
    """How far a critical speed has to be from the operating speeds: a mode with AF of at least `least` by

        base + slope (1 - 1/(AF - offset)), at most `most`,

    over the speed that it is near, each below the operating range and above it.
    """

    least: float = 2.5
    slope: float = 0.17
    offset: float = 1.5
    below: tuple[float, float] = (0.0, 0.16)  # base and most, of a critical speed below the lowest operating speed
    above: tuple[float, float] = (0.10, 0.26)

    def required(self, amplification: float, *, above: bool) -> float:
        """Return the separation that is required, over the speed that it is near; 0 of a critically damped mode."""
        if amplification < self.least:
            return 0.0
        base, most = self.above if above else self.below
        return min(base + self.slope * (1.0 - 1.0 / (amplification - self.offset)), most)


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """Where a resonance stands beside the operating speeds."""

    resonance: Resonance
    actual: float  # distance over the operating speed that is near; 0 within the range
    required: float
    required_most: float  # by the upper end of the interval of the amplification factor
    passed: bool  # the lower end of the actual one is at least that
    sd: float  # of the actual one


def separations(
    resonances: Sequence[Resonance], operating: tuple[float, float], rule: SeparationRule | None = None
) -> tuple[Separation, ...]:
    """Return the margin of each resonance to the lowest and highest operating speed, rad/s."""
    raise NotImplementedError


@dataclass(frozen=True, slots=True, kw_only=True)
class Scaled:
    """A measured response to unbalance, multiplied so that it reaches a limit in the operating range."""

    factor: float
    at: float  # speed in the operating range at which it reaches the limit, rad/s
    largest: float  # zero to peak over all speeds, scaled, m
    largest_at: float  # rad/s
    room: float  # what it may be, m
    passed: bool


def scaled_to_limit(
    speed: Array, size: Array, operating: tuple[float, float], limit: float, room: float,
    factors: tuple[float, float] = (1.0, 6.0),
) -> Scaled:  # fmt: skip
    """Scale a response (n,), zero to peak in m, so that its largest in the operating range is `limit`, by a factor
    within `factors`, and compare its largest at any speed with `room`.
    """
    raise NotImplementedError


# --- whirl at constant speed ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class WhirlPoint:
    """A mode that noise excites in a record at constant speed: a point of a measured Campbell diagram."""

    speed: float  # rad/s
    frequency: EstimatedNumber  # rad/s
    damping: EstimatedNumber  # ratio
    direction: int  # 1 forward, -1 backward, 0 of one plane alone
    plane: str


def whirl_points(passages: Sequence[object]) -> tuple[WhirlPoint, ...]:
    """Return the modes that noise shows in records at constant speed."""
    raise NotImplementedError
