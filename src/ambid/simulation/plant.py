"""Plants as the simulation loop takes them, and the poles of the sampled loop around them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.coenergy_law import law_numbers
from ambid.physics.law import StateLaw
from ambid.physics.law_magnet import BEARING_NUMBERS, LawMagnet
from ambid.physics.linear_model import LinearModel, discretise, model
from ambid.physics.loop import Loop
from ambid.physics.magnet import CoEnergy
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint

Equations = tuple[Array, Array, Array, Array] | tuple[Array, Array, tuple[float, float, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearPlant:
    """A linear model with numbers.

    Attributes
    ----------
    model : LinearModel
        One of `ambid.physics.linear_model.model`.
    parameters : Mapping[str, float]
        All of the model's parameters in SI units.
    """

    model: LinearModel
    parameters: Mapping[str, float]

    def __post_init__(self) -> None:
        for spec in self.model.parameters:
            value = self.parameters.get(spec.name, spec.default)
            if value is None or not math.isfinite(value) or (spec.positive and value <= 0.0):
                rule = "a positive number" if spec.positive else "a number"
                raise ModelError(
                    f"parameter {spec.name!r} of model {self.model.name!r} is {value}; a simulation needs {rule} "
                    f"in {spec.unit}. Give {spec.name}"
                )
        full = {s.name: float(self.parameters.get(s.name, s.default or 0.0)) for s in self.model.parameters}
        object.__setattr__(self, "parameters", MappingProxyType(full))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standing:
    """A plant at its operating point: what the simulation loop needs to know, linear or not."""

    plant: LinearPlant | NonlinearPlant  # the plant itself
    model: LinearModel  # its linear model, or the one that it linearises to
    point: OperatingPoint  # where it stands, SI
    # (n_states,), SI, the states at `point`; after those of the model the force behind the eddy pole, where there is
    # one
    centre: Array
    centre_input: float  # the input at `point`, SI

    @classmethod
    def of(cls, plant: LinearPlant | NonlinearPlant, point: OperatingPoint | None) -> Standing:
        """Return `plant` at `point`, by default at rest at zero."""
        more: list[float] = []
        if isinstance(plant, LinearPlant):
            linear, point = plant.model, point or OperatingPoint()
        else:
            linear, point = model("one-axis"), point or plant.equilibrium(0.0)
            if math.isfinite(plant.eddy_pole):
                more = [plant.magnet.coenergy.force(point.position, point.current)]
        values = {"position": point.position, "velocity": 0.0, "current": point.current, "voltage": point.voltage}
        values["force"] = 0.0  # behind an eddy pole, from rest
        return cls(
            plant=plant,
            model=linear,
            point=point,
            centre=np.array([values[s] for s in linear.states] + more),
            centre_input=values[linear.inputs[0]],
        )

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the linear model in SI units."""
        if isinstance(self.plant, LinearPlant):
            return self.plant.parameters
        return self.plant.linearise(self.point.position)

    @property
    def gap(self) -> tuple[float, float]:
        """Positions in m between which the equations hold."""
        return (-math.inf, math.inf) if isinstance(self.plant, LinearPlant) else self.plant.magnet.range

    def equations(self, period: float, fraction: float, substeps: int) -> Equations:
        """Return what a compiled loop steps the plant with, the input late by `fraction` of `period`: A, B, B_late and
        E, or magnet (k_a, s_a, k_b, s_b, i0, leakage, i0_asym of a `CoEnergy`, or `LawMagnet.vector`), body (m, c, R,
        gravity, eddy pole, v_drop, i_drop, limits, offset) and timing.
        """
        if isinstance(self.plant, LinearPlant):
            d, _ = discretise(self.model.matrices(self.plant.parameters), period, fraction=fraction)
            full, now, late, noise = (np.ascontiguousarray(x) for x in (d.A, d.B[:, 0], d.B_late[:, 0], d.E))
            return full, now, late, noise
        w, p = self.plant.magnet.coenergy, self.plant
        if isinstance(w, LawMagnet):
            magnet = np.array(w.vector)
        elif isinstance(w, CoEnergy):
            magnet = np.array([w.k_a, w.s_a, w.k_b, w.s_b, w.i0, w.leakage, w.i0_asym])
        else:
            raise ModelError(f"a {type(w).__name__} cannot be simulated. Give a CoEnergy or a LawMagnet")
        stage = p.stage
        body = [p.m, p.c, p.R, p.gravity, p.eddy_pole, stage.v_drop, stage.i_drop, *stage.limits, stage.offset]
        return magnet, np.array(body), (float(fraction), period, substeps)  # one type: one kernel


def nonlinear_truth(plant: NonlinearPlant) -> Mapping[str, float]:
    """Return, SI, the law's numbers and g of a nonlinear plant by the names of ``[magnet.parameters]``, of the others
    those that are not zero; and R, without what a drop adds to it.
    """
    magnet, stage, w = plant.magnet, plant.stage, plant.magnet.coenergy
    if isinstance(magnet, LawMagnet):
        numbers = {"L_leak": 0.0, **magnet.values, "x_offset": magnet.x_offset}
        always = {*magnet.law.names[:2], "L_leak", "g"}
    elif isinstance(w, CoEnergy) and (w.k_a == 0.0 or w.s_a == w.s_b):
        numbers = law_numbers(w)
        always = {"k", "s", "L_leak", "g"}
    else:
        return {}
    numbers |= {"a": plant.eddy_pole if math.isfinite(plant.eddy_pole) else 0.0, "v_offset": stage.offset}
    numbers |= {"v_drop": stage.v_drop, "i_drop": stage.i_drop if stage.v_drop else 0.0}
    numbers["g"] = plant.gravity
    names = [spec.name for spec in BEARING_NUMBERS if spec.name in numbers]
    return {"R": plant.R, **{n: numbers[n] for n in names if numbers[n] != 0.0 or n in always}}


def closed_loop_matrix(
    parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str | LinearModel = "one-axis"
) -> Array:
    """Return the matrix that carries [plant states, u[k-1], u[k-2], ..., controller states] over one sample.

    Parameters
    ----------
    parameters : Mapping[str, float]
        Of the model, in SI units.
    loop : Loop
        Controller and delay, the same on every axis.
    rate_hz : float
        Sampling rate in Hz.
    of : str or LinearModel
        Commands u and a PID's states I, D, x[k-1] are one for each of its inputs, those of a `StateLaw` are its own.

    Returns
    -------
    ndarray, shape (n_states + n_delayed n_inputs + n_controller, ...)
        Limits and quantisation are left out.
    """
    return excited_loop(parameters, loop, rate_hz, of=of)[0]


def fed_back(of: LinearModel) -> NDArray[np.int64]:
    """Return the outputs of position (first sensor) and current, ``ax_position`` and ``ax_current``, that the
    controller of each input such as ``ax_voltage`` feeds back, -1: none; (n_inputs, 2).
    """

    def place(name: str) -> int:
        return of.outputs.index(name) if name in of.outputs else -1

    axes = [name.removesuffix(name.rsplit("_", 1)[-1]) for name in of.inputs]
    return np.array([[place(f"{axis}position"), place(f"{axis}current")] for axis in axes], dtype=np.int64)


def signals_fed_back(of: LinearModel) -> NDArray[np.int64]:
    """Return the outputs that a `StateLaw` sees, in its order: position and current of one axis after the other."""
    pairs = fed_back(of).ravel()
    return pairs[pairs >= 0]


def law_on(loop: Loop, of: LinearModel, rate_hz: float) -> StateLaw | None:
    """Return the state-space law of a loop, if it has one; refuse another plant or rate."""
    if loop.law is not None:
        loop.law.check(len(of.inputs), signals_fed_back(of).size, rate_hz)
    return loop.law


def matrices_of(law: StateLaw | None) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, B, C, D and G as the compiled loops take them; empty without a law."""
    none = np.zeros((0, 0))
    return (none,) * 5 if law is None else (law.A, law.B, law.C, law.D, law.windup)


def excited_loop(
    parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str | LinearModel = "one-axis"
) -> tuple[Array, Array, Array]:
    """Return the matrix z of `closed_loop_matrix`, the rows that give the commands, and what an excitation e added to
    them does: states become z x + excited e, ordered is command x + e; vectors of a model with one input.
    """
    plant, period = model(of) if isinstance(of, str) else of, 1.0 / rate_hz
    whole = math.floor(loop.delay)
    d, _ = discretise(plant.matrices(parameters), period, fraction=loop.delay - whole)
    n, line, inputs = d.A.shape[0], whole + (loop.delay > whole), d.B.shape[1]
    law = law_on(loop, plant, rate_hz)
    first = n + line * inputs  # of the controller's states
    total = first + (3 * inputs if law is None else law.order)
    unit = np.eye(total)
    slots = [slice(n + j * inputs, n + (j + 1) * inputs) for j in range(line)]
    measured = np.zeros((d.C.shape[0] + 1, total))
    measured[:-1, :n] = d.C  # the last row is what is not fed back
    z, excited = np.zeros((total, total)), np.zeros((total, inputs))
    if law is None:
        i, dd, last = (slice(first + j * inputs, first + (j + 1) * inputs) for j in range(3))
        position, current = measured[fed_back(plant).T]
        derivative = (loop.filter_s * unit[dd] - loop.kd * (position - unit[last])) / (loop.filter_s + period)
        command = -loop.kp * position + unit[i] + derivative - loop.kc * current
        z[i] = unit[i] - loop.ki * period * position
        z[dd], z[last] = derivative, position
    else:
        seen = measured[signals_fed_back(plant)]
        command = law.C @ unit[first:] + law.D @ seen
        z[first:] = law.A @ unit[first:] + law.B @ seen
    history = [command, *(unit[s] for s in slots)]  # rows that give u[k], u[k-1], ...
    z[:n, :n] = d.A
    z[:n] += d.B @ history[whole]
    if line > whole:
        z[:n] += d.B_late @ history[whole + 1]
    if whole == 0:
        excited[:n] = d.B
    if line:
        excited[slots[0]] = np.eye(inputs)
    for j in range(line):
        z[slots[j]] = history[j]
    return (z, command[0], excited[:, 0]) if inputs == 1 else (z, command, excited)


def closed_loop_poles(
    parameters: Mapping[str, float], loop: Loop, rate_hz: float, *, of: str | LinearModel = "one-axis"
) -> NDArray[np.complex128]:
    """Return the poles of the sampled loop in the z plane; stable where all lie inside the unit circle.

    An integral without gain (ki = 0) is left out.

    Parameters
    ----------
    parameters : Mapping[str, float]
        Of the model, in SI units.
    loop : Loop
    rate_hz : float
        Sampling rate in Hz.
    of : str or LinearModel

    Returns
    -------
    ndarray, shape (n_poles,), complex
        Sorted by falling modulus.

    Raises
    ------
    ModelError
        If the parameters carry the loop beyond the finite numbers.
    """
    with np.errstate(all="ignore"):
        z = closed_loop_matrix(parameters, loop, rate_hz, of=of)
    if not np.isfinite(z).all():
        values = ", ".join(f"{name} = {value:g}" for name, value in parameters.items())
        raise ModelError(f"the loop at {rate_hz:g} Hz diverges ({values}). Correct the parameters")
    if loop.ki == 0.0 and loop.law is None:
        count = len((model(of) if isinstance(of, str) else of).inputs)
        keep = np.r_[: z.shape[0] - 3 * count, z.shape[0] - 2 * count : z.shape[0]]
        z = z[np.ix_(keep, keep)]
    poles = np.linalg.eigvals(z).astype(np.complex128)
    return poles[np.argsort(-np.abs(poles))]
