"""Compact test functions phi(t) = (1 - (t/h)^2)^p, and their integrals as sums over samples (thesis eq. 3.8).

They vanish with p - 1 derivatives at both ends, so that the trapezoidal rule is exact to that order and integration by
parts leaves no boundary terms: int phi y^(k) dt = (-1)^k int phi^(k) y dt (Messenger and Bortz 2021). What the
trapezoidal rule leaves is the spectrum of phi^(k) at the sampling rate, which falls as (2 / (w h))^(p - k): short
supports want a high degree, or records of little noise are biased by many standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ambid.arrays import Array

_OVERLAP = 7  # rows on half a support: closer ones say the same again, wider ones leave something out
_SMOOTH = 13  # degree beyond the highest derivative: over 20 samples sums are then integrals to 1e-7


@dataclass(frozen=True, slots=True, kw_only=True)
class Bump:
    """One test function, set at many centres."""

    half: int  # half of its support in samples
    degree: int  # p
    dt: float

    @property
    def hop(self) -> int:
        """Samples between neighbouring centres."""
        return max(1, self.half // _OVERLAP)

    def centres(self, n_samples: int, lead: int) -> NDArray[np.int64]:
        """Return the samples at which the function is centred.

        `lead`: samples at the beginning that are to be left out. Returns (n_rows,).
        """
        return np.arange(self.half + lead, n_samples - self.half, self.hop)

    def kernel(self, order: int) -> Array:
        """Return the weights of samples -half to half in (-1)^k int phi^(k) y dt.

        `order`: k. Returns (2 half + 1,).
        """
        tau = np.arange(-self.half, self.half + 1) / self.half
        scale = (-1.0 / (self.half * self.dt)) ** order * self.dt
        return np.asarray(_bump(self.degree).deriv(order)(tau) * scale)

    def held_kernel(self, order: int, fraction: float) -> Array:
        """Return the weights of values that are held over a sample, exact, for offsets -half - 1 to half.

        `order`: k; `fraction`: part of a sample by which the values come late, 0 to 1. Returns (2 half + 2,).
        """
        whole = _bump(self.degree).integ() if order == 0 else _bump(self.degree).deriv(order - 1)
        edges = np.clip((np.arange(-self.half - 1, self.half + 2) + fraction) / self.half, -1.0, 1.0)
        scale = (-1.0) ** order * (self.half * self.dt) ** (1 - order)
        return np.asarray(np.diff(whole(edges)) * scale)


def degree_for(order: int) -> int:
    """Return the degree of test functions that carry derivatives up to `order`."""
    return order + _SMOOTH


def moments_at(x: Array, kernel: Array, last: int, centres: NDArray[np.int64]) -> Array:
    """Return sums of x[c + o] kernel[o] at centres c.

    `x`: (n_samples,); `kernel`: (n_offsets,), for offsets up to `last`; `centres`: (n_rows,). Returns (n_rows,).
    """
    from scipy.signal import oaconvolve

    return np.asarray(oaconvolve(x, kernel[::-1])[centres + last])


def spread_out(q: Array, kernel: Array, centres: NDArray[np.int64], n_samples: int) -> Array:
    """Return the adjoint of `moments_at` for a symmetric range of offsets: sum over centres of q kernel[t - c].

    `q`: (n_rows,); `kernel`: (2 half + 1,); `centres`: (n_rows,). Returns (n_samples,).
    """
    from scipy.signal import oaconvolve

    comb = np.zeros(n_samples)
    comb[centres] = q
    half = kernel.size // 2
    return np.asarray(oaconvolve(comb, kernel)[half : half + n_samples])


def _bump(degree: int) -> Polynomial:
    return Polynomial([1.0, 0.0, -1.0]) ** degree
