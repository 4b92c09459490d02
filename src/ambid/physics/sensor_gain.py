"""A linear model seen through sensors whose gain is a parameter: what a fault of a sensor looks like.

A sensor of gain g logs g x. With states in logged units, x_g = T x and T = diag(g of the state's sensor), the outputs
stay what they were and A becomes T A T^-1, B and E become T B and T E.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.physics.linear_model import LinearModel, ParameterSpec, StateSpace

PREFIX = "gain_"


@dataclass(frozen=True, slots=True)
class SensorGains:
    """A linear model with one more parameter for each output: ``gain_<output>``, 1 for a sensor as calibrated."""

    base: LinearModel  # its outputs are states of it

    @property
    def name(self) -> str:
        """Name of the base model."""
        return self.base.name

    @property
    def summary(self) -> str:
        """What it is, in one line."""
        return f"{self.base.summary}, with sensor gains"

    @property
    def gains(self) -> tuple[str, ...]:
        """Names of the gains, in the order of the outputs."""
        return tuple(f"{PREFIX}{output}" for output in self.base.outputs)

    @property
    def parameters(self) -> tuple[ParameterSpec, ...]:
        """Those of the base model, and the gains."""
        more = [
            ParameterSpec(
                name=f"{PREFIX}{output}", unit="1", meaning=f"gain of the {output} sensor", positive=True, default=1.0
            )
            for output in self.base.outputs
        ]
        return (*self.base.parameters, *more)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Of the base model."""
        return self.base.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Of the base model."""
        return self.base.outputs

    @property
    def states(self) -> tuple[str, ...]:
        """Of the base model, in logged units."""
        return self.base.states

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Of the base model."""
        return self.base.disturbances

    @property
    def units(self) -> Mapping[str, str]:
        """Of the base model."""
        return self.base.units

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the matrices of the model in logged units.

        `theta`: parameters in SI units; a gain that is absent is 1.
        """
        return self._logged(self.base.matrices(theta), theta)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the derivative of the matrices by one parameter.

        `theta`: parameters in SI units; `parameter`: of the base model, or a gain.
        """
        if parameter not in self.gains:
            return self._logged(self.base.derivative(theta, parameter), theta)
        at, g = self.matrices(theta), theta.get(parameter, 1.0)
        own = np.array([float(self._sensor(state) == parameter) for state in self.states]) / g
        return StateSpace(
            A=own[:, None] * at.A - at.A * own,
            B=own[:, None] * at.B,
            E=own[:, None] * at.E,
            C=np.zeros_like(at.C),
        )

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the natural scales of the base model.

        `theta`: parameters in SI units.
        """
        return self.base.references(theta)

    def _logged(self, at: StateSpace, theta: Mapping[str, float]) -> StateSpace:
        t = np.array([theta.get(self._sensor(state), 1.0) for state in self.states])
        return StateSpace(A=t[:, None] * at.A / t, B=t[:, None] * at.B, E=t[:, None] * at.E, C=at.C)

    def _sensor(self, state: str) -> str:
        """Name of the gain that a state is logged with; the velocity goes with the position."""
        of = "position" if state == "velocity" else state
        return f"{PREFIX}{of}"
