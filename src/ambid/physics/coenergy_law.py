"""Magnets with leakage, saturation and a choice of gap law, with the derivatives that a fit needs, all of one co-energy
W'(x, i) (theory.md eq. 23): force dW'/dx, flux linkage dW'/di, k_i = d2W'/dx di, k_x = -d2W'/dx2, L = d2W'/di2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.magnet import CoEnergy, Number

MAGNET_NUMBERS = ("strength", "length", "sigma", "L_leak", "L_rise", "i_knee", "i0", "k_asym", "i0_asym")
"""Places of a magnet's numbers in the vector `q`: strength is k or L_g, length is s or zeta."""

ORDERS = ("x", "xx", "xi", "ii", "xxx", "xxi", "xii", "iii", "xxxi", "xxii", "xiii", "iiii")
"""Derivatives of W' in the order in which they are written."""

SLOPED = ("x", "xx", "xi", "ii", "xxi", "xii", "iii")
"""Those whose derivatives by `q` are written beside them, in that order."""

_SIGN = np.array([1.0, -1.0, 1.0, 1.0])  # k_x = -W_xx


def coenergy_derivatives(x: float, i: float, q: Array, exponential: bool, pair: bool, w: Array, dw: Array) -> None:
    """Write the derivatives of W' at `x` m and `i` A of the numbers `q` (9,), `MAGNET_NUMBERS` in SI: those of `ORDERS`
    into `w` (12,), those by `q` of `SLOPED` into `dw` (7, 9). `pair`: two opposed magnets. Scalar code for compiled
    callers.
    """
    for a in range(12):
        w[a] = 0.0
    for a in range(7):
        for b in range(9):
            dw[a, b] = 0.0
    s, sigma = q[1], q[2]
    for side in range(2 if pair else 1):
        sd = -1.0 if pair and side == 0 else 1.0  # d(gap)/dx
        sc = -1.0 if side == 1 else 1.0  # d(coil current)/di
        share = 1.0 - sd * q[7] if pair else 1.0
        k, d, j = q[0] * share, sd * x, sc * i
        if pair:
            j += q[6] + sc * q[8]
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
        h4 = (15.0 * sigma * j * j / (r * r) - 3.0) * sigma * r**-5
        hs, h1s, h2s = -(j**4) / (2.0 * r * (1.0 + r) ** 2), -(j**3) / (2.0 * r**3), -1.5 * j * j / r**5
        h3s = (7.5 * sigma * j * j / (r * r) - 3.0) * j * r**-5
        w[0] += sd * g1 * h
        w[1] += g2 * h
        w[2] += sd * sc * g1 * h1
        w[3] += g * h2
        w[4] += sd * g3 * h
        w[5] += sc * g2 * h1
        w[6] += sd * g1 * h2
        w[7] += sc * g * h3
        w[8] += sd * sc * g3 * h1
        w[9] += g2 * h2
        w[10] += sd * sc * g1 * h3
        w[11] += g * h4
        for b in range(4):  # strength, length, sigma, and the coil current, through which i0 and i0_asym act
            if b == 0:
                f0, f1, f2, e0, e1, e2, e3 = g / q[0], g1 / q[0], g2 / q[0], h, h1, h2, h3
            elif b == 1:
                f0, f1, f2, e0, e1, e2, e3 = gs, g1s, g2s, h, h1, h2, h3
            elif b == 2:
                f0, f1, f2, e0, e1, e2, e3 = g, g1, g2, hs, h1s, h2s, h3s
            elif pair:
                f0, f1, f2, e0, e1, e2, e3 = g, g1, g2, h1, h2, h3, h4
            else:
                continue
            at = 6 if b == 3 else b
            slopes = (sd * f1 * e0, f2 * e0, sd * sc * f1 * e1, f0 * e2, sc * f2 * e1, sd * f1 * e2, sc * f0 * e3)
            for a in range(7):
                dw[a, at] += slopes[a]
                if pair and b == 0:
                    dw[a, 7] -= sd * q[0] / share * slopes[a]
                if b == 3:
                    dw[a, 8] += sc * slopes[a]
    knee2, square = q[5] * q[5], i * i + q[5] * q[5]
    part, bend = i * i / square, 2.0 * i * knee2 / square**2
    w[3] += q[3] + q[4] * part
    w[7] += q[4] * bend
    w[11] += 2.0 * q[4] * knee2 * (knee2 - 3.0 * i * i) / square**3
    dw[3, 3] = 1.0
    dw[3, 4] = part
    dw[3, 5] = -2.0 * q[4] * q[5] * part / square
    dw[6, 4] = bend
    dw[6, 5] = 4.0 * q[4] * i * q[5] * (i * i - knee2) / square**3


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnetLaw:
    """W'(x, i) = sum over magnets of g(d) h(j) + S(i) in m, A, J, without its numbers.

    Gap law g: k/(s + d), ideal, or L_g exp(-d/zeta), a small armature before a pole; h = j^2/(1 + sqrt(1 + sigma j^2)),
    sigma = 0 unsaturated; S'' = L_leak + L_rise i^2/(i^2 + i_knee^2). One magnet: d = x (up to s), j = i. A pair: d =
    -+x, j = i0 +- i0_asym +- i, k (1 +- k_asym); gaps that differ at x = 0 are a centre elsewhere (x_offset).
    """

    gap: Literal["hyperbolic", "exponential"] = "hyperbolic"  # how the inductance falls with the gap
    pair: bool = False  # two opposed magnets with currents i0 + i and i0 - i
    saturation: bool = False  # whether sigma may differ from zero
    rise: bool = False  # whether the leakage inductance may depend on the current
    # whether the two magnets of a pair may differ: in strength (k_asym, between -1 and 1) and in bias (i0_asym)
    asymmetric: bool = False

    def __post_init__(self) -> None:
        if self.asymmetric and not self.pair:
            raise ModelError("one magnet has no other to differ from: asymmetric=True needs pair=True. Correct one")
        if self.pair and self.gap == "exponential":
            raise ModelError(
                "a differential pair needs the hyperbolic gap law; its gap is bounded on both sides. Correct gap"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its numbers, in the order of `MAGNET_NUMBERS`."""
        first = ("L_g", "zeta") if self.gap == "exponential" else ("k", "s")
        return (*first, *MAGNET_NUMBERS[2:])

    def __str__(self) -> str:
        """Name it in a few words."""
        kinds = (("unequal", self.asymmetric), ("saturation", self.saturation), ("rising leakage", self.rise))
        extras = [t for t, on in kinds if on]
        return ", ".join([f"{self.gap} {'pair' if self.pair else 'single magnet'}", *extras])

    def vector(self, values: Mapping[str, float]) -> Array:
        """Return numbers, by name in SI, as `q` (9,); what the law does not have may be absent."""
        neutral = {"sigma": 0.0, "L_leak": 0.0, "L_rise": 0.0, "i_knee": 1.0, "i0": 0.0, "k_asym": 0.0, "i0_asym": 0.0}
        return np.array([values[n] if n in values else neutral[n] for n in self.names])

    def value(self, x: Number, i: Number, values: Mapping[str, float]) -> Number:
        """Return W' in J at `x` m and `i` A, real or complex (of magnitude below the knee where complex)."""
        k, s, sigma, leak, rise, knee, bias, more, other = self.vector(values).tolist()
        sides: tuple[tuple[float, Number, Number], ...] = ((k, x, i),)
        if self.pair:
            sides = (k * (1.0 + more), -x, bias + other + i), (k * (1.0 - more), x, bias - other - i)
        total = 0.0 * x
        for strength, d, j in sides:
            g = strength * np.exp(-d / s) if self.gap == "exponential" else strength / (s + d)
            total = total + g * j**2 / (1.0 + np.sqrt(1.0 + sigma * j**2))
        core = knee * (i * np.arctan(i / knee) - 0.5 * knee * np.log(1.0 + (i / knee) ** 2))
        energy: Number = total + 0.5 * (leak + rise) * i**2 - rise * core
        return energy

    def force(self, x: Array, i: Array, values: Mapping[str, float]) -> Array:
        """Return the force dW'/dx in N (n_points,) at `x` m and `i` A, by a complex step."""
        step = 1e-30
        energies: Any = self.value(cast(Any, x + 1j * step), cast(Any, i), values)
        return np.asarray(energies.imag / step)

    def table(self, x: Array, i: Array, values: Mapping[str, float]) -> tuple[Array, Array]:
        """Return force in N, k_x = -df/dx in N/m, k_i in N/A and L in H at `x` m and `i` A, (n_points, 4), and their
        derivatives by `q`, (n_points, 4, 9).
        """
        table, slopes = self._derivatives(x, i, values)
        return table[:, :4] * _SIGN, slopes[:, :4] * _SIGN[:, None]

    def gradients(self, x: Array, i: Array, values: Mapping[str, float]) -> Array:
        """Return the derivatives of force, k_x, k_i, L by position (m) and current (A), (n_points, 4, 2)."""
        found, _ = self._derivatives(x, i, values)
        by_x, by_i = found[:, [1, 4, 5, 6]], found[:, [2, 5, 6, 7]]
        return np.stack([by_x * _SIGN, by_i * _SIGN], axis=2)

    def _derivatives(self, x: Array, i: Array, values: Mapping[str, float]) -> tuple[Array, Array]:
        q, w, dw = self.vector(values), np.zeros(len(ORDERS)), np.zeros((len(SLOPED), len(MAGNET_NUMBERS)))
        table, slopes = np.zeros((x.size, len(ORDERS))), np.zeros((x.size, *dw.shape))
        for n, (at, current) in enumerate(zip(x.tolist(), i.tolist(), strict=True)):
            coenergy_derivatives(at, current, q, self.gap == "exponential", self.pair, w, dw)
            table[n], slopes[n] = w, dw
        return table, slopes


def law_numbers(coenergy: CoEnergy) -> dict[str, float]:
    """Return the numbers of the hyperbolic law that is a given ideal magnet: k in N m^2/A^2, s in m, L_leak in H, i0
    and i0_asym in A, k_asym in 1.
    """
    w = coenergy
    if w.k_a == 0.0:
        return {"k": w.k_b, "s": w.s_b, "L_leak": w.leakage, "i0": 0.0, "k_asym": 0.0, "i0_asym": 0.0}
    if w.s_a != w.s_b:
        raise ModelError("the gaps of a pair must be alike at x = 0; count x from where they are")
    total = w.k_a + w.k_b
    return {"k": total / 2.0, "s": w.s_a, "L_leak": w.leakage, "i0": w.i0, "k_asym": (w.k_a - w.k_b) / total,
            "i0_asym": w.i0_asym}  # fmt: skip
