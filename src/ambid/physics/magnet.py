"""Magnets on one axis: co-energy W'(x, i), and from it force f = dW'/dx along +x, flux linkage lambda = dW'/di and
inductance; df/di and the back-EMF per velocity dlambda/dx are the same number k_i (thesis eq. 4.4, 4.8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

from ambid.errors import ModelError

MU_0 = 4e-7 * math.pi
"""Permeability of free space in H/m (thesis eq. 2.7; the print drops pi)."""

Number = TypeVar("Number", float, complex)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoEnergy:
    """W'(x, i) = k_a (i0 + j)^2 / (2 (s_a - x)) + k_b (i0 - j)^2 / (2 (s_b + x)) + leakage i^2 / 2, j = i0_asym + i.
    Both magnets of this file are cases of it, so that one compiled loop simulates them all.
    """

    k_a: float  # magnet constants in N m^2/A^2 of the magnet that pulls along +x and of the one along -x
    s_a: float  # their gaps in m at x = 0; infinite where there is no such magnet
    k_b: float
    s_b: float
    i0: float  # bias current in A
    leakage: float  # inductance in H that does not depend on x
    i0_asym: float = 0.0  # half the difference of the two bias currents in A

    @classmethod
    def opposed(cls, *, k_i: float, k_x: float, L: float, gap: float, x: float = 0.0, i: float = 0.0) -> CoEnergy:
        """Return two equal magnets `gap` away that have these numbers (k_x < 0), and no force, at `x` and `i`
        (theory.md sec. 1): i0 = -k_x s0/k_i, k = k_i s0²/(2 i0), leakage what L has beyond k_i²/abs(k_x).
        """
        bias = -k_x * gap / k_i
        k = 0.5 * k_i * gap**2 / bias
        return cls(k_a=k, s_a=gap + x, k_b=k, s_b=gap - x, i0=bias, leakage=L - 2.0 * k / gap, i0_asym=-i)

    def value(self, x: Number, i: Number) -> Number:
        """Return W' in J at position `x` in m and axis current `i` in A."""
        j = self.i0_asym + i
        pull_a = self.k_a * (self.i0 + j) ** 2 / (self.s_a - x)
        pull_b = self.k_b * (self.i0 - j) ** 2 / (self.s_b + x)
        return (pull_a + pull_b + self.leakage * i**2) / 2.0

    def force(self, x: Number, i: Number) -> Number:
        """Return the force dW'/dx in N along +x at `x` in m and `i` in A."""
        j = self.i0_asym + i
        a, b = (self.i0 + j) / (self.s_a - x), (self.i0 - j) / (self.s_b + x)
        return (self.k_a * a * a - self.k_b * b * b) / 2.0

    def flux_linkage(self, x: Number, i: Number) -> Number:
        """Return the flux linkage dW'/di in V s at `x` in m and `i` in A."""
        j = self.i0_asym + i
        return self.k_a * (self.i0 + j) / (self.s_a - x) - self.k_b * (self.i0 - j) / (self.s_b + x) + self.leakage * i

    def inductance(self, x: Number, i: Number | float = 0.0) -> Number:  # noqa: ARG002  (other laws saturate)
        """Return L = dlambda/di in H at `x` in m; here it does not depend on the current `i` in A."""
        return self.k_a / (self.s_a - x) + self.k_b / (self.s_b + x) + self.leakage

    def force_per_current(self, x: Number, i: Number) -> Number:
        """Return k_i = df/di = dlambda/dx in N/A at `x` in m and `i` in A."""
        a, b = 1.0 / (self.s_a - x), 1.0 / (self.s_b + x)
        j = self.i0_asym + i
        return self.k_a * (self.i0 + j) * a * a + self.k_b * (self.i0 - j) * b * b

    def displacement_coefficient(self, x: Number, i: Number) -> Number:
        """Return k_x = -df/dx in N/m (negative for any attracting magnet) at `x` in m and `i` in A."""
        a, b = 1.0 / (self.s_a - x), 1.0 / (self.s_b + x)
        j = self.i0_asym + i
        return -(self.k_a * (self.i0 + j) ** 2 * a * a * a + self.k_b * (self.i0 - j) ** 2 * b * b * b)


class Energy(Protocol):
    """What a plant asks of a co-energy: itself and its derivatives at a position in m and an axis current in A."""

    def value(self, x: Number, i: Number) -> Number:
        """Return W' in J at `x` and `i`."""
        ...

    def force(self, x: Number, i: Number) -> Number:
        """Return dW'/dx in N along +x at `x` and `i`."""
        ...

    def flux_linkage(self, x: Number, i: Number) -> Number:
        """Return dW'/di in V s at `x` and `i`."""
        ...

    def inductance(self, x: Number, i: Number | float = 0.0) -> Number:
        """Return d2W'/di2 in H at `x` and `i`."""
        ...

    def force_per_current(self, x: Number, i: Number) -> Number:
        """Return d2W'/dx di in N/A at `x` and `i`."""
        ...

    def displacement_coefficient(self, x: Number, i: Number) -> Number:
        """Return -d2W'/dx2 in N/m at `x` and `i`."""
        ...


class Magnet(Protocol):
    """What a plant asks of a magnet."""

    @property
    def coenergy(self) -> Energy:
        """Co-energy as a function of position and axis current."""
        ...

    @property
    def range(self) -> tuple[float, float]:
        """Positions in m between which every gap is open."""
        ...

    def holding_current(self, x: float, load: float) -> float:
        """Return the axis current in A that holds `load` in N (along +x) at rest at `x` in m."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class SingleMagnet:
    """One attracting magnet; the position is its gap and grows away from it. f = -k (i/x)^2 / 2 along +x (thesis eq.
    1.9, 2.7), lambda = (k/x + leakage) i, so k_i < 0 and k_x < 0.
    """

    k: float  # magnet constant in N m^2/A^2: mu0 n^2 A (thesis eq. 2.7), half of it for a horseshoe's two gaps
    leakage: float = 0.0  # inductance in H that does not depend on the gap

    def __post_init__(self) -> None:
        _positive("k", self.k, "N m^2/A^2")
        _not_negative("leakage", self.leakage, "H")

    @property
    def coenergy(self) -> CoEnergy:
        """W' = k i^2 / (2 x) + leakage i^2 / 2."""
        return CoEnergy(k_a=0.0, s_a=math.inf, k_b=self.k, s_b=0.0, i0=0.0, leakage=self.leakage)

    @property
    def range(self) -> tuple[float, float]:
        """Positions in m between which the gap is open: (0, inf)."""
        return 0.0, math.inf

    def holding_current(self, x: float, load: float) -> float:
        """Return i = x sqrt(2 load / k) in A, which holds `load` N (away from the magnet, along +x) at gap `x` m."""
        _open(x, self.range)
        if load <= 0.0:
            raise ModelError(
                f"a single magnet only attracts: it cannot hold a load of {load:g} N along its own pull; the load must"
                " be positive (away from the magnet). Give gravity > 0"
            )
        return x * math.sqrt(2.0 * load / self.k)


@dataclass(frozen=True, slots=True, kw_only=True)
class DifferentialPair:
    """Two opposed magnets with currents i0 + i and i0 - i (theory.md sec. 1).

    f = k' cos(alpha) [((i0 + i)/(s0 - x))^2 - ((i0 - i)/(s0 + x))^2]. At the centre k_i = 4 k' i0/s0^2 cos(alpha) and
    k_x = -4 k' i0^2/s0^3 cos(alpha), one cosine each, as W' = k' cos(alpha) i^2/(s0 -+ x): the gap closes by the full
    x. What that leaves out of a coil's inductance at the centre, 2 k' (1 - cos(alpha))/s0, is constant and belongs to
    the leakage. (A gap s0 -+ x cos(alpha) would put cos(alpha)^2 into k_x: -1.19e5 N/m, not the -1.29e5 N/m of the
    unstable-bearing preset.)

    The bias is held by its source; the axis voltage is the difference V = V1 - V2 of the two coil voltages. Then V = R
    i + L i' + k_i x' with lambda = lambda1 - lambda2 = dW'/di, R = 2 R_coil, L = 2 L_coil and the k_i of the force.
    (One coil alone sees k_i/2 and L/2.) Without leakage L k_s = k_i^2, k_s = -k_x.

    Attributes
    ----------
    turns : float
        Of each magnet's winding.
    area : float
        Of one pole face in m^2.
    bias : float
        Bias current i0 in A.
    gap : float
        Gap s0 in m at the centre.
    half_angle : float
        Pole half-angle alpha in rad.
    leakage : float
        Inductance of the axis (both coils) in H.
    """

    turns: float
    area: float
    bias: float
    gap: float
    half_angle: float = 0.0
    leakage: float = 0.0

    def __post_init__(self) -> None:
        _positive("turns", self.turns, "1")
        _positive("area", self.area, "m^2")
        _positive("bias", self.bias, "A")
        _positive("gap", self.gap, "m")
        _not_negative("leakage", self.leakage, "H")
        if not 0.0 <= self.half_angle < math.pi / 2:
            raise ModelError(f"half_angle is {self.half_angle} rad; it must be in [0, pi/2). Give it in rad")

    @property
    def coenergy(self) -> CoEnergy:
        """W' of both magnets as a function of x and of the differential current."""
        k = MU_0 * self.turns**2 * self.area / 2.0 * math.cos(self.half_angle)
        return CoEnergy(k_a=k, s_a=self.gap, k_b=k, s_b=self.gap, i0=self.bias, leakage=self.leakage)

    @property
    def range(self) -> tuple[float, float]:
        """Positions in m between which both gaps are open: (-s0, s0)."""
        return -self.gap, self.gap

    def holding_current(self, x: float, load: float) -> float:
        """Return the differential current that holds `load` in N (along +x) at `x` in m, with both coils conducting.

        Solves a (i0 + i)^2 - b (i0 - i)^2 + load = 0 with a = k_a/(2 (s0 - x)^2) and b = k_b/(2 (s0 + x)^2).

        Parameters
        ----------
        x, load : float
            Position in m, constant force along +x in N.

        Returns
        -------
        float
            Differential current in A, abs(i) <= i0.

        Raises
        ------
        ModelError
            If no current up to the bias holds the load there.
        """
        _open(x, self.range)
        w = self.coenergy
        a, b = w.k_a / (2.0 * (w.s_a - x) ** 2), w.k_b / (2.0 * (w.s_b + x) ** 2)
        half, last = w.i0 * (a + b), (a - b) * w.i0**2 + load
        inside = half**2 - (a - b) * last
        # The root of (a - b) i^2 + 2 half i + last that stays finite for a = b.
        i = -last / (half + math.sqrt(inside)) if inside >= 0.0 else math.nan
        if not abs(i) <= w.i0:
            raise ModelError(
                f"a load of {load:g} N at {x:g} m needs more than the bias current of {w.i0:g} A; abs(i) must not"
                " exceed the bias. Lower the load or raise the bias"
            )
        return i


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ModelError(f"{name} is {value} {unit}; it must be a positive number. Correct {name}")


def _not_negative(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise ModelError(f"{name} is {value} {unit}; it must be zero or positive. Correct {name}")


def _open(x: float, between: tuple[float, float]) -> None:
    if not between[0] < x < between[1]:
        raise ModelError(
            f"position {x:g} m closes an air gap; it must lie between {between[0]:g} and {between[1]:g} m. Move it"
        )
