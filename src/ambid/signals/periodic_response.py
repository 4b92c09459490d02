"""Frequency response from periodic excitation, the inputs as noisy as the outputs, feedback allowed. Noise differs
between periods, nonlinear distortion between realisations of the phases (Pintelon and Schoukens 2012, ch. 2 to 4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.settings.caller import setting
from ambid.signals.response import (
    FrequencyResponse,
    Hold,
    checked,
    feedback_caution,
    labels,
    ratio_map,
    right_inverse,
    scatter,
    transformed,
    weak_inputs,
)

Lines = NDArray[np.intp]
_LARGEST_GAP_FROM = 1e-3  # of the largest line: no line under it counts as excited


def find_period(x: Array) -> int:
    """Find the period of an excitation: the smallest shift under which it comes back.

    The mean square difference d(τ) between the signal and itself τ later, over that of unrelated stretches, is 0 at the
    period (noise over total power with noise). The first local minimum that is nearly as deep as the deepest, after d
    has once risen over a half, is taken.

    Parameters
    ----------
    x : ndarray, shape (n_samples,) or (n_samples, n_channels), any unit
        At least a period and a thirty-second of one.

    Returns
    -------
    int
        Period in samples.

    Raises
    ------
    EstimationError
        If nothing comes back.
    """
    x = x[:, None] if x.ndim == 1 else x
    d = np.mean([_differences(column) for column in x.T], axis=0)
    risen = int(np.argmax(d > 0.5)) if np.any(d > 0.5) else d.size
    low = np.flatnonzero((d[1:-1] <= d[:-2]) & (d[1:-1] <= d[2:])) + 1 if d.size > 2 else np.zeros(0, dtype=np.intp)
    low = low[low > risen]
    if not low.size or d[low].min() > 0.3:
        raise EstimationError(
            f"no period found in {x.shape[0]} samples of the excitation; a period and a part of the next must be in "
            f"it. Give the period, or use the local or the random method ({setting('method')})"
        )
    deepest = float(d[low].min())
    # A multiple of the period is as deep but for noise: the first that is not clearly shallower is the period.
    return int(low[np.argmax(d[low] <= 2.0 * deepest + 1e-3)])


def excited_lines(mean: Complex, noise: Array | None, *, least: int = 1) -> tuple[Lines, bool]:
    """Return the excited lines of spectra `mean` (n_experiments, n_lines, n_channels), and whether a gap shows them:
    those over the largest gap in the sorted amplitudes, of 12 dB at least, below the `least` largest. Without one, all
    within 60 dB of the largest and 10 dB over their own noise power `noise` (n_lines,).
    """
    power = np.sum(np.abs(mean) ** 2, axis=(0, 2))
    if not np.any(power > 0):
        raise EstimationError("the excitation has no power at any line of the period. Check the period")
    level = np.log(np.maximum(power, np.finfo(float).tiny))
    order = np.argsort(level)[::-1]
    high = int(np.sum(power > power.max() * _LARGEST_GAP_FROM**2))
    falls = level[order[:-1]] - level[order[1:]]
    falls[: least - 1] = 0.0  # of a designed excitation some lines are far larger than the others
    last = int(np.argmax(falls[:high])) if falls.size else 0
    clear = bool(falls.size and falls[:high].max() > np.log(10.0**1.2))
    lines = np.sort(order[: last + 1]) if clear else np.sort(order[:high])
    if not clear and noise is not None:
        lines = lines[power[lines] > 10.0 * noise[lines]]
        if not lines.size:
            raise EstimationError("no line of the excitation is 10 dB above its noise. Average more periods")
    return lines, clear


def without_strays(lines: Lines) -> tuple[Lines, Lines]:
    """Return excited lines and strays: even lines among an odd excitation (under 5 % of all), such as mains hum."""
    odd = (lines + 1) % 2 == 1
    if 0 < np.sum(~odd) < 0.05 * lines.size:
        return lines[odd], lines[~odd]
    return lines, lines[:0]


def transient_ratio(periods: Array) -> float:
    """Return how many standard deviations the first of P >= 3 periods (P, n, n_z) differs more than noise allows, in
    the worst channel: its mean square distance from the mean of the others against theirs, with (Σ S)²/Σ S² independent
    samples.
    """
    count = periods.shape[0]
    rest = periods[1:]
    noise = np.fft.rfft(rest - rest.mean(axis=0), axis=1)[:, 1:]
    S = np.mean(np.abs(noise) ** 2, axis=0) * (count - 1) / (count - 2)
    first = np.fft.rfft(periods[0] - rest.mean(axis=0), axis=0)[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sum(np.abs(first) ** 2, axis=0) / np.sum(S, axis=0) / (1.0 + 1.0 / (count - 1))
        lines = np.sum(S, axis=0) ** 2 / np.sum(S**2, axis=0)
        sd = np.sqrt((1.0 + 1.0 / (count - 2)) / np.maximum(lines, 1.0))
    # Without noise, round-off is not a transient.
    size = np.sqrt(np.mean(np.square(periods), axis=(0, 1)))
    exact = np.sqrt(np.mean(np.square(periods[0] - rest.mean(axis=0)), axis=0)) < 1e-9 * size
    return float(np.max(np.where(exact | ~np.isfinite(share), 0.0, (share - 1.0) / sd)))


def _differences(x: Array) -> Array:
    """Return d(τ), 0 for equal and 1 for unrelated stretches, 1 where less is left to compare than a whole τ, or a
    thirty-second of it that holds 16 independent samples, (Σ S)²/Σ S² in the whole record.
    """
    x = x - x.mean()
    n = x.size
    size = 1 << (2 * n - 1).bit_length()
    F = np.fft.rfft(x, size)
    products = np.fft.irfft(np.abs(F) ** 2, size)[:n]
    energy = np.concatenate(([0.0], np.cumsum(x**2)))
    shifts = np.arange(n)
    both = energy[n - shifts] + energy[n] - energy[shifts]
    d = np.divide(both - 2.0 * products, both, out=np.ones(n), where=both > 1e-12 * energy[n])
    S = np.abs(F[1:]) ** 2
    independent = float(np.sum(S) ** 2 / max(np.sum(S**2), 1e-300)) * 2.0 / size  # an idle stretch has none
    left = n - shifts
    enough = (left >= shifts) | ((left >= shifts / 32) & (left * independent >= 16))
    return np.asarray(np.where(enough, d, 1.0))


_POOLED = 6  # detection lines averaged around each excited line


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distortions:
    """Output levels at detection lines, rms of the sine there (mean over experiments); they hold noise: compare with
    it.
    """

    even_hz: Array  # (n_even,), Hz: Even lines without excitation, between the lowest and the highest excited line
    even: Array  # (n_even, n_y), output units: Level there
    even_noise: Array | None  # (n_even, n_y), or None: Part of it that differs between periods; None with one period
    odd_hz: Array  # (n_odd,), Hz: Odd lines without excitation
    odd: Array  # (n_odd, n_y), output units: Level there
    odd_noise: Array | None  # (n_odd, n_y), or None: Part of it that differs between periods
    signal: Array  # (n_f, n_y), output units: Level at the excited lines


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
    """Return what the output does at lines without excitation, less the response to the input there: of mean spectra
    `Z` (n_experiments, n_lines, n_y + 1), their `noise` (..., n_y + 1, n_y + 1) and `G` (n_f, n_y, 1) at the lines
    `excited`.
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
    """Return the distortion's covariance of the output at the excited lines and its degrees of freedom, None without
    lines: the mean over the nearest detection lines of the excitation's parity, less the noise there, negative parts at
    0.
    """
    odd_only = bool(np.all((excited + 1) % 2 == 1))
    lines = detection.of_parity(True) if odd_only else detection
    if not lines.lines.size:
        return None
    pooled = min(_POOLED, lines.lines.size)
    power = lines.power if lines.noise is None else lines.power - lines.noise
    first = np.searchsorted(lines.lines, excited) - pooled // 2
    nearest = np.clip(first, 0, lines.lines.size - pooled)[:, None] + np.arange(pooled)
    level, vectors = np.linalg.eigh(power[nearest].mean(axis=1))
    covariance = (vectors * np.maximum(level, 0.0)[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2))
    return covariance, 2.0 * pooled * lines.n_experiments


def _rms(power: Complex) -> Array:
    return np.asarray(np.sqrt(2.0 * np.maximum(np.real(np.diagonal(power, axis1=1, axis2=2)), 0.0)))


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
    covariance = of_noise if of_all is None else of_all
    return Found(
        G=G,
        noise=None if of_noise is None else transformed(of_noise, T),
        total=None if of_all is None else transformed(of_all, T),
        warnings=() if covariance is None else weak_inputs(mean, covariance, n_y),
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


_TRANSIENT = 6.0  # standard deviations that the first period may differ from the others


def frf_periodic(
    u: Array | Sequence[Array],
    y: Array | Sequence[Array],
    rate_hz: float,
    *,
    r: Array | Sequence[Array] | None = None,
    period: int | None = None,
    lines: Sequence[int] | None = None,
    drop_periods: int | Literal["auto"] = 0,
    open_loop: bool = False,
    hold: Hold = "zoh",
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
) -> FrequencyResponse:
    """Estimate the frequency response from one or more experiments with periodic excitation. n_u successive ones,
    inputs linearly independent at every line, e.g. orthogonal multisines, make a realisation, G = Y U⁻¹; these are
    averaged. With a reference r the responses of [Y; U] to it are averaged first, so that noise and distortion at the
    input do not bias G.
    """
    experiments = _experiments(u, y, r, rate_hz, inputs, outputs)
    n_u, n_y = experiments[0][0].shape[1], experiments[0][1].shape[1]
    if period is None:
        period = find_period(experiments[0][0] if experiments[0][2] is None else experiments[0][2])
    spectra = [_spectra(k, *e, period, drop_periods) for k, e in enumerate(experiments)]
    excited, doubts = _lines(spectra, lines, n_y, period)
    estimate = over_realisations(spectra, excited, n_y, n_u)
    warnings = tuple(w for s in spectra for w in s.warnings) + doubts + estimate.warnings
    if estimate.noise is None and r is None and not open_loop:
        warnings += (f"one period cannot reveal noise at the input: {feedback_caution()}",)
    spacing = rate_hz / period
    details: dict[str, object] = {
        "period": period,
        "periods": tuple(s.n_periods for s in spectra),
        "dropped_periods": tuple(s.dropped for s in spectra),
        "realisations": len(spectra) // n_u,
        "lines": tuple(int(k) + 1 for k in excited),
    }
    total, nu, more = _total(spectra, excited, estimate, spacing, n_u, details)
    return FrequencyResponse(
        frequency_hz=np.asarray((excited + 1) * spacing, dtype=np.float64),
        G=estimate.G,
        covariance=total,
        noise_covariance=estimate.noise,
        method="periodic, joint input-output with the reference" if r is not None else "periodic",
        inputs=labels(inputs, "u", n_u),
        outputs=labels(outputs, "y", n_y),
        units=MappingProxyType(dict(units or {})),
        rate_hz=rate_hz,
        hold=hold,
        degrees_of_freedom=nu,
        warnings=warnings + more,
        details=MappingProxyType(details),
    )


def _experiments(
    u: Array | Sequence[Array],
    y: Array | Sequence[Array],
    r: Array | Sequence[Array] | None,
    rate_hz: float,
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
) -> list[tuple[Array, Array, Array | None]]:
    us, ys = ([x] if isinstance(x, np.ndarray) else list(x) for x in (u, y))
    rs = [None] * len(us) if r is None else [r] if isinstance(r, np.ndarray) else list(r)
    if not us or not len(us) == len(ys) == len(rs):
        raise EstimationError(f"{len(us)} experiments of u, {len(ys)} of y and {len(rs)} of r. Give as many of each")
    experiments = [checked(*e, rate_hz, inputs, outputs) for e in zip(us, ys, rs, strict=True)]
    shapes = {tuple(0 if x is None else x.shape[1] for x in e) for e in experiments}
    if len(shapes) > 1:
        raise EstimationError(f"experiments differ in their channels (u, y, r): {sorted(shapes)}. Use the same in all")
    n_u, _, n_r = shapes.pop()
    if len(experiments) % n_u or (n_r and n_r != n_u):
        raise EstimationError(
            f"{len(experiments)} experiments with {n_u} inputs and {n_r} references; each realisation takes {n_u} "
            "experiments, and a reference for each input. Add experiments, or use the local method "
            f"({setting('method', 'local')})"
        )
    return experiments


def _spectra(k: int, u: Array, y: Array, r: Array | None, period: int, drop: int | str) -> Spectra:
    n = u.shape[0]
    count = n // period if period > 0 else 0
    least = 2 if drop == "auto" else int(drop) + 1
    if period < 4 or count < min(least, 1) or (drop != "auto" and (int(drop) < 0 or count < int(drop) + 1)):
        raise EstimationError(
            f"experiment {k + 1}: {n} samples with a period of {period} and {drop} periods dropped; one whole period "
            "of at least 4 samples must remain. Correct the period, or drop fewer"
        )
    warnings: tuple[str, ...] = ()
    if n % period:
        warnings += (
            f"experiment {k + 1}: the first {n % period} samples precede the {count} whole periods and are not used",
        )
    n_z = u.shape[1] + y.shape[1]
    all_z = np.concatenate([y, u] if r is None else [y, u, r], axis=1)[n % period :].reshape(count, period, -1)
    dropped = _transient_periods(all_z[:, :, :n_z]) if drop == "auto" else int(drop)
    if drop == "auto" and dropped:
        first = "first period holds" if dropped == 1 else f"first {dropped} periods hold"
        warnings += (f"experiment {k + 1}: the {first} a transient and {'is' if dropped == 1 else 'are'} not used",)
    periods = all_z[dropped:]
    if periods.shape[0] >= 3 and transient_ratio(periods[:, :, :n_z]) > _TRANSIENT:
        warnings += (
            f"experiment {k + 1}: the first period differs from the others by more than noise: a transient, which "
            f"biases G and its variance. Cut it off ({setting('from_s')}, or drop_periods)",
        )
    Z = np.fft.rfft(periods, axis=1)[:, 1 : (period + 1) // 2] / period
    mean = Z.mean(axis=0)
    count = periods.shape[0]
    d = Z[:, :, :n_z] - mean[:, :n_z]
    noise = np.einsum("pfi,pfj->fij", d, d.conj()) / (count * (count - 1)) if count > 1 else None
    return Spectra(
        Z=mean[:, :n_z],
        R=None if r is None else mean[:, n_z:],
        noise=noise,
        n_periods=count,
        dropped=dropped,
        warnings=warnings,
    )


def _transient_periods(periods: Array) -> int:
    dropped = 0
    while periods.shape[0] - dropped >= 3 and transient_ratio(periods[dropped:]) > _TRANSIENT:
        dropped += 1
    return dropped


def _lines(spectra: list[Spectra], lines: Sequence[int] | None, n_y: int, period: int) -> tuple[Lines, tuple[str, ...]]:
    last = (period - 1) // 2
    if lines is not None:
        numbers = np.unique(np.asarray(lines, dtype=np.intp))
        if not numbers.size or numbers[0] < 1 or numbers[-1] > last:
            raise EstimationError(f"lines must be 1 to {last} with a period of {period} samples. Correct them")
        return numbers - 1, ()
    source = np.stack([s.Z[:, n_y:] if s.R is None else s.R for s in spectra])
    noise = None
    if spectra[0].R is None and all(s.noise is not None for s in spectra):
        diagonals = [np.diagonal(s.noise, axis1=1, axis2=2)[:, n_y:] for s in spectra if s.noise is not None]
        noise = np.sum(np.real(diagonals), axis=(0, 2))
    excited, clear = excited_lines(source, noise)
    excited, strays = without_strays(excited)
    doubts: tuple[str, ...] = ()
    if not clear:
        doubts += ("the excited lines are not clearly separated from the others; check them, or give lines",)
    if strays.size:
        listed = ", ".join(str(k + 1) for k in strays)
        doubts += (f"even lines {listed} are excited among odd ones: treated as hum and omitted. Otherwise give lines",)
    return excited, doubts


def _total(
    spectra: list[Spectra], excited: Lines, estimate: Found, spacing: float, n_u: int, details: dict[str, object]
) -> tuple[Complex, Array | float, tuple[str, ...]]:
    """Return the total covariance, its degrees of freedom and warnings; enter the distortion levels in `details`."""
    M = len(spectra) // n_u
    of_noise = 2.0 * (sum(s.n_periods for s in spectra) - len(spectra)) / n_u
    details["noise_degrees_of_freedom"] = of_noise
    n_y = estimate.G.shape[1]
    detection = None
    if n_u == 1 and excited[-1] - excited[0] >= excited.size:
        Z = np.stack([s.Z for s in spectra])
        C = np.stack([s.noise for s in spectra if s.noise is not None]) if estimate.noise is not None else None
        detection = detected(Z, C, estimate.G, excited)
        details["distortions"] = distortions(detection, spacing, Z[:, excited, :n_y])
    if estimate.total is not None:
        return estimate.total, 2.0 * (M - 1), ()
    at_lines = None if detection is None else at_excited(detection, excited)
    if at_lines is None and estimate.noise is None:
        raise EstimationError(
            "one period of one realisation without free lines gives no variance. Measure more periods or "
            f"realisations, omit lines, or use the local method ({setting('method', 'local')})"
        )
    if at_lines is None and estimate.noise is not None:
        return (
            estimate.noise,
            of_noise,
            (
                "one realisation without free lines like the excited ones: the variance is noise only, without the "
                "nonlinear distortion",
            ),
        )
    assert at_lines is not None
    inverse = right_inverse(np.mean([s.Z[excited, n_y:] for s in spectra], axis=0)[:, :, None])
    distortion = at_lines[0] * np.abs(inverse) ** 2
    if estimate.noise is None:
        return distortion, at_lines[1], ()
    total = estimate.noise + distortion
    a, b = (np.real(np.trace(c, axis1=1, axis2=2)) for c in (estimate.noise, distortion))
    # Satterthwaite: the degrees of freedom of a sum of two variances
    with np.errstate(divide="ignore", invalid="ignore"):
        nu = (a + b) ** 2 / (a**2 / of_noise + b**2 / at_lines[1])
    return total, np.where(np.isfinite(nu), nu, of_noise), ()
