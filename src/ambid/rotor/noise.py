"""Noise of a rotor's spectra: levels of sensors, forces and voltages from between the excited lines, and feedback.

Between the lines of a periodic excitation e = Y - H U is noise alone. Its covariance is that of white sources seen
through the model,

    C(k) = Σ_j s_j g_j(k) g_j(k)ᴴ,   g_j: a sensor's unit vector, or the response to a held force or voltage,

whose levels s_j maximise the likelihood (Fisher scoring; Pintelon and Schoukens 2012, ch. 10 and 12). Feedback carries
that noise back into the inputs: with U = R - K Y they hold -(I + K H)⁻¹ K e; K follows from U and Y between the lines,
which a controller binds. Inputs that are measured themselves, such as currents without voltages, hold noise of their
own: there Q follows from U and e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.linear import least_squares
from ambid.rotor.response import Sampled
from ambid.rotor.spectra import Between, PeriodSpectra, smoothed

_STEPS = 40
_SETTLED = 1e-3
_LEAST = 1e-14  # level of a source, over the mean power that it would explain alone
_LINES_PER_UNKNOWN = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noise:
    """Noise of one period's residuals."""

    levels: Array  # (n_sources,): variance of one period's spectrum, sensors first, then disturbances
    covariance: Complex  # (n_lines, n_y, n_y) at the excited lines, of one period

    def sd(self, period: int) -> Array:
        """Return the rms of each source in samples of SI units."""
        return np.asarray(np.sqrt(self.levels * period))


def residuals(spectra: PeriodSpectra, H: Complex) -> Complex:
    """Return Y_p - H U_p, (n_periods, n_lines, n_y)."""
    return np.asarray(spectra.Y - np.einsum("kyu,pku->pky", H, spectra.U))


def fit_noise(between: Between, response_between: Sampled, sampled: Sampled, before: Noise | None = None) -> Noise:
    """Return the noise at a model: levels by maximum likelihood between the lines, covariance at each line.

    `response_between`, `sampled`: the model between the lines and at them; `before`: at a model nearby.
    """
    e = between.Y - (response_between.transfer() @ between.U[:, :, None])[:, :, 0]
    g = _sources(response_between)  # (n_between, n_y, n_sources)
    power = np.real(np.einsum("kij,kij->kj", g.conj(), g))
    pulled = np.abs(np.einsum("kis,ki->ks", g.conj(), e)) ** 2 / np.maximum(power, 1e-300) ** 2
    alone = np.maximum(np.median(pulled, axis=0) / 2.0, 1e-300)
    least = _LEAST * alone
    levels = alone if before is None else before.levels
    for _ in range(_STEPS):
        back = np.linalg.solve(_covariance(g, levels), np.concatenate([g, e[:, :, None]], axis=2))
        back, whitened = back[:, :, :-1], back[:, :, -1]
        power_of_sources = np.sum(np.abs(np.einsum("kis,ki->ks", g.conj(), whitened)) ** 2, axis=0)
        products = np.conj(np.swapaxes(g, 1, 2)) @ back
        present = np.real(np.einsum("kss->s", products))
        information = np.sum(np.abs(products) ** 2, axis=0) * np.outer(levels, levels)
        step = least_squares(information + 1e-9 * np.diag(np.diag(information)), levels * (power_of_sources - present))
        step = np.clip(step, -2.0, 2.0)
        levels = np.maximum(levels * np.exp(step), least)
        if float(np.max(np.abs(step) * (levels > 2.0 * least))) < _SETTLED:
            break
    return Noise(levels=levels, covariance=_covariance(_sources(sampled), levels))


def _sources(sampled: Sampled) -> Complex:
    """Return what each source does to the outputs, (n_lines, n_y, n_sources): sensors, then disturbances."""
    g = sampled.disturbed()
    unit = np.broadcast_to(np.eye(g.shape[1], dtype=complex), (g.shape[0], g.shape[1], g.shape[1]))
    return np.concatenate([unit, g], axis=2)


def _covariance(g: Complex, levels: Array) -> Complex:
    return np.asarray((g * levels) @ np.conj(np.swapaxes(g, 1, 2)))


def feedback(spectra: PeriodSpectra, H: Complex, H_between: Complex, *, measured: bool) -> Complex | None:
    """Return Q(k), what goes with the residuals in the inputs, (n_lines, n_u, n_y); None: too few lines.

    K (or Q) is constant with a slope over as many neighbouring lines as its rows have unknowns, three equations for
    each. `H`, `H_between`: the model at the lines and between them; `measured`: some inputs are no commands of a
    controller.
    """
    spectrum_between = spectra.between
    at, n_u, n_y = spectrum_between.frequency_hz, spectrum_between.U.shape[1], spectrum_between.Y.shape[1]
    y = spectrum_between.Y - (H_between @ spectrum_between.U[:, :, None])[:, :, 0] if measured else spectrum_between.Y
    window = _LINES_PER_UNKNOWN * 2 * n_y
    if window > at.size:
        return None
    size = np.sqrt(np.mean(np.abs(y) ** 2, axis=0))
    if not np.all(size > 0.0):
        return None
    centres = np.unique(
        np.r_[np.arange(window // 2, at.size - window // 2, max(1, window // 4)), at.size - window // 2 - 1]
    )
    K = np.empty((centres.size, n_u, n_y), dtype=complex)
    for j, c in enumerate(centres):
        near = slice(c - window // 2, c - window // 2 + window)
        run = (at[near] - at[c]) / np.ptp(at[near])
        x = y[near] / size
        solution = np.linalg.lstsq(np.hstack([x, x * run[:, None]]), -spectrum_between.U[near], rcond=1e-10)[0]
        K[j] = (solution[:n_y] / size[:, None]).T
    lines = spectra.frequency_hz
    every = np.stack([np.interp(lines, at[centres], x) for x in K.reshape(centres.size, -1).T], axis=1)
    smooth: Complex = np.asarray(every.reshape(lines.size, n_u, n_y), dtype=np.complex128)
    return np.asarray(-smooth) if measured else closed(smooth, H)


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
