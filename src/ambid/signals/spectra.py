"""Power and cross spectra by Welch's method, and the signal-to-noise ratio of a channel (thesis fig. 5.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record
from ambid.signals.conditioning import finite
from ambid.signals.delay import fit_arx

_CHUNK = 64  # segments transformed at a time: memory does not grow with the record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PowerSpectrum:
    """One-sided power spectral density."""

    frequency_hz: Array  # (n_frequencies,), Hz: Frequencies from 0 to half the rate
    density: Array  # (n_frequencies,), signal unit squared per Hz: Its integral over frequency is the variance
    n_segments: int  # half-overlapping segments that were averaged
    n_effective: float  # independent segments that would give the same variance; fewer, since neighbours share samples

    @property
    def sd(self) -> Array:
        """Standard deviation density/√n_effective, shape (n_frequencies,), in the unit of the density."""
        return np.asarray(self.density / np.sqrt(self.n_effective))

    def confidence(self, level: float = 0.95) -> tuple[Array, Array]:
        """Return the bounds of the density: 2 n_effective·estimate/truth is χ² with 2 n_effective degrees of freedom.

        It holds inside the band; at 0 and at half the rate the density has half the degrees of freedom.
        """
        from scipy.special import gammaincinv

        if not 0.0 < level < 1.0:
            raise RecordError(f"a confidence level of {level}; it must lie between 0 and 1. Give e.g. 0.95")
        n = self.n_effective
        low, high = (self.density * n / gammaincinv(n, 0.5 * (1.0 + s * level)) for s in (1.0, -1.0))
        return low, high


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CrossSpectra:
    """One-sided spectral density matrix of several signals."""

    frequency_hz: Array  # (n_frequencies,), Hz: Frequencies from 0 to half the rate
    # (n_frequencies, n_signals, n_signals), product of units per Hz: E[Z Zᴴ], so that entry (i, j) is signal i
    # times the conjugate of signal j. Its integral is the covariance
    density: NDArray[np.complex128]
    n_segments: int  # segments averaged
    n_effective: float  # independent segments that would give the same variance (Welch 1967)
    # neighbouring lines share noise through the window: Σ over lags of the squared correlation
    lines_per_independent: float


def power_spectrum(x: Array, rate_hz: float, *, segment: int | None = None) -> PowerSpectrum:
    """Estimate the power spectral density by Welch's method (Hann window, half overlap, mean removed).

    Parameters
    ----------
    x : ndarray, shape (n_samples,), any unit
    rate_hz : float
        Sampling rate in Hz.
    segment : int, optional
        Samples of a segment; by default an eighth of the record, at least 256 where there are as many.

    Returns
    -------
    PowerSpectrum
        In the unit of `x` squared per Hz.

    Raises
    ------
    RecordError
        If the segment does not fit the record.
    """
    spectra = cross_spectra(x[:, None], rate_hz, segment=segment)
    return PowerSpectrum(
        frequency_hz=spectra.frequency_hz,
        density=np.ascontiguousarray(spectra.density[:, 0, 0].real),
        n_segments=spectra.n_segments,
        n_effective=spectra.n_effective,
    )


def cross_spectra(z: Array, rate_hz: float, *, segment: int | None = None) -> CrossSpectra:
    """Estimate the spectral density matrix of several signals by Welch's method (Hann, half overlap).

    Parameters
    ----------
    z : ndarray, shape (n_samples, n_signals), any units
    rate_hz : float
        Sampling rate in Hz.
    segment : int, optional
        As in `power_spectrum`.

    Returns
    -------
    CrossSpectra
        Densities, with the number of independent averages that they are worth.

    Raises
    ------
    RecordError
        If the segment does not fit the record.
    """
    length = _segment(z.shape[0], segment)
    step = length - length // 2
    count = (z.shape[0] - length) // step + 1
    w = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)  # Hann, periodic
    segments = np.lib.stride_tricks.sliding_window_view(z, length, axis=0)[::step]
    density = np.zeros((length // 2 + 1, z.shape[1], z.shape[1]), dtype=np.complex128)
    for first in range(0, count, _CHUNK):
        x = segments[first : first + _CHUNK]
        Z = np.fft.rfft((x - x.mean(axis=-1, keepdims=True)) * w, axis=-1)
        density += np.einsum("sif,sjf->fij", Z, Z.conj(), optimize=True)
    density *= 2.0 / (count * rate_hz * np.sum(w**2))
    density[0] *= 0.5
    if length % 2 == 0:
        density[-1] *= 0.5
    power = np.sum(w**2)
    total = 1.0
    for q in range(1, min(count, -(-w.size // step))):
        rho = float(np.sum(w[q * step :] * w[: w.size - q * step]) / power)
        total += 2.0 * (1.0 - q / count) * rho**2
    return CrossSpectra(
        frequency_hz=np.asarray(np.fft.rfftfreq(length, 1.0 / rate_hz), dtype=np.float64),
        density=density,
        n_segments=count,
        n_effective=(count / total),
        lines_per_independent=_line_overlap(w),
    )


def _segment(n_samples: int, segment: int | None) -> int:
    if segment is None:
        return min(n_samples, max(256, n_samples // 8))
    if not 8 <= segment <= n_samples:
        raise RecordError(f"a segment of {segment} samples; it must have 8 to {n_samples} (the record). Give another")
    return segment


def _line_overlap(w: Array) -> float:
    """Return Σ_q |ρ(q)|² over lags of lines, ρ(q) = Σ w² e^{-2πj q t/n}/Σ w²: 1 for a box, 35/18 for Hann."""
    rho = np.fft.fft(w**2) / np.sum(w**2)
    return float(np.sum(np.abs(rho) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Snr:
    """Signal-to-noise ratio of a channel."""

    channel: str  # channel and its unit
    unit: str
    db: float  # 10·log10(σ²_signal/σ²_noise); inf without noise, -inf without signal
    signal_sd: float  # standard deviations in `unit`. The mean counts as neither
    noise_sd: float
    method: str  # how the noise was told from the signal, in words

    def __str__(self) -> str:
        return f"{self.channel}: SNR {self.db:.1f} dB, noise {self.noise_sd:.3g} {self.unit} rms ({self.method})"


def snr(
    record: Record,
    name: str,
    *,
    inputs: str | Sequence[str] = (),
    order: int = 20,
) -> Snr:
    """Estimate the signal-to-noise ratio of a channel.

    Noise is what a high-order (auto)regression cannot predict: the variance of its one-step error, fitted by QR.

    Parameters
    ----------
    record : Record
    name : str, a channel
    inputs : str or sequence of str
        Channels that drive it, for the prediction; without them an unpredictable excitation counts as noise and the
        ratio is a lower bound.
    order : int
        Lags of the channel and of each input in the prediction.

    Returns
    -------
    Snr
        In dB, with the method stated.

    Raises
    ------
    RecordError
        If the channel is among its own inputs.
    EstimationError
        If the record is too short for `order`.
    """
    y = finite(record, name)
    driving = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    if name in driving:
        raise RecordError(f"snr of {name!r} lists the channel among its own inputs. Omit it there")
    noise, spread = 0.0, float(np.std(y))
    if spread > 0.0:
        u = [finite(record, n) for n in driving]
        scaled = [(x - x.mean()) / (x.std() or 1.0) for x in u]
        fit = fit_arx((y - y.mean()) / spread, scaled, order, range(order + 1) if scaled else ())
        noise = fit.variance * spread**2
    source = f" and inputs {', '.join(driving)}" if driving else ", no inputs: a lower bound"
    method = f"one-step prediction error, {order} lags of the channel{source}"
    total = float(np.var(y))
    noise = min(noise, total)
    signal = total - noise
    with np.errstate(divide="ignore", invalid="ignore"):
        db = float(10.0 * (np.log10(signal) - np.log10(noise))) if total > 0 else -np.inf
    return Snr(
        channel=name,
        unit=record.channel(name).unit,
        db=db,
        signal_sd=float(np.sqrt(signal)),
        noise_sd=float(np.sqrt(noise)),
        method=method,
    )
