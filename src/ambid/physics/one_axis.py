"""Coil, magnet and mass on one axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.physics.linear_model import K_I, K_X, MASS, UNITS, C, L, R, StateSpace, unknown_parameter
from ambid.physics.parameters import ParameterSpec


@dataclass(frozen=True, slots=True)
class OneAxis:
    """Coil, magnet and mass on one axis (thesis eq. 4.4 and 4.8).

    m x'' = k_i i - k_x x - c x' + f,  V = R i + L i' + k_i x'; both position and current are measured (the printed C =
    [1 0 1]^T has to be two rows, theory.md sec. 1).
    """

    name: str = "one-axis"  # as in `LinearModel`
    summary: str = "coil + magnet + mass on one axis: voltage in, position and current out"
    parameters: tuple[ParameterSpec, ...] = (MASS, K_X, K_I, R, L, C)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("position", "current")
    states: tuple[str, ...] = ("position", "velocity", "current")
    disturbances: tuple[str, ...] = ("force", "voltage")

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C of thesis eq. 4.8 with damping.

        `theta`: m, k_x, k_i, R, L, c in SI units. Returns a (3, 3), B (3, 1), E (3, 2), C (2, 3).
        """
        m, k_x, k_i, r, ell, c = (theta[k] for k in ("m", "k_x", "k_i", "R", "L", "c"))
        return StateSpace(
            A=np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, k_i / m], [0.0, -k_i / ell, -r / ell]]),
            B=np.array([[0.0], [0.0], [1.0 / ell]]),
            E=np.array([[0.0, 0.0], [1.0 / m, 0.0], [0.0, 1.0 / ell]]),
            C=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, in the shapes of `matrices`.

        `theta`: m, k_x, k_i, R, L, c in SI units; `parameter`: name of the parameter. Returns derivatives of A (3, 3),
        B (3, 1), E (3, 2), C (2, 3).
        """
        m, k_x, k_i, r, ell, c = (theta[k] for k in ("m", "k_x", "k_i", "R", "L", "c"))
        d_a, d_b, d_e = np.zeros((3, 3)), np.zeros((3, 1)), np.zeros((3, 2))
        match parameter:
            case "m":
                d_a[1] = np.array([k_x, c, -k_i]) / m**2
                d_e[1, 0] = -1.0 / m**2
            case "k_x":
                d_a[1, 0] = -1.0 / m
            case "k_i":
                d_a[1, 2], d_a[2, 1] = 1.0 / m, -1.0 / ell
            case "R":
                d_a[2, 2] = -1.0 / ell
            case "L":
                d_a[2] = np.array([0.0, k_i, r]) / ell**2
                d_b[2, 0] = d_e[2, 1] = -1.0 / ell**2
            case "c":
                d_a[1, 1] = -1.0 / m
            case _:
                raise unknown_parameter(self, parameter)
        return StateSpace(A=d_a, B=d_b, E=d_e, C=np.zeros((2, 3)))

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the scale against which a damping near zero is judged: that of critical damping.

        `theta`: parameters in SI units. Returns ``{"c": sqrt(m |k|)}`` in N s/m, k the stiffness that sets the plant's
        frequency.
        """
        return {"c": float(np.sqrt(abs(theta["m"] * max(abs(theta["k_x"]), theta["k_i"] ** 2 / theta["L"]))))}
