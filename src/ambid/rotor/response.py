"""The exact sampled response of a linear model at many lines, and its derivatives, through one eigendecomposition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.physics.linear_model import StateSpace

_SAME = 1e-7  # distance of eigenvalues, over their size, from which the divided difference is the derivative
_BLOCK = 512  # lines
_SMALL = 1e-5  # s T below which series are taken
_REST = 1e-9  # an eigenvalue at 0 stands here, 1/s


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """A model at lines: `delays` (n_u,) in samples, `held` (n_u,) whether an input is held over a sample, or linear.

    Held and f samples late, H = C h_z(A) B with h_z(s) = (exp(s (1-f) T) - 1 + (exp(s T) - exp(s (1-f) T))/z) / (s (z -
    exp(s T))) (Astrom and Wittenmark 1997, sec. 2.3); a measured current, linear, has h_z(s) = (g0 - g1 + g1 z)/(z -
    exp(s T)), g0 = (exp(s T) - 1)/s, g1 = (exp(s T) - 1 - s T)/(s² T). With A = V diag(s) V⁻¹ the derivative along dA
    is V [(V⁻¹ dA V) ∘ D] V⁻¹, D_ij = (h_z(s_i) - h_z(s_j))/(s_i - s_j) (Daleckii and Krein 1965; Higham 2008, th.
    3.11).
    """

    space: StateSpace
    omega: Array  # (n_lines,), rad/s
    rate_hz: float
    delays: Array
    held: tuple[bool, ...]

    @cached_property
    def eigen(self) -> tuple[Complex, Complex, Complex]:
        """Eigenvalues, right eigenvectors and their inverse."""
        values, V = np.linalg.eig(self.space.A)
        values = np.where(np.abs(values) < _REST, _REST, values).astype(complex)
        return values, V, np.linalg.inv(V)

    @cached_property
    def groups(self) -> tuple[tuple[Array, bool, float], ...]:
        """Inputs that are treated alike: which, whether held, and their fraction of a sample."""
        fraction = self.delays - np.floor(self.delays)
        keys = list(zip(self.held, fraction.tolist(), strict=True))
        return tuple(
            (np.array([k for k, x in enumerate(keys) if x == key]), key[0], key[1]) for key in dict.fromkeys(keys)
        )

    def scalar(self, held: bool, fraction: float) -> Complex:
        """Return h_z at the eigenvalues, (n_lines, n_states)."""
        s, T = self.eigen[0], 1.0 / self.rate_hz
        z = np.exp(1j * self.omega * T)[:, None]
        if not held:
            (g0, g1), _ = _ramp(s, T)
            return np.asarray((g0 - g1 + g1 * z) / (z - np.exp(s * T)) * z**-fraction)
        part, whole = np.expm1(s * (1.0 - fraction) * T), np.expm1(s * T)
        return np.asarray((part + (whole - part) / z) / (s * (z - 1.0 - whole)))

    def scalar_slopes(self, held: bool, fraction: float) -> tuple[Complex, Complex]:
        """Return the derivatives of h_z by the eigenvalue and by the fraction, (n_lines, n_states)."""
        s, T = self.eigen[0], 1.0 / self.rate_hz
        h = self.scalar(held, fraction)
        z, a = np.exp(1j * self.omega * T)[:, None], (1.0 - fraction) * T
        if not held:
            _, (d0, d1) = _ramp(s, T)
            E = np.exp(s * T)
            by_value = (d0 - d1 + d1 * z) / (z - E) * z**-fraction + h * T * E / (z - E)
            return by_value, -1j * (self.omega * T)[:, None] * h
        E, part = np.exp(s * T), np.exp(s * a)
        below = z - E
        by_value = (a * part + (T * E - a * part) / z) / (s * below) - h / s + h * T * E / below
        return by_value, -T * part * (1.0 - 1.0 / z) / below

    def late(self) -> Complex:
        """Return what the whole samples of the delays do to each input, (n_lines, n_u)."""
        return np.exp(-1j * np.outer(self.omega / self.rate_hz, np.floor(self.delays)))

    def transfer(self) -> Complex:
        """Return H from the inputs, (n_lines, n_y, n_u)."""
        _, V, inverse = self.eigen
        left, right, late = self.space.C @ V, inverse @ self.space.B, self.late()
        H = np.empty((self.omega.size, left.shape[0], right.shape[1]), dtype=complex)
        for columns, held, fraction in self.groups:
            h = self.scalar(held, fraction)
            H[:, :, columns] = (h[:, None, :] * left) @ right[:, columns] * late[:, None, columns]
        return H

    def disturbed(self) -> Complex:
        """Return H from the disturbances, held over a sample, (n_lines, n_y, n_d)."""
        _, V, inverse = self.eigen
        h = self.scalar(True, 0.0)
        return np.asarray((h[:, None, :] * (self.space.C @ V)) @ (inverse @ self.space.E))

    def transients(self) -> Complex:
        """Return what a difference of states, and of held inputs, between the ends of a period adds, (n_lines, n_y, n):
        z C (z - A_d)⁻¹ and C (z - A_d)⁻¹ B (Pintelon and Schoukens 2012, sec. 6.3.2).
        """
        s, V, inverse = self.eigen
        z = np.exp(1j * self.omega / self.rate_hz)[:, None]
        decay = 1.0 / (z - np.exp(s / self.rate_hz))
        left = decay[:, None, :] * (self.space.C @ V)
        return np.concatenate([z[:, :, None] * (left @ inverse), left @ (inverse @ self.space.B)], axis=2)

    def states(self, U: Complex) -> Complex:
        """Return the states at spectra of the inputs `U` (n_lines, n_u): (n_lines, n_states)."""
        return np.asarray(self._modal(U) @ self.eigen[1].T)

    def _modal(self, U: Complex) -> Complex:
        _, _, inverse = self.eigen
        right, late = inverse @ self.space.B, U * self.late()
        parts = [self.scalar(held, f) * (late[:, cols] @ right[:, cols].T) for cols, held, f in self.groups]
        return np.asarray(np.sum(parts, axis=0))

    def slopes(self, U: Complex, directions: Sequence[StateSpace], n_delays: int = 0) -> Complex:
        """Return the derivative of H U along directions (dA, dB, dC), then by the first `n_delays` delays, (n_lines,
        n_y, n_directions + n_delays).
        """
        if self.omega.size > _BLOCK:  # a block's arrays stay in the cache
            blocks = [slice(k, k + _BLOCK) for k in range(0, self.omega.size, _BLOCK)]
            return np.concatenate(
                [replace(self, omega=self.omega[b]).slopes(U[b], directions, n_delays) for b in blocks]
            )
        s, V, inverse = self.eigen
        n, left, late = s.size, self.space.C @ V, U * self.late()
        right = inverse @ self.space.B
        gap = s[:, None] - s[None, :]
        same = np.abs(gap) <= _SAME * (np.abs(s[:, None]) + np.abs(s[None, :]))
        per_gap, (i, j) = 1.0 / np.where(same, 1.0, gap), np.nonzero(same)
        weights = np.zeros((self.omega.size, n, n), dtype=complex)  # divided differences times the modal input
        modal = np.zeros((self.omega.size, n), dtype=complex)
        d_B = [inverse @ d.B for d in directions]
        through = np.zeros((self.omega.size, n, len(directions) + n_delays), dtype=complex)
        for columns, held, fraction in self.groups:
            h = self.scalar(held, fraction)
            by_value, by_fraction = self.scalar_slopes(held, fraction)
            into = late[:, columns] @ right[:, columns].T
            differences = h[:, :, None] - h[:, None, :]
            differences *= per_gap
            differences[:, i, j] = 0.5 * (by_value[:, i] + by_value[:, j])
            differences *= into[:, None, :]
            weights += differences
            modal += h * into
            for k, d in enumerate(d_B):
                if np.any(d[:, columns]):
                    through[:, :, k] += h * (late[:, columns] @ d[:, columns].T)
            for m in columns:
                if m < n_delays:
                    through[:, :, len(directions) + m] = by_fraction * (late[:, [m]] @ right[:, [m]].T)
        d_A = np.array([inverse @ d.A @ V for d in directions])  # (n_directions, n, n)
        if len(directions):
            moved = np.matmul(weights.transpose(1, 0, 2), d_A.transpose(1, 2, 0))  # (n, n_lines, n_directions)
            through[:, :, : len(directions)] += moved.transpose(1, 0, 2)
        slopes_of_response = left @ through
        x = modal @ V.T
        for k, direction in enumerate(directions):
            if np.any(direction.C):
                slopes_of_response[:, :, k] += x @ direction.C.T
        return np.asarray(slopes_of_response)


def _ramp(s: Complex, T: float) -> tuple[tuple[Complex, Complex], tuple[Complex, Complex]]:
    """Return g0, g1 of an input that is linear between the samples, and their derivatives by s."""
    x, whole = s * T, np.expm1(s * T)
    small = np.abs(x) < _SMALL
    safe = np.where(small, 1.0, s)
    g0 = whole / s
    g1 = np.where(small, T * (0.5 + x / 6.0), (whole - x) / (safe**2 * T))
    d0 = np.where(small, T**2 * (0.5 + x / 3.0), (T * (whole + 1.0) - g0) / safe)
    d1 = np.where(small, T**2 * (1.0 / 6.0 + x / 12.0), whole / safe**2 - 2.0 * g1 / safe)
    return (g0, g1), (d0, d1)
