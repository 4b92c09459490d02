"""Excitation waveforms, multisines among them, and their choice by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import ceil, log2
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError, choices

AmplitudeIs = Literal["peak", "rms"]


def scaled(x: Array, amplitude: float, amplitude_is: AmplitudeIs = "peak") -> Array:
    """Return samples (n_samples,), not all zero, scaled so that their largest absolute value, or their rms, is
    `amplitude`.
    """
    if not (np.isfinite(amplitude) and amplitude > 0):
        raise AmbidError(f"excitation amplitude {amplitude}; it must be a positive number. Give another")
    if amplitude_is not in ("peak", "rms"):
        raise AmbidError(f"amplitude_is {amplitude_is!r}; it must be 'peak' or 'rms'. Give one of them")
    size = np.max(np.abs(x)) if amplitude_is == "peak" else np.sqrt(np.mean(x**2))
    return np.asarray(x * (amplitude / size), dtype=np.float64)


def checked(n_samples: int, rate_hz: float) -> None:
    """Refuse a length under two samples or a rate that is not positive."""
    if n_samples < 2 or not (np.isfinite(rate_hz) and rate_hz > 0):
        raise AmbidError(
            f"excitation of {n_samples} samples at {rate_hz} Hz; it needs at least 2 samples and a positive rate. "
            f"Give others"
        )


def checked_band(band: tuple[float, float], rate_hz: float) -> tuple[float, float]:
    """Return a band (low, high) in Hz after checking 0 <= low < high <= rate/2."""
    low, high = float(band[0]), float(band[1])
    if not 0.0 <= low < high <= rate_hz / 2:
        raise AmbidError(
            f"excitation band {low:g} to {high:g} Hz at a rate of {rate_hz:g} Hz; it must lie between 0 and half "
            f"the rate "
            f"({rate_hz / 2:g} Hz), low end first. Give another band or rate"
        )
    return low, high


def steps(n_samples: int, rate_hz: float, *, amplitude: float) -> Array:
    """Return steps through 0, 1, 0, -1 times the amplitude, an eighth of the signal each, and over again."""
    checked(n_samples, rate_hz)
    heights = np.array([0.0, 1.0, 0.0, -1.0])
    x = heights[(np.arange(n_samples) // max(1, round(n_samples / 8))) % heights.size]
    return scaled(x, amplitude)


def chirp(n_samples: int, rate_hz: float, *, amplitude: float, band: tuple[float, float]) -> Array:
    """Return a sine of phase φ = 2π (f0 t + (f1 - f0) t²/(2 T)), whose frequency runs once through the band."""
    checked(n_samples, rate_hz)
    low, high = checked_band(band, rate_hz)
    t, duration = np.arange(n_samples) / rate_hz, n_samples / rate_hz
    turns = low * t + (high - low) * t**2 / (2.0 * duration)
    return scaled(np.sin(2.0 * np.pi * turns), amplitude)


def prbs(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    bits: int | None = None,
    hold: int = 1,
    seed: int | np.random.Generator = 0,
) -> Array:
    """Return a maximum-length pseudo-random binary sequence of ±amplitude: `bits` bits give a period of 2^bits - 1
    ticks, mean amplitude/(2^bits - 1) and a two-valued periodic autocorrelation (Ljung 1999, sec. 13.3). The spectrum
    falls to half at 0.44/tick and to nothing at 1/tick.
    """
    from scipy.signal import max_len_seq

    checked(n_samples, rate_hz)
    ticks = -(-n_samples // hold)
    if bits is None:
        bits = max(4, int(ticks).bit_length())
    start = np.random.default_rng(seed).integers(1, 2**bits)
    register = np.array([(int(start) >> k) & 1 for k in range(bits)], dtype=np.int8)
    sequence = max_len_seq(bits, state=register, length=ticks)[0]
    x = np.repeat(2.0 * sequence - 1.0, hold)[:n_samples]
    return scaled(x, amplitude)


def gaussian(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float] | None = None,
    seed: int | np.random.Generator = 0,
) -> Array:
    """Return Gaussian noise, white or confined to a band."""
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
    return scaled(x, amplitude, "rms")


def multisine(
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float],
    periods: int = 1,
    phases: Literal["random", "schroeder"] = "random",
    shape: Literal["flat", "pink"] = "flat",
    lines: Literal["all", "odd"] = "all",
    crest_iterations: int = 0,
    seed: int | np.random.Generator = 0,
    amplitude_is: AmplitudeIs = "peak",
) -> Array:
    """Return a whole number of periods of a multisine.

    It has a line at each multiple of rate/(n_samples/periods) in the band (0 and half the rate left out). Schroeder
    phases φ_k = -2π Σ_{j<k} (k - j) p_j, with p_j the share of line j in the power, give a crest factor of about 1.7
    for a flat spectrum of many lines (Schroeder 1970). `crest_iterations` lowers it by clipping the peaks and putting
    the amplitudes back (van der Ouderaa, Schoukens and Renneboog 1988); the best iteration is kept.

    Parameters
    ----------
    n_samples : int
        A multiple of `periods`.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Largest absolute value, or rms, in the unit of the result.
    band : (float, float), Hz
    periods : int
        Whole periods in the signal, at least 1.
    phases : {"random", "schroeder"}
    shape : {"flat", "pink"}
        Amplitude of the lines: all equal, or falling with 1/√f (equal power per octave).
    lines : {"all", "odd"}
        All multiples, or the odd ones only, whose even neighbours then show nonlinearity.
    crest_iterations : int
        Some 100 go far.
    seed : int or numpy.random.Generator
        Source of random phases.
    amplitude_is : {"peak", "rms"}

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`

    Raises
    ------
    AmbidError
        If a setting is out of range, or no line falls into the band.
    """
    checked(n_samples, rate_hz)
    low, high = checked_band(band, rate_hz)
    if periods < 1 or n_samples % periods or crest_iterations < 0:
        raise AmbidError(
            f"multisine of {n_samples} samples in {periods} periods with {crest_iterations} iterations; periods "
            f"must divide the samples and "
            "iterations not be negative. Give other numbers"
        )
    period = n_samples // periods
    numbers = _line_numbers(period, rate_hz, low, high, lines)
    size = _amplitudes(numbers, shape)
    if phases == "random":
        angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, numbers.size)
    elif phases == "schroeder":
        angle = schroeder_phases(size)
    else:
        raise AmbidError(f"multisine phases {phases!r}; they must be 'random' or 'schroeder'. Give one of them")
    x = _flattened(period, numbers, size, angle, crest_iterations)
    return np.tile(scaled(x, amplitude, amplitude_is), periods)


def schroeder_phases(size: Array) -> Array:
    """Return Schroeder's phases for lines of the given amplitudes (equally spaced in frequency)."""
    share = size**2 / np.sum(size**2)
    # Σ_{j<k} (k - j) p_j is the running sum of the running sum of p, one line late.
    twice = np.cumsum(np.cumsum(share))
    phases: Array = -2.0 * np.pi * np.concatenate(([0.0], twice[:-1]))
    return phases


def crest_factor(x: Array) -> float:
    """Return the crest factor max|x|/rms(x).

    Parameters
    ----------
    x : ndarray, shape (n_samples,), any unit
        Not all zero.

    Returns
    -------
    float
        Dimensionless, at least 1; √2 for a sine.

    Raises
    ------
    AmbidError
        If all samples are zero.
    """
    rms = float(np.sqrt(np.mean(np.square(x))))
    if rms == 0.0:
        raise AmbidError("the crest factor of a signal that is zero throughout does not exist. Pass an excitation")
    return float(np.max(np.abs(x))) / rms


def _line_numbers(period: int, rate_hz: float, low: float, high: float, lines: str) -> np.ndarray:
    spacing = rate_hz / period
    # A band end that is meant to be a line (1 Hz at 1 Hz spacing) must not miss it by round-off.
    first = max(1, int(np.ceil(low / spacing - 1e-9)))
    last = min((period - 1) // 2, int(np.floor(high / spacing + 1e-9)))
    if lines not in ("all", "odd"):
        raise AmbidError(f"multisine lines {lines!r}; they must be 'all' or 'odd'. Give one of them")
    numbers = np.arange(first, last + 1)
    numbers = numbers if lines == "all" else numbers[numbers % 2 == 1]
    if not numbers.size:
        raise AmbidError(
            f"a multisine with lines every {spacing:g} Hz has none ({lines}) between {low:g} and {high:g} Hz. "
            "Widen the band, or make the period longer"
        )
    return numbers


def _amplitudes(numbers: np.ndarray, shape: str) -> Array:
    if shape == "flat":
        return np.ones(numbers.size)
    if shape == "pink":
        return 1.0 / np.sqrt(numbers.astype(np.float64))
    raise AmbidError(f"multisine shape {shape!r}; it must be 'flat' or 'pink'. Give one of them")


def _flattened(period: int, numbers: np.ndarray, size: Array, angle: Array, iterations: int) -> Array:
    """Return one period with the phases `angle`, after `iterations` rounds of clipping that change the phases only."""

    def wave(phases: Array) -> Array:
        spectrum = np.zeros(period // 2 + 1, dtype=complex)
        spectrum[numbers] = size * np.exp(1j * phases)
        return np.asarray(np.fft.irfft(spectrum, period), dtype=np.float64)

    x: Array = wave(angle)
    best: Array = x
    for k in range(iterations):
        # Clip little at first and less later: hard clipping moves the phases too far to settle.
        limit = (0.85 + 0.14 * k / iterations) * np.max(np.abs(x))
        angle = np.angle(np.fft.rfft(np.clip(x, -limit, limit))[numbers])
        x = wave(angle)
        if np.max(np.abs(x)) < np.max(np.abs(best)):
            best = x
    return best


def _prbs_in_band(
    n_samples: int, rate_hz: float, *, amplitude: float, band: tuple[float, float] | None = None,
    seed: int | np.random.Generator = 0,
) -> Array:  # fmt: skip
    """PRBS with its half-power frequency 0.44/tick at the top of the band and a line at its bottom or under."""
    hold, bits = 1, None
    if band is not None:
        low, high = checked_band(band, rate_hz)
        hold = max(1, int(0.44 * rate_hz / high))
        bits = max(2, ceil(log2(rate_hz / (hold * low) + 1.0))) if low > 0.0 else None
    return prbs(n_samples, rate_hz, amplitude=amplitude, bits=bits, hold=hold, seed=seed)


AXES_EXCITATIONS = ("zippered", "orthogonal")
"""Multisines over the axes of a rotor, by name; see `excitation_of_axes`."""


def excitation_of_axes(
    name: str,
    n_samples: int,
    rate_hz: float,
    *,
    axes: int,
    excited: Sequence[int] | None = None,
    amplitude: float,
    band: tuple[float, float] | None = None,
    periods: int = 1,
    seed: int = 0,
) -> Array:
    """Make an excitation of several axes at once.

    ``zippered``: line k of a multisine goes to axis k mod n, so that each line excites one axis and one experiment
    shows the whole response matrix, at every n-th line. ``orthogonal``: every axis has all lines, in n experiments one
    after the other; from one to the next the phases turn by 2 pi b j/n on axis j, so that those of all experiments, a
    discrete Fourier matrix at each line, are orthogonal over the axes (Dobrowiecki and Schoukens 2007). Every other
    name: an excitation of its own on each axis.

    Parameters
    ----------
    name : str
        One of `AXES_EXCITATIONS`, or of `EXCITATIONS` with random numbers in it.
    n_samples : int
        A multiple of `periods`, for ``orthogonal`` of `periods` times the excited axes.
    rate_hz : float
        Sampling rate in Hz.
    axes : int
    excited : sequence of int, optional
        Axes that are excited, counted from 0; default all.
    amplitude : float
        Peak of each excited axis (rms for ``gaussian``), in the unit of the result.
    band : (float, float), Hz, optional
        Default: from one line on to a fifth of the rate.
    periods : int
        Whole periods; of ``orthogonal`` in each experiment.
    seed : int
        Of the random phases.

    Returns
    -------
    ndarray, shape (n_samples, axes), unit of `amplitude`
        Zero on axes that are not excited.

    Raises
    ------
    AmbidError
        If a setting is out of range, or all axes would have the same signal.

    Examples
    --------
    >>> import numpy as np
    >>> from ambid.signals import excitation_of_axes
    >>> u = excitation_of_axes("zippered", 1000, 1000.0, axes=2, amplitude=1.0, band=(1.0, 100.0))
    >>> lines = np.abs(np.fft.rfft(u, axis=0)) > 1e-6
    >>> np.flatnonzero(lines[:, 0])[:3].tolist(), np.flatnonzero(lines[:, 1])[:3].tolist()
    ([2, 4, 6], [1, 3, 5])
    """
    checked(n_samples, rate_hz)
    _refuse_unknown(name, (*EXCITATIONS, *AXES_EXCITATIONS))
    moved = tuple(range(axes)) if excited is None else tuple(excited)
    blocks = len(moved) if name == "orthogonal" else 1
    if not moved or periods < 1 or n_samples % (periods * blocks):
        several = f" in each of {blocks} experiments" if blocks > 1 else ""
        raise AmbidError(
            f"excitation {name!r} of {n_samples} samples in {periods} periods{several}: they do not divide. Give "
            "another duration, or other periods"
        )
    period = n_samples // (periods * blocks)
    waves = np.zeros((n_samples, axes))
    if name not in AXES_EXCITATIONS:
        if name in ("steps", "chirp", "schroeder") and len(moved) > 1:
            raise AmbidError(
                f"excitation {name!r} is the same on every axis, so none shows by itself. Give {AXES_EXCITATIONS[0]}"
            )
        for j in moved:
            x = excitation(name, period, rate_hz, amplitude=amplitude, band=band, seed=np.random.default_rng([seed, j]))
            waves[:, j] = np.tile(x, periods)
        return waves
    low, high = checked_band(band or (rate_hz / period, rate_hz / 5.0), rate_hz)
    numbers = _line_numbers(period, rate_hz, low, high, "all")
    for k, j in enumerate(moved):
        own = numbers if blocks > 1 else numbers[numbers % len(moved) == k]
        if not own.size:
            raise AmbidError(
                f"{numbers.size} lines between {low:g} and {high:g} Hz are too few for {len(moved)} axes. Widen the "
                "band, or make the period longer"
            )
        angle = np.random.default_rng([seed, j]).uniform(0.0, 2.0 * np.pi, own.size)
        turned = [angle + 2.0 * np.pi * b * k / blocks for b in range(blocks)]
        parts = [np.tile(_flattened(period, own, np.ones(own.size), phases, 0), periods) for phases in turned]
        waves[:, j] = scaled(np.concatenate(parts), amplitude)
    return waves


EXCITATIONS: Mapping[str, Callable[..., Array]] = MappingProxyType(
    {
        "steps": steps,
        "chirp": chirp,
        "prbs": _prbs_in_band,
        "gaussian": gaussian,
        "multisine": multisine,
        "schroeder": partial(multisine, phases="schroeder"),
    }
)
"""Excitations by name; each takes (n_samples, rate_hz, *, amplitude, ...)."""

_NEED_BAND = ("chirp", "multisine", "schroeder")


def excitation(
    name: str,
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float] | None = None,
    seed: int | np.random.Generator = 0,
) -> Array:
    """Make an excitation by name.

    Parameters
    ----------
    name : str
        ``steps``, ``chirp``, ``prbs``, ``gaussian``, ``multisine`` or ``schroeder``.
    n_samples : int
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Peak (rms for ``gaussian``) in the unit of the result.
    band : (float, float), Hz, optional
        Default: one period over the record to a fifth of the rate for chirp and multisines, all for prbs and gaussian.
        Steps have none.
    seed : int or numpy.random.Generator
        The same seed gives the same samples. Steps and chirp have none.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`

    Raises
    ------
    AmbidError
        If the name is unknown (the message names the nearest), or a setting is out of range.
    """
    if name in AXES_EXCITATIONS:
        raise AmbidError(f"excitation {name!r} is over the axes of a rotor; this bench has one axis. Give multisine")
    _refuse_unknown(name, tuple(EXCITATIONS))
    checked(n_samples, rate_hz)
    settings: dict[str, object] = {"amplitude": amplitude}
    if name == "steps" and band is not None:
        raise AmbidError("excitation 'steps' has no band. Omit the band, or choose 'prbs' for steps in a band")
    if band is not None:
        settings["band"] = band
    elif name in _NEED_BAND:
        settings["band"] = (rate_hz / n_samples, rate_hz / 5.0)
    if name not in ("steps", "chirp"):
        settings["seed"] = seed
    return EXCITATIONS[name](n_samples, rate_hz, **settings)


def _refuse_unknown(name: str, allowed: Sequence[str]) -> None:
    if name not in allowed:
        raise AmbidError(f"excitation {name!r} is unknown; there are {choices(name, allowed)} Give one of these")
