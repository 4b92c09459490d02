"""Magnets with leakage, saturation and a choice of gap law, from one co-energy; with the derivatives that a fit needs.

W'(x, i) = sum over magnets of g(gap) h(current) + S(i): force dW'/dx, flux linkage dW'/di, k_i = d2W'/dx di,
k_x = -d2W'/dx2, L = d2W'/di2 (thesis eq. 1.9, 2.7, 4.4 and 4.8 are the case g = k/gap, h = i^2/2, S = 0). So force and
motional voltage cannot disagree, whatever the numbers.

- gap law g(d): hyperbolic k/(s + d), an ideal gap of reluctance proportional to s + d; or exponential L_g exp(-d/zeta),
  a small armature before a pole, whose flux spreads sideways.
- iron h(j) = j^2/(1 + sqrt(1 + sigma j^2)): j^2/2 for small currents, growing as j for j^2 sigma >> 1 (saturated: flux
  no longer grows). sigma = 0 is a linear magnet.
- coil iron S''(i) = L_leak + L_rise i^2/(i^2 + i_knee^2): inductance that does not depend on the position, rising from
  that of initial permeability to that of the open core; L_rise = 0 is plain leakage.

One magnet: d = x (the position is the gap, up to s), j = i. A pair: d = -x, j = i0 + i and d = x, j = i0 - i.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import ModelError
from ambid.physics.magnet import CoEnergy, Number

Array = NDArray[np.float64]

MAGNET_NUMBERS = ("strength", "length", "sigma", "L_leak", "L_rise", "i_knee", "i0")
"""Places of a magnet's numbers in the vector `q`: strength is k or L_g, length is s or zeta."""

FIRST, THIRD = 4, 8
"""Of W_x, W_xx, W_xi, W_ii, W_xxx, W_xxi, W_xii, W_iii: how many carry derivatives by `q`, and how many there are."""

_SIGN = np.array([1.0, -1.0, 1.0, 1.0])  # k_x = -W_xx


def coenergy_derivatives(x: float, i: float, q: Array, exponential: bool, pair: bool, w: Array, dw: Array) -> None:
    """Write the derivatives of W' at one point; plain scalar code that the estimator's kernels compile.

    Parameters
    ----------
    x, i : float
        Position in m, axis current in A.
    q : ndarray, shape (7,), SI
        See `MAGNET_NUMBERS`.
    exponential, pair : bool
        Gap law, and whether two magnets oppose each other.
    w : ndarray, shape (8,)
        Written: W_x, W_xx, W_xi, W_ii, W_xxx, W_xxi, W_xii, W_iii.
    dw : ndarray, shape (4, 7)
        Written: derivatives of the first four by `q`.
    """
    for a in range(8):
        w[a] = 0.0
    for a in range(4):
        for b in range(7):
            dw[a, b] = 0.0
    k, s, sigma = q[0], q[1], q[2]
    for side in range(2 if pair else 1):
        sd = -1.0 if pair and side == 0 else 1.0  # d(gap)/dx
        sc = -1.0 if side == 1 else 1.0  # d(coil current)/di
        d, j = sd * x, sc * i + (q[6] if pair else 0.0)
        if exponential:
            g = k * math.exp(-d / s)
            g1, g2, g3 = -g / s, g / s**2, -g / s**3
            gs = g * d / s**2
            g1s, g2s = g / s**2 - gs / s, gs / s**2 - 2.0 * g / s**3
        else:
            g = k / (s + d)
            g1 = -g / (s + d)
            g2 = -2.0 * g1 / (s + d)
            g3 = -3.0 * g2 / (s + d)
            gs, g1s, g2s = g1, g2, g3
        r = math.sqrt(1.0 + sigma * j * j)
        h, h1, h2, h3 = j * j / (1.0 + r), j / r, r**-3, -3.0 * sigma * j * r**-5
        w[0] += sd * g1 * h
        w[1] += g2 * h
        w[2] += sd * sc * g1 * h1
        w[3] += g * h2
        w[4] += sd * g3 * h
        w[5] += sc * g2 * h1
        w[6] += sd * g1 * h2
        w[7] += sc * g * h3
        dw[0, 0] += sd * g1 / k * h
        dw[1, 0] += g2 / k * h
        dw[2, 0] += sd * sc * g1 / k * h1
        dw[3, 0] += g / k * h2
        dw[0, 1] += sd * g1s * h
        dw[1, 1] += g2s * h
        dw[2, 1] += sd * sc * g1s * h1
        dw[3, 1] += gs * h2
        hs, h1s, h2s = -(j**4) / (2.0 * r * (1.0 + r) ** 2), -(j**3) / (2.0 * r**3), -1.5 * j * j / r**5
        dw[0, 2] += sd * g1 * hs
        dw[1, 2] += g2 * hs
        dw[2, 2] += sd * sc * g1 * h1s
        dw[3, 2] += g * h2s
        if pair:
            dw[0, 6] += sd * g1 * h1
            dw[1, 6] += g2 * h1
            dw[2, 6] += sd * sc * g1 * h2
            dw[3, 6] += g * h3
    square = i * i + q[5] * q[5]
    part = i * i / square
    w[3] += q[3] + q[4] * part
    w[7] += 2.0 * q[4] * i * q[5] * q[5] / square**2
    dw[3, 3] = 1.0
    dw[3, 4] = part
    dw[3, 5] = -2.0 * q[4] * q[5] * part / square


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnetLaw:
    """Which co-energy, without its numbers.

    Attributes
    ----------
    gap : {"hyperbolic", "exponential"}
        How the inductance falls with the gap.
    pair : bool
        Two opposed magnets with currents i0 + i and i0 - i.
    saturation : bool
        Whether sigma may differ from zero.
    rise : bool
        Whether the leakage inductance may depend on the current.
    """

    gap: Literal["hyperbolic", "exponential"] = "hyperbolic"
    pair: bool = False
    saturation: bool = False
    rise: bool = False

    def __post_init__(self) -> None:
        if self.pair and self.gap == "exponential":
            raise ModelError("a differential pair wants the hyperbolic gap law; its gap is not open to one side")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers, in the order of `MAGNET_NUMBERS`."""
        first = ("L_g", "zeta") if self.gap == "exponential" else ("k", "s")
        return (*first, *MAGNET_NUMBERS[2:])

    def __str__(self) -> str:
        """Name it in a few words."""
        extras = [t for t, on in (("saturation", self.saturation), ("rising leakage", self.rise)) if on]
        return ", ".join([f"{self.gap} {'pair' if self.pair else 'single magnet'}", *extras])

    def vector(self, values: Mapping[str, float]) -> Array:
        """Write numbers as `q`, in shape (7,).

        Parameters
        ----------
        values : Mapping[str, float]
            By name, SI; what the law does not have may be absent.

        Returns
        -------
        ndarray, shape (7,)
        """
        neutral = {"sigma": 0.0, "L_leak": 0.0, "L_rise": 0.0, "i_knee": 1.0, "i0": 0.0}
        return np.array([values[n] if n in values else neutral[n] for n in self.names])

    def value(self, x: Number, i: Number, values: Mapping[str, float]) -> Number:
        """Return W' in J, for real or complex arguments (of magnitude below the knee where complex).

        Parameters
        ----------
        x, i : float or complex
            Position in m, axis current in A.
        values : Mapping[str, float]
            As `vector`.

        Returns
        -------
        float or complex
        """
        k, s, sigma, leak, rise, knee, bias = self.vector(values).tolist()
        sides = ((-x, bias + i), (x, bias - i)) if self.pair else ((x, i),)
        total = 0.0 * x
        for d, j in sides:
            g = k * np.exp(-d / s) if self.gap == "exponential" else k / (s + d)
            total = total + g * j**2 / (1.0 + np.sqrt(1.0 + sigma * j**2))
        core = knee * (i * np.arctan(i / knee) - 0.5 * knee * np.log(1.0 + (i / knee) ** 2))
        found: Number = total + 0.5 * (leak + rise) * i**2 - rise * core
        return found

    def table(self, x: Array, i: Array, values: Mapping[str, float]) -> tuple[Array, Array]:
        """Return force, k_x, k_i, L at points, and their derivatives by `q`.

        Parameters
        ----------
        x, i : ndarray, shape (n_points,), m and A
        values : Mapping[str, float]
            As `vector`.

        Returns
        -------
        values : ndarray, shape (n_points, 4)
            In N, N/m (k_x = -df/dx), N/A and H.
        slopes : ndarray, shape (n_points, 4, 7)
        """
        found, slopes = self._derivatives(x, i, values)
        return found[:, :FIRST] * _SIGN, slopes * _SIGN[:, None]

    def gradients(self, x: Array, i: Array, values: Mapping[str, float]) -> Array:
        """Return the derivatives of force, k_x, k_i, L by position and current.

        Parameters
        ----------
        x, i : ndarray, shape (n_points,), m and A
        values : Mapping[str, float]
            As `vector`.

        Returns
        -------
        ndarray, shape (n_points, 4, 2)
        """
        found, _ = self._derivatives(x, i, values)
        by_x, by_i = found[:, [1, 4, 5, 6]], found[:, [2, 5, 6, 7]]
        return np.stack([by_x * _SIGN, by_i * _SIGN], axis=2)

    def _derivatives(self, x: Array, i: Array, values: Mapping[str, float]) -> tuple[Array, Array]:
        q, w, dw = self.vector(values), np.zeros(THIRD), np.zeros((FIRST, len(MAGNET_NUMBERS)))
        found, slopes = np.zeros((x.size, THIRD)), np.zeros((x.size, *dw.shape))
        for n, (at, current) in enumerate(zip(x.tolist(), i.tolist(), strict=True)):
            coenergy_derivatives(at, current, q, self.gap == "exponential", self.pair, w, dw)
            found[n], slopes[n] = w, dw
        return found, slopes


def law_numbers(coenergy: CoEnergy) -> dict[str, float]:
    """Return the numbers of the hyperbolic law that is a given ideal magnet.

    Parameters
    ----------
    coenergy : CoEnergy
        Of a `SingleMagnet` or of a symmetric `DifferentialPair`.

    Returns
    -------
    dict of str to float
        k in N m^2/A^2, s in m, L_leak in H, i0 in A.

    Raises
    ------
    ModelError
        If the two magnets of a pair are not alike.
    """
    if coenergy.k_a == 0.0:
        return {"k": coenergy.k_b, "s": coenergy.s_b, "L_leak": coenergy.leakage, "i0": 0.0}
    if coenergy.k_a != coenergy.k_b or coenergy.s_a != coenergy.s_b:
        raise ModelError("the magnets of a pair must be alike: one constant k, one gap s at the centre")
    return {"k": coenergy.k_a, "s": coenergy.s_a, "L_leak": coenergy.leakage, "i0": coenergy.i0}
