"""Named benches: plants of known truth with a loop that holds them, noise and limits.

What a source prints is given with its source; everything else is chosen, and `Preset.sources` says so for every number.
"""

from __future__ import annotations

from pathlib import Path

from ambid.errors import ModelError, nearest
from ambid.physics.loop import Limits, Noise, placed_loop
from ambid.physics.magnet import DifferentialPair, SingleMagnet
from ambid.physics.named_bench import Preset as Preset
from ambid.physics.nonlinear import NonlinearPlant
from ambid.physics.rotor_presets import ROTOR_MAKERS


def _thesis() -> Preset:
    parameters = {"m": 0.1, "k_x": 587.22, "k_i": -310.08, "R": 1.25, "L": 59.6e-3, "c": 0.0}
    table = "thesis table 4.1"
    return Preset(
        name="thesis",
        summary="the thesis's simulation rig: stable, poles -0.0076 and -10.5 +- 4017j rad/s",
        parameters=parameters,
        loop=placed_loop(parameters, (-400 + 3990j, -400 - 3990j, -40, -10), derivative_cutoff_hz=3000.0, delay=0.0),
        usually_closed=False,
        noise=Noise(position=5e-7, current=1e-4),
        limits=Limits(voltage=(-24.0, 24.0), current=(-2.0, 2.0), position=(-0.01, 0.01)),
        rate_hz=10_000.0,
        sources={
            "m": table,
            "k_x": table,
            "k_i": table,
            "L": f"{table}, printed 5.96e-2 mH; (4.10) needs 59.6 mH",
            "R": f"{table}, printed 1.8 ohm; (4.10) needs 1.25 ohm",
            "c": "thesis eq. 4.8: none",
            "loop, noise, limits, rate_hz": "chosen; travel of 20 mm as in thesis ch. 5",
        },
    )


def _unstable_bearing() -> Preset:
    magnet = DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392, leakage=2e-3)
    plant = NonlinearPlant(magnet=magnet, m=4.0, R=1.6)
    parameters = plant.linearise(0.0)
    return Preset(
        name="unstable-bearing",
        summary="differential bearing: 138 turns, 470.3 mm2, bias 1 A, gap 0.432 mm; k_i 55.7 N/A, k_x -1.29e5 N/m",
        parameters=parameters,
        plant=plant,
        loop=placed_loop(parameters, (-600, -120 + 120j, -120 - 120j, -20), derivative_cutoff_hz=1500.0, delay=1.0),
        usually_closed=True,
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=2e-3, force=1.0, voltage=0.05),
        limits=Limits(voltage=(-48.0, 48.0), current=(-1.0, 1.0), position=(-0.2e-3, 0.2e-3)),
        rate_hz=20_000.0,
        sources={
            "turns, area, bias, gap, half_angle": "given for this bench; k_i and k_x follow (theory.md sec. 1)",
            "L": "follows from the geometry (24.07 mH) and a chosen leakage of 2 mH, both coils",
            "m": "chosen",
            "R": "chosen, both coils",
            "limits.current": "the bias: neither coil reverses",
            "loop, noise, limits, rate_hz": "chosen",
        },
    )


def _rmit_axis() -> Preset:
    parameters = {"m": 2.0, "k_x": -150_000.0, "k_i": 61.0, "R": 2.0, "L": 30e-3, "c": 0.0}
    source = "thesis sec. 1.4"
    return Preset(
        name="rmit-axis",
        summary="one axis of the RMIT bearing: 61 N/A, -150 000 N/m, air gap 0.35 mm",
        parameters=parameters,
        loop=placed_loop(parameters, (-800, -180 + 180j, -180 - 180j, -20), derivative_cutoff_hz=1500.0, delay=1.0),
        usually_closed=True,
        noise=Noise.held(rate_hz=20_000.0, position=1e-7, current=1e-3, force=0.5, voltage=0.05),
        limits=Limits(voltage=(-60.0, 60.0), current=(-2.0, 2.0), position=(-350e-6, 350e-6)),
        rate_hz=20_000.0,
        sources={
            "k_i": f"{source}, eq. 1.6",
            "k_x": f"{source}, eq. 1.6: 150 000 N/m, there F = k_x x + k_i i",
            "limits.position": source,
            "position_sensor": source,
            "amplifier": source,
            "m": "chosen",
            "R": "chosen",
            "L": "chosen, above k_i^2/abs(k_x) = 24.8 mH that the magnet's own energy needs",
            "loop, noise, voltage and current limits, rate_hz": "chosen",
        },
        instruments={"position_sensor": (4000.0, "V/m"), "amplifier": (-0.2, "A/V")},
    )


def _levitated_ball() -> Preset:
    m, gravity, gap, current = 0.06, 9.81, 0.010, 0.95
    k = 2.0 * m * gravity * (gap / current) ** 2
    plant = NonlinearPlant(magnet=SingleMagnet(k=k, leakage=0.104), m=m, R=4.2, gravity=gravity)
    parameters = plant.linearise(gap)
    return Preset(
        name="levitated-ball",
        summary="a ball under one magnet: position is the gap, rest at 10 mm and 0.95 A",
        parameters=parameters,
        plant=plant,
        operating_point=plant.equilibrium(gap),
        loop=placed_loop(parameters, (-150, -40 + 30j, -40 - 30j, -2), derivative_cutoff_hz=400.0, delay=1.0),
        usually_closed=True,
        noise=Noise.held(rate_hz=2000.0, position=2e-6, current=1e-3, force=2e-3, voltage=0.02),
        limits=Limits(voltage=(0.0, 12.0), current=(0.0, 2.5), position=(0.002, 0.020)),
        rate_hz=2000.0,
        sources={
            "k_i, k_x": "gravity balance at the chosen rest point: k_i = -2 m g/i0, k_x = -2 m g/x0",
            "m, R, leakage, rest point": "chosen",
            "loop, noise, limits, rate_hz": "chosen",
        },
    )


def _prototype() -> Preset:
    magnet = DifferentialPair(turns=600, area=400e-6, bias=1.0, gap=3e-3, half_angle=0.0, leakage=20e-3)
    plant = NonlinearPlant(magnet=magnet, m=0.3, R=6.0)
    parameters = plant.linearise(0.0)
    rate_hz, volts, counts = 2000.0, 24.0, 800
    position_step, current_step = 2.5e-3 / 1024, 2.5 / 1024
    return Preset(
        name="prototype",
        summary="table-top bearing on an Arduino Uno: 12 V bridge, 10 bits, 2 kHz; k_i 20.1 N/A, k_x -6702 N/m",
        parameters=parameters,
        plant=plant,
        loop=placed_loop(parameters, (-320, -80 + 80j, -80 - 80j, -16), derivative_cutoff_hz=300.0, delay=0.35),
        usually_closed=True,
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
        sources={
            "supply": "12 V battery, thesis ch. 5; a full bridge is chosen, so that the coil sees both signs",
            "position_resolution, current_resolution": "10 bits over 2.5 mm and 2.5 A, chosen",
            "voltage_resolution": "800 counts of pulse width over +-12 V",
            "turns, area, bias, gap, leakage, m, R": "chosen",
            "limits.voltage": "pulse width of 2.5 to 97.5 %: a bridge with a charge pump needs its pause",
            "limits.current": "the bias: neither coil reverses",
            "loop.delay": "the controller's 175 us (firmware/amb_daq/README.md)",
            "loop, noise, limits.position, rate_hz": "chosen",
        },
        instruments={
            "position_sensor": (5.0 / 2.5e-3, "V/m"),
            "current_sensor": (5.0 / 2.5, "V/A"),
            "pulse_width": (volts / counts, "V"),
        },
    )


_MAKERS = {
    "thesis": _thesis,
    "unstable-bearing": _unstable_bearing,
    "rmit-axis": _rmit_axis,
    "levitated-ball": _levitated_ball,
    "prototype": _prototype,
    **ROTOR_MAKERS,
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
        Names for the command line.
    """
    return tuple(name for name in _MAKERS if rotors in (None, name in ROTOR_MAKERS))


def preset(name: str) -> Preset:
    """Return the bench called `name`.

    Parameters
    ----------
    name : str
        One of `preset_names`.

    Returns
    -------
    Preset
        The bench.

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in _MAKERS:
        known = list(_MAKERS)
        raise ModelError(
            f"preset {name!r} is unknown; known: {', '.join(known)}.{nearest(name, known)} Give one of them"
        )
    return _MAKERS[name]()


def preset_of(name: str) -> Preset | None:
    """Take a word for a preset if it is one, or cannot be a file; None for a path."""
    if name in _MAKERS or not (Path(name).exists() or Path(name).suffix or len(Path(name).parts) > 1):
        return preset(name)
    return None
