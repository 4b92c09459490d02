"""Named benches: plants of known truth with a loop that holds them, noise and limits. Comments say of every number
from where it is, or that it was chosen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from ambid.errors import ModelError, choices
from ambid.physics.loop import Limits, Loop, Noise, placed_loop
from ambid.physics.magnet import DifferentialPair, SingleMagnet
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.physics.shaft import Disc, Material, Shaft, Step


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """A named bench."""

    name: str  # name for the command line, and one line that describes it
    summary: str
    parameters: Mapping[str, float]  # truth of the linear model `model` in SI units: m, k_x, k_i, R, L, c
    loop: Loop  # controller and delay; stable on the linear plant at `rate_hz`
    usually_closed: bool = True  # whether a record is taken in closed loop unless told otherwise
    noise: Noise  # sensor and process noise
    limits: Limits  # voltage, current and stops
    rate_hz: float  # sampling rate in Hz that the loop is designed for
    model: str = "one-axis"  # name of the linear model
    plant: NonlinearPlant | None = None  # the nonlinear plant whose linearisation `parameters` is, where there is one
    operating_point: OperatingPoint = field(default_factory=OperatingPoint)  # where the bench rests: m, A, V
    # gains of sensors and amplifiers with their units, where the source gives them
    instruments: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    rotor: RotorBody | None = None  # of a rotor on many axes; loop, limits and noise are those of every axis

    def __post_init__(self) -> None:
        for name in ("parameters", "instruments"):  # nobody changes what a name stands for
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))


def _thesis() -> Preset:
    parameters = {"m": 0.1, "k_x": 587.22, "k_i": -310.08, "R": 1.25, "L": 59.6e-3, "c": 0.0}
    # Sources: m, k_x, k_i: thesis table 4.1; L: thesis table 4.1, printed 5.96e-2 mH, (4.10) needs 59.6 mH; R:
    # thesis table 4.1, printed 1.8 ohm, (4.10) needs 1.25 ohm; c: thesis eq. 4.8: none; loop, noise, limits,
    # rate_hz: chosen, travel of 20 mm as in thesis ch. 5
    return Preset(
        name="thesis",
        summary="the thesis's simulation rig: stable, poles -0.0076 and -10.5 +- 4017j rad/s",
        parameters=parameters,
        loop=placed_loop(parameters, (-400 + 3990j, -400 - 3990j, -40, -10), derivative_cutoff_hz=3000.0, delay=0.0),
        usually_closed=False,
        noise=Noise(position=5e-7, current=1e-4),
        limits=Limits(voltage=(-24.0, 24.0), current=(-2.0, 2.0), position=(-0.01, 0.01)),
        rate_hz=10_000.0,
    )


def _unstable_bearing() -> Preset:
    magnet = DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392, leakage=2e-3)
    plant = NonlinearPlant(magnet=magnet, m=4.0, R=1.6)
    parameters = plant.linearise(0.0)
    # Sources: turns, area, bias, gap, half_angle: given for this bench, k_i and k_x follow (theory.md sec. 1); L:
    # follows from the geometry (24.07 mH) and a chosen leakage of 2 mH, both coils; m, loop, noise, limits,
    # rate_hz: chosen; R: chosen, both coils; limits.current: the bias: neither coil reverses
    return Preset(
        name="unstable-bearing",
        summary="differential bearing: 138 turns, 470.3 mm2, bias 1 A, gap 0.432 mm; k_i 55.7 N/A, k_x -1.29e5 N/m",
        parameters=parameters,
        plant=plant,
        loop=placed_loop(parameters, (-600, -120 + 120j, -120 - 120j, -20), derivative_cutoff_hz=1500.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=2e-3, force=1.0, voltage=0.05),
        limits=Limits(voltage=(-48.0, 48.0), current=(-1.0, 1.0), position=(-0.2e-3, 0.2e-3)),
        rate_hz=20_000.0,
    )


def _rmit_axis() -> Preset:
    parameters = {"m": 2.0, "k_x": -150_000.0, "k_i": 61.0, "R": 2.0, "L": 30e-3, "c": 0.0}
    # Sources: k_i: thesis sec. 1.4, eq. 1.6; k_x: thesis sec. 1.4, eq. 1.6: 150 000 N/m, there F = k_x x + k_i i;
    # limits.position, position_sensor, amplifier: thesis sec. 1.4; m, R, loop, noise, voltage and current limits,
    # rate_hz: chosen; L: chosen, above k_i^2/abs(k_x) = 24.8 mH that the magnet's own energy needs
    return Preset(
        name="rmit-axis",
        summary="one axis of the RMIT bearing: 61 N/A, -150 000 N/m, air gap 0.35 mm",
        parameters=parameters,
        loop=placed_loop(parameters, (-800, -180 + 180j, -180 - 180j, -20), derivative_cutoff_hz=1500.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=1e-3, force=0.5, voltage=0.05),
        limits=Limits(voltage=(-60.0, 60.0), current=(-2.0, 2.0), position=(-350e-6, 350e-6)),
        rate_hz=20_000.0,
        instruments={"position_sensor": (4000.0, "V/m"), "amplifier": (-0.2, "A/V")},
    )


def _levitated_ball() -> Preset:
    m, gravity, gap, current = 0.06, 9.81, 0.010, 0.95
    k = 2.0 * m * gravity * (gap / current) ** 2
    plant = NonlinearPlant(magnet=SingleMagnet(k=k, leakage=0.104), m=m, R=4.2, gravity=gravity)
    parameters = plant.linearise(gap)
    # Sources: k_i, k_x: gravity balance at the chosen rest point: k_i = -2 m g/i0, k_x = -2 m g/x0; m, R,
    # leakage, rest point, loop, noise, limits, rate_hz: chosen
    return Preset(
        name="levitated-ball",
        summary="a ball under one magnet: position is the gap, rest at 10 mm and 0.95 A",
        parameters=parameters,
        plant=plant,
        operating_point=plant.equilibrium(gap),
        loop=placed_loop(parameters, (-150, -40 + 30j, -40 - 30j, -2), derivative_cutoff_hz=400.0, delay=1.0),
        noise=Noise.held(rate_hz=2000.0, position=2e-6, current=1e-3, force=2e-3, voltage=0.02),
        limits=Limits(voltage=(0.0, 12.0), current=(0.0, 2.5), position=(0.002, 0.020)),
        rate_hz=2000.0,
    )


def _prototype() -> Preset:
    magnet = DifferentialPair(turns=600, area=400e-6, bias=1.0, gap=3e-3, half_angle=0.0, leakage=20e-3)
    plant = NonlinearPlant(magnet=magnet, m=0.3, R=6.0)
    parameters = plant.linearise(0.0)
    rate_hz, volts, counts = 2000.0, 24.0, 800
    position_step, current_step = 2.5e-3 / 1024, 2.5 / 1024
    # Sources: supply: 12 V battery, thesis ch. 5, a full bridge is chosen, so that the coil sees both signs;
    # position_resolution, current_resolution: 10 bits over 2.5 mm and 2.5 A, chosen; voltage_resolution: 800
    # counts of pulse width over +-12 V; turns, area, bias, gap, leakage, m, R, loop, noise, limits.position,
    # rate_hz: chosen; limits.voltage: pulse width of 2.5 to 97.5 %: a bridge with a charge pump needs its pause;
    # limits.current: the bias: neither coil reverses; loop.delay: the controller's 175 us
    # (firmware/amb_daq/README.md)
    return Preset(
        name="prototype",
        summary="table-top bearing on an Arduino Uno: 12 V bridge, 10 bits, 2 kHz; k_i 20.1 N/A, k_x -6702 N/m",
        parameters=parameters,
        plant=plant,
        loop=placed_loop(parameters, (-320, -80 + 80j, -80 - 80j, -16), derivative_cutoff_hz=300.0, delay=0.35),
        noise=Noise(
            position=2e-6,
            current=2e-3,
            force=0.01,
            position_resolution=position_step,
            current_resolution=current_step,
            voltage_resolution=volts / counts,
        ),
        limits=Limits(voltage=(-11.4, 11.4), current=(-1.0, 1.0), position=(-1e-3, 1e-3)),
        rate_hz=rate_hz,
        instruments={
            "position_sensor": (5.0 / 2.5e-3, "V/m"),
            "current_sensor": (5.0 / 2.5, "V/A"),
            "pulse_width": (volts / counts, "V"),
        },
    )


_STEEL = Material(E=2.11e11, rho=7850.0, nu=0.3)
_RPM = 2.0 * math.pi / 60.0


def _radial(name: str, axes: tuple[str, str], z: float, z_sensor: float) -> Bearing:
    return Bearing(name=name, axes=axes, z=z, z_sensors=(z_sensor,))


def _of_pair(axes: tuple[str, ...], magnet: DifferentialPair, resistance: float) -> dict[str, float]:
    """Return k_i, k_x, R and L at the centre of a pair on each axis."""
    w = magnet.coenergy
    numbers = {"k_i": w.force_per_current(0.0, 0.0), "k_x": w.displacement_coefficient(0.0, 0.0)}
    numbers |= {"R": resistance, "L": w.inductance(0.0)}
    return {f"{axis}.{name}": value for axis in axes for name, value in numbers.items()}


def _utrc() -> Preset:
    axes = ("ax", "ay", "bx", "by")
    magnet = DifferentialPair(turns=100, area=600e-6, bias=2.0, gap=0.5e-3, half_angle=0.392, leakage=2e-3)
    steps = ((0.06, 0.030), (0.08, 0.045), (0.23, 0.030), (0.06, 0.050), (0.23, 0.030), (0.08, 0.045), (0.06, 0.030))
    shaft = Shaft(
        material=_STEEL,
        steps=tuple(Step(length=length, diameter=diameter) for length, diameter in steps),
        discs=(Disc(z=0.40, m=2.5, Id=4.0e-3, Ip=7.5e-3), Disc(z=0.76, m=0.7, Id=6.0e-4, Ip=1.1e-3)),
        zeta=(0.01, 0.01, 0.01),
    )
    model = RotorModel(
        bearings=(_radial("A", ("ax", "ay"), 0.085, 0.060), _radial("B", ("bx", "by"), 0.690, 0.665)),
        speed=15_000.0 * _RPM, polar=True, n_modes=3,
        extras=("a", *(f"{axis}.sensor_pole" for axis in axes)),
    )  # fmt: skip
    sensors = {f"{axis}.sensor_pole": 2.0 * math.pi * 8000.0 for axis in axes}
    # Sources: speed: thesis sec. 1.3: 15 000 rpm, above the first bending critical speed; modes: thesis sec. 1.3:
    # three bending modes, damping 1 %, the shaft is chosen; a: thesis eq. 1.4, its value is chosen; loop.kc: the
    # amplifier of thesis eq. 1.5, K H = kc with H = 1, its value is chosen; sensor_pole: thesis sec. 1.3: sensors
    # as low-pass filters, the value is chosen; magnets, planes, unbalance, runout, loop, noise, limits, rate_hz:
    # chosen
    return Preset(
        name="utrc",
        summary="the UTRC facility: flexible rotor at 15 000 rpm above its first bending mode, four axes, eddy pole",
        model="rotor",
        parameters={**_of_pair(axes, magnet, 1.2), **sensors, "a": 2.0 * math.pi * 1200.0},
        rotor=RotorBody(
            model=model, shaft=shaft, gap=magnet.gap, sigma=0.01,
            unbalance=(Turning(name="disc", value=8e-6, phase=0.7, z=0.40),),
            runout=(Turning(name="A", value=0.5e-6, phase=1.1), Turning(name="B", value=0.4e-6, phase=-0.6)),
        ),
        loop=Loop(kp=3.8e5, ki=3.0e6, kd=850.0, kc=60.0, derivative_cutoff_hz=3000.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=0.2e-6, current=3e-3, force=0.5, voltage=0.05),
        limits=Limits(voltage=(-200.0, 200.0), current=(-2.0, 2.0), position=(-0.25e-3, 0.25e-3)),
        rate_hz=20_000.0,
    )  # fmt: skip


def _rmit() -> Preset:
    axes = ("xL", "yL", "xR", "yR")
    numbers = {"k_i": 61.0, "k_x": -150_000.0, "R": 2.0, "L": 30e-3}
    rigid = {"m": 4.0, "Id": 0.0365, "z_cg": 0.20}
    # Sources: k_i: thesis sec. 1.4, eq. 1.6; k_x: thesis sec. 1.4, eq. 1.6: 150 000 N/m, there F = k_x x + k_i i;
    # limits.position: thesis sec. 1.4: clearance of the actuators; position_sensor, amplifier: thesis sec. 1.4;
    # m, Id, planes, R, loop, noise, limits, rate_hz: chosen; L: chosen, above k_i^2/abs(k_x) = 24.8 mH that the
    # magnet's own energy needs; gap: chosen: the clearance and 0.05 mm of iron and cover
    return Preset(
        name="rmit",
        summary="the RMIT rotor on four axes: 61 N/A, -150 000 N/m, air gap 0.35 mm",
        model="rotor",
        parameters={**rigid, **{f"{axis}.{name}": x for axis in axes for name, x in numbers.items()}},
        rotor=RotorBody(
            model=RotorModel(bearings=(_radial("L", axes[:2], 0.07, 0.04), _radial("R", axes[2:], 0.33, 0.36))),
            gap=0.40e-3,
        ),
        loop=Loop(kp=1.7e5, ki=1.5e6, kd=330.0, kc=40.0, derivative_cutoff_hz=1500.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=1e-3, force=0.5, voltage=0.05),
        limits=Limits(voltage=(-60.0, 60.0), current=(-0.9, 0.9), position=(-350e-6, 350e-6)),
        rate_hz=20_000.0,
        instruments={"position_sensor": (4000.0, "V/m"), "amplifier": (-0.2, "A/V")},
    )


def _central_mass() -> Preset:
    axes = ("ax", "ay", "bx", "by")
    magnet = DifferentialPair(turns=110, area=300e-6, bias=1.5, gap=0.45e-3, half_angle=0.392, leakage=1.5e-3)
    steps = ((0.05, 0.016), (0.06, 0.036), (0.17, 0.020), (0.04, 0.030), (0.17, 0.020), (0.06, 0.036), (0.08, 0.016))
    shaft = Shaft(
        material=_STEEL,
        steps=tuple(Step(length=length, diameter=diameter) for length, diameter in steps),
        discs=(Disc(z=0.30, m=2.0, Id=2.0e-3, Ip=3.8e-3),),
        zeta=(0.005, 0.005),
    )
    # Sources: two bearings, central mass: thesis ch. 6, fig. 6.1; shaft, mass, magnets, planes, speed, unbalance:
    # chosen, the thesis prints none; loop, noise, limits, rate_hz: chosen
    return Preset(
        name="central-mass",
        summary="the thesis's proposal: two bearings, a central mass between them; two bending modes, 3000 rpm",
        model="rotor",
        parameters=_of_pair(axes, magnet, 1.0),
        rotor=RotorBody(
            model=RotorModel(
                bearings=(_radial("A", axes[:2], 0.075, 0.100), _radial("B", axes[2:], 0.525, 0.500)),
                speed=3000.0 * _RPM, polar=True, n_modes=2,
            ),
            shaft=shaft, gap=magnet.gap, sigma=0.01,
            unbalance=(Turning(name="mass", value=20e-6, phase=1.0, z=0.30),),
        ),
        loop=Loop(kp=1.8e5, ki=1.8e6, kd=450.0, kc=25.0, derivative_cutoff_hz=2500.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=0.2e-6, current=2e-3, force=0.3, voltage=0.05),
        limits=Limits(voltage=(-100.0, 100.0), current=(-1.5, 1.5), position=(-0.2e-3, 0.2e-3)),
        rate_hz=20_000.0,
    )  # fmt: skip


def _spindle() -> Preset:
    axes = ("ax", "ay", "bx", "by", "az")
    magnet = DifferentialPair(turns=80, area=250e-6, bias=2.0, gap=0.4e-3, half_angle=0.392, leakage=1e-3)
    rigid = {"m": 2.2, "Id": 0.0072, "Ip": 0.0011, "z_cg": 0.11}
    # Sources: numbers, loop, noise, limits, rate_hz: chosen
    return Preset(
        name="spindle",
        summary="a rigid spindle on five axes at 30 000 rpm",
        model="rotor",
        parameters={**rigid, **_of_pair(axes, magnet, 0.8)},
        rotor=RotorBody(
            model=RotorModel(
                bearings=(
                    _radial("A", axes[:2], 0.04, 0.02), _radial("B", axes[2:4], 0.17, 0.19),
                    Bearing(name="T", axes=("az",), axial=True),
                ),
                speed=30_000.0 * _RPM, polar=True,
            ),
            gap=magnet.gap, sigma=0.01,
            unbalance=(Turning(name="nose", value=0.5e-6, phase=-0.4, z=0.19),),
        ),
        loop=Loop(kp=2.1e5, ki=1.8e6, kd=400.0, kc=20.0, derivative_cutoff_hz=3000.0, delay=1.0),
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=2e-3, force=0.2, voltage=0.05),
        limits=Limits(voltage=(-80.0, 80.0), current=(-2.0, 2.0), position=(-0.2e-3, 0.2e-3)),
        rate_hz=20_000.0,
    )  # fmt: skip


_ROTORS = {"utrc": _utrc, "rmit": _rmit, "central-mass": _central_mass, "spindle": _spindle}
_MAKERS = {
    "thesis": _thesis,
    "unstable-bearing": _unstable_bearing,
    "rmit-axis": _rmit_axis,
    "levitated-ball": _levitated_ball,
    "prototype": _prototype,
    **_ROTORS,
}


def preset_names(*, rotors: bool | None = None) -> tuple[str, ...]:
    """Return the names of all presets.

    Parameters
    ----------
    rotors : bool, optional
        Only those with a rotor on many axes, or only those without; default both.

    Returns
    -------
    tuple of str
    """
    return tuple(name for name in _MAKERS if rotors in (None, name in _ROTORS))


def preset(name: str) -> Preset:
    """Return the bench called `name`.

    Parameters
    ----------
    name : str
        One of `preset_names`.

    Returns
    -------
    Preset

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in _MAKERS:
        raise ModelError(f"preset {name!r} is unknown; known: {choices(name, _MAKERS)} Give one of them")
    return _MAKERS[name]()


def preset_of(name: str) -> Preset | None:
    """Take a word for a preset if it is one, or cannot be a file; None for a path."""
    if name in _MAKERS or not (Path(name).exists() or Path(name).suffix or len(Path(name).parts) > 1):
        return preset(name)
    return None
