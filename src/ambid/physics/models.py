"""Linear models: physics as a function of named parameters (theory.md sec. 1).

A model turns parameters into continuous-time matrices and their exact derivatives. It knows nothing of data.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ambid.errors import ModelError
from ambid.physics.parameters import ParameterSpec

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateSpace:
    """Continuous-time matrices of x' = A x + B u + E d, y = C x.

    Attributes
    ----------
    A : ndarray, shape (n_states, n_states), 1/s in SI state units
    B : ndarray, shape (n_states, n_inputs)
        Inputs, held constant over a sample.
    E : ndarray, shape (n_states, n_disturbances)
        Disturbances (force in N, voltage in V): process noise and constant offsets enter here.
    C : ndarray, shape (n_outputs, n_states)
    """

    A: Array
    B: Array
    E: Array
    C: Array


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


_UNITS = {
    "voltage": "V",
    "current": "A",
    "position": "m",
    "velocity": "m/s",
    "force": "N",
}

_MASS = ParameterSpec(name="m", unit="kg", meaning="mass of the rotor on this axis", positive=True)
_K_X = ParameterSpec(name="k_x", unit="N/m", meaning="displacement coefficient, f = k_i i - k_x x")
_K_I = ParameterSpec(name="k_i", unit="N/A", meaning="force per current; also the motional voltage in V s/m")
_R = ParameterSpec(name="R", unit="ohm", meaning="coil resistance", positive=True)
_L = ParameterSpec(name="L", unit="H", meaning="coil inductance at the operating point", positive=True)
_C = ParameterSpec(name="c", unit="N s/m", meaning="mechanical damping", default=0.0)


@dataclass(frozen=True, slots=True)
class OneAxis:
    """Coil, magnet and mass on one axis (thesis eq. 4.4 and 4.8).

    m x'' = k_i i - k_x x - c x' + f,  V = R i + L i' + k_i x'; both position and current are measured
    (the printed C = [1 0 1]^T has to be two rows, theory.md sec. 1).

    Attributes
    ----------
    name, summary, parameters, inputs, outputs, states, disturbances
        As in `LinearModel`.
    """

    name: str = "one-axis"
    summary: str = "coil + magnet + mass on one axis: voltage in, position and current out"
    parameters: tuple[ParameterSpec, ...] = (_MASS, _K_X, _K_I, _R, _L, _C)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("position", "current")
    states: tuple[str, ...] = ("position", "velocity", "current")
    disturbances: tuple[str, ...] = ("force", "voltage")

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return _UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C of thesis eq. 4.8 with damping.

        Parameters
        ----------
        theta : Mapping[str, float]
            m, k_x, k_i, R, L, c in SI units.

        Returns
        -------
        StateSpace
            A (3, 3), B (3, 1), E (3, 2), C (2, 3).
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

        Parameters
        ----------
        theta : Mapping[str, float]
            m, k_x, k_i, R, L, c in SI units.
        parameter : str
            Name of the parameter.

        Returns
        -------
        StateSpace
            Derivatives of A (3, 3), B (3, 1), E (3, 2), C (2, 3).

        Raises
        ------
        ModelError
            If the model has no such parameter.
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
                raise _unknown_parameter(self, parameter)
        return StateSpace(A=d_a, B=d_b, E=d_e, C=np.zeros((2, 3)))

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the scale against which a damping near zero is judged: that of critical damping.

        Parameters
        ----------
        theta : Mapping[str, float]
            Parameters in SI units.

        Returns
        -------
        Mapping[str, float]
            ``{"c": sqrt(m |k|)}`` in N s/m, k the stiffness that sets the plant's frequency.
        """
        return {"c": float(np.sqrt(abs(theta["m"] * max(abs(theta["k_x"]), theta["k_i"] ** 2 / theta["L"]))))}


@dataclass(frozen=True, slots=True)
class Coil:
    """Coil with the rotor at rest (thesis eq. 2.3 and 4.1): V = R i + L i'.

    Attributes
    ----------
    name, summary, parameters, inputs, outputs, states, disturbances
        As in `LinearModel`.
    """

    name: str = "coil"
    summary: str = "coil alone, rotor held at rest: voltage in, current out"
    parameters: tuple[ParameterSpec, ...] = (_R, _L)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("current",)
    states: tuple[str, ...] = ("current",)
    disturbances: tuple[str, ...] = ("voltage",)

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return _UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C, each (1, 1), for R in ohm and L in H.

        Parameters
        ----------
        theta : Mapping[str, float]
            R and L in SI units.

        Returns
        -------
        StateSpace
            All of shape (1, 1).
        """
        r, ell = theta["R"], theta["L"]
        return StateSpace(
            A=np.array([[-r / ell]]), B=np.array([[1.0 / ell]]), E=np.array([[1.0 / ell]]), C=np.array([[1.0]])
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, each (1, 1).

        Parameters
        ----------
        theta : Mapping[str, float]
            R and L in SI units.
        parameter : str
            ``"R"`` or ``"L"``.

        Returns
        -------
        StateSpace
            All of shape (1, 1).

        Raises
        ------
        ModelError
            If the model has no such parameter.
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
                raise _unknown_parameter(self, parameter)

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return no scales: neither R nor L may be zero.

        Parameters
        ----------
        theta : Mapping[str, float]
            R and L in SI units.

        Returns
        -------
        Mapping[str, float]
            Empty.
        """
        del theta
        return {}


@dataclass(frozen=True, slots=True)
class Rotor:
    """Mass on a current-driven magnet (thesis eq. 2.1, 2.14): m x'' = k_i i - k_x x - c x' + f.

    The current is the input, as with a transconductance amplifier; the data show only ratios to m
    (theory.md sec. 1), so m wants a fixed value or a prior.

    Attributes
    ----------
    name, summary, parameters, inputs, outputs, states, disturbances
        As in `LinearModel`.
    """

    name: str = "rotor"
    summary: str = "magnet + mass, current-driven: current in, position out (shows ratios to m only)"
    parameters: tuple[ParameterSpec, ...] = (_MASS, _K_X, _K_I, _C)
    inputs: tuple[str, ...] = ("current",)
    outputs: tuple[str, ...] = ("position",)
    states: tuple[str, ...] = ("position", "velocity")
    disturbances: tuple[str, ...] = ("force",)

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return _UNITS

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A (2, 2), B (2, 1), E (2, 1), C (1, 2).

        Parameters
        ----------
        theta : Mapping[str, float]
            m, k_x, k_i, c in SI units.

        Returns
        -------
        StateSpace
            The continuous-time matrices.
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

        Parameters
        ----------
        theta : Mapping[str, float]
            m, k_x, k_i, c in SI units.
        parameter : str
            Name of the parameter.

        Returns
        -------
        StateSpace
            The derivatives.

        Raises
        ------
        ModelError
            If the model has no such parameter.
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
                raise _unknown_parameter(self, parameter)
        return StateSpace(A=d_a, B=d_b, E=d_e, C=np.zeros((1, 2)))

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return the scale against which a damping near zero is judged: that of critical damping.

        Parameters
        ----------
        theta : Mapping[str, float]
            Parameters in SI units.

        Returns
        -------
        Mapping[str, float]
            ``{"c": sqrt(m |k|)}`` in N s/m, k the stiffness that sets the plant's frequency.
        """
        return {"c": float(np.sqrt(abs(theta["m"] * theta["k_x"])))}


_MODELS: dict[str, LinearModel] = {m.name: m for m in (OneAxis(), Coil(), Rotor())}


def _unknown_parameter(of: LinearModel, parameter: str) -> ModelError:
    names = [p.name for p in of.parameters]
    return ModelError(
        f"model {of.name!r} has no parameter {parameter!r}; it has {', '.join(names)}.{nearest(parameter, names)}"
    )


def nearest(word: str, known: Sequence[str]) -> str:
    """Return `` Did you mean 'x'?`` for the known word closest to `word`, or an empty string.

    Parameters
    ----------
    word : str
        What was written.
    known : Sequence[str]
        What may be written.

    Returns
    -------
    str
        A sentence that begins with a space, or ``""``.
    """
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.4)
    return f" Did you mean {close[0]!r}?" if close else ""


def model_names() -> tuple[str, ...]:
    """Return the names of all linear models.

    Returns
    -------
    tuple of str
        Names as they are written in a rig file.
    """
    return tuple(_MODELS)


def model(name: str) -> LinearModel:
    """Return the linear model called `name`.

    Parameters
    ----------
    name : str
        One of `model_names`.

    Returns
    -------
    LinearModel
        The model.

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in _MODELS:
        raise ModelError(
            f"there is no model {name!r}; there are {', '.join(_MODELS)}.{nearest(name, list(_MODELS))} "
            "See 'ambid models'"
        )
    return _MODELS[name]
