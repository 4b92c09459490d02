"""Plants as the simulation loop takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.discretise import discretise
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import LinearModel
from ambid.physics.magnet import CoEnergy
from ambid.physics.models import model
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearPlant:
    """A linear model with numbers.

    Attributes
    ----------
    model : LinearModel
        One of `ambid.physics.models.model`.
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
                    f"parameter {spec.name!r} of model {self.model.name!r} is {value}; a simulation wants {rule} in"
                    f" {spec.unit}. Give {spec.name}"
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
            of, point = plant.model, point or OperatingPoint()
        else:
            of, point = model("one-axis"), point or plant.equilibrium(0.0)
            if math.isfinite(plant.eddy_pole):
                more = [plant.magnet.coenergy.force(point.position, point.current)]
        known = {"position": point.position, "velocity": 0.0, "current": point.current, "voltage": point.voltage}
        return cls(
            plant=plant,
            model=of,
            point=point,
            centre=np.array([known[s] for s in of.states] + more),
            centre_input=known[of.inputs[0]],
        )

    @property
    def linear(self) -> bool:
        """True for a linear plant."""
        return isinstance(self.plant, LinearPlant)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the linear model in SI units."""
        if isinstance(self.plant, LinearPlant):
            return self.plant.parameters
        return self.plant.linearise(self.point.position)

    @property
    def gap(self) -> tuple[float, float]:
        """Positions in m between which the equations hold."""
        return (-math.inf, math.inf) if isinstance(self.plant, LinearPlant) else self.plant.magnet.range

    def matrices(self, period: float, fraction: float) -> tuple[Array, Array, Array, Array]:
        """Return A, B, B_late and E over a period; zeros for a nonlinear plant.

        `period`: in s; `fraction`: part of the period by which the input is late, 0 to 1. Returns shapes (n_states,
        n_states), (n_states,), (n_states,), (n_states, n_disturbances).
        """
        if not isinstance(self.plant, LinearPlant):
            return np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros((3, 2))
        d, _ = discretise(self.model.matrices(self.plant.parameters), period, fraction=fraction)
        full, now, late, noise = (np.ascontiguousarray(x) for x in (d.A, d.B[:, 0], d.B_late[:, 0], d.E))
        return full, now, late, noise

    def nonlinear(self) -> tuple[Array, Array]:
        """Return the numbers of the magnet, and of body and stage, for compiled loops; zeros for a linear plant.

        Returns `magnet`: k_a, s_a, k_b, s_b, i0, leakage and i0_asym of a `CoEnergy`, or `LawMagnet.vector`; SI;
        `body`: (10,), m, c, R, gravity, eddy pole, v_drop, i_drop, the stage's limits and its offset; SI.
        """
        if isinstance(self.plant, LinearPlant):
            return np.zeros(7), np.zeros(10)
        w, p = self.plant.magnet.coenergy, self.plant
        if isinstance(w, LawMagnet):
            magnet = w.vector
        elif isinstance(w, CoEnergy):
            magnet = np.array([w.k_a, w.s_a, w.k_b, w.s_b, w.i0, w.leakage, w.i0_asym])
        else:
            raise ModelError(f"a {type(w).__name__} cannot be simulated. Give a CoEnergy or a LawMagnet")
        stage = p.stage
        body = [p.m, p.c, p.R, p.gravity, p.eddy_pole, stage.v_drop, stage.i_drop, *stage.limits, stage.offset]
        return magnet, np.array(body)
