"""Start values of a rigid rotor without help: coils and mechanics by weighted linear least squares on period spectra
below the first mode. Rows count by their noise; a voltage counts from the middle of the sample over which it is held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.linear import least_squares
from ambid.physics.linear_model import Parameter
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.likelihood import Experiment, Point
from ambid.rotor.spectra import PeriodSpectra

_RELATIVE = 0.02  # error of the equations beside noise
_DELAYS = np.arange(0.0, 5.01, 0.25)  # samples
_ROUNDS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """Motion and currents of a band: planes' translation and slope at the datum, positions at the magnets."""

    omega: Array
    at_magnets: Complex  # (n_lines, n_axes)
    of_planes: Mapping[int, Complex]  # (n_lines, 2): translation at the datum, slope
    current: Complex  # (n_lines, n_axes)
    noise_x: Array  # (n_lines, n_axes), variances of the positions at the magnets
    noise_i: Array


def planes_known(model: RotorModel, values: Mapping[str, float]) -> dict[str, float]:
    """Return every plane of the rotor; a sensor's that is not known is taken to be its bearing's."""
    planes: dict[str, float] = {}
    for b in model.bearings:
        if b.axial:
            continue
        planes[f"{b.name}.z"] = z = values.get(f"{b.name}.z", 0.0)
        for k in range(len(b.z_sensors)):
            planes[b.sensor_parameter(k)] = values.get(b.sensor_parameter(k), z)
    return planes


def rigid_start(
    experiment: Experiment, model: RotorModel, parameters: Sequence[Parameter], *, eddy: float | None = None
) -> Point:
    """Return start values of the rigid rotor from one band of lines; values that are fixed or given are kept."""
    values = {p.name: p.value for p in parameters if p.value is not None}
    planes = planes_known(model, values)
    amplifiers = {
        p.name: values.get(p.name, 1.0 if p.unit == "A/V" else np.pi * experiment.spectra.rate_hz)
        for p in model.parameters
        if ".amplifier_" in p.name
    }
    motion = _see(experiment.spectra, model, planes, amplifiers)
    electric = {n: v for n, v in values.items() if n.split(".")[-1] in ("R", "L", "k_i")}
    delays, coils = _coils(experiment.spectra, model, motion, electric)
    theta = {**planes, **coils, **amplifiers}
    if "a" in model.extras:
        theta["a"] = values.get("a", eddy or 2.0 * np.pi * 1000.0)
    for name in model.extras:
        if name != "a":
            default = 1.0 if name.endswith(".gain") else np.pi * experiment.spectra.rate_hz
            theta[name] = values.get(name, default)
    theta |= _mechanics(model, motion, theta, values, experiment.speed, theta.get("a"))
    return Point(theta={**theta, **values}, delays=delays)


def _see(
    spectra: PeriodSpectra, model: RotorModel, planes: Mapping[str, float], amplifiers: Mapping[str, float]
) -> _Seen:
    """Return what the sensors show of the rigid motion, and the currents; a command's as its amplifier makes it."""
    n, n_axes = spectra.frequency_hz.size, len(model.axes)
    Y, noise = spectra.mean_y, spectra.scatter[1] / spectra.n_periods
    at = np.zeros((n, n_axes), dtype=complex)
    noise_x, of_planes = np.zeros((n, n_axes)), dict[int, Complex]()
    for plane in model.planes:
        rows = [k for k, (j, _) in enumerate(model.sensors) if model.placed[j][1] == plane]
        axes = [j for j in range(n_axes) if model.placed[j][1] == plane]
        if plane == 2:
            at[:, axes], noise_x[:, axes] = Y[:, rows[:1]], noise[:, rows[:1]]
            of_planes[2] = np.column_stack([Y[:, rows[0]], np.zeros(n)])
            continue
        z = np.array([planes[_sensor_place(model, k)] for k in rows])
        read = np.column_stack([np.ones(z.size), z])
        inverse = np.linalg.pinv(read)  # translation and slope of the sensors
        where = np.column_stack([np.ones(len(axes)), [planes[f"{model.placed[j][0].name}.z"] for j in axes]])
        of_planes[plane] = Y[:, rows] @ inverse.T
        at[:, axes] = Y[:, rows] @ (where @ inverse).T
        noise_x[:, axes] = noise[:, rows] @ ((where @ inverse) ** 2).T
    current, noise_i = np.zeros((n, n_axes), dtype=complex), np.zeros((n, n_axes))
    for j in range(n_axes):
        if j in model.coils:
            k = len(model.sensors) + model.coils.index(j)
            current[:, j], noise_i[:, j] = Y[:, k], noise[:, k]
        else:
            current[:, j], noise_i[:, j] = spectra.mean_u[:, j], spectra.scatter[0][:, j] / spectra.n_periods
            if j in model.amplified:
                gain, pole = (amplifiers[f"{model.axes[j]}.amplifier_{q}"] for q in ("gain", "pole"))
                response = gain * pole / (1j * spectra.omega + pole)
                current[:, j], noise_i[:, j] = current[:, j] * response, noise_i[:, j] * np.abs(response) ** 2
    return _Seen(
        omega=spectra.omega, at_magnets=at, of_planes=of_planes, current=current, noise_x=noise_x, noise_i=noise_i
    )


def _sensor_place(model: RotorModel, row: int) -> str:
    j, k = model.sensors[row]
    return model.placed[j][0].sensor_parameter(k)


def _coils(
    spectra: PeriodSpectra, model: RotorModel, motion: _Seen, values_of_rig: Mapping[str, float]
) -> tuple[Array, dict[str, float]]:
    """Return the delays in samples, and R, L, k_i of each coil, V = R i + L jw i + k_i jw x_b; without a coil, k_i
    alone as a first guess.
    """
    delays, coils = np.zeros(len(model.axes)), dict[str, float]()
    jw = 1j * motion.omega
    x = motion.omega / spectra.rate_hz
    hold = np.sinc(x / (2.0 * np.pi)) * np.exp(-0.5j * x)  # fundamental of a voltage that is held
    for j, axis in enumerate(model.axes):
        if j not in model.coils:
            coils[f"{axis}.k_i"] = values_of_rig.get(f"{axis}.k_i", 1.0)
            continue
        terms = np.column_stack([motion.current[:, j], jw * motion.current[:, j], jw * motion.at_magnets[:, j]])
        names = [f"{axis}.{q}" for q in ("R", "L", "k_i")]
        values, delay = np.array([1.0, 1e-2, 0.0]), 0.0
        for _ in range(_ROUNDS):
            tried: list[tuple[float, float, Array]] = []
            for delay in _DELAYS:
                v = spectra.mean_u[:, j] * hold * np.exp(-1j * x * delay)
                weight = 1.0 / np.sqrt(
                    (_RELATIVE * np.abs(v)) ** 2 + np.abs(values[0] + jw * values[1]) ** 2 * motion.noise_i[:, j]
                    + (values[2] * motion.omega) ** 2 * motion.noise_x[:, j] + 1e-300
                )  # fmt: skip
                free = [k for k, name in enumerate(names) if name not in values_of_rig]
                rest = v - terms @ np.array([values_of_rig.get(name, 0.0) for name in names])
                got = np.array([values_of_rig.get(name, 0.0) for name in names])
                if free:
                    got[free] = _real_solution(terms[:, free], rest, weight)
                left = float(np.sum(np.abs((v - terms @ got) * weight) ** 2))
                tried.append((left, float(delay), got))
            _, delay, values = min(tried, key=lambda t: t[0])
        delays[j] = delay
        coils |= {names[0]: max(values[0], 1e-3), names[1]: max(values[1], 1e-6), names[2]: values[2] or 1.0}
    return delays, {n: float(v) for n, v in coils.items()}


def _mechanics(
    model: RotorModel,
    motion: _Seen,
    theta: Mapping[str, float],
    own: Mapping[str, float],
    speed: float,
    eddy: float | None,
) -> dict[str, float]:
    """Return m, Id, Ip, z_cg and k_x from currents, motion x(z) = x0 + z alpha and force factors, of each plane:

        m a0 + S a1 + Σ k_x x_b = Σ k_i i,   S a0 + J a1 ± Ip W jw b + Σ z k_x x_b = Σ z k_i i

    with a0 = -w² x0, a1 = -w² alpha, S = m z_cg, J = Id + m z_cg², b the slope of the other plane.
    """
    jw = 1j * motion.omega
    pull = motion.current * (eddy / (jw + eddy))[:, None] if eddy else motion.current
    k_i = np.array([theta[f"{axis}.k_i"] for axis in model.axes])
    force = pull * k_i
    radial = [p for p in model.planes if p < 2]
    rigid = ["m", *(["S", "J"] if radial else []), *(["Ip"] if model.turning and model.polar else [])]
    names = [*rigid, *(f"{axis}.k_x" for axis in model.axes)]
    column = {name: k for k, name in enumerate(names)}
    free_force = [j for j in range(len(model.axes)) if j not in model.coils and f"{model.axes[j]}.k_i" not in own]
    if free_force:  # only ratios to m are seen: with a mass the force factors follow
        names += [f"{model.axes[j]}.k_i" for j in free_force]
        column = {name: k for k, name in enumerate(names)}
        force = force.copy()
        force[:, free_force] = 0.0
    mass = own.get("m", 1.0) if free_force else own.get("m")
    rows, right, weights = [], [], []
    reach = model.span(theta)
    for plane in model.planes:
        axes = [j for j in range(len(model.axes)) if model.placed[j][1] == plane]
        x0, slope = motion.of_planes[plane].T
        z = np.array([theta[f"{model.placed[j][0].name}.z"] if plane < 2 else 0.0 for j in axes])
        for arm in (np.ones(z.size), z) if plane < 2 else (np.ones(z.size),):
            block = np.zeros((motion.omega.size, len(names)), dtype=complex)
            turning = arm is not z
            if turning:
                block[:, column["m"]] = jw**2 * x0
                if plane < 2:
                    block[:, column["S"]] = jw**2 * slope
            else:
                block[:, column["S"]], block[:, column["J"]] = jw**2 * x0, jw**2 * slope
                if "Ip" in column:
                    other = motion.of_planes[1 - plane][:, 1]
                    block[:, column["Ip"]] = (1.0 if plane == 0 else -1.0) * speed * jw * other
            for j, a in zip(axes, arm, strict=True):
                block[:, column[f"{model.axes[j]}.k_x"]] = a * motion.at_magnets[:, j]
                if j in free_force:
                    block[:, column[f"{model.axes[j]}.k_i"]] = -a * pull[:, j]
            total = force[:, axes] @ arm
            size = np.sqrt(np.sum((np.abs(force[:, axes]) * np.abs(arm)) ** 2, axis=1))
            inertia = (mass or 1.0) * motion.omega**2 * (1.0 if turning else reach)
            noise = (
                np.sum(motion.noise_x[:, axes], axis=1) * inertia**2
                + (k_i[axes] ** 2 * motion.noise_i[:, axes]) @ arm**2
            )
            rows.append(block)
            right.append(total)
            weights.append(1.0 / np.sqrt((_RELATIVE * size) ** 2 + noise + 1e-300))
    fixed = {n: v for n, v in own.items() if n in column}
    if free_force:
        fixed["m"] = float(mass or 1.0)
    if "m" in fixed and "z_cg" in own:
        fixed["S"] = fixed["m"] * own["z_cg"]
    A, b, w = np.concatenate(rows), np.concatenate(right), np.concatenate(weights)
    values = np.array([fixed.get(n, 0.0) for n in names])
    free = [k for k, n in enumerate(names) if n not in fixed]
    values[free] = _real_solution(A[:, free], b - A @ values, w)
    got = dict(zip(names, values.tolist(), strict=True))
    m = abs(got["m"]) or 1.0
    mechanics = {"m": m, **{n: v for n, v in got.items() if n.endswith((".k_x", ".k_i"))}}
    if radial:
        z_cg = own.get("z_cg", got["S"] / m)
        inertia = got["J"] - m * z_cg**2
        mechanics |= {"z_cg": z_cg, "Id": inertia if inertia > 0.0 else m * reach**2 / 10.0}
        if model.polar:
            mechanics["Ip"] = abs(got.get("Ip", 0.0)) or 0.2 * mechanics["Id"]
    return mechanics


def _real_solution(A: Complex, b: Complex, weight: Array) -> Array:
    """Solve complex equations for real numbers in weighted least squares."""
    A, b = A * weight[:, None], b * weight
    return least_squares(np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag]))
