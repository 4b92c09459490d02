"""The rotor alone, driven by the measured current."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.physics.linear_model import K_I, K_X, MASS, UNITS, C, StateSpace, unknown_parameter
from ambid.physics.parameters import ParameterSpec


@dataclass(frozen=True, slots=True)
class Rotor:
    """Mass on a current-driven magnet (thesis eq. 2.1, 2.14): m x'' = k_i i - k_x x - c x' + f.

    The current is the input, as with a transconductance amplifier; the data show only ratios to m (theory.md sec. 1),
    so m wants a fixed value or a prior.
    """

    name: str = "rotor"  # as in `LinearModel`
    summary: str = "magnet + mass, current-driven: current in, position out (shows ratios to m only)"
    parameters: tuple[ParameterSpec, ...] = (MASS, K_X, K_I, C)
    inputs: tuple[str, ...] = ("current",)
    outputs: tuple[str, ...] = ("position",)
    states: tuple[str, ...] = ("position", "velocity")
    disturbances: tuple[str, ...] = ("force",)

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A (2, 2), B (2, 1), E (2, 1), C (1, 2).

        `theta`: m, k_x, k_i, c in SI units. Returns the continuous-time matrices.
        """
        m, k_x, k_i, c = (theta[k] for k in ("m", "k_x", "k_i", "c"))
        return StateSpace(
            A=np.array([[0.0, 1.0], [-k_x / m, -c / m]]),
            B=np.array([[0.0], [k_i / m]]),
            E=np.array([[0.0], [1.0 / m]]),
            C=np.array([[1.0, 0.0]]),
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, in the shapes of `matrices`.

        `theta`: m, k_x, k_i, c in SI units; `parameter`: name of the parameter. Returns the derivatives.
        """
        m, k_x, k_i, c = (theta[k] for k in ("m", "k_x", "k_i", "c"))
        d_a, d_b, d_e = np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 1))
        match parameter:
            case "m":
                d_a[1] = np.array([k_x, c]) / m**2
                d_b[1, 0], d_e[1, 0] = -k_i / m**2, -1.0 / m**2
            case "k_x":
                d_a[1, 0] = -1.0 / m
            case "k_i":
                d_b[1, 0] = 1.0 / m
            case "c":
                d_a[1, 1] = -1.0 / m
            case _:
                raise unknown_parameter(self, parameter)
        return StateSpace(A=d_a, B=d_b, E=d_e, C=np.zeros((1, 2)))

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the scale against which a damping near zero is judged: that of critical damping.

        `theta`: parameters in SI units. Returns ``{"c": sqrt(m |k|)}`` in N s/m, k the stiffness that sets the plant's
        frequency.
        """
        return {"c": float(np.sqrt(abs(theta["m"] * theta["k_x"])))}
