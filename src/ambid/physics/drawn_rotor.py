"""Between a drawing and the numbers of a rotor in its bearings, both ways; how well its whirl is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ambid.arrays import Array
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import FreeRotor, Shaft
from ambid.physics.whirl import Campbell


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


def whirl_sd(
    model: RotorModel, theta: Mapping[str, float], names: Sequence[str], covariance: Array, whirl: Campbell
) -> Array:
    """Return standard deviations of the frequencies of `whirl`, (n_speeds, n_lines), rad/s.

    `whirl`: of `free_rotor_of(model, theta)` without supports; `covariance`: of the parameters `names`. To first order,
    from the exact derivative of a pole: with D = s² + s (C - j d W G) + K for circular whirl in direction d = ±1, and
    its null vectors l, r, ds = -l* dD r / (l* D' r).
    """
    rotor = free_rotor_of(model, theta)
    root = np.sqrt(rotor.mass)
    K, C, G = np.diag(rotor.omega**2), np.diag(2 * rotor.zeta * rotor.omega), rotor.gyro / np.outer(root, root)
    parts = [_moved(rotor, G, name) for name in names]
    sd = np.full(whirl.frequency.shape, np.nan)
    for k, speed in enumerate(whirl.speed):
        for line in np.flatnonzero(np.isfinite(whirl.frequency[k])):
            s, turn = whirl.poles[k, line], 1j * np.sign(whirl.direction[k, line]) * speed
            rate = C - turn * G
            left, _, right = np.linalg.svd(s**2 * np.eye(root.size) + s * rate + K)
            of, by = left[:, -1].conj(), right[-1].conj()
            slope = of @ (2 * s * by + rate @ by)
            g = [(-(of @ (dK + s * (dC - turn * dG)) @ by) / slope).imag for dK, dC, dG in parts]
            sd[k, line] = np.sqrt(max(float(np.array(g) @ covariance @ np.array(g)), 0.0))
    return sd


def _moved(rotor: FreeRotor, G: Array, name: str) -> tuple[Array, Array, Array]:
    """Derivatives by a parameter of stiffness, damping and gyroscopic matrix, all scaled with the masses.

    Zero where the rotor does not have it, as of a mode left out or of a bearing.
    """
    dK, dC, dG = np.zeros_like(G), np.zeros_like(G), np.zeros_like(G)
    place, _, what = name.partition(".")
    if what in ("omega", "zeta"):
        r = int(place.removeprefix("mode")) + 1
        if r < rotor.mass.size:
            dC[r, r] = 2 * (rotor.zeta[r] if what == "omega" else rotor.omega[r])
            dK[r, r] = 2 * rotor.omega[r] if what == "omega" else 0.0
    elif name == "Id":
        dG[1], dG[:, 1] = -G[1] / (2 * rotor.mass[1]), -G[:, 1] / (2 * rotor.mass[1])
        dG[1, 1] *= 2
    elif name == "Ip" or place == "gyro":
        r, s = (1, 1) if name == "Ip" else (int(what[0]) + 1, int(what[1:]) + 1)
        if max(r, s) < rotor.mass.size:
            dG[r, s] = dG[s, r] = 1.0 / np.sqrt(rotor.mass[r] * rotor.mass[s])
    return dK, dC, dG
