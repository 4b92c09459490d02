"""The nonlinear magnets of a rotor: pole pairs, from the linear numbers of each axis and the air gap.

A pole pair with gap d and coil current j has W' = k h(j)/d, h = j^2/(1 + sqrt(1 + sigma j^2)) (thesis eq. 1.9 for
sigma = 0; `physics.coenergy_law`). The sum of all is one co-energy of the positions and currents of all axes, so that
force and back-EMF agree. Two opposed pairs on an axis have, at the centre and with gap s, bias i0 and pole faces that
the axis meets at an angle with the cosine c,

    k_i = 2 c k h'(i0)/s^2,   k_x = -4 c^2 k h(i0)/s^3,   L = 2 k h''(i0)/s + leakage,

so k, i0 and leakage follow from k_i, k_x, L and s. Conical pole faces at an angle to the shaft have c = cos(cone), and
act with sin(cone) along it: a current of the axial axis adds half of itself to every coil of the bearing that pulls to
+z and takes as much from those of the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RigError
from ambid.physics.rotor_model import RotorModel
from ambid.rig.rig import Rig

_SAME = 1e-3  # how well numbers of an axial axis have to agree with those of the cones


class Poles(NamedTuple):
    """Pole pairs of a rotor, as the compiled loop takes them."""

    numbers: Array  # (n_poles, 8): k, gap, bias, sigma; direction and winding on the first axis and on the second
    axes: NDArray[np.int64]  # (n_poles, 2): first axis, second or -1
    leakage: Array  # (n_axes,), H


def poles_of(rig: Rig, of: RotorModel, theta: Mapping[str, float]) -> Poles:
    """Return the pole pairs that have the linear numbers of a rig at its centre.

    Raises `RigError` where there is no gap, or no magnet can have these numbers.
    """
    known, where = rig.magnet, f"rig {rig.name!r}"
    gap = None if known is None else known.known("s")
    if known is None or gap is None or not gap.value or gap.value <= 0.0:
        raise RigError(
            f"{where}: there is no gap; a nonlinear simulation needs it. Give s = {{ value = …, unit = \"mm\" }} in "
            "[magnet.parameters], or omit nonlinear"
        )  # fmt: skip
    if len(of.coils) != len(of.axes):
        raise RigError(f"{where}: an axis is driven by its current; nonlinear magnets need voltages. Omit nonlinear")
    sigma = known.known("sigma")
    saturation, s = 0.0 if sigma is None or sigma.value is None else sigma.value, gap.value
    radial = [j for j, (_, plane) in enumerate(of.placed) if plane < 2]
    axial = [j for j, (_, plane) in enumerate(of.placed) if plane == 2]
    ends = [b.name for b in of.bearings if not b.axial]
    if known.cone and (len(axial) != 1 or len(ends) != 2):
        raise RigError(f"{where}: magnet.cone needs two radial bearings and an axial one. Remove it, or add them")
    rows, axes = list[list[float]](), list[tuple[int, int]]()
    leakage = np.array([theta[f"{axis}.L"] for axis in of.axes])
    for j in radial if known.cone else range(len(of.axes)):
        cosine, sine = math.cos(known.cone), math.sin(known.cone)
        k, bias = _strength(of.axes[j], theta, s, saturation, cosine, where)
        pull = 1.0 if ends[-1:] == [of.placed[j][0].name] else -1.0  # of its stator along the shaft
        along = (pull * sine, 0.5 * pull) if known.cone else (0.0, 0.0)
        for side in (1.0, -1.0):
            rows.append([k, s, bias, saturation, side * cosine, side, *along])
            axes.append((j, axial[0] if known.cone else -1))
    found = Poles(np.array(rows), np.array(axes, dtype=np.int64), leakage)
    _take_own(found)
    if known.cone:
        _check_axial(found, of.axes[axial[0]], axial[0], theta, where)
    short = [of.axes[j] for j in range(leakage.size) if leakage[j] < -1e-9 * theta[f"{of.axes[j]}.L"]]
    if short:
        raise RigError(
            f"{where}: L of {', '.join(short)} is below k_i^2/abs(k_x), which the magnet's own energy needs. Correct "
            "L, k_i or k_x"
        )
    return found


def _strength(
    axis: str, theta: Mapping[str, float], s: float, sigma: float, cosine: float, where: str
) -> tuple[float, float]:
    """Return strength and bias of the pairs of an axis."""
    k_i, k_x = theta[f"{axis}.k_i"], theta[f"{axis}.k_x"]
    if not (k_i > 0.0 > k_x):
        raise RigError(
            f"{where}: {axis} has k_i {k_i:g} N/A and k_x {k_x:g} N/m; a magnet with bias has k_i > 0 > k_x. Correct it"
        )
    part = -s * k_x / (2.0 * cosine * k_i)  # h/h' = i0 r/(1 + r)
    bias = 2.0 * part
    for _ in range(100):
        r = math.sqrt(1.0 + sigma * bias**2)
        bias = part * (1.0 + r) / r
    return k_i * s**2 * math.sqrt(1.0 + sigma * bias**2) / (2.0 * cosine * bias), bias


def _take_own(found: Poles) -> None:
    """Leave of the inductances what is not that of the poles."""
    k, s, bias, sigma, _, winding, _, second = found.numbers.T
    own = k / s * (1.0 + sigma * bias**2) ** -1.5
    np.subtract.at(found.leakage, found.axes[:, 0], own * winding**2)
    coupled = found.axes[:, 1] >= 0
    np.subtract.at(found.leakage, found.axes[coupled, 1], (own * second**2)[coupled])


def _check_axial(found: Poles, axis: str, j: int, theta: Mapping[str, float], where: str) -> None:
    """Refuse numbers of the axial axis that are not those of the cones."""
    k, s, bias, sigma, _, _, along, winding = found.numbers[found.axes[:, 1] == j].T
    r = np.sqrt(1.0 + sigma * bias**2)
    needed = {
        "k_i": float(np.sum(k * bias / r * along * winding / s**2)),
        "k_x": -float(np.sum(2.0 * k * bias**2 / (1.0 + r) * along**2 / s**3)),
    }
    for name, value in needed.items():
        given = theta[f"{axis}.{name}"]
        if abs(given - value) > _SAME * abs(value):
            raise RigError(
                f"{where}: {axis}.{name} is {given:g}; with this cone the radial magnets make it {value:.6g}. Correct "
                "it, or magnet.cone"
            )
