"""Results for other programs: matrices and numbers as ``.mat``, a rotor as a script for ROSS.

ROSS reads the stiffness of a bearing at the running speed only. A magnet under control has another one at every
frequency, so that its bearings stand for the synchronous frequency alone; the whole plant is beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.bearing.magnet_result import NonlinearBearingEstimate, linearised
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.prediction import plant_form
from ambid.errors import EstimationError
from ambid.job.files import EXPORT_ENDINGS
from ambid.physics.linear_model import model
from ambid.physics.shaft import Disc, Material, Shaft, Step
from ambid.rotor.estimate import RotorEstimate

_STILL = 1.0  # Hz at which the bearings of a rotor at rest are read
_STIFF, _LIGHT, _THICK = 1e14, 1e-3, 0.05  # E, rho and diameter of the shaft of a rotor without drawing


def plant_of(result: Any) -> Any:
    """Return the model of a linear result, whose inputs and outputs have names."""
    return result.plant if isinstance(result, RotorEstimate) else model(result.model)


def export(result: Any, path: str | Path) -> None:
    """Write a linear result for another program, by the ending of the file."""
    path = Path(path)
    if path.suffix == ".mat":
        _save_mat(path, _matrices(result))
    elif path.suffix == ".py":
        if not isinstance(result, RotorEstimate):
            raise EstimationError("a script for ROSS holds a rotor; this result is none. Give a file ending in .mat")
        path.write_text(ross_script(result), encoding="utf-8")
    else:
        raise EstimationError(f"{path.name} ends in none of {', '.join(EXPORT_ENDINGS)}. Give one of these endings")


def _save_mat(path: Path, content: dict[str, Any]) -> None:
    from scipy.io import savemat

    savemat(path, content, long_field_names=True, oned_as="column")


def _matrices(result: Any) -> dict[str, Any]:
    """Return what a ``.mat`` file holds: the plant by name, numbers as columns."""
    if isinstance(result, BlackBoxFit):
        form = plant_form(result)
        names = {"inputs": result.inputs, "outputs": result.outputs}
        found = {"A": form.A, "B": form.B, "C": form.C, "D": form.D, "sample_time_s": form.dt}
        return found | {name: _cells(x) for name, x in names.items()}
    at, plant = (
        linearised(result) if isinstance(result, NonlinearBearingEstimate) else result.continuous,
        plant_of(result),
    )
    delay = result.delay if isinstance(result.delay, dict) else {}
    found = {
        "A": at.A, "B": at.B, "C": at.C, "D": np.zeros((at.C.shape[0], at.B.shape[1])), "states": _cells(at.states),
        "inputs": _cells(plant.inputs), "outputs": _cells(plant.outputs),
        "delay_samples": np.array([_late(delay, role) for role in plant.inputs]),
        "parameters": _cells(p.name for p in result.parameters), "units": _cells(p.unit for p in result.parameters),
        "value": np.array([p.value for p in result.parameters]), "sd": np.array([p.sd for p in result.parameters]),
    }  # fmt: skip
    if isinstance(result, RotorEstimate):
        modes = result.modes
        found |= {
            "speed_rad_s": result.speed, "rate_hz": float(str(result.record["rate_hz"])),
            "mode_hz": np.array([m.frequency_hz.value for m in modes]),
            "mode_damping": np.array([m.damping.value for m in modes]),
            "mode_shape": np.array([[m.shape[p].value for p in result.plant.places] for m in modes]),
            "mode_places": _cells(result.plant.places),
        }  # fmt: skip
    return found


def _cells(names: Any) -> Any:
    return np.array(list(names), dtype=object)


def _late(delay: Any, role: str) -> float:
    return float(delay[role].samples + delay[role].fraction) if role in delay else 0.0


# --- ROSS -----------------------------------------------------------------------------------------------------------


def ross_script(estimate: RotorEstimate) -> str:
    """Return a Python script that builds the rotor for ROSS, with its state space."""
    from ambid.rig import rig_from_text

    rig = rig_from_text(str(estimate.rig["text"]), str(estimate.rig["name"]))
    theta, plant = estimate.numbers, estimate.plant
    frequency = abs(estimate.speed) / (2.0 * np.pi) or _STILL
    K = _controller(estimate, rig, frequency)
    planes = [theta[place] for place in plant.places]
    shaft = rig.shaft or _rigid(planes, theta)
    z = np.asarray(shaft.free_rotor(1, planes=[*planes, theta["z_cg"]]).z)
    stiffness = [_stiffness(estimate, K, frequency, j) for j in range(len(plant.axes))]
    read = "the loop and the magnets" if K is not None else "the magnets alone (no controller is known)"
    of = "the drawing" if rig.shaft else "m, Id and Ip on a shaft that does not bend (no drawing is known)"
    return "\n".join([
        f'"""{estimate.rig["name"]}: a rotor for ROSS, as identified.', "",
        f"Shaft: {of}. Bearings: synchronous, {read} at {frequency:.6g} Hz; at other frequencies they are wrong.",
        'The identified plant, all frequencies, is state_space(): x\' = A x + B u, y = C x, SI.', '"""', "",
        "import numpy as np", "import ross as rs", "", f"SPEED = {estimate.speed!r}  # rad/s",
        f"INPUTS = {list(plant.inputs)}", f"OUTPUTS = {list(plant.outputs)}",
        f"STATES = {list(estimate.continuous.states)}", "", "", "def rotor():",
        '    """Return the rotor: shaft, discs, bearings."""', *_elements(shaft, z),
        "    discs = [", *_discs(shaft, z), "    ]", "    bearings = [", *_bearings(estimate, stiffness, z),
        "    ]", "    return rs.Rotor(shaft, discs, bearings)", "", "", "def state_space():",
        '    """Return A, B, C."""',
        *(f"    {x} = np.array({getattr(estimate.continuous, x).tolist()})" for x in "ABC"),
        "    return A, B, C", "", "", 'if __name__ == "__main__":',
        "    print(rotor().run_modal(SPEED).wd / (2 * np.pi), \"Hz\")", "",
    ])  # fmt: skip


def _rigid(planes: list[float], theta: Mapping[str, float]) -> Shaft:
    """Return a light, stiff shaft through all planes with the mass of a rotor without drawing as one disc."""
    low, high = min(*planes, theta["z_cg"]), max(*planes, theta["z_cg"])
    disc = Disc(z=theta["z_cg"], m=theta["m"], Id=theta["Id"], Ip=theta.get("Ip", 0.0))
    steps = (Step(length=high - low, diameter=_THICK),)
    return Shaft(steps=steps, discs=(disc,), material=Material(E=_STIFF, rho=_LIGHT), z=low, elements=1)


def _elements(shaft: Shaft, z: Array) -> list[str]:
    """Return the shaft's elements from node to node."""
    ends = shaft.z + np.cumsum([step.length for step in shaft.steps])
    materials = list(dict.fromkeys(step.material or shaft.material for step in shaft.steps))
    lines = [
        f'    material{k} = rs.Material(name="material{k}", rho={m.rho!r}, E={m.E!r}, Poisson={m.nu!r})'
        for k, m in enumerate(materials)
    ]
    lines.append("    shaft = [")
    for a, b in pairwise(z.tolist()):
        step = shaft.steps[min(int(np.searchsorted(ends, (a + b) / 2.0)), len(shaft.steps) - 1)]
        k = materials.index(step.material or shaft.material)
        lines.append(
            f"        rs.ShaftElement(L={b - a!r}, idl={step.bore!r}, odl={step.diameter!r}, material=material{k}),"
        )
    return [*lines, "    ]"]


def _discs(shaft: Shaft, z: Array) -> list[str]:
    return [f"        rs.DiskElement(n={_node(z, d.z)}, m={d.m!r}, Id={d.Id!r}, Ip={d.Ip!r})," for d in shaft.discs]


def _bearings(estimate: RotorEstimate, stiffness: list[complex], z: Array) -> list[str]:
    """Return the bearings, stiffness and damping of each axis at the synchronous frequency."""
    theta, plant, lines = estimate.numbers, estimate.plant, []
    W = abs(estimate.speed) or 2.0 * np.pi * _STILL
    for b in plant.bearings:
        node = _node(z, theta["z_cg"] if b.axial else theta[f"{b.name}.z"])
        words = {"kxx": 0.0, "kyy": 0.0, "cxx": 0.0, "cyy": 0.0}
        for plane, axis in zip("z" if b.axial else "xy", b.axes, strict=False):
            k = stiffness[plant.axes.index(axis)]
            words |= {f"k{plane}{plane}": k.real, f"c{plane}{plane}": k.imag / W}
        said = ", ".join(f"{name}={x:.9g}" for name, x in words.items())
        lines.append(f'        rs.BearingElement(n={node}, {said}, tag="{b.name}"),  # synchronous')
    return lines


def _node(z: Array, at: float) -> int:
    return int(np.argmin(np.abs(z - at)))


def _controller(estimate: RotorEstimate, rig: Any, frequency_hz: float) -> Complex | None:
    """Return the controller at a frequency, from outputs to inputs, without sign; None where none is known."""
    from ambid.job.closed_loop import loop_of, spectra_of
    from ambid.rotor.synchronous import separate

    spectra, speed, of = None, estimate.speed, estimate.plant
    if estimate.used:
        speeds = [abs(float(str(r["speed"]))) for r in estimate.records]
        spectra = spectra_of(separate(estimate.used[int(np.argmax(speeds))], of, speed).record, of, speed)
    try:
        loop = loop_of(estimate, rig, float(str(estimate.record["rate_hz"])), spectra, speed)
    except EstimationError:
        return None
    return np.asarray(loop.at(np.array([frequency_hz])).K[0])


def _stiffness(estimate: RotorEstimate, K: Complex | None, frequency_hz: float, j: int) -> complex:
    """Return -f/x of one axis at a frequency, as if its sensors stood at the magnet.

    i = -(K_x late + k_i s) x/(R + L s + K_i late) of a coil, f = k_i a/(s + a) i - k_x x.
    """
    theta, plant, axis = estimate.numbers, estimate.plant, estimate.plant.axes[j]
    s = 2j * np.pi * frequency_hz
    k_i, k_x = theta[f"{axis}.k_i"], theta[f"{axis}.k_x"]
    pull = k_i * (theta["a"] / (s + theta["a"]) if "a" in plant.extras else 1.0)
    if K is None:
        return complex(k_x)
    rate = float(str(estimate.record["rate_hz"]))
    late = np.exp(-s * (_late(estimate.delay, plant.inputs[j]) + 0.5 * (plant.drive(j) != "current")) / rate)
    rows = [k for k, (of, _) in enumerate(plant.sensors) if of == j]
    by_position = complex(K[j, rows].sum()) * late
    if plant.drive(j) == "voltage":
        row = plant.outputs.index(f"{axis}_current")
        ratio = (by_position + k_i * s) / (theta[f"{axis}.R"] + theta[f"{axis}.L"] * s + complex(K[j, row]) * late)
    elif plant.drive(j) == "command":
        pole = theta[f"{axis}.amplifier_pole"]
        ratio = theta[f"{axis}.amplifier_gain"] * pole / (s + pole) * by_position
    else:
        ratio = by_position
    return complex(k_x + pull * ratio)
