"""Noise of a rotor's spectra: levels of sensors, forces and voltages from the scatter between periods, and feedback.

The residual of one period is e_p = Y_p - H U_p. Its covariance over the lines is that of white sources seen through the
model,

    C(k) = Σ_j s_j g_j(k) g_j(k)ᴴ,   g_j: a sensor's unit vector, or the response to a held force or voltage,

whose levels s_j maximise the likelihood of the scatter of e_p about its mean (Fisher scoring; Pintelon and Schoukens
2012, ch. 10 and 12). Feedback carries that noise back into the inputs: with U = R - K Y the inputs hold -(I + K H)⁻¹ K
e; K follows from the scatter of U and Y, which a controller binds line by line. Inputs that are measured themselves,
such as currents without voltages, hold noise of their own: there Q follows from the scatter of U and e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.linear import least_squares
from ambid.rotor.response import Sampled
from ambid.rotor.spectra import PeriodSpectra, smoothed

_STEPS = 40
_SETTLED = 1e-4
_LEAST = 1e-14  # level of a source, over the mean power that it would explain alone
_LINES_PER_UNKNOWN = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noise:
    """Noise of one period's residuals."""

    levels: Array  # (n_sources,): variance of one period's spectrum, sensors first, then disturbances
    covariance: Complex  # (n_lines, n_y, n_y), of one period

    def sd(self, period: int) -> Array:
        """Return the rms of each source in samples of SI units."""
        return np.asarray(np.sqrt(self.levels * period))


def residuals(spectra: PeriodSpectra, H: Complex) -> Complex:
    """Return Y_p - H U_p, (n_periods, n_lines, n_y)."""
    return np.asarray(spectra.Y - np.einsum("kyu,pku->pky", H, spectra.U))


def fit_noise(spectra: PeriodSpectra, sampled: Sampled, H: Complex) -> Noise:
    """Return the noise at a model: levels by maximum likelihood, covariance at each line."""
    e = residuals(spectra, H)
    apart = e - e.mean(axis=0)
    freedom = spectra.n_periods - 1
    scatter = np.einsum("pki,pkj->kij", apart, apart.conj()) / freedom
    n_y = e.shape[2]
    unit = np.broadcast_to(np.eye(n_y, dtype=complex), (e.shape[1], n_y, n_y))
    g = np.concatenate([unit, sampled.disturbed()], axis=2)  # (n_lines, n_y, n_sources)
    power = np.real(np.einsum("kij,kij->kj", g.conj(), g))
    size = np.sqrt(np.maximum(power, 1e-300))
    typical = np.real(np.einsum("kis,kij,kjs->ks", (g / size[:, None, :]).conj(), scatter, g / size[:, None, :]))
    start = np.median(typical / np.maximum(power, 1e-300), axis=0) / 2.0
    levels = np.maximum(start, 1e-300)
    least = _LEAST * levels
    for _ in range(_STEPS):
        inverse = np.linalg.inv(_covariance(g, levels))
        back = inverse @ g
        pulled = np.real(np.einsum("kis,kij,kjs->s", back.conj(), scatter, back))
        present = np.real(np.einsum("kis,kis->s", g.conj(), back))
        gradient = freedom * levels * (pulled - present)
        products = np.conj(np.swapaxes(g, 1, 2)) @ back
        information = freedom * np.sum(np.abs(products) ** 2, axis=0) * np.outer(levels, levels)
        step = least_squares(information + 1e-9 * np.diag(np.diag(information)), gradient)
        step = np.clip(step, -2.0, 2.0)
        levels = np.maximum(levels * np.exp(step), least)
        if float(np.max(np.abs(step) * (levels > 2.0 * least))) < _SETTLED:
            break
    return Noise(levels=levels, covariance=_covariance(g, levels))


def _covariance(g: Complex, levels: Array) -> Complex:
    return np.asarray((g * levels) @ np.conj(np.swapaxes(g, 1, 2)))


def feedback(spectra: PeriodSpectra, H: Complex, *, measured: bool) -> Complex | None:
    """Return Q(k), what goes with the residuals in the inputs, (n_lines, n_u, n_y); None: too few lines.

    K (or Q) is constant with a slope over as many neighbouring lines as its rows have unknowns, three equations for
    each. `measured`: some inputs are no commands of a controller.
    """
    n_u, n_y = spectra.U.shape[2], spectra.Y.shape[2]
    d_u, d_y = (x - x.mean(axis=0) for x in (spectra.U, residuals(spectra, H) if measured else spectra.Y))
    window = int(np.ceil(_LINES_PER_UNKNOWN * 2 * n_y / (spectra.n_periods - 1)))
    n = spectra.frequency_hz.size
    if window > n:
        return None
    size = np.sqrt(np.mean(np.abs(d_y) ** 2, axis=(0, 1)))
    if not np.all(size > 0.0):
        return None
    centres = np.unique(np.r_[np.arange(window // 2, n - window // 2, max(1, window // 4)), n - 1 - window // 2])
    K = np.empty((centres.size, n_u, n_y), dtype=complex)
    for j, c in enumerate(centres):
        near = slice(c - window // 2, c - window // 2 + window)
        run = (spectra.frequency_hz[near] - spectra.frequency_hz[c]) / np.ptp(spectra.frequency_hz[near])
        y = (d_y[:, near] / size).reshape(-1, n_y)
        slope = y * np.tile(run, spectra.n_periods)[:, None]
        found = np.linalg.lstsq(np.hstack([y, slope]), -d_u[:, near].reshape(-1, n_u), rcond=1e-10)[0]
        K[j] = (found[:n_y] / size[:, None]).T
    at = spectra.frequency_hz
    every = np.stack([np.interp(at, at[centres], x) for x in K.reshape(centres.size, -1).T], axis=1)
    found = every.reshape(n, n_u, n_y).astype(np.complex128)
    return -found if measured else closed(found, H)


def closed(K: Complex, H: Complex) -> Complex:
    """Return -(I + K H)⁻¹ K."""
    return np.asarray(-np.linalg.solve(np.eye(K.shape[1]) + K @ H, K))


def rough_covariance(spectra: PeriodSpectra, H: Complex, relative: float) -> Complex:
    """Return variances of the mean residual without a noise model, (n_lines, n_y, n_y).

    Scatter between periods, and a relative error of the model, which makes the criterion smooth far from its minimum.
    """
    e = residuals(spectra, H)
    level = np.sqrt(smoothed(np.abs(spectra.mean_y) ** 2, 2))
    variance = spectra.scatter_of(e) / spectra.n_periods + (relative * level) ** 2
    return np.asarray(variance[:, :, None] * np.eye(e.shape[2]))
