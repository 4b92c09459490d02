"""Excitations with a simple time course: steps, chirp, pseudo-random binary sequence, Gaussian noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError

AmplitudeIs = Literal["peak", "rms"]


def scaled(x: Array, amplitude: float, amplitude_is: AmplitudeIs) -> Array:
    """Scale samples so that their largest absolute value, or their rms, is `amplitude`.

    `x`: (n_samples,), samples, not all zero; `amplitude`: wanted peak or rms, in the unit of the result; over 0;
    `amplitude_is`: what `amplitude` means. Returns (n_samples,), unit of `amplitude`, scaled samples.
    """
    if not (np.isfinite(amplitude) and amplitude > 0):
        raise AmbidError(f"excitation amplitude {amplitude}; it must be a positive number. Give another")
    if amplitude_is not in ("peak", "rms"):
        raise AmbidError(f"amplitude_is {amplitude_is!r}; it must be 'peak' or 'rms'. Give one of them")
    size = np.max(np.abs(x)) if amplitude_is == "peak" else np.sqrt(np.mean(x**2))
    return np.asarray(x * (amplitude / size), dtype=np.float64)


def checked(n_samples: int, rate_hz: float) -> None:
    """Refuse a length under two samples or a rate that is not positive.

    `n_samples`: samples; `rate_hz`: sampling rate in Hz.
    """
    if n_samples < 2 or not (np.isfinite(rate_hz) and rate_hz > 0):
        raise AmbidError(
            f"excitation of {n_samples} samples at {rate_hz} Hz; it needs at least 2 samples and a positive rate. "
            f"Give others"
        )


def checked_band(band: tuple[float, float], rate_hz: float) -> tuple[float, float]:
    """Return a band (low, high) in Hz after checking 0 <= low < high <= rate/2.

    `band`: ends in Hz; `rate_hz`: sampling rate in Hz. Returns the same band in Hz.
    """
    low, high = float(band[0]), float(band[1])
    if not 0.0 <= low < high <= rate_hz / 2:
        raise AmbidError(
            f"excitation band {low:g} to {high:g} Hz at a rate of {rate_hz:g} Hz; it must lie between 0 and half "
            f"the rate "
            f"({rate_hz / 2:g} Hz), low end first. Give another band or rate"
        )
    return low, high


def steps(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    hold_s: float,
    levels: Sequence[float] = (0.0, 1.0, 0.0, -1.0),
    amplitude_is: AmplitudeIs = "peak",
) -> Array:
    """Return steps that run through `levels`, holding each for `hold_s`, over and over.

    Parameters
    ----------
    n_samples : int
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Largest absolute value, or rms over the signal, in the unit of the result.
    hold_s : float
        Time in s for which a level is held, at least one sample; rounded to whole samples.
    levels : sequence of float
        Relative heights.
    amplitude_is : {"peak", "rms"}
        What `amplitude` means.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The steps.

    Raises
    ------
    AmbidError
        If a setting is out of range, or no step falls into the signal.
    """
    checked(n_samples, rate_hz)
    hold = round(hold_s * rate_hz)
    if hold < 1:
        raise AmbidError(
            f"steps held for {hold_s:g} s at {rate_hz:g} Hz are shorter than a sample. Give a longer hold_s"
        )
    heights = np.asarray(levels, dtype=np.float64)
    x = heights[(np.arange(n_samples) // hold) % heights.size]
    if np.ptp(x) == 0.0:
        raise AmbidError(
            f"steps held for {hold_s:g} s give no step in {n_samples / rate_hz:g} s. Give a shorter hold_s"
        )
    return scaled(x, amplitude, amplitude_is)


def chirp(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float],
    sweep: Literal["linear", "log"] = "linear",
    amplitude_is: AmplitudeIs = "peak",
) -> Array:
    """Return a sine whose frequency runs once through the band, starting at phase 0.

    Linear: φ = 2π (f0 t + (f1 - f0) t²/(2 T)); logarithmic: φ = 2π f0 T/ln(f1/f0) ((f1/f0)^(t/T) - 1).

    Parameters
    ----------
    n_samples : int
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Largest absolute value, or rms, in the unit of the result.
    band : (float, float)
        First and last frequency in Hz; the first must be over 0 for a logarithmic sweep.
    sweep : {"linear", "log"}
        Frequency linear in time, or its logarithm.
    amplitude_is : {"peak", "rms"}
        What `amplitude` means.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The chirp.

    Raises
    ------
    AmbidError
        If a setting is out of range.
    """
    checked(n_samples, rate_hz)
    low, high = checked_band(band, rate_hz)
    t, duration = np.arange(n_samples) / rate_hz, n_samples / rate_hz
    if sweep == "linear":
        turns = low * t + (high - low) * t**2 / (2.0 * duration)
    elif sweep == "log":
        if low == 0.0:
            raise AmbidError("a logarithmic chirp cannot start at 0 Hz. Give a low end over 0, or sweep='linear'")
        turns = low * duration / np.log(high / low) * ((high / low) ** (t / duration) - 1.0)
    else:
        raise AmbidError(f"chirp sweep {sweep!r}; it must be 'linear' or 'log'. Give one of them")
    return scaled(np.sin(2.0 * np.pi * turns), amplitude, amplitude_is)


def prbs(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    bits: int | None = None,
    hold: int = 1,
    seed: int | np.random.Generator = 0,
    amplitude_is: AmplitudeIs = "peak",
) -> Array:
    """Return a maximum-length pseudo-random binary sequence of ±amplitude.

    A shift register of `bits` bits gives a period of 2^bits - 1 clock ticks; its mean is amplitude/(2^bits - 1) and
    its periodic autocorrelation has two values only (Ljung 1999, sec. 13.3). The spectrum falls to half at 0.44/tick
    and to nothing at 1/tick.

    Parameters
    ----------
    n_samples : int
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Both peak and rms, which are equal here, in the unit of the result.
    bits : int, optional
        Length of the register, 2 to 31; by default the shortest (at least 4) whose period is as long as the signal.
    hold : int
        Samples of a clock tick.
    seed : int or numpy.random.Generator
        Chooses where in its period the sequence starts.
    amplitude_is : {"peak", "rms"}
        Accepted for uniformity.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The sequence.

    Raises
    ------
    AmbidError
        If a setting is out of range.
    """
    from scipy.signal import max_len_seq

    checked(n_samples, rate_hz)
    if hold < 1:
        raise AmbidError(f"PRBS tick of {hold} samples; it must be at least 1. Give another hold")
    ticks = -(-n_samples // hold)
    if bits is None:
        bits = max(4, int(ticks).bit_length())
    if not 2 <= bits <= 31:
        raise AmbidError(f"PRBS register of {bits} bits; it must have 2 to 31. Give another number of bits")
    start = np.random.default_rng(seed).integers(1, 2**bits)
    register = np.array([(int(start) >> k) & 1 for k in range(bits)], dtype=np.int8)
    sequence = max_len_seq(bits, state=register, length=ticks)[0]
    x = np.repeat(2.0 * sequence - 1.0, hold)[:n_samples]
    return scaled(x, amplitude, amplitude_is)


def gaussian(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float] | None = None,
    seed: int | np.random.Generator = 0,
    amplitude_is: AmplitudeIs = "rms",
) -> Array:
    """Return Gaussian noise, white or confined to a band.

    Parameters
    ----------
    n_samples : int
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Rms of these samples (default), or largest absolute value, in the unit of the result.
    band : (float, float), optional
        Band in Hz, cut out exactly in the discrete Fourier transform of the whole signal; white by default.
    seed : int or numpy.random.Generator
        Source of the noise.
    amplitude_is : {"rms", "peak"}
        What `amplitude` means.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The noise.

    Raises
    ------
    AmbidError
        If a setting is out of range, or no frequency of the signal falls into the band.
    """
    checked(n_samples, rate_hz)
    x = np.random.default_rng(seed).standard_normal(n_samples)
    if band is not None:
        low, high = checked_band(band, rate_hz)
        lines = np.fft.rfft(x)
        frequency = np.fft.rfftfreq(n_samples, 1.0 / rate_hz)
        inside = (frequency >= low) & (frequency <= high)
        if not inside[1:].any():
            raise AmbidError(
                f"{n_samples / rate_hz:g} s of noise have no line between {low:g} and {high:g} Hz. Widen the band, "
                f"or make it longer"
            )
        x = np.fft.irfft(np.where(inside, lines, 0.0), n_samples)
    return scaled(x, amplitude, amplitude_is)
