"""An LPV model at one fixed value of the scheduling signal: transfer function, poles and gains, with their spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.roots import root_derivative, roots_of

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frozen:
    """The linear model y = (B/A) u + offset/A(1) + H e that stands still at one p; H = C/D or C/(D A).

    With p made of the output it describes movements about the set point that are fast beside its low-pass.
    """

    p: float
    dt: float
    nk: int  # smallest lag of the inputs
    a: Array  # (order + 1,), of q^0, q^-1, ...; the first is 1
    b: Array  # (n_exciting, nb), SI, of q^-nk,
    c: Array  # of the error model; the first is 1
    d: Array
    # (order,), complex, rad/s, log(z)/dt of the roots z of A, largest real part first; -inf for a root at 0
    poles: Complex
    dc_gain: Array  # (n_exciting,), SI, B(1)/A(1); negative behind an unstable pole
    a_sd: Array | None = None  # standard deviations; None without a covariance
    b_sd: Array | None = None
    c_sd: Array | None = None
    d_sd: Array | None = None
    poles_sd: Complex | None = None  # (order,), complex, rad/s, or None, of real and imaginary part
    dc_gain_sd: Array | None = None  # (n_exciting,), SI, or None

    @property
    def stable(self) -> bool:
        """Whether all poles are in the left half plane."""
        return bool(np.all(self.poles.real < 0))

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response from each exciting input.

        `frequency`: (n,), Hz. Returns (n, n_exciting), complex, SI.
        """
        w = np.exp(-2j * np.pi * np.asarray(frequency, dtype=np.float64) * self.dt)
        below = np.polynomial.polynomial.polyval(w, self.a)
        above = np.stack([w**self.nk * np.polynomial.polynomial.polyval(w, row) for row in self.b], axis=-1)
        out: Complex = above / below[:, None]
        return out


def frozen(p: float, dt: float, nk: int, a: Array, b: Array, c: Array, d: Array, P: Array | None) -> Frozen:
    """Return poles, gains and standard deviations of a model that stands still.

    `a`: (order,); `b`: (n_exciting, nb); `P`: (n, n), or None, covariance of a, b (row by row), d, c.
    """
    na, nb, m = a.size, b.shape[1], b.shape[0]
    whole = np.concatenate([[1.0], a])
    z = roots_of(whole)
    with np.errstate(divide="ignore", invalid="ignore"):
        poles = np.where(z == 0, -np.inf, np.log(np.where(z == 0, 1.0, z)) / dt)
        gain = b.sum(axis=1) / whole.sum()
    turn = np.lexsort((-poles.imag, -poles.real))
    values = Frozen(
        p=p,
        dt=dt,
        nk=nk,
        a=whole,
        b=b,
        c=np.concatenate([[1.0], c]),
        d=np.concatenate([[1.0], d]),
        poles=poles[turn],
        dc_gain=gain,
    )
    if P is None:
        return values
    sd = np.sqrt(np.maximum(np.diag(P), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = root_derivative(whole, z)[:, 1:] / (z * dt)[:, None]
    by_gain = np.zeros((m, P.shape[0]))
    for i in range(m):
        by_gain[i, :na] = -gain[i] / whole.sum()
        by_gain[i, na + i * nb : na + (i + 1) * nb] = 1.0 / whole.sum()
    own = P[:na, :na]
    real, imaginary = (np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", x, own, x), 0.0)) for x in (slope.real, slope.imag))
    n = na + m * nb
    return Frozen(
        **{k: getattr(values, k) for k in ("p", "dt", "nk", "a", "b", "c", "d", "poles", "dc_gain")},
        a_sd=np.concatenate([[0.0], sd[:na]]),
        b_sd=sd[na:n].reshape(m, nb),
        d_sd=np.concatenate([[0.0], sd[n : n + d.size]]),
        c_sd=np.concatenate([[0.0], sd[n + d.size :]]),
        poles_sd=(real + 1j * imaginary)[turn],
        dc_gain_sd=np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", by_gain, P, by_gain), 0.0)),
    )
