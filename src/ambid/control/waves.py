"""A periodic excitation under limits on what it moves: waves of signals, their peaks, amplitudes and phases together.

An excitation Re Σ c_k exp(jω_k t) moves signal s as Re Σ T_sk c_k exp(jω_k t). Its use of the limits is the largest
part of the way to any of them; a criterion that falls with the squared amplitude is best where the use is 1, so that
ln criterion + 2 ln use is minimised over amplitudes and phases at once, the use as a p-norm whose p rises (Guillaume,
Schoukens, Pintelon and Kollar 1991 for phases alone), by L-BFGS with exact gradients. A part of the power is spread
evenly: few lines would blind the tests of delay and residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.information import Information

Lines = NDArray[np.int64]
"""Numbers of lines, or of what belongs to each."""

BROADBAND = 0.2
"""Part of the power that is spread evenly over the lines."""
_NORMS = (6.0, 20.0, 60.0, 200.0)  # p
_STEPS = (80, 60, 60, 80)  # of the search at each p
_LEAST = 1e-12  # share of power of a line that the search begins with


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Limited:
    """Signals that an excitation moves, of one plant or of several."""

    lines: Lines  # (n_lines,), whole periods in `period` samples
    period: int
    T: Complex  # (n_lines, n_signals)
    low: Array  # (n_signals,), negative; -inf: no limit
    high: Array

    def waves(self, c: Complex) -> Array:
        """Return the signals over one period, (period, n_signals)."""
        X = np.zeros((self.period // 2 + 1, self.T.shape[1]), dtype=complex)
        X[self.lines] = 0.5 * self.period * c[:, None] * self.T
        return np.asarray(np.fft.irfft(X, self.period, axis=0), dtype=np.float64)

    def part(self, waves: Array) -> Array:
        """Return the part of the way to their limits that waves use, as `waves`."""
        return np.asarray(np.maximum(waves / self.high, waves / self.low))

    def use(self, c: Complex) -> Array:
        """Return the largest part of each signal, (n_signals,)."""
        return np.asarray(self.part(self.waves(c)).max(axis=0))

    def norm(self, c: Complex, p: float) -> tuple[float, Complex]:
        """Return the logarithm of the p-norm of the parts, and its slope G: Re Σ G_k dc_k is the change."""
        waves = self.waves(c)
        part = self.part(waves)
        top = float(part.max())
        powers = (part / top) ** (p - 1.0)
        total = float(np.sum(powers * part / top))
        pull = powers / (top * total) / np.where(waves > 0.0, self.high, self.low)
        back = np.conj(np.fft.rfft(pull, axis=0))[self.lines]
        return float(np.log(top) + np.log(total / waves.shape[0]) / p), np.asarray(np.sum(self.T * back, axis=1))

    def among(self, keep: Sequence[int]) -> Limited:
        """Return some of the signals."""
        k = list(keep)
        return Limited(lines=self.lines, period=self.period, T=self.T[:, k], low=self.low[k], high=self.high[k])


def spread_power(share: Array) -> Array:
    """Return shares of the power of which a part is spread evenly."""
    return np.asarray((1.0 - BROADBAND) * share / share.sum() + BROADBAND / share.size)


def joint_design(
    information: Information, limited: Limited, starts: Sequence[Complex], samples: float,
    *, tick: Callable[[], object] = lambda: None,
) -> Complex:  # fmt: skip
    """Return amplitudes and phases with the least criterion at a largest use of 1, (n_lines,)."""

    def judged(c: Complex) -> float:
        return information.judge(information.total(np.abs(c / np.max(limited.use(c))) ** 2, samples))[0]

    tried = list(starts)
    for p, steps in zip(_NORMS, _STEPS, strict=True):
        tried = [_search(information, limited, c, samples, p, steps) for c in tried]
        tried = [min(tried, key=judged)]  # the best start alone goes on
        tick()
    return tried[0] / np.max(limited.use(tried[0]))


def _search(
    information: Information, limited: Limited, start: Complex, samples: float, p: float, steps: int
) -> Complex:
    """Return the amplitudes of least criterion, the use taken as a p-norm."""
    from scipy.optimize import minimize

    n = start.size
    share = np.abs(start) ** 2 / np.sum(np.abs(start) ** 2)
    own = np.maximum((share - BROADBAND / n) / (1.0 - BROADBAND), _LEAST)

    def unpack(v: Array) -> tuple[Array, Array, Complex]:
        q = np.exp(2.0 * (v[:n] - v[:n].max()))
        q = q / q.sum()
        power = spread_power(q)
        return q, power, np.asarray(np.sqrt(power) * np.exp(1j * v[n:]))

    def value(v: Array) -> tuple[float, Array]:
        q, power, c = unpack(v)
        size, G = limited.norm(c, p)
        scaled = samples * np.exp(-2.0 * size)
        M = information.total(power, scaled)
        judged, slope = information.judge(M)
        by_power = scaled * np.einsum("pkij,pij->k", information.lines, slope) / judged
        by_size = -2.0 * float(np.sum(slope * (M - information.prior))) / judged
        turned = G * c
        by_power = by_power + by_size * np.real(turned) / (2.0 * power)
        by_share = 2.0 * (1.0 - BROADBAND) * q * (by_power - q @ by_power)
        return float(np.log(judged)), np.concatenate([by_share, -by_size * np.imag(turned)])

    found = minimize(
        value, np.concatenate([0.5 * np.log(own), np.angle(start)]), jac=True, method="L-BFGS-B",
        options={"maxiter": steps, "maxcor": 20},
    )  # fmt: skip
    return unpack(found.x)[2]
