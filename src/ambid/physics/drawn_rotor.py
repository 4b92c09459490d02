"""Between a drawing and the numbers of a rotor in its bearings, both ways."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import FreeRotor, Shaft


def drawn_numbers(model: RotorModel, shaft: Shaft, planes: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of a model that follow from a drawing: mass, inertia, centre of gravity, bending modes.

    `planes`: where each of `model.places` lies, m from the datum. Shapes have modal mass 1 kg and rise at the left end.
    """
    at = [planes[place] for place in model.places]
    rotor = shaft.free_rotor(model.n_modes, planes=at)
    rows = rotor.deflection(at)
    found = {"m": rotor.mass[0], "Id": rotor.mass[1], "Ip": rotor.gyro[1, 1], "z_cg": rotor.z_cg}
    for r in range(1, model.n_modes + 1):
        found |= {f"mode{r}.omega": rotor.omega[r + 1], f"mode{r}.zeta": rotor.zeta[r + 1]}
        found |= {f"mode{r}.{place}": row[r + 1] for place, row in zip(model.places, rows, strict=True)}
        found |= {f"gyro.{s}{r}": rotor.gyro[s + 1, r + 1] for s in range(r + 1)}
    names = {p.name for p in model.parameters}
    return {name: float(value) for name, value in found.items() if name in names}


def free_rotor_of(model: RotorModel, theta: Mapping[str, float]) -> FreeRotor:
    """Return the rotor of a model at parameters `theta` without its bearings, with the planes of the model as nodes.

    Between planes its shapes are a guess, at planes they are the parameters. Gyroscopic terms are 0 where the model
    has none.
    """
    planes = {theta[place]: place for place in reversed(model.places)}
    z = np.array(sorted(planes))
    n = model.n_modes + 2
    shape = np.zeros((z.size, 2, n))
    shape[:, 0, 0], shape[:, 0, 1] = 1.0, z - theta["z_cg"]
    for r in range(1, model.n_modes + 1):
        shape[:, 0, r + 1] = [theta[f"mode{r}.{planes[x]}"] for x in z]
    shape[:, 1] = np.gradient(shape[:, 0], z, axis=0) if z.size > 1 else 0.0
    gyro = np.zeros((n, n))
    gyro[1, 1] = theta.get("Ip", 0.0)
    for r in range(1, n - 1):
        for s in range(r + 1):
            gyro[s + 1, r + 1] = gyro[r + 1, s + 1] = theta.get(f"gyro.{s}{r}", 0.0)
    modes = range(1, model.n_modes + 1)
    return FreeRotor(
        z_cg=theta["z_cg"],
        mass=np.array([theta["m"], theta["Id"], *(1.0 for _ in modes)]),
        omega=np.array([0.0, 0.0, *(theta[f"mode{r}.omega"] for r in modes)]),
        zeta=np.array([0.0, 0.0, *(theta[f"mode{r}.zeta"] for r in modes)]),
        gyro=gyro,
        z=z,
        shape=shape,
    )
