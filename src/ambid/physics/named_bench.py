"""What a named bench is: numbers, loop, limits and noise, with the source of each number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import Shaft


@dataclass(frozen=True, slots=True, kw_only=True)
class Turning:
    """What turns with a rotor: unbalance in a plane in kg m, or run-out of sensors in m."""

    name: str  # of the unbalance, or of the bearing whose sensors run out
    value: float
    phase: float = 0.0  # rad against the mark of the angle
    z: float = 0.0  # plane of an unbalance from the datum, m


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorBody:
    """What a bench with a rotor on many axes has beside the numbers of its model."""

    model: RotorModel  # bearings, planes, speed; its bending modes are those of `shaft`
    shaft: Shaft | None = None  # the drawing that mass, inertia and bending modes follow from; None: rigid, as given
    unbalance: tuple[Turning, ...] = ()
    runout: tuple[Turning, ...] = ()
    gap: float = 0.0  # of the magnets at the centre, m, for the nonlinear law
    sigma: float = 0.0  # saturation of their iron, 1/A^2
    cone: float = 0.0  # angle of the pole faces in rad, by which radial magnets act along the shaft too


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """A named bench."""

    name: str  # name for the command line, and one line that describes it
    summary: str
    parameters: Mapping[str, float]  # truth of the linear model `model` in SI units: m, k_x, k_i, R, L, c
    loop: Loop  # controller and delay; stable on the linear plant at `rate_hz`
    usually_closed: bool  # whether a record is taken in closed loop unless told otherwise
    noise: Noise  # sensor and process noise
    limits: Limits  # voltage, current and stops
    rate_hz: float  # sampling rate in Hz that the loop is designed for
    sources: Mapping[str, str]  # where each number comes from, or that it is chosen
    model: str = "one-axis"  # name of the linear model
    plant: NonlinearPlant | None = None  # the nonlinear plant whose linearisation `parameters` is, where there is one
    operating_point: OperatingPoint = field(default_factory=OperatingPoint)  # where the bench rests: m, A, V
    # gains of sensors and amplifiers with their units, where the source gives them
    instruments: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    rotor: RotorBody | None = None  # of a rotor on many axes; loop, limits and noise are those of every axis

    def __post_init__(self) -> None:
        for name in ("parameters", "sources", "instruments"):  # nobody changes what a name stands for
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
