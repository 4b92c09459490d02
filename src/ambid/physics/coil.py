"""The coil alone, rotor at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.physics.linear_model import UNITS, L, R, StateSpace, unknown_parameter
from ambid.physics.parameters import ParameterSpec


@dataclass(frozen=True, slots=True)
class Coil:
    """Coil with the rotor at rest (thesis eq. 2.3 and 4.1): V = R i + L i'."""

    name: str = "coil"  # as in `LinearModel`
    summary: str = "coil alone, rotor held at rest: voltage in, current out"
    parameters: tuple[ParameterSpec, ...] = (R, L)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("current",)
    states: tuple[str, ...] = ("current",)
    disturbances: tuple[str, ...] = ("voltage",)

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C, each (1, 1), for R in ohm and L in H.

        `theta`: R and L in SI units. Returns all of shape (1, 1).
        """
        r, ell = theta["R"], theta["L"]
        return StateSpace(
            A=np.array([[-r / ell]]), B=np.array([[1.0 / ell]]), E=np.array([[1.0 / ell]]), C=np.array([[1.0]])
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, each (1, 1).

        `theta`: R and L in SI units; `parameter`: ``"R"`` or ``"L"``. Returns all of shape (1, 1).
        """
        r, ell = theta["R"], theta["L"]
        zero = np.zeros((1, 1))
        match parameter:
            case "R":
                return StateSpace(A=np.array([[-1.0 / ell]]), B=zero, E=zero, C=zero)
            case "L":
                d_b = np.array([[-1.0 / ell**2]])
                return StateSpace(A=np.array([[r / ell**2]]), B=d_b, E=d_b, C=zero)
            case _:
                raise unknown_parameter(self, parameter)

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return no scales: neither R nor L may be zero.

        `theta`: R and L in SI units. Returns empty.
        """
        del theta
        return {}
