"""A rotor from its drawings (theory.md sec. 9): Timoshenko beam elements, discs, and the modes of the free shaft.
Przemieniecki (1968), ch. 5.6, 11; Friswell and others (2010), sec. 5.4; Cowper, J. Appl. Mech. 33 (1966) 335.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError

ELEMENTS = 60  # that a shaft is cut into, about: six bending modes of a stepped shaft within 0.02 %
_SAME = 1e-6  # of the length, below which two planes are one node


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """An isotropic material.

    Attributes
    ----------
    E : float
        Young's modulus in Pa.
    rho : float
        Density in kg/m³.
    nu : float
        Poisson's ratio; the shear modulus is E/(2 (1 + nu)).

    Raises
    ------
    ModelError
        If E or rho is not positive, or nu outside 0 to 0.5.
    """

    E: float
    rho: float
    nu: float = 0.3

    def __post_init__(self) -> None:
        _positive("a material", E=self.E, rho=self.rho)
        if not 0 <= self.nu < 0.5:
            raise ModelError(f"Poisson's ratio is {self.nu:g}; it lies from 0 to 0.5. Correct it")


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A cylinder of the shaft, solid or hollow.

    Attributes
    ----------
    length, diameter, bore : float
        Length, outer and inner diameter in m; bore 0: solid.
    material : Material or None
        Where it is not the shaft's.

    Raises
    ------
    ModelError
        If length or diameter is not positive, or the bore not inside the diameter.
    """

    length: float
    diameter: float
    bore: float = 0.0
    material: Material | None = None

    def __post_init__(self) -> None:
        _positive("a step of the shaft", length=self.length, diameter=self.diameter)
        if not 0 <= self.bore < self.diameter:
            raise ModelError(
                f"a step of the shaft has a bore of {self.bore:g} m in a diameter of {self.diameter:g} m. Correct one"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Disc:
    """A rigid disc: mass and inertia at one plane, no stiffness.

    Attributes
    ----------
    z : float
        Plane, m from the datum.
    m : float
        Mass in kg.
    Id, Ip : float
        Diametral and polar moment of inertia about its centre, kg m².

    Raises
    ------
    ModelError
        If a mass or a moment is negative, or not finite.
    """

    z: float
    m: float
    Id: float = 0.0
    Ip: float = 0.0

    def __post_init__(self) -> None:
        for name, value in {"mass": self.m, "Id": self.Id, "Ip": self.Ip}.items():
            if not (math.isfinite(value) and value >= 0):
                raise ModelError(f"the disc at {self.z:g} m has {name} {value:g}; it must not be negative. Correct it")

    @classmethod
    def of_geometry(cls, *, z: float, outer: float, inner: float, width: float, rho: float) -> Disc:
        """Return a ring with a rectangular section.

        Parameters
        ----------
        z, outer, inner, width : float
            Its middle plane, diameters and width in m.
        rho : float
            Density in kg/m³.

        Returns
        -------
        Disc
            m = rho pi (D² - d²) w/4, Ip = m (D² + d²)/8, Id = Ip/2 + m w²/12.

        Raises
        ------
        ModelError
            If a size or the density is not positive, or the inner diameter not inside the outer one.
        """
        _positive("a disc", outer=outer, width=width, rho=rho)
        if not 0 <= inner < outer:
            raise ModelError(f"a disc has an inner diameter of {inner:g} m, outer {outer:g} m. Correct one")
        m = rho * math.pi * (outer**2 - inner**2) / 4.0 * width
        i_p = m * (outer**2 + inner**2) / 8.0
        return cls(z=z, m=m, Id=i_p / 2.0 + m * width**2 / 12.0, Ip=i_p)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeRotor:
    """A rotor without bearings in modal coordinates: two rigid ones, then bending modes of modal mass 1 kg.

    Each plane obeys mass q'' + 2 zeta mass omega q' + mass omega² q = sum of phi(z) f; rotation couples the planes
    through the modal gyroscopic matrix, +W gyro q_y' in the x plane and -W gyro q_x' in the y plane.

    Attributes
    ----------
    z_cg : float
        Centre of gravity, m from the datum.
    mass : Array, shape (n,)
        m in kg, Id in kg m², then 1.
    omega, zeta : Array, shape (n,)
        Natural frequencies in rad/s, 0 for the rigid coordinates, and damping ratios.
    gyro : Array, shape (n, n)
        Modal gyroscopic matrix; entry (1, 1) is Ip in kg m².
    z : Array, shape (n_nodes,)
        Nodes in m from the datum, rising.
    shape : Array, shape (n_nodes, 2, n)
        Deflection and rotation of each node in each coordinate: 1 and 0 of the translation, z - z_cg and 1 of the tilt,
        and the mode shapes, whose left end deflects to +.
    """

    z_cg: float
    mass: Array
    omega: Array
    zeta: Array
    gyro: Array
    z: Array
    shape: Array

    def deflection(self, z: float | Sequence[float] | Array) -> Array:
        """Return the rows that turn modal coordinates into deflections.

        Parameters
        ----------
        z : float or array of shape (n_planes,)
            Planes in m from the datum; between nodes, cubic interpolation.

        Returns
        -------
        Array, shape (n_planes, n)

        Raises
        ------
        ModelError
            If a plane lies outside the shaft.
        """
        return self._rows(z, 0)

    def slope(self, z: float | Sequence[float] | Array) -> Array:
        """Return the rows that turn modal coordinates into slopes (rotations of the section).

        Parameters
        ----------
        z : float or array of shape (n_planes,)
            Planes in m from the datum.

        Returns
        -------
        Array, shape (n_planes, n), 1/m times the coordinate's unit

        Raises
        ------
        ModelError
            If a plane lies outside the shaft.
        """
        return self._rows(z, 1)

    def _rows(self, z: float | Sequence[float] | Array, derivative: int) -> Array:
        from scipy.interpolate import CubicHermiteSpline

        at = np.atleast_1d(np.asarray(z, dtype=float))
        for plane in at:
            _inside("a plane", float(plane), self.z[0], self.z[-1])
        spline = CubicHermiteSpline(self.z, self.shape[:, 0], self.shape[:, 1])
        return np.asarray(spline(np.clip(at, self.z[0], self.z[-1]), derivative))


@dataclass(frozen=True, kw_only=True)
class Shaft:
    """A stepped shaft with discs, as a drawing gives it.

    Attributes
    ----------
    steps : tuple of Step
        From the left end to the right.
    discs : tuple of Disc
    material : Material
        Of the steps that name none.
    z : float
        Left end, m from the datum of all planes.
    zeta : tuple of float
        Damping ratios of its bending modes, the last one for all that follow; none: undamped.
    elements : int
        About how many beam elements it is cut into; every step has at least one.

    Raises
    ------
    ModelError
        If there is no step, a disc lies outside the shaft, or a damping ratio outside 0 to 1.

    Examples
    --------
    A uniform steel shaft without bearings bends at 22.37 sqrt(EI/(rho A))/L² rad/s, less a little for shear:

    >>> from ambid.physics import Material, Shaft, Step
    >>> steel = Material(E=2.11e11, rho=7810.0, nu=0.3)
    >>> shaft = Shaft(steps=(Step(length=1.0, diameter=0.02),), material=steel)
    >>> rotor = shaft.free_rotor(modes=2)
    >>> [round(float(w) / 6.2831853, 1) for w in rotor.omega]
    [0.0, 0.0, 92.4, 254.3]
    >>> round(float(rotor.mass[0]), 4), round(rotor.z_cg, 3)
    (2.4536, 0.5)
    """

    steps: tuple[Step, ...]
    discs: tuple[Disc, ...] = ()
    material: Material
    z: float = 0.0
    zeta: tuple[float, ...] = ()
    elements: int = ELEMENTS

    def __post_init__(self) -> None:
        if not self.steps:
            raise ModelError("the shaft has no steps. Give at least one")
        if any(not 0 <= ratio < 1 for ratio in self.zeta):
            raise ModelError(f"damping ratios of the shaft are {list(self.zeta)}; they lie from 0 to 1. Correct them")
        for disc in self.discs:
            _inside("a disc", disc.z, self.z, self.z + self.length)

    @cached_property
    def length(self) -> float:
        """Length in m."""
        return math.fsum(step.length for step in self.steps)

    def free_rotor(self, modes: int, *, planes: Sequence[float] = (), residual: bool = False) -> FreeRotor:
        """Return the rotor without bearings in modal coordinates.

        Parameters
        ----------
        modes : int
            Bending modes that are kept.
        planes : sequence of float
            Planes in m from the datum that get a node, so that the mode shapes are exact there.
        residual : bool
            Whether further coordinates stand for the static response of all other modes to forces at the planes and to
            gyroscopic moments. Bearings then act as on the whole shaft. Their frequencies are no natural ones.

        Returns
        -------
        FreeRotor

        Raises
        ------
        ModelError
            If there are fewer modes than asked for, or a plane lies outside the shaft.
        """
        from scipy.linalg import eigh

        for plane in planes:
            _inside("a plane", plane, self.z, self.z + self.length)
        # ends of steps, discs and planes, and between them as many nodes as the number of elements asks for
        ends = self.z + np.concatenate([[0.0], np.cumsum([step.length for step in self.steps])])
        kept = list(ends)
        for x in (*(disc.z for disc in self.discs), *planes):
            if min(abs(x - y) for y in kept) > _SAME * self.length:
                kept.append(x)
        parts = []
        for a, b in pairwise(sorted(kept)):
            n = max(1, round((b - a) / self.length * self.elements))
            parts.append(a + (b - a) * np.arange(n) / n)
        z = np.concatenate([*parts, ends[-1:]])
        M, K, P = self._matrices(z)
        if not 0 <= modes <= M.shape[0] - 2:
            raise ModelError(f"{modes} bending modes are asked for; this shaft has {M.shape[0] - 2}. Ask for fewer")
        rigid, z_cg = _rigid(M, z)
        scale = 1.0 / np.sqrt(np.diag(M))  # deflections and slopes differ by orders of magnitude
        squares, vectors = eigh(scale[:, None] * K * scale, scale[:, None] * M * scale)
        basis = scale[:, None] * vectors[:, 2 : 2 + modes]
        omega = np.sqrt(squares[2 : 2 + modes])
        if residual:
            rest = scale[:, None] * vectors[:, 2 + modes :]
            basis, omega = _with_residual(
                basis, omega, rest, squares[2 + modes :], self._loads(z, P, rigid, basis, planes)
            )
        basis = basis * np.where(basis[0] < 0, -1.0, 1.0)
        T = np.column_stack([rigid, basis])
        ratios = [0.0, 0.0, *(self.zeta or (0.0,))]
        ratios += ratios[-1:] * T.shape[1]
        return FreeRotor(
            z_cg=z_cg,
            mass=np.concatenate([np.diag(rigid.T @ M @ rigid), np.ones(omega.size)]),
            omega=np.concatenate([[0.0, 0.0], omega]),
            zeta=np.array(ratios[: T.shape[1]]),
            gyro=T.T @ P @ T,
            z=z,
            shape=T.reshape(z.size, 2, -1),
        )

    def _loads(self, z: Array, P: Array, rigid: Array, basis: Array, planes: Sequence[float]) -> Array:
        """Forces at the planes and the gyroscopic moments of the coordinates kept, (2 n_nodes, n_loads)."""
        forces = np.zeros((2 * z.size, len(planes)))
        forces[[2 * _node(z, plane) for plane in planes], np.arange(len(planes))] = 1.0
        return np.column_stack([forces, P @ np.column_stack([rigid[:, 1], basis])])

    def _matrices(self, z: Array) -> tuple[Array, Array, Array]:
        """Mass, stiffness and polar-inertia matrix of one plane, each (2 n_nodes, 2 n_nodes)."""
        M, K, P = (np.zeros((2 * z.size, 2 * z.size)) for _ in range(3))
        ends = self.z + np.cumsum([step.length for step in self.steps])
        for e, (a, b) in enumerate(pairwise(z)):
            step = self.steps[min(int(np.searchsorted(ends, (a + b) / 2.0)), len(self.steps) - 1)]
            s = slice(2 * e, 2 * e + 4)
            for whole, part in zip((M, K, P), _element(step, step.material or self.material, b - a), strict=True):
                whole[s, s] += part
        for disc in self.discs:
            k = 2 * _node(z, disc.z)
            M[k, k] += disc.m
            M[k + 1, k + 1] += disc.Id
            P[k + 1, k + 1] += disc.Ip
        return M, K, P


def _element(step: Step, material: Material, length: float) -> tuple[Array, Array, Array]:
    """Mass (with rotary inertia), stiffness and polar-inertia matrix of a beam element, (4, 4)."""
    l, E, rho, nu = length, material.E, material.rho, material.nu  # noqa: E741
    area = math.pi * (step.diameter**2 - step.bore**2) / 4.0
    inertia = math.pi * (step.diameter**4 - step.bore**4) / 64.0
    hollow = (1.0 + (step.bore / step.diameter) ** 2) ** 2
    kappa = 6 * (1 + nu) * hollow / ((7 + 6 * nu) * hollow + (20 + 12 * nu) * (step.bore / step.diameter) ** 2)
    f = 24.0 * (1 + nu) * inertia / (kappa * area * l**2)
    K = E * inertia / ((1 + f) * l**3) * np.array(
        [
            [12, 6 * l, -12, 6 * l],
            [6 * l, (4 + f) * l**2, -6 * l, (2 - f) * l**2],
            [-12, -6 * l, 12, -6 * l],
            [6 * l, (2 - f) * l**2, -6 * l, (4 + f) * l**2],
        ]
    )  # fmt: skip
    a, b = 312 + 588 * f + 280 * f**2, (44 + 77 * f + 35 * f**2) * l
    c, d = 108 + 252 * f + 140 * f**2, (26 + 63 * f + 35 * f**2) * l
    g, h = (8 + 14 * f + 7 * f**2) * l**2, (6 + 14 * f + 7 * f**2) * l**2
    translation = np.array([[a, b, c, -d], [b, g, d, -h], [c, d, a, -b], [-d, -h, -b, g]])
    p, q = (3 - 15 * f) * l, (4 + 5 * f + 10 * f**2) * l**2
    r = (1 + 5 * f - 5 * f**2) * l**2
    rotation = np.array([[36, p, -36, p], [p, q, -p, -r], [-36, -p, 36, -p], [p, -r, -p, q]])
    turning = rho * inertia / (30 * l * (1 + f) ** 2) * rotation
    return rho * area * l / (840 * (1 + f) ** 2) * translation + turning, K, 2.0 * turning


def _rigid(M: Array, z: Array) -> tuple[Array, float]:
    """Translation and tilt about the centre of gravity, (2 n_nodes, 2), and the centre of gravity."""
    translation, tilt = np.zeros(2 * z.size), np.ones(2 * z.size)
    translation[0::2] = 1.0
    tilt[0::2] = z
    z_cg = float(translation @ M @ tilt / (translation @ M @ translation))
    tilt[0::2] -= z_cg
    return np.column_stack([translation, tilt]), z_cg


def _with_residual(basis: Array, omega: Array, rest: Array, squares: Array, loads: Array) -> tuple[Array, Array]:
    """Add what the modes left out do statically under loads, as coordinates with modal mass 1 of their own."""
    from scipy.linalg import eigh

    response = (rest.T @ loads) / squares[:, None]
    response /= np.linalg.norm(response, axis=0) + np.finfo(float).tiny
    left, size, _ = np.linalg.svd(response, full_matrices=False)
    left = left[:, size > 1e-6 * size[0]]
    more, turn = eigh(left.T @ (squares[:, None] * left))
    return np.column_stack([basis, rest @ left @ turn]), np.concatenate([omega, np.sqrt(more)])


def _node(z: Array, plane: float) -> int:
    return int(np.argmin(np.abs(z - plane)))


def _inside(what: str, z: float, low: float, high: float) -> None:
    room = _SAME * (high - low)
    if not low - room <= z <= high + room:
        raise ModelError(f"{what} lies at {z:g} m, outside the shaft ({low:g} to {high:g} m). Correct it")


def _positive(what: str, **sizes: float) -> None:
    for name, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise ModelError(f"{what} has {name} {value:g}; it must be positive. Correct it")
