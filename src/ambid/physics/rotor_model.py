"""The rotor in its bearings, magnets and coils on many axes (theory.md eq. 30, 31)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.linear_model import UNITS, ParameterSpec, StateSpace, unknown_parameter

Drive = Literal["voltage", "current", "command"]

_STEP = 1e-30
"""Of the complex step: the matrices are rational in the parameters, so that it is exact to rounding."""

M = ParameterSpec(name="m", unit="kg", meaning="mass of the rotor", positive=True)
ID = ParameterSpec(
    name="Id", unit="kg m^2", meaning="transverse moment of inertia about the centre of gravity", positive=True
)
IP = ParameterSpec(name="Ip", unit="kg m^2", meaning="polar moment of inertia", positive=True)
Z_CG = ParameterSpec(name="z_cg", unit="m", meaning="centre of gravity along the shaft, from the datum of the planes")
EDDY = ParameterSpec(
    name="a", unit="rad/s", meaning="eddy-current pole of the actuators, f = k_i a/(s + a) i", positive=True
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bearing:
    """A radial bearing with its axes, or an axial one, and where its sensors stand along the shaft."""

    name: str  # such as "A"
    axes: tuple[str, ...]  # planes x and y; one name: plane x alone; of an axial bearing one
    z: float | None = None  # plane of the magnet from the datum, m; None: to be estimated from nothing
    z_sensors: tuple[float | None, ...] = (None,)  # plane of each sensor, m
    axial: bool = False  # whether it acts along the shaft

    def sensor_parameter(self, k: int) -> str:
        """Return the name of the parameter that is the plane of sensor `k`, from 0."""
        return f"{self.name}.z_sensor" if k == 0 else f"{self.name}.z_sensor{k + 1}"


def position_role(axis: str, k: int) -> str:
    """Return the role of sensor `k` of an axis, from 0: ``ax_position``, ``ax_position2`` …"""
    return f"{axis}_position" if k == 0 else f"{axis}_position{k + 1}"


@dataclass(frozen=True, kw_only=True)
class RotorModel:
    """A rotor in magnetic bearings on many axes, a linear model; z along the shaft, alpha = dx/dz, beta = dy/dz, speed
    W:

        m x'' = Σ f_x,   Id alpha'' + Ip W beta' = Σ (z_b - z_cg) f_x,   Id beta'' - Ip W alpha' = Σ (z_b - z_cg) f_y,
        eta'' + 2 zeta w eta' + w² eta + gyroscopic terms = Σ phi(z_b) f,   modal mass 1 kg, f = k_i i_eff - k_x x_b,
        i_eff' = a (i - i_eff) (thesis eq. 1.4),   V = R i + L i' + k_i x_b' (eq. 4.4),   sensors gain·x(z_s).

    Where only the command of a current amplifier is logged, i' = p (g u - i), p = (R + K H)/L, g = K/(R + K H) (thesis
    eq. 1.5, voltages induced by motion neglected): data show p, and of k_i and g the product, K, H, R, L not one by
    one.
    """

    bearings: tuple[Bearing, ...]  # in their order along the shaft
    speed: float = 0.0  # speed of rotation W, rad/s
    polar: bool = False  # whether the polar moment of inertia is a parameter
    # of each axis: its coil's voltage (current measured), its measured current, or the command of its current amplifier
    drives: tuple[Drive, ...] = ()
    extras: tuple[str, ...] = ()  # optional parameters that are asked for: "a", "<axis>.gain", "<axis>.sensor_pole"
    n_modes: int = 0  # bending modes
    name: str = "rotor"
    summary: str = "rotor in magnetic bearings on many axes, with bending modes and gyroscopic coupling ([bearings.X])"

    # --- names ------------------------------------------------------------------------------------------------------

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """Names of all axes, bearing by bearing."""
        return tuple(axis for b in self.bearings for axis in b.axes)

    @cached_property
    def placed(self) -> tuple[tuple[Bearing, int], ...]:
        """Bearing and plane of each axis: 0 for x, 1 for y, 2 for axial."""
        return tuple((b, 2 if b.axial else k) for b in self.bearings for k in range(len(b.axes)))

    @cached_property
    def planes(self) -> tuple[int, ...]:
        """Planes in which the rotor moves."""
        return tuple(sorted({plane for _, plane in self.placed}))

    @cached_property
    def sensors(self) -> tuple[tuple[int, int], ...]:
        """Axis and number of each sensor: the first of all axes, then the second …"""
        most = max(len(b.z_sensors) for b, _ in self.placed)
        return tuple((j, k) for k in range(most) for j, (b, _) in enumerate(self.placed) if k < len(b.z_sensors))

    @property
    def turning(self) -> bool:
        """Whether the gyroscopic terms matter."""
        return self.speed != 0.0 and {0, 1} <= set(self.planes)

    def drive(self, j: int) -> Drive:
        """Return what drives axis `j`."""
        return self.drives[j] if self.drives else "voltage"

    @property
    def held(self) -> tuple[bool, ...]:
        """Whether each input is held over a sample: all but measured currents."""
        return tuple(self.drive(j) != "current" for j in range(len(self.axes)))

    @cached_property
    def coils(self) -> tuple[int, ...]:
        """Axes that are driven by a voltage."""
        return tuple(j for j in range(len(self.axes)) if self.drive(j) == "voltage")

    @cached_property
    def amplified(self) -> tuple[int, ...]:
        """Axes that are driven by the command of an amplifier."""
        return tuple(j for j in range(len(self.axes)) if self.drive(j) == "command")

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """One an axis: its voltage, its current, or the command of its amplifier."""
        return tuple(f"{axis}_{self.drive(j)}" for j, axis in enumerate(self.axes))

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Positions of all sensors, then the currents of the coils."""
        positions = (position_role(self.axes[j], k) for j, k in self.sensors)
        return (*positions, *(f"{self.axes[j]}_current" for j in self.coils))

    @cached_property
    def optional_roles(self) -> Mapping[str, str]:
        """Roles that a rig may name beside, in any unit: the reference of each axis, pulses once a revolution."""
        return {**{f"{axis}_reference": "?" for axis in self.axes}, "tacho": "?"}

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """Generalised coordinates: per plane translation, slope, modes; the axial translation."""
        modes = tuple(f"mode{r}" for r in range(1, self.n_modes + 1))
        names: list[str] = []
        for plane, letter in ((0, "x"), (1, "y")):
            if plane in self.planes:
                names += [letter, f"slope_{letter}", *(f"{mode}_{letter}" for mode in modes)]
        return (*names, *(("z",) if 2 in self.planes else ()))

    @cached_property
    def states(self) -> tuple[str, ...]:
        """Coordinates, their rates, currents of the coils and behind the eddy pole, sensors behind their poles."""
        lagged = (position_role(self.axes[j], k) for j, k in self.sensors if self._pole(j))
        eddy = (f"{axis}_effective_current" for axis in self.axes) if "a" in self.extras else ()
        return (
            *self.coordinates, *(f"{q}_rate" for q in self.coordinates),
            *(f"{self.axes[j]}_current" for j in self.coils), *eddy, *lagged,
            *(f"{self.axes[j]}_amplifier_current" for j in self.amplified),
        )  # fmt: skip

    @cached_property
    def disturbances(self) -> tuple[str, ...]:
        """A force on each axis, a voltage on each coil."""
        return (*(f"{axis}_force" for axis in self.axes), *(f"{self.axes[j]}_voltage" for j in self.coils))

    @cached_property
    def units(self) -> Mapping[str, str]:
        """SI unit of inputs, outputs, states and disturbances."""

        def unit(name: str) -> str:
            kind = name.rsplit("_", 1)[-1].rstrip("0123456789")
            if kind == "rate":
                return "rad/s" if name.startswith("slope") else "m/s"
            return UNITS.get(kind, "rad" if name.startswith("slope") else "m")

        return {x: unit(x) for x in (*self.inputs, *self.outputs, *self.states, *self.disturbances)}

    @cached_property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """All numbers of the model."""
        radial = any(not b.axial for b in self.bearings)
        specs = [M, *((ID,) if radial else ()), *((IP,) if self.polar else ()), *((Z_CG,) if radial else ())]
        specs += [EDDY] if "a" in self.extras else []
        for j, axis in enumerate(self.axes):
            rows = [
                ("k_i", "N/A", f"force–current factor of axis {axis}", False),
                ("k_x", "N/m", f"position stiffness of axis {axis} (negative for a magnet)", False),
            ]
            if j in self.coils:
                rows.append(("R", "ohm", f"coil resistance of axis {axis}", True))
                rows.append(("L", "H", f"coil inductance of axis {axis}", True))
            if j in self.amplified:
                rows.append(("amplifier_gain", "A/V", f"static gain of the amplifier of axis {axis}", False))
                rows.append(("amplifier_pole", "rad/s", f"pole of the amplifier of axis {axis}", True))
            if f"{axis}.gain" in self.extras:
                rows.append(("gain", "1", f"gain error of the position sensor of axis {axis}", False))
            if self._pole(j):
                rows.append(("sensor_pole", "rad/s", f"pole of the position sensor of axis {axis}", True))
            specs += [
                ParameterSpec(name=f"{axis}.{name}", unit=unit, meaning=meaning, positive=positive)
                for name, unit, meaning, positive in rows
            ]
        for b in self.bearings:
            if b.axial:
                continue
            specs.append(ParameterSpec(name=f"{b.name}.z", unit="m", meaning=f"plane of bearing {b.name}", default=b.z))
            specs += [
                ParameterSpec(name=b.sensor_parameter(k), unit="m", meaning=f"sensor plane of {b.name}", default=z)
                for k, z in enumerate(b.z_sensors)
            ]  # fmt: skip
        return (*specs, *self.mode_parameters)

    @cached_property
    def mode_parameters(self) -> tuple[ParameterSpec, ...]:
        """Numbers of the bending modes: pole, shape at bearings and sensors, gyroscopic terms."""
        specs: list[ParameterSpec] = []
        for r in range(1, self.n_modes + 1):
            specs += [
                ParameterSpec(
                    name=f"mode{r}.omega",
                    unit="rad/s",
                    meaning=f"natural frequency of bending mode {r}, at rest",
                    positive=True,
                ),
                ParameterSpec(name=f"mode{r}.zeta", unit="1", meaning=f"damping ratio of bending mode {r}"),
            ]
            specs += [
                ParameterSpec(name=f"mode{r}.{place}", unit="1", meaning=f"shape of bending mode {r} at {place}")
                for place in self.places
            ]
        if self.turning:
            for s in range(1, self.n_modes + 1):
                for r in range(s + 1):
                    meaning = f"gyroscopic term of mode {s} and " + (f"mode {r}" if r else "the rigid slope")
                    specs.append(ParameterSpec(name=f"gyro.{r}{s}", unit="kg" if r else "kg m", meaning=meaning))
        return tuple(specs)

    @cached_property
    def places(self) -> tuple[str, ...]:
        """Where the shape of a mode is a number: each bearing plane, each sensor plane."""
        radial = [b for b in self.bearings if not b.axial]
        return (
            *(f"{b.name}.z" for b in radial),
            *(b.sensor_parameter(k) for b in radial for k in range(len(b.z_sensors))),
        )

    def with_modes(self, n: int) -> RotorModel:
        """Return the model with `n` bending modes."""
        return replace(self, n_modes=n)

    def at_speed(self, speed: float) -> RotorModel:
        """Return the model at another speed, rad/s."""
        return replace(self, speed=speed, polar=self.polar or speed != 0.0)

    # --- matrices ---------------------------------------------------------------------------------------------------

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C at parameters `theta` (SI)."""
        return self._assemble(theta, np.float64)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the derivative of A, B, E, C with respect to a parameter, by a complex step."""
        if parameter not in {p.name for p in self.parameters}:
            raise unknown_parameter(self, parameter)
        step: dict[str, Any] = {**theta, parameter: theta[parameter] + 1j * _STEP}
        moved = self._assemble(step, np.complex128)
        return StateSpace(
            A=moved.A.imag / _STEP, B=moved.B.imag / _STEP, E=moved.E.imag / _STEP, C=moved.C.imag / _STEP
        )

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return natural scales of the parameters that may rightly be zero: lengths against the span of the planes."""
        span = self.span(theta)
        lengths = [p.name for p in self.parameters if p.unit == "m"]
        return dict.fromkeys(lengths, span)

    def span(self, theta: Mapping[str, float]) -> float:
        """Return the distance between the outermost bearing planes, m; 1 where there is one plane."""
        z = [theta[f"{b.name}.z"] for b in self.bearings if not b.axial]
        return float(max(z) - min(z)) if len(z) > 1 and max(z) > min(z) else 1.0

    def rows(self, theta: Mapping[str, float], kind: Any = np.float64) -> tuple[Array, Array]:
        """Return what each axis and each sensor sees of the coordinates: (n_axes, n), (n_sensors, n)."""
        index, n = {q: k for k, q in enumerate(self.coordinates)}, len(self.coordinates)

        def row(plane: int, place: str) -> Array:
            entries: Array = np.zeros(n, dtype=kind)
            if plane == 2:
                entries[index["z"]] = 1.0
                return entries
            letter = "xy"[plane]
            entries[index[letter]] = 1.0
            entries[index[f"slope_{letter}"]] = theta[place] - theta["z_cg"]
            for r in range(1, self.n_modes + 1):
                entries[index[f"mode{r}_{letter}"]] = theta[f"mode{r}.{place}"]
            return entries

        magnets = np.array([row(plane, f"{b.name}.z") for b, plane in self.placed])
        read = [row(self.placed[j][1], self.placed[j][0].sensor_parameter(k)) for j, k in self.sensors]
        gains = np.array(
            [theta[f"{self.axes[j]}.gain"] if f"{self.axes[j]}.gain" in self.extras else 1.0 for j, _ in self.sensors]
        )
        return magnets, np.array(read) * gains[:, None]

    def rotor_matrices(self, theta: Mapping[str, float], kind: Any = np.float64) -> tuple[Array, Array, Array]:
        """Return mass, stiffness/mass and damping/mass (with gyroscopic terms) of the free rotor, n coordinates."""
        q = self.coordinates
        n, index = len(q), {name: k for k, name in enumerate(q)}
        mass: Array = np.ones(n, dtype=kind)
        stiff: Array = np.zeros(n, dtype=kind)
        damp: Array = np.zeros((n, n), dtype=kind)
        for k, name in enumerate(q):
            if name in ("x", "y", "z"):
                mass[k] = theta["m"]
            elif name.startswith("slope"):
                mass[k] = theta["Id"]
            else:
                mode = name.split("_")[0]
                omega = theta[f"{mode}.omega"]
                stiff[k], damp[k, k] = omega**2, 2.0 * theta[f"{mode}.zeta"] * omega
        if self.turning and self.polar:
            of_x = [index["slope_x"], *(index[f"mode{r}_x"] for r in range(1, self.n_modes + 1))]
            of_y = [index["slope_y"], *(index[f"mode{r}_y"] for r in range(1, self.n_modes + 1))]
            for r, (x, y) in enumerate(zip(of_x, of_y, strict=True)):
                for s, (x2, y2) in enumerate(zip(of_x, of_y, strict=True)):
                    g = theta["Ip"] if r == s == 0 else theta[f"gyro.{min(r, s)}{max(r, s)}"]
                    damp[x, y2] += self.speed * g / mass[x]
                    damp[y, x2] -= self.speed * g / mass[y]
        return mass, stiff, damp

    def _assemble(self, theta: Mapping[str, float], kind: Any) -> StateSpace:
        n, n_i, axes, coils = len(self.coordinates), len(self.coils), self.axes, list(self.coils)
        eddy, lagged = "a" in self.extras, [k for k, (j, _) in enumerate(self.sensors) if self._pole(j)]
        n_e = len(axes) if eddy else 0
        size = 2 * n + n_i + n_e + len(lagged) + len(self.amplified)
        position, rate = slice(0, n), slice(n, 2 * n)
        current = 2 * n + np.arange(n_i)
        effective = 2 * n + n_i + np.arange(n_e)
        behind = 2 * n + n_i + n_e + np.arange(len(lagged))
        magnets, sensors = self.rows(theta, kind)
        mass, stiff, damp = self.rotor_matrices(theta, kind)
        k_i, k_x = (_of_axes(theta, axes, q, kind) for q in ("k_i", "k_x"))
        force = magnets.T / mass[:, None]  # what a force on each axis does to the rates
        A: Array = np.zeros((size, size), dtype=kind)
        B: Array = np.zeros((size, len(axes)), dtype=kind)
        E: Array = np.zeros((size, len(axes) + n_i), dtype=kind)
        C: Array = np.zeros((len(self.outputs), size), dtype=kind)
        A[position, rate] = np.eye(n)
        A[rate, position] = -np.diag(stiff) - force @ (k_x[:, None] * magnets)
        A[rate, rate] = -damp
        E[rate, : len(axes)] = force
        resistance, inductance = (_of_axes(theta, [axes[j] for j in coils], q, kind) for q in ("R", "L"))
        A[current, current] = -resistance / inductance
        A[current, rate] = -(k_i[coils] / inductance)[:, None] * magnets[coils]
        B[current, coils] = E[current, len(axes) + np.arange(n_i)] = 1.0 / inductance
        pull = force * k_i  # of one ampere in each axis
        ordered = size - len(self.amplified) + np.arange(len(self.amplified))
        for j, state in zip(self.amplified, ordered, strict=True):
            made, pole = theta[f"{axes[j]}.amplifier_gain"], theta[f"{axes[j]}.amplifier_pole"]
            A[state, state], B[state, j] = -pole, pole * made
        where = dict(zip([*coils, *self.amplified], [*current, *ordered], strict=True))
        for j in range(len(axes)):
            into, gain = (effective[j], theta["a"]) if eddy else (rate, pull[:, j])
            if j in where:
                A[into, where[j]] += gain
            else:
                B[into, j] += gain
            if eddy:
                A[rate, effective[j]] += pull[:, j]
                A[effective[j], effective[j]] -= theta["a"]
        C[: len(sensors), position] = sensors
        for state, k in zip(behind, lagged, strict=True):
            pole = theta[f"{axes[self.sensors[k][0]]}.sensor_pole"]
            A[state, position], A[state, state] = pole * sensors[k], -pole
            C[k, position], C[k, state] = 0.0, 1.0
        C[len(sensors) + np.arange(n_i), current] = 1.0
        return StateSpace(A=A, B=B, E=E, C=C)

    def _pole(self, j: int) -> bool:
        return f"{self.axes[j]}.sensor_pole" in self.extras

    def __post_init__(self) -> None:
        if not self.bearings:
            raise ModelError("a rotor has no bearing. Add [bearings.A] with z, z_sensor and axes")
        names = [axis for b in self.bearings for axis in b.axes]
        twice = next((x for k, x in enumerate(names) if x in names[:k]), None)
        if twice is not None:
            raise ModelError(f"axis {twice!r} is named twice; an axis belongs to one bearing. Rename one")


def _of_axes(theta: Mapping[str, float], axes: Sequence[str], what: str, kind: Any) -> Array:
    return np.array([theta[f"{axis}.{what}"] for axis in axes], dtype=kind)
