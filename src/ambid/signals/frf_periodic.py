"""Frequency response from periodic excitation, with the noise and the nonlinear distortion told apart.

Noise differs between periods; stochastic nonlinear distortion is the same in every period and differs between
realisations of the random phases (Pintelon and Schoukens 2012, ch. 2 to 4). With one realisation, lines that the
excitation leaves out show it (`Distortions`). Inputs are as noisy as outputs here, and may be fed back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.signals._distortion import at_excited, detected, distortions
from ambid.signals._joint import FEEDBACK, checked, labels, right_inverse
from ambid.signals._periodicity import Lines, excited_lines, find_period, transient_ratio, without_strays
from ambid.signals._realisations import Found, Spectra, over_realisations
from ambid.signals.frf import Complex, FrequencyResponse, Hold

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
    """Estimate the frequency response from one or more experiments with periodic excitation.

    With n_u inputs, n_u successive experiments (with inputs that are linearly independent at every line, e.g.
    orthogonal multisines) make a realisation, in which G = Y U⁻¹. Realisations are averaged; with a reference r, the
    responses of [Y; U] to it are averaged first, so that noise and distortion at the input do not bias G.

    Parameters
    ----------
    u, y : ndarray, shape (n_samples, n_u) and (n_samples, n_y), or a sequence of them
        Inputs and outputs, one array per experiment. What leads before the last whole number of periods is not used.
    rate_hz : float
        Sampling rate in Hz.
    r : ndarray, shape (n_samples, n_u), or a sequence of them, optional
        Reference: what excited the experiment.
    period : int, optional
        Period in samples; by default found from r or u.
    lines : sequence of int, optional
        Excited multiples of rate/period; by default found from r or u.
    drop_periods : int or "auto"
        Leading periods not used, for the transient; "auto" drops those that differ significantly, and says so.
    open_loop : bool
        Whether it is known that no feedback was at work; otherwise single periods, which do not show the noise that
        feedback carries to the input, give a warning.
    hold : {"zoh", "band-limited"}
        What the input does between samples; kept with the result.
    inputs, outputs : sequence of str, optional
        Names.
    units : Mapping[str, str], optional
        SI unit by name.

    Returns
    -------
    FrequencyResponse
        At the excited lines. Its total variance is that over the realisations; with one realisation the noise plus
        the distortion at detection lines, where there are any. ``details["distortions"]`` holds the levels.

    Raises
    ------
    EstimationError
        If experiments do not fit together, or neither periods nor realisations nor free lines give a variance.
    """
    experiments = _experiments(u, y, r, rate_hz, inputs, outputs)
    n_u, n_y = experiments[0][0].shape[1], experiments[0][1].shape[1]
    if period is None:
        period = find_period(experiments[0][0] if experiments[0][2] is None else experiments[0][2])
    spectra = [_spectra(k, *e, period, drop_periods) for k, e in enumerate(experiments)]
    excited, doubts = _lines(spectra, lines, n_y, period)
    found = over_realisations(spectra, excited, n_y, n_u)
    warnings = tuple(w for s in spectra for w in s.warnings) + doubts + found.warnings
    if found.noise is None and r is None and not open_loop:
        warnings += (f"one period does not show noise at the input: {FEEDBACK}",)
    spacing = rate_hz / period
    details: dict[str, object] = {
        "period": period,
        "periods": tuple(s.n_periods for s in spectra),
        "dropped_periods": tuple(s.dropped for s in spectra),
        "realisations": len(spectra) // n_u,
        "lines": tuple(int(k) + 1 for k in excited),
    }
    total, nu, more = _total(spectra, excited, found, spacing, n_u, details)
    return FrequencyResponse(
        frequency_hz=np.asarray((excited + 1) * spacing, dtype=np.float64),
        G=found.G,
        covariance=total,
        noise_covariance=found.noise,
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
    found = [checked(*e, rate_hz, inputs, outputs) for e in zip(us, ys, rs, strict=True)]
    shapes = {tuple(0 if x is None else x.shape[1] for x in e) for e in found}
    if len(shapes) > 1:
        raise EstimationError(f"experiments differ in their channels (u, y, r): {sorted(shapes)}. Use the same in all")
    n_u, _, n_r = shapes.pop()
    if len(found) % n_u or (n_r and n_r != n_u):
        raise EstimationError(
            f"{len(found)} experiments with {n_u} inputs and {n_r} references; each realisation takes {n_u} "
            "experiments, and a reference for each input. Add experiments, or use the local method (--method local)"
        )
    return found


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
            f"experiment {k + 1}: the first {n % period} samples lead the {count} whole periods and are not used",
        )
    n_z = u.shape[1] + y.shape[1]
    all_z = np.concatenate([y, u] if r is None else [y, u, r], axis=1)[n % period :].reshape(count, period, -1)
    dropped = _transient_periods(all_z[:, :, :n_z]) if drop == "auto" else int(drop)
    if drop == "auto" and dropped:
        first = "first period holds" if dropped == 1 else f"first {dropped} periods hold"
        warnings += (f"experiment {k + 1}: the {first} a transient and {'is' if dropped == 1 else 'are'} not used",)
    used = all_z[dropped:]
    if used.shape[0] >= 3 and transient_ratio(used[:, :, :n_z]) > _TRANSIENT:
        warnings += (
            f"experiment {k + 1}: the first period differs from the others by more than noise: a transient, which "
            "biases G and its variance. Cut it off (--from, or drop_periods)",
        )
    Z = np.fft.rfft(used, axis=1)[:, 1 : (period + 1) // 2] / period
    mean = Z.mean(axis=0)
    count = used.shape[0]
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
        doubts += ("the excited lines do not stand out clearly from the others; check them, or give lines",)
    if strays.size:
        listed = ", ".join(str(k + 1) for k in strays)
        doubts += (f"even lines {listed} are excited among odd ones: taken for hum and left out. Else give lines",)
    return excited, doubts


def _total(
    spectra: list[Spectra], excited: Lines, found: Found, spacing: float, n_u: int, details: dict[str, object]
) -> tuple[Complex, Array | float, tuple[str, ...]]:
    """Return the total covariance, its degrees of freedom and warnings; enter the distortion levels in `details`."""
    M = len(spectra) // n_u
    of_noise = 2.0 * (sum(s.n_periods for s in spectra) - len(spectra)) / n_u
    details["noise_degrees_of_freedom"] = of_noise
    n_y = found.G.shape[1]
    detection = None
    if n_u == 1 and excited[-1] - excited[0] >= excited.size:
        Z = np.stack([s.Z for s in spectra])
        C = np.stack([s.noise for s in spectra if s.noise is not None]) if found.noise is not None else None
        detection = detected(Z, C, found.G, excited)
        details["distortions"] = distortions(detection, spacing, Z[:, excited, :n_y])
    if found.total is not None:
        return found.total, 2.0 * (M - 1), ()
    known = None if detection is None else at_excited(detection, excited)
    if known is None and found.noise is None:
        raise EstimationError(
            "one period of one realisation without free lines gives no variance. Measure more periods or realisations, "
            "leave out lines, or use the local method (--method local)"
        )
    if known is None and found.noise is not None:
        return (
            found.noise,
            of_noise,
            (
                "one realisation without free lines like the excited ones: the variance is noise only, without the "
                "nonlinear distortion",
            ),
        )
    assert known is not None
    inverse = right_inverse(np.mean([s.Z[excited, n_y:] for s in spectra], axis=0)[:, :, None])
    distortion = known[0] * np.abs(inverse) ** 2
    if found.noise is None:
        return distortion, known[1], ()
    total = found.noise + distortion
    a, b = (np.real(np.trace(c, axis1=1, axis2=2)) for c in (found.noise, distortion))
    # Satterthwaite: the degrees of freedom of a sum of two variances
    with np.errstate(divide="ignore", invalid="ignore"):
        nu = (a + b) ** 2 / (a**2 / of_noise + b**2 / known[1])
    return total, np.where(np.isfinite(nu), nu, of_noise), ()
