"""Even and odd nonlinear distortion at the lines that a multisine leaves out (the fast method).

An odd multisine through a nonlinear system puts even distortion at even lines and odd distortion at odd lines, the
left-out ones among them (Pintelon and Schoukens 2012, sec. 4.3.1). What the input itself carries there goes through
the response first, which also serves under feedback.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.signals._periodicity import Lines
from ambid.signals.frf import Complex

_POOLED = 6  # detection lines averaged around each excited line


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distortions:
    """Output levels at detection lines, each the rms of the sine at that line (mean over experiments).

    Levels hold noise too; compare them with the noise beside them.

    Attributes
    ----------
    even_hz : ndarray, shape (n_even,), Hz
        Even lines without excitation, between the lowest and the highest excited line.
    even : ndarray, shape (n_even, n_y), output units
        Level there.
    even_noise : ndarray, shape (n_even, n_y), or None
        Part of it that differs between periods; None with one period.
    odd_hz : ndarray, shape (n_odd,), Hz
        Odd lines without excitation.
    odd : ndarray, shape (n_odd, n_y), output units
        Level there.
    odd_noise : ndarray, shape (n_odd, n_y), or None
        Part of it that differs between periods.
    signal : ndarray, shape (n_f, n_y), output units
        Level at the excited lines.
    """

    even_hz: Array
    even: Array
    even_noise: Array | None
    odd_hz: Array
    odd: Array
    odd_noise: Array | None
    signal: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detection:
    """Output power matrices at detection lines: `lines` (n_d,) from 0, `power` and `noise` (n_d, n_y, n_y)."""

    lines: Lines
    power: Complex
    noise: Complex | None
    n_experiments: int

    def of_parity(self, odd: bool) -> Detection:
        """Return the odd, or the even, multiples of the lowest line."""
        keep = (self.lines + 1) % 2 == odd
        noise = None if self.noise is None else self.noise[keep]
        return Detection(lines=self.lines[keep], power=self.power[keep], noise=noise, n_experiments=self.n_experiments)


def detected(Z: Complex, noise: Complex | None, G: Complex, excited: Lines) -> Detection:
    """Return what the output does at lines without excitation, less the response to the input there.

    `Z` (n_experiments, n_lines, n_y + 1) mean spectra, `noise` (n_experiments, n_lines, n_y + 1, n_y + 1) of them,
    `G` (n_f, n_y, 1) at the lines `excited`.
    """
    n_y = G.shape[1]
    inside = np.arange(excited[0], excited[-1] + 1)
    lines = np.setdiff1d(inside, excited)
    between = np.stack([np.interp(lines, excited, G[:, i, 0]) for i in range(n_y)], axis=1)
    left = np.concatenate([np.broadcast_to(np.eye(n_y), (lines.size, n_y, n_y)), -between[:, :, None]], axis=2)
    v = np.einsum("fyz,efz->efy", left, Z[:, lines])
    power = np.einsum("efi,efj->fij", v, v.conj()) / Z.shape[0]
    of_noise = None if noise is None else left @ noise[:, lines].mean(axis=0) @ np.conj(np.swapaxes(left, 1, 2))
    return Detection(lines=lines, power=power, noise=of_noise, n_experiments=Z.shape[0])


def distortions(detection: Detection, spacing_hz: float, signal: Complex) -> Distortions:
    """Return the levels by parity; `signal` (n_experiments, n_f, n_y) are the outputs at the excited lines."""
    even, odd = detection.of_parity(False), detection.of_parity(True)
    return Distortions(
        even_hz=np.asarray((even.lines + 1) * spacing_hz, dtype=np.float64),
        even=_rms(even.power),
        even_noise=None if even.noise is None else _rms(even.noise),
        odd_hz=np.asarray((odd.lines + 1) * spacing_hz, dtype=np.float64),
        odd=_rms(odd.power),
        odd_noise=None if odd.noise is None else _rms(odd.noise),
        signal=np.sqrt(2.0 * np.mean(np.abs(signal) ** 2, axis=0)),
    )


def at_excited(detection: Detection, excited: Lines) -> tuple[Complex, float] | None:
    """Return the distortion's covariance of the output at the excited lines and its degrees of freedom.

    The mean over the nearest detection lines that share the parity of the excitation, less the noise there, with
    negative parts (noise that scatters) at 0. None where there are no such lines.
    """
    odd_only = bool(np.all((excited + 1) % 2 == 1))
    used = detection.of_parity(True) if odd_only else detection
    if not used.lines.size:
        return None
    pooled = min(_POOLED, used.lines.size)
    found = used.power if used.noise is None else used.power - used.noise
    first = np.searchsorted(used.lines, excited) - pooled // 2
    nearest = np.clip(first, 0, used.lines.size - pooled)[:, None] + np.arange(pooled)
    level, vectors = np.linalg.eigh(found[nearest].mean(axis=1))
    covariance = (vectors * np.maximum(level, 0.0)[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2))
    return covariance, 2.0 * pooled * used.n_experiments


def _rms(power: Complex) -> Array:
    return np.asarray(np.sqrt(2.0 * np.maximum(np.real(np.diagonal(power, axis1=1, axis2=2)), 0.0)))
