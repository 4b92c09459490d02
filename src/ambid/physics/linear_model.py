"""Linear models, which know no data: parameters, physics (theory.md sec. 1), exact discretisation. An input held over a
sample may reach the plant a fraction late (Astrom and Wittenmark, Computer-Controlled Systems, ch. 2).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError, choices

Role = Literal["free", "fixed", "prior"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSpec:
    """A number that a model has."""

    name: str  # name in code, SI unit, and one line that says what it is (theory.md sec. 0).
    unit: str
    meaning: str
    positive: bool = False  # physics allows positive values only (mass, resistance, inductance)
    default: float | None = None  # value taken as fixed when nothing is said of it; None: it is free


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """What is known of one parameter, in SI units.

    Attributes
    ----------
    name, unit : str
    role : {"free", "fixed", "prior"}
        Estimated; held at `value`; estimated with a Gaussian prior (`value`, `sd`).
    value : float or None
        Start value (free, optional), value (fixed) or mean (prior).
    sd : float or None
        Standard deviation of the prior; None otherwise.
    """

    name: str
    unit: str
    role: Role = "free"
    value: float | None = None
    sd: float | None = None

    def __post_init__(self) -> None:
        if self.role in ("fixed", "prior") and self.value is None:
            raise ModelError(f"parameter {self.name!r} is {self.role} but has no value. Give value = ...")
        if self.role == "prior" and not (self.sd is not None and self.sd > 0):
            raise ModelError(
                f"parameter {self.name!r} has a prior without a positive sd (got {self.sd}). Give sd = ..."
            )
        if self.role != "prior" and self.sd is not None:
            raise ModelError(f"parameter {self.name!r} is {self.role} but has an sd. Remove sd, or set role = 'prior'")


UNITS = {  # of inputs, outputs, states and disturbances
    "voltage": "V",
    "command": "V",
    "current": "A",
    "position": "m",
    "velocity": "m/s",
    "force": "N",
}

MASS = ParameterSpec(name="m", unit="kg", meaning="mass of the rotor on this axis", positive=True)
K_X = ParameterSpec(name="k_x", unit="N/m", meaning="position stiffness (negative for a magnet), f = k_i i - k_x x")
K_I = ParameterSpec(name="k_i", unit="N/A", meaning="force–current factor; also the back-EMF in V s/m")
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


def unknown_parameter(plant: LinearModel, parameter: str) -> ModelError:
    """Return the error for a parameter that a model does not have; it names the nearest."""
    names = [p.name for p in plant.parameters]
    return ModelError(f"model {plant.name!r} has no parameter {parameter!r}; it has {choices(parameter, names)}")


class _OnAxis:
    """What models of one axis share."""

    __slots__ = ()

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of inputs, outputs, states and disturbances."""
        return UNITS

    def references(self, theta: Mapping[str, float]) -> Mapping[str, float]:
        """Return no scales: no parameter may be zero, unless a model says otherwise."""
        del theta
        return {}


@dataclass(frozen=True, slots=True)
class OneAxis(_OnAxis):
    """Coil, magnet and mass on one axis (thesis eq. 4.4 and 4.8): m x'' = k_i i - k_x x - c x' + f, V = R i + L i' +
    k_i x'; position and current are measured (the printed C = [1 0 1]^T has to be two rows, theory.md sec. 1).
    """

    name: str = "one-axis"  # as in `LinearModel`
    summary: str = "coil + magnet + mass on one axis: voltage in, position and current out"
    parameters: tuple[ParameterSpec, ...] = (MASS, K_X, K_I, R, L, C)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("position", "current")
    states: tuple[str, ...] = ("position", "velocity", "current")
    disturbances: tuple[str, ...] = ("force", "voltage")

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A (3, 3), B (3, 1), E (3, 2), C (2, 3) of thesis eq. 4.8, damped; m, k_x, k_i, R, L, c in SI."""
        m, k_x, k_i, r, ell, c = (theta[k] for k in ("m", "k_x", "k_i", "R", "L", "c"))
        return StateSpace(
            A=np.array([[0.0, 1.0, 0.0], [-k_x / m, -c / m, k_i / m], [0.0, -k_i / ell, -r / ell]]),
            B=np.array([[0.0], [0.0], [1.0 / ell]]),
            E=np.array([[0.0, 0.0], [1.0 / m, 0.0], [0.0, 1.0 / ell]]),
            C=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, in the shapes of `matrices`."""
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
        """Return ``{"c": sqrt(m |k|)}`` in N s/m, critical damping, against which a damping near zero is judged; k is
        the stiffness that sets the plant's frequency.
        """
        return {"c": float(np.sqrt(abs(theta["m"] * max(abs(theta["k_x"]), theta["k_i"] ** 2 / theta["L"]))))}


@dataclass(frozen=True, slots=True)
class Coil(_OnAxis):
    """Coil with the rotor at rest (thesis eq. 2.3 and 4.1): V = R i + L i'."""

    name: str = "coil"  # as in `LinearModel`
    summary: str = "coil alone, rotor held at rest: voltage in, current out"
    parameters: tuple[ParameterSpec, ...] = (R, L)
    inputs: tuple[str, ...] = ("voltage",)
    outputs: tuple[str, ...] = ("current",)
    states: tuple[str, ...] = ("current",)
    disturbances: tuple[str, ...] = ("voltage",)

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A, B, E, C, each (1, 1), for R in ohm and L in H."""
        r, ell = theta["R"], theta["L"]
        return StateSpace(
            A=np.array([[-r / ell]]), B=np.array([[1.0 / ell]]), E=np.array([[1.0 / ell]]), C=np.array([[1.0]])
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for ``"R"`` or ``"L"``, each (1, 1)."""
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


@dataclass(frozen=True, slots=True)
class Rotor(_OnAxis):
    """Mass on a current-driven magnet (thesis eq. 2.1, 2.14): m x'' = k_i i - k_x x - c x' + f. The current is the
    input, as with a transconductance amplifier; data show only ratios to m (theory.md sec. 1): fix it, or give a prior.
    """

    name: str = "rotor"  # as in `LinearModel`
    summary: str = "magnet + mass, current-driven: current in, position out (identifies ratios to m only)"
    parameters: tuple[ParameterSpec, ...] = (MASS, K_X, K_I, C)
    inputs: tuple[str, ...] = ("current",)
    outputs: tuple[str, ...] = ("position",)
    states: tuple[str, ...] = ("position", "velocity")
    disturbances: tuple[str, ...] = ("force",)

    def matrices(self, theta: Mapping[str, float]) -> StateSpace:
        """Return A (2, 2), B (2, 1), E (2, 1), C (1, 2) of m, k_x, k_i, c in SI."""
        m, k_x, k_i, c = (theta[k] for k in ("m", "k_x", "k_i", "c"))
        return StateSpace(
            A=np.array([[0.0, 1.0], [-k_x / m, -c / m]]),
            B=np.array([[0.0], [k_i / m]]),
            E=np.array([[0.0], [1.0 / m]]),
            C=np.array([[1.0, 0.0]]),
        )

    def derivative(self, theta: Mapping[str, float], parameter: str) -> StateSpace:
        """Return dA, dB, dE, dC for one parameter, in the shapes of `matrices`."""
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
        """Return ``{"c": sqrt(m |k|)}`` in N s/m, as of `OneAxis`."""
        return {"c": float(np.sqrt(abs(theta["m"] * theta["k_x"])))}


_MODELS: dict[str, LinearModel] = {m.name: m for m in (OneAxis(), Coil(), Rotor())}


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

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in _MODELS:
        raise ModelError(f"model {name!r} is unknown; known: {choices(name, _MODELS)} See 'ambid models'")
    return _MODELS[name]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DiscreteSpace:
    """Matrices of x[k+1] = A x[k] + B u[k-d] + B_late u[k-d-1] + E d[k], y[k] = C x[k]."""

    A: Array  # (n_states, n_states)
    B: Array  # (n_states, n_inputs), `B_late` is zero where the delay is a whole number of samples
    B_late: Array
    E: Array  # (n_states, n_disturbances), disturbances held over a sample
    C: Array  # (n_outputs, n_states)


def zero_order_hold(A: Array, B: Array, period_s: float) -> tuple[Array, Array]:
    """Return x' = A x + B u discretised exactly, u held over a sample: exp([[A, B], [0, 0]] T) holds both (Van Loan
    1978). A may be complex for a complex step.
    """
    n, n_u = B.shape
    block = np.zeros((n + n_u, n + n_u), dtype=np.result_type(A, B))
    block[:n, :n], block[:n, n:] = A, B
    full = _exponential(block * period_s, n)
    return full[:n, :n], full[:n, n:]


def discretise(
    space: StateSpace, period_s: float, *, fraction: float | None = None, derivatives: Sequence[StateSpace] = ()
) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
    """Discretise exactly, with the derivatives along directions (dA, dB, dE), dC passed on, and along a `fraction` if
    given.

    exp([[A, B, E], [0, 0, 0]] T) holds A_d, B_d and E_d (Van Loan 1978); a derivative is the upper right block of
    exp([[M, dM], [0, M]] T) (Mathias 1996). Without directions matrices may be stacked, (..., rows, columns).
    """
    n, nu = space.B.shape[-2:]
    size = n + nu + space.E.shape[-1]
    kind = np.result_type(space.A, space.B, space.E)
    several, width = ((len(derivatives),), 2 * size) if derivatives else (space.A.shape[:-2], size)
    stack = np.zeros((*several, width, width), dtype=kind)
    edges = (slice(0, n), slice(n, n + nu), slice(n + nu, size))
    for name, columns in zip("ABE", edges, strict=True):
        stack[..., :n, columns] = getattr(space, name)
        if derivatives:
            stack[:, :n, columns.start + size : columns.stop + size] = [getattr(d, name) for d in derivatives]
    if derivatives:
        stack[:, size : size + n, size:] = stack[:, :n, :size]
    stack *= period_s
    full = _exponential(stack, n)
    late = full if fraction is None else _exponential(stack * (1.0 - fraction), n)

    def split(now: Array, partial: Array, c: Array) -> DiscreteSpace:
        b = partial[..., :n, n : n + nu]
        return DiscreteSpace(
            A=now[..., :n, :n], B=b, B_late=now[..., :n, n : n + nu] - b, E=now[..., :n, n + nu : size], C=c
        )

    first, first_late = (full[0], late[0]) if derivatives else (full, late)
    discrete = split(first, first_late, space.C)
    directional = [split(full[j, :size, size:], late[j, :size, size:], d.C) for j, d in enumerate(derivatives)]
    if fraction is not None:
        slope = -period_s * first_late[..., :n, :n] @ space.B
        zero = np.zeros_like
        directional.append(
            DiscreteSpace(A=zero(discrete.A), B=slope, B_late=-slope, E=zero(discrete.E), C=zero(space.C))
        )
    return discrete, tuple(directional)


def delayed(space: StateSpace, period_s: float, delays: Sequence[float] | Array) -> DiscreteSpace:
    """Discretise exactly, each input late by its delay in samples, whole and fraction: the states followed by the
    inputs on their way; B_late is zero.
    """
    n, whole = space.A.shape[0], np.floor(delays).astype(int)
    line = whole + (np.asarray(delays) > whole)
    first = n + np.concatenate([[0], np.cumsum(line)])
    A, B = np.zeros((first[-1], first[-1])), np.zeros((first[-1], whole.size))
    for j in range(whole.size):
        d, _ = discretise(space, period_s, fraction=float(delays[j] - whole[j]))
        A[:n, :n] = d.A
        history = [B[:, j], *(A[:, k] for k in range(first[j], first[j + 1]))]  # what u[k], u[k-1], ... act on
        history[whole[j]][:n] += d.B[:, j]
        if line[j] > whole[j]:
            history[-1][:n] += d.B_late[:, j]
        for k, column in enumerate(history[: line[j]]):
            column[first[j] + k] = 1.0
    E, C = np.zeros((A.shape[0], d.E.shape[1])), np.zeros((space.C.shape[0], A.shape[0]))
    E[:n], C[:, :n] = d.E, space.C
    return DiscreteSpace(A=A, B=B, B_late=np.zeros_like(B), E=E, C=C)


_PADE = (17297280.0, 8648640.0, 1995840.0, 277200.0, 25200.0, 1512.0, 56.0, 1.0)  # of order 7
_REACH = 0.95  # norm up to which it is right to rounding (Higham 2005)


def _exponential(a: NDArray[Any], n: int) -> NDArray[Any]:
    """Exponential of matrices (..., size, size) by scaling and squaring (Higham 2005), scaled by their first `n` rows
    and columns, which the others only follow: large inputs cost no digits.
    """
    norms = np.sum(np.abs(a[..., :n, :n]), axis=-2)
    norm = float(np.max(norms, initial=0.0, where=np.isfinite(norms)))
    squarings = max(0, int(np.ceil(np.log2(norm / _REACH)))) if norm > 0.0 else 0
    a = a / 2.0**squarings
    square = a @ a
    fourth = square @ square
    even = (np.eye(a.shape[-1]), square, fourth, square @ fourth)
    odd = a @ sum(c * power for c, power in zip(_PADE[1::2], even, strict=True))
    rest = sum(c * power for c, power in zip(_PADE[::2], even, strict=True))
    more = np.linalg.solve(rest - odd, 2.0 * odd)  # what is beyond the identity: digits of slow modes stand there
    for _ in range(squarings):
        more = 2.0 * more + more @ more
    return np.asarray(more + np.eye(a.shape[-1]))
