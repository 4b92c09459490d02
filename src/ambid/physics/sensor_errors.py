"""Errors of sensors: what each adds to the signals, how far J⁺c it moves the parameters (least squares with Jacobian
J), and the residuals c - J J⁺c, along which alone a score test sees it (Rao 1948); c: what e adds to G(jw; theta) u.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.physics.linear_model import LinearModel, ParameterSpec, StateSpace
from ambid.physics.rotor_model import RotorModel

Kind = Literal["gain", "offset", "zero", "lag", "cross-talk", "limiter", "fixed"]
CHANNELS = ("voltage", "current", "position", "time")
_LINES, _BEYOND = 60, 10.0  # of the default frequencies, and the factor by which they reach beyond the poles
_RANK = 1e-9  # relative singular value of directions that no parameter is moved along
_GENERIC = {"m": 1.3, "k_x": -2.1, "k_i": 1.7, "R": 0.9, "L": 0.6, "c": 0.4}  # of which whole powers are the same


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorError:
    """An error e of one channel, or of a number that the model takes for known, such as a sensor's plane, too large by
    e.

    To first order a channel logs: gain s + e s, offset s + e, lag (or a pole at 1/e) s - e s', cross-talk s + e s_2,
    time (1 + e) t; of a zero that moves between records, means (1 + e) times as far apart. Where all that it scales is
    free, no record shows a gain: of the position sensor it moves m and k_x by -2, k_i by -1 (one k_i fixes force and
    thesis eq. 4.4), if none is held. An offset moves no parameter.
    """

    kind: Kind
    channel: str  # role of an input or output, "time", or the name of a fixed number
    other: str = ""  # channel that a cross-talk is of

    @property
    def moves_signal(self) -> bool:
        """Whether its column is a signal's own, and no derivative of the matrices of a plant."""
        return self.kind == "limiter" or (self.kind == "lag" and not self.channel.endswith("_position"))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """What a record shows at `omega`, rad/s, of a plant, such as a rotor at its speed."""

    plant: LinearModel | RotorModel
    omega: Array
    excitation: Complex  # (n_lines, n_inputs, n_experiments)
    whiten: Complex | None = None  # (n_lines, n_outputs, n_outputs); None: each output over its rms


def logged_error(kind: Kind, signal: Complex, omega: Array, other: Complex | None = None) -> Complex:
    """Return what an error of one unit adds to the spectrum of its channel at `omega`; `other`: of cross-talk."""
    match kind:
        case "gain":
            return signal
        case "lag":
            return np.asarray(-1j * omega * signal)
        case "cross-talk" if other is not None:
            return other
    return np.zeros_like(signal)


def other_plane(model: RotorModel, k: int) -> int | None:
    """Return the sensor of the other plane beside sensor `k` of a rotor: the one it may have a cross-talk of."""
    j, number = model.sensors[k]
    bearing = model.placed[j][0]
    sensors = (i for i, (axis, n) in enumerate(model.sensors) if n == number and model.placed[axis][0] is bearing)
    return next((i for i in sensors if i != k), None)


def electrical_errors(model: RotorModel) -> tuple[SensorError, ...]:
    """Return the errors that a rotor's currents, voltages and commands may have; a voltage lags, or is limited, where
    its amplifier does.
    """
    roles = (*(x for x in model.outputs if x.endswith("_current")), *model.inputs)
    return tuple(SensorError(kind=kind, channel=role) for kind in ("gain", "lag", "limiter") for role in roles)


def position_errors(model: RotorModel) -> tuple[SensorError, ...]:
    """Return the errors that a rotor's position sensors may have and that are no parameters of the model."""
    outputs, free = model.outputs, set(model.extras)
    roles = [(outputs[k], model.axes[j], other_plane(model, k)) for k, (j, _) in enumerate(model.sensors)]
    return (
        *(SensorError(kind="gain", channel=role) for role, axis, _ in roles if f"{axis}.gain" not in free),
        *(SensorError(kind="lag", channel=role) for role, axis, _ in roles if f"{axis}.sensor_pole" not in free),
        *(
            SensorError(kind="cross-talk", channel=role, other=outputs[other])
            for role, _, other in roles
            if other is not None
        ),
    )


class _Response:
    """Outputs of a plant over lines, (n_lines, n_outputs, n_experiments), and what they are changed by."""

    def __init__(self, plant: LinearModel | RotorModel, theta: Mapping[str, float], omega: Array, u: Complex) -> None:
        self.plant, self.theta, self.omega, self.u = plant, theta, omega[:, None], u
        self.space = plant.matrices(theta)
        self.states = np.linalg.inv(1j * self.omega[:, None] * np.eye(len(self.space.A)) - self.space.A)
        self.read, self.names = self.space.C @ self.states, {p.name for p in plant.parameters}
        self.x = self.states @ self.space.B @ u
        self.y = self.space.C @ self.x

    def slope(self, name: str) -> Complex:
        """Derivative by a parameter."""
        if name not in self.names:  # such as a gyroscopic term at rest
            return np.zeros_like(self.y)
        d = self.plant.derivative(self.theta, name)
        return np.asarray(self.read @ (d.A @ self.x + d.B @ self.u) + d.C @ self.x)

    def column(self, error: SensorError) -> Complex:
        """Derivative by an error of what is logged, for the inputs that are logged."""
        if error.kind == "fixed":
            return -self.slope(error.channel)
        if error.channel == "time":  # G(jw) is taken for G(jw (1 + e))
            return np.asarray(-1j * self.omega[:, None] * (self.read @ self.x))
        roles, signals = self.plant.outputs, self.y
        if error.channel in self.plant.inputs:
            roles, signals = self.plant.inputs, self.u
        k, moved = roles.index(error.channel), np.zeros_like(signals)
        other = signals[:, roles.index(error.other)] if error.other else None
        moved[:, k] = logged_error(error.kind, signals[:, k], self.omega, other)
        # an input acts as it is: what is logged, less the error
        return moved if roles is self.plant.outputs else np.asarray(-self.read @ self.space.B @ moved)


def error_moves(
    plant: LinearModel | RotorModel,
    theta: Mapping[str, float],
    errors: Sequence[SensorError],
    *,
    free: Sequence[str] | None = None,
    omega: Array | None = None,
    lines: Sequence[Lines] = (),
) -> Array:
    """Return d ln(parameter) / d(error), (n_free, n_errors); of a parameter that is zero over its natural scale.

    `lines`: what records show, default each input alone at `omega` in rad/s, by itself around the poles. Errors are in
    SI, a lag in s. Directions that the outputs do not show are not moved along.
    """
    free = [p.name for p in plant.parameters if p.default is None] if free is None else list(free)
    if omega is None:
        poles = np.abs(np.linalg.eigvals(plant.matrices(theta).A))
        omega = np.geomspace(poles[poles > 0.0].min() / _BEYOND, _BEYOND * poles.max(), _LINES)
    alone = np.broadcast_to(np.eye(len(plant.inputs), dtype=complex), (omega.size, *(len(plant.inputs),) * 2))
    natural = {name: theta[name] or plant.references(theta).get(name, 1.0) for name in free}
    parts = list[Array]()
    for at in lines or [Lines(plant=plant, omega=omega, excitation=alone)]:
        response = _Response(at.plant, theta, at.omega, at.excitation)
        rms = np.sqrt(np.mean(np.abs(response.y) ** 2, axis=(0, 2)))
        whiten = np.diag(1.0 / rms).astype(complex) if at.whiten is None else at.whiten
        slopes = [natural[name] * response.slope(name) for name in free]
        c = np.array([(whiten @ x).ravel() for x in (*slopes, *map(response.column, errors))]).T
        parts += [c.real, c.imag]
    J, columns = np.split(np.concatenate(parts), [len(free)], axis=1)
    size = np.linalg.norm(J, axis=0)
    size[size == 0.0] = 1.0
    moves = np.linalg.lstsq(J / size, columns, rcond=_RANK)[0]
    return np.asarray(moves / size[:, None], dtype=float)


def unit_powers(plant: LinearModel) -> Mapping[str, tuple[int, ...]]:
    """Return by parameter the powers of the gains on `CHANNELS` that it scales with, 0 for a channel that is not there.
    All are free but a mass that nothing shows: without a voltage only ratios to it are seen.
    """
    theta = {p.name: _GENERIC[p.name] for p in plant.parameters}
    free = [name for name in theta if name != "m" or "voltage" in plant.inputs]
    there = [c for c in CHANNELS if c in (*plant.inputs, *plant.outputs, "time")]
    moves = error_moves(plant, theta, [SensorError(kind="gain", channel=c) for c in there], free=free)
    powers = {name: dict(zip(there, np.rint(row), strict=True)) for name, row in zip(free, moves, strict=True)}
    return {name: tuple(int(powers.get(name, {}).get(c, 0)) for c in CHANNELS) for name in theta}


class SensorGains:
    """A linear model with one more parameter for each output: ``gain_<output>``, 1 for a sensor as calibrated. In
    logged units x_g = T x, T = diag(gain of the state's sensor), A becomes T A T^-1, B and E T B and T E; outputs stay.
    """

    def __init__(self, base: LinearModel) -> None:
        """`base`: its outputs are states of it."""
        self.base, self.name, self.summary = base, base.name, f"{base.summary}, with sensor gains"
        self.inputs, self.outputs, self.states = base.inputs, base.outputs, base.states
        self.disturbances, self.units = base.disturbances, base.units
        self.gains = tuple(f"gain_{output}" for output in base.outputs)
        self.parameters: tuple[ParameterSpec, ...] = (
            *base.parameters,
            *(
                ParameterSpec(name=f"gain_{x}", unit="1", meaning=f"gain of the {x} sensor", positive=True, default=1.0)
                for x in base.outputs
            ),
        )
        # of each state; the velocity goes with the position
        self._gains = [f"gain_{'position' if state == 'velocity' else state}" for state in base.states]

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the matrices in logged units; a gain that `theta` lacks is 1."""
        return self._logged(self.base.matrices(theta), theta)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the derivative of the matrices by a parameter of the base model, or a gain."""
        if parameter not in self.gains:
            return self._logged(self.base.derivative(theta, parameter), theta)
        at = self.matrices(theta)
        own = np.array([float(gain == parameter) for gain in self._gains]) / theta.get(parameter, 1.0)
        return StateSpace(
            A=own[:, None] * at.A - at.A * own, B=own[:, None] * at.B, E=own[:, None] * at.E, C=np.zeros_like(at.C)
        )

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the natural scales of the base model."""
        return self.base.references(theta)

    def _logged(self, at: StateSpace, theta: Mapping[str, float]) -> StateSpace:
        t = np.array([theta.get(gain, 1.0) for gain in self._gains])
        return StateSpace(A=t[:, None] * at.A / t, B=t[:, None] * at.B, E=t[:, None] * at.E, C=at.C)
