"""Whirl of a rotor on supports over its speed: the Campbell diagram, critical speeds, how well both are known: from the
eigenvalues of both planes in modal coordinates (theory.md sec. 9; Friswell et al. 2010, ch. 6; Genta 2005, ch. 2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import ModelError
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import FreeRotor, Shaft

SPEEDS = 61  # of the grid on which critical speeds are sought
_SURE = 0.95  # likeness of two shapes, from which they are one mode
_EQUAL = 1e-9  # relative distance below which poles are one
_GONE = 0.2  # likeness below which a mode no longer oscillates
_STEPS = (1e-4, 1 / 60)  # of the highest speed: at the least step modes that repel each other count as crossing
_BESIDE = 4  # modes followed beyond the lines shown, so that none is taken for one of them
_MORE = 8  # bending modes of a shaft beyond those asked for


@dataclass(frozen=True, slots=True, kw_only=True)
class Support:
    """A linear bearing: the force -stiffness (x, y) - damping (x', y') at a plane.

    Attributes
    ----------
    z : float
        Plane, m from the datum of the rotor.
    stiffness : float or tuple of 2 by 2 float
        N/m: of both planes alike, or ((k_xx, k_xy), (k_yx, k_yy)). A negative one pulls away, as a magnet does.
    damping : float or tuple of 2 by 2 float
        N s/m, likewise.
    """

    z: float
    stiffness: float | tuple[tuple[float, float], tuple[float, float]]
    damping: float | tuple[tuple[float, float], tuple[float, float]] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Campbell:
    """Whirl over speed, one line for each mode that oscillates at the first speed, by frequency there.

    A mode is followed from speed to speed by its shape; where two come too close for that, speeds between are computed
    until they differ. A whirl is forward where its orbits turn with the shaft, from x to y.

    Attributes
    ----------
    speed : Array, shape (n_speeds,), rad/s
    poles : NDArray of complex, shape (n_speeds, n_lines), rad/s
        With positive imaginary part; nan where a mode is so damped that it does not oscillate.
    direction : Array, shape (n_speeds, n_lines)
        1 for a forward circular orbit, -1 for a backward one, 0 for a straight line, between for ellipses.
    """

    speed: Array
    poles: Complex
    direction: Array

    @property
    def frequency(self) -> Array:
        """Damped frequencies in rad/s, shape (n_speeds, n_lines)."""
        return np.where(np.isfinite(self.poles), self.poles.imag, np.nan)

    @property
    def damping(self) -> Array:
        """Damping ratios, negative where a mode grows, shape (n_speeds, n_lines)."""
        return np.asarray(-self.poles.real / np.abs(self.poles))

    def critical_speeds(self) -> tuple[CriticalSpeed, ...]:
        """Return where lines meet the running speed: the frequency of a mode equals that of unbalance.

        Returns
        -------
        tuple of CriticalSpeed
            By speed; from cubic splines through the lines.
        """
        from scipy.interpolate import CubicSpline

        speeds: list[CriticalSpeed] = []
        for line in range(self.poles.shape[1]):
            f, damping, direction = (x[:, line] for x in (self.frequency, self.damping, self.direction))
            known = np.isfinite(f) & (self.speed > 0)
            if known.sum() > 1:
                w = self.speed[known]
                roots = CubicSpline(w, f[known] - w).roots(extrapolate=False)
                at = (np.interp(roots, w, x[known]) for x in (direction, damping))
                speeds += [
                    CriticalSpeed(speed=float(x), line=line, direction=float(d), damping=float(z))
                    for x, d, z in zip(roots, *at, strict=True)
                ]
        return tuple(sorted(speeds, key=lambda c: c.speed))


@dataclass(frozen=True, slots=True, kw_only=True)
class CriticalSpeed:
    """A speed at which a mode whirls as fast as the shaft turns.

    Attributes
    ----------
    speed : float, rad/s
    line : int
        Line of the Campbell diagram.
    direction : float
        As `Campbell.direction`; unbalance excites forward whirl, and backward whirl on unlike supports only.
    damping : float
        Damping ratio there.
    """

    speed: float
    line: int
    direction: float
    damping: float


def campbell(
    rotor: FreeRotor | Shaft,
    speeds: Sequence[float] | Array,
    supports: Sequence[Support] = (),
    *,
    lines: int | None = None,
) -> Campbell:
    """Return the whirl frequencies of a rotor over its speed.

    Parameters
    ----------
    rotor : FreeRotor or Shaft
        As identified or from a drawing; of a shaft, as many modes are taken as the lines need.
    speeds : sequence of float or array of shape (n_speeds,)
        rad/s, not negative, rising.
    supports : sequence of Support
        Bearings; none: the rotor is free, and only tilting and bending are shown.
    lines : int, optional
        How many modes are shown, the lowest ones at the first speed; None: all of a `FreeRotor`, 8 of a `Shaft`.

    Returns
    -------
    Campbell

    Raises
    ------
    ModelError
        If the speeds do not rise from 0 or more, a support lies outside the shaft, or more lines are asked for than the
        elements of a shaft can show.

    Examples
    --------
    >>> from ambid.physics import Disc, Material, Shaft, Step, Support, campbell
    >>> steel = Material(E=2.11e11, rho=7810.0, nu=0.3)
    >>> disc = Disc.of_geometry(z=0.3, outer=0.3, inner=0.05, width=0.07, rho=7810.0)
    >>> shaft = Shaft(steps=(Step(length=1.2, diameter=0.05),), discs=(disc,), material=steel)
    >>> whirl = campbell(shaft, [0.0, 400.0], [Support(z=0.0, stiffness=1e7), Support(z=1.2, stiffness=1e7)], lines=2)
    >>> [[round(float(f), 1) for f in row] for row in whirl.frequency]
    [[225.0, 225.0], [218.8, 230.7]]
    """
    speed = np.asarray(speeds, dtype=float)
    if (
        speed.ndim != 1
        or speed.size == 0
        or not (speed[0] >= 0 and np.all(np.diff(speed) > 0) and np.isfinite(speed[-1]))
    ):
        raise ModelError("the speeds of a Campbell diagram have to rise from 0 or more. Correct them")
    if isinstance(rotor, Shaft):
        lines = lines or 8
        elements = max(rotor.elements, len(rotor.steps))
        modes = min(lines // 2 + _MORE, elements)
        if lines > 2 * modes:
            raise ModelError(
                f"{lines} lines are asked for of a shaft cut into {elements} elements; it shows at most "
                f"{2 * modes}. Ask for fewer, or raise elements"
            )
        rotor = rotor.free_rotor(modes, planes=[s.z for s in supports], residual=True)
    whirl = _Whirl.of(rotor, supports)
    # at rest two alike planes have double eigenvalues with any shapes: a speed near 0 tells them apart
    slow = 1e-5 * max(float(speed[-1]), float(rotor.omega[2]) if rotor.omega.size > 2 else 1.0)
    first = whirl.at(max(float(speed[0]), slow))
    if lines is not None:
        first = first.lowest(lines + _BESIDE)
    path = [first]
    for w in speed[1:]:
        path.append(_followed(whirl, path[-1], float(w), float(speed[-1])))
    kept = [p.lowest(lines) for p in path]
    return Campbell(
        speed=speed, poles=np.array([p.poles for p in kept]), direction=np.array([p.direction for p in kept])
    )


def critical_speeds(
    rotor: FreeRotor | Shaft, highest: float, supports: Sequence[Support] = (), *, lines: int | None = None
) -> tuple[CriticalSpeed, ...]:
    """Return the critical speeds of a rotor.

    Parameters
    ----------
    rotor : FreeRotor or Shaft
    highest : float
        Up to which speed they are sought, rad/s.
    supports : sequence of Support
    lines : int, optional
        As in `campbell`, like rotor and supports.

    Returns
    -------
    tuple of CriticalSpeed
        By speed, forward and backward ones.

    Raises
    ------
    ModelError
        If `highest` is not positive, or a support lies outside the shaft.
    """
    if not (math.isfinite(highest) and highest > 0):
        raise ModelError(f"critical speeds are sought up to {highest:g} rad/s; it must be positive. Correct it")
    return campbell(rotor, np.linspace(0.0, highest, SPEEDS), supports, lines=lines).critical_speeds()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _At:
    """Modes at one speed."""

    speed: float
    poles: Complex  # (n_modes,)
    shapes: Complex  # (2 n, n_modes): of x and y, scaled with the modal masses, norm 1
    direction: Array  # (n_modes,)

    def lowest(self, n: int | None) -> _At:
        """Return the first `n` modes."""
        return _At(speed=self.speed, poles=self.poles[:n], shapes=self.shapes[:, :n], direction=self.direction[:n])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Whirl:
    """M q'' + (C + W G) q' + K q = 0 of both planes, with M = 1 by scaling."""

    K: Array  # (2 n, 2 n)
    C: Array
    G: Array
    moving: NDArray[np.intp]  # which coordinates have a stiffness; of the others only the rate is a state

    @classmethod
    def of(cls, rotor: FreeRotor, supports: Sequence[Support]) -> _Whirl:
        root = np.sqrt(rotor.mass)
        turn = rotor.gyro / np.outer(root, root)
        K: Any = np.kron(np.eye(2), np.diag(rotor.omega**2))
        C: Any = np.kron(np.eye(2), np.diag(2.0 * rotor.zeta * rotor.omega))
        for s in supports:
            row = rotor.deflection(s.z)[0] / root
            K += np.kron(_both(s.stiffness), np.outer(row, row))
            C += np.kron(_both(s.damping), np.outer(row, row))
        G = np.kron(np.array([[0.0, 1.0], [-1.0, 0.0]]), turn)
        return cls(K=K, C=C, G=G, moving=np.flatnonzero(np.any(K != 0, axis=0)))

    def at(self, speed: float) -> _At:
        n, k = self.K.shape[0], self.moving.size
        A = np.zeros((k + n, k + n))
        A[np.arange(k), k + self.moving] = 1.0
        A[k:, :k] = -self.K[:, self.moving]
        A[k:, k:] = -(self.C + speed * self.G)
        values, vectors = np.linalg.eig(A)
        floor = 1e-12 * np.sqrt(np.abs(self.K).max())  # what rounding makes of a pole at zero
        up = np.flatnonzero(values.imag > np.maximum(floor, 1e-3 * np.abs(values)))
        up = up[np.argsort(values[up].imag, kind="stable")]
        shapes = vectors[k:, up]
        shapes = _circular(values[up], shapes / np.linalg.norm(shapes, axis=0))
        x, y = shapes[: n // 2], shapes[n // 2 :]
        direction = np.clip(-2.0 * np.sum((x.conj() * y).imag, axis=0), -1.0, 1.0)
        return _At(speed=speed, poles=values[up], shapes=shapes, direction=direction)


def _circular(poles: Complex, shapes: Complex) -> Complex:
    """Return the shapes of equal poles, which may be any mixture, as forward and backward whirl."""
    n = shapes.shape[0] // 2
    turn = np.kron(np.array([[0.0, 1j], [-1j, 0.0]]), np.eye(n))  # v^H turn v is the direction of v
    turned = shapes.copy()
    for k, pole in enumerate(poles):
        alike = np.abs(poles - pole) < _EQUAL * np.abs(pole)
        if alike.sum() > 1 and not alike[:k].any():
            basis, spread, _ = np.linalg.svd(shapes[:, alike], full_matrices=False)
            if spread[-1] > _EQUAL:  # else they are one shape
                turned[:, alike] = basis @ np.linalg.eigh(basis.conj().T @ turn @ basis)[1]
    return turned


def _followed(whirl: _Whirl, before: _At, speed: float, top: float) -> _At:
    """Return the modes of `before` at another speed, in their order; nan where one no longer oscillates."""
    from scipy.optimize import linear_sum_assignment

    step = (speed - before.speed) / top
    if step > _STEPS[1]:
        return _followed(whirl, _followed(whirl, before, (before.speed + speed) / 2.0, top), speed, top)
    after = whirl.at(speed)
    likeness = np.abs(np.nan_to_num(before.shapes).conj().T @ after.shapes) ** 2
    # of modes with the same shape, as of one coordinate on two supports, the nearer frequency
    apart = np.abs(np.nan_to_num(before.poles)[:, None] - after.poles) / (1.0 + np.abs(after.poles))
    rows, columns = linear_sum_assignment(likeness - 1e-3 * np.minimum(apart, 1.0), maximize=True)
    alive = np.isfinite(before.poles[rows])
    if step > _STEPS[0] and np.any(likeness[rows, columns][alive] < _SURE):
        return _followed(whirl, _followed(whirl, before, (before.speed + speed) / 2.0, top), speed, top)
    sure = alive & (likeness[rows, columns] > _GONE)
    n = before.poles.size
    poles, direction = np.full(n, np.nan, dtype=complex), np.full(n, np.nan)
    shapes = np.full((after.shapes.shape[0], n), np.nan, dtype=complex)
    poles[rows[sure]], direction[rows[sure]] = after.poles[columns[sure]], after.direction[columns[sure]]
    shapes[:, rows[sure]] = after.shapes[:, columns[sure]]
    return _At(speed=speed, poles=poles, shapes=shapes, direction=direction)


def _both(given: float | tuple[tuple[float, float], tuple[float, float]]) -> Array:
    """A coefficient of both planes alike as a matrix, (2, 2)."""
    return given * np.eye(2) if isinstance(given, (int, float)) else np.asarray(given, dtype=float)


def drawn_numbers(model: RotorModel, shaft: Shaft, planes: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of a model that follow from a drawing: mass, inertia, centre of gravity, bending modes of
    modal mass 1 kg that rise at the left end. `planes`: where each of `model.places` lies, m from the datum.
    """
    at = [planes[place] for place in model.places]
    rotor = shaft.free_rotor(model.n_modes, planes=at)
    rows = rotor.deflection(at)
    numbers = {"m": rotor.mass[0], "Id": rotor.mass[1], "Ip": rotor.gyro[1, 1], "z_cg": rotor.z_cg}
    for r in range(1, model.n_modes + 1):
        numbers |= {f"mode{r}.omega": rotor.omega[r + 1], f"mode{r}.zeta": rotor.zeta[r + 1]}
        numbers |= {f"mode{r}.{place}": row[r + 1] for place, row in zip(model.places, rows, strict=True)}
        numbers |= {f"gyro.{s}{r}": rotor.gyro[s + 1, r + 1] for s in range(r + 1)}
    names = {p.name for p in model.parameters}
    return {name: float(value) for name, value in numbers.items() if name in names}


def free_rotor_of(model: RotorModel, theta: Mapping[str, float]) -> FreeRotor:
    """Return the rotor of a model at parameters `theta` without its bearings, with the planes of the model as nodes,
    between which its shapes are a guess. Gyroscopic terms are 0 where the model has none.
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
    """Return standard deviations (n_speeds, n_lines), rad/s, of the frequencies of a `whirl` of `free_rotor_of(model,
    theta)` without supports, to first order in the parameters `names`: with D = s² + s (C - j d W G) + K for circular
    whirl in direction d = ±1, and its null vectors l, r, ds = -l* dD r / (l* D' r).
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
    """Derivatives by a parameter of stiffness, damping and gyroscopic matrix, all scaled with the masses; zero where
    the rotor does not have it, as of a mode left out or of a bearing.
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
