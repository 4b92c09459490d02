"""Responses from the mean spectra of periodic experiments: groups of experiments solved for G, and averaged.

With a reference the responses of [Y; U] to it are averaged and divided once, without one each realisation is divided.
Noise is propagated from the periods, the total is the scatter between realisations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.signals._joint import ratio_map, right_inverse, scatter, transformed, weak_inputs
from ambid.signals._periodicity import Lines
from ambid.signals.frf import Complex


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectra:
    """Mean spectra at lines 1, 2, … under half the rate: `Z` = [Y; U] (n_lines, n_z) and `R`; covariance of `Z`."""

    Z: Complex
    R: Complex | None
    noise: Complex | None
    n_periods: int
    dropped: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """G at the excited lines, its covariance by noise alone, and by the scatter of realisations (None with one)."""

    G: Complex
    noise: Complex | None
    total: Complex | None
    warnings: tuple[str, ...]


def over_realisations(spectra: list[Spectra], excited: Lines, n_y: int, n_u: int) -> Found:
    """Return G over all realisations: averaged as ratios, or with a reference as responses to it."""
    groups = [spectra[m : m + n_u] for m in range(0, len(spectra), n_u)]
    Z = np.stack([np.stack([s.Z[excited] for s in g], axis=2) for g in groups])
    C = None if any(s.noise is None for s in spectra) else np.stack([_block_noise(g, excited) for g in groups])
    R = [s.R[excited] for s in spectra if s.R is not None]
    if not R:
        return _mean_of_ratios(Z, C, n_y)
    return _ratio_of_means(Z, C, np.stack(R).reshape(len(groups), n_u, *R[0].shape).transpose(0, 2, 3, 1), n_y)


def _mean_of_ratios(Z: Complex, C: Complex | None, n_y: int) -> Found:
    M, n_f = Z.shape[:2]
    each = [ratio_map(z, n_y) for z in Z]
    G = np.stack([g for g, _ in each])
    weak: list[str] = []
    noise = None
    if C is not None:
        noise = np.sum([transformed(c, T) for c, (_, T) in zip(C, each, strict=True)], axis=0) / M**2
        weak = [w for z, c in zip(Z, C, strict=True) for w in weak_inputs(z, c, n_y)]
    total = scatter(G.reshape(M, n_f, -1)) / M if M > 1 else None
    return Found(G=G.mean(axis=0), noise=noise, total=total, warnings=tuple(weak[:1]))


def _ratio_of_means(Z: Complex, C: Complex | None, R: Complex, n_y: int) -> Found:
    """Return the ratio of the mean responses Z R⁻¹ to the reference; `Z` (M, n_f, n_z, n_u), `R` (M, n_f, n_u, n_u)."""
    M, n_f, n_z, n_u = Z.shape
    inverse = np.stack([right_inverse(x) for x in R])
    responses = Z @ inverse
    mean = responses.mean(axis=0)
    G, T = ratio_map(mean, n_y)
    of_noise = None
    if C is not None:
        by_r = np.eye(n_z)[:, None, :, None] * np.swapaxes(inverse, 2, 3)[:, :, None, :, None, :]
        of_noise = transformed(C, by_r.reshape(M, n_f, n_z * n_u, n_z * n_u)).sum(axis=0) / M**2
    of_all = scatter(responses.reshape(M, n_f, -1)) / M if M > 1 else None
    known = of_noise if of_all is None else of_all
    return Found(
        G=G,
        noise=None if of_noise is None else transformed(of_noise, T),
        total=None if of_all is None else transformed(of_all, T),
        warnings=() if known is None else weak_inputs(mean, known, n_y),
    )


def _block_noise(group: list[Spectra], excited: Lines) -> Complex:
    """Return the covariance of vec(Z), Z (n_z, n_u) with a column of each experiment: noise is independent between."""
    n_u = len(group)
    C = [s.noise[excited] for s in group if s.noise is not None]
    n_f, n_z = C[0].shape[:2]
    blocks = np.zeros((n_f, n_z, n_u, n_z, n_u), dtype=complex)
    for e, c in enumerate(C):
        blocks[:, :, e, :, e] = c
    return blocks.reshape(n_f, n_z * n_u, n_z * n_u)
