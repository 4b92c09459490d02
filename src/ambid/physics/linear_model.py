"""What a linear model is: physics as a function of named parameters (theory.md sec. 1).

A model turns parameters into continuous-time matrices and their exact derivatives. It knows nothing of data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from ambid.arrays import Array
from ambid.errors import ModelError, nearest
from ambid.physics.parameters import ParameterSpec

UNITS = {  # of inputs, outputs, states and disturbances
    "voltage": "V",
    "current": "A",
    "position": "m",
    "velocity": "m/s",
    "force": "N",
}

MASS = ParameterSpec(name="m", unit="kg", meaning="mass of the rotor on this axis", positive=True)
K_X = ParameterSpec(name="k_x", unit="N/m", meaning="displacement coefficient, f = k_i i - k_x x")
K_I = ParameterSpec(name="k_i", unit="N/A", meaning="force per current; also the motional voltage in V s/m")
R = ParameterSpec(name="R", unit="ohm", meaning="coil resistance", positive=True)
L = ParameterSpec(name="L", unit="H", meaning="coil inductance at the operating point", positive=True)
C = ParameterSpec(name="c", unit="N s/m", meaning="mechanical damping", default=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateSpace:
    """Continuous-time matrices of x' = A x + B u + E d, y = C x."""

    A: Array  # (n_states, n_states), 1/s in SI state units
    B: Array  # (n_states, n_inputs), inputs, held constant over a sample
    # (n_states, n_disturbances), disturbances (force in N, voltage in V): process noise and constant offsets enter
    # here
    E: Array
    C: Array  # (n_outputs, n_states)


class LinearModel(Protocol):
    """What the identification asks of a linear model.

    Attributes
    ----------
    name, summary : str
        Name in rig files, and one line for ``ambid models``.
    parameters : tuple of ParameterSpec
        All numbers of the model, in the order of its tables.
    inputs, outputs, states, disturbances : tuple of str
        Roles of the columns of B, rows of C, rows of A and columns of E.
    units : Mapping[str, str]
        SI unit of every input, output, state and disturbance.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def summary(self) -> str: ...  # noqa: D102
    @property
    def parameters(self) -> tuple[ParameterSpec, ...]: ...  # noqa: D102
    @property
    def inputs(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def outputs(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def states(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def disturbances(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def units(self) -> Mapping[str, str]: ...  # noqa: D102

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return the matrices at parameters `theta` (SI)."""
        ...

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return the exact derivative of the matrices at `theta` (SI) with respect to `parameter`."""
        ...

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return natural scales at `theta` (SI) of the parameters that may rightly be zero, to judge values against."""
        ...


def unknown_parameter(of: LinearModel, parameter: str) -> ModelError:
    """Return the error for a parameter that a model does not have.

    `parameter`: what was asked for. Returns names the nearest known parameter.
    """
    names = [p.name for p in of.parameters]
    return ModelError(
        f"model {of.name!r} has no parameter {parameter!r}; it has {', '.join(names)}.{nearest(parameter, names)}"
    )
