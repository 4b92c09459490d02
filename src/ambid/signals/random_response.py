"""Frequency response from noise-like excitation, by averaged spectra.

G = S_yu S_uu⁻¹ (H1: noise at the output), S_yy S_uy⁻¹ (H2: at the input), total least squares (Hv: at both), or
S_yr S_ur⁻¹ with a reference, which feedback does not bias. Leakage of short segments is not in the variance: it is
looked for by halving them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.signals.response import (
    FEEDBACK,
    FrequencyResponse,
    Hold,
    checked,
    labels,
    product_covariance,
    ratio,
    weak_inputs,
)
from ambid.signals.spectra import CrossSpectra, cross_spectra

Kind = Literal["h1", "h2", "hv"]
_Found = tuple[Complex, Complex, Array, str]  # G, covariance, coherence, method
_LEAKAGE_FROM = 32  # shortest segment that is compared with its half
_EDGE = 2  # lines at 0 and at half the rate whose window reaches over the end, where errors are not circular


def frf_random(
    u: Array,
    y: Array,
    rate_hz: float,
    *,
    r: Array | None = None,
    kind: Kind = "h1",
    segment: int | None = None,
    noise_ratio: float | None = None,
    open_loop: bool = False,
    hold: Hold = "zoh",
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
) -> FrequencyResponse:
    """Estimate the frequency response from arbitrary excitation by Welch's averages.

    Its variance is (1 - γ²)/γ² |G|²/n with one input and n independent averages (Bendat and Piersol 2010, sec. 9.2),
    with n reduced for overlap (Welch 1967), and its several-input form S_vv ⊗ S_uu⁻ᵀ/n.

    Parameters
    ----------
    u : ndarray, shape (n_samples, n_u), any units
        Inputs.
    y : ndarray, shape (n_samples, n_y), any units
        Outputs.
    rate_hz : float
        Sampling rate in Hz.
    r : ndarray, shape (n_samples, n_r), optional
        References: outer excitation of the loop, independent of the noise, at least as many as inputs.
    kind : {"h1", "h2", "hv"}
        Where the noise is, without a reference: outputs, inputs (as many outputs as inputs), or both.
    segment : int, optional
        Samples of a segment; by default an eighth of the record. It should hold several time constants.
    noise_ratio : float, optional
        For "hv": variance of the input noise over that of the output noise. By default the noise is taken to be the
        same share of both signals at every line.
    open_loop : bool
        Whether the record is known to be open loop.
    hold : {"zoh", "band-limited"}
        What the input does between samples; kept with the result.
    inputs, outputs : sequence of str, optional
        Names.
    units : Mapping[str, str], optional
        SI unit by name.

    Returns
    -------
    FrequencyResponse
        At the lines of a segment, the two next to 0 and to half the rate left out.

    Raises
    ------
    EstimationError
        If there are too few segments, options contradict each other, or inputs cannot be distinguished.
    RecordError
        If the segment does not fit the record.
    """
    u, y, r = checked(u, y, r, rate_hz, inputs, outputs)
    _options_agree(kind, noise_ratio, r is not None)
    z = np.concatenate([y, u] if r is None else [y, u, r], axis=1)
    spectra = cross_spectra(z, rate_hz, segment=segment)
    n_y, n_u, n_x = y.shape[1], u.shape[1], (u if r is None else r).shape[1]
    if spectra.n_effective <= n_x + 1 or spectra.frequency_hz.size < 2 * _EDGE + 2:
        raise EstimationError(
            f"{spectra.n_segments} segments, worth {spectra.n_effective:.1f} averages, with {n_x} inputs or "
            f"references; more than {n_x + 1} averages are needed. Use a longer record, or shorter segments"
        )
    found, warnings = _found(spectra, n_y, n_u, kind, noise_ratio)
    if r is None:
        warnings += () if open_loop else (f"{kind.upper()}: {FEEDBACK}",)
        if kind == "hv" and noise_ratio is None:
            warnings += ("Hv assumes the same noise share of input and output at every line. Give noise_ratio",)
    length = round(rate_hz / spectra.frequency_hz[1])
    if length % 2 == 0 and length >= _LEAKAGE_FROM:
        half = cross_spectra(z, rate_hz, segment=length // 2)
        warnings += _leakage(found, _found(half, n_y, n_u, kind, noise_ratio)[0], 2.0 * (spectra.n_effective - n_x))
    G, covariance, coherence, method = found
    return FrequencyResponse(
        frequency_hz=spectra.frequency_hz[_EDGE:-_EDGE],
        G=G,
        covariance=covariance,
        coherence=coherence,
        method=f"{method}, {spectra.n_segments} segments",
        inputs=labels(inputs, "u", n_u),
        outputs=labels(outputs, "y", n_y),
        units=MappingProxyType(dict(units or {})),
        rate_hz=rate_hz,
        hold=hold,
        degrees_of_freedom=2.0 * (spectra.n_effective - n_x),
        lines_per_independent=spectra.lines_per_independent,
        warnings=warnings,
        details=MappingProxyType(_details(spectra, rate_hz)),
    )


def _options_agree(kind: str, noise_ratio: float | None, reference: bool) -> None:
    if kind not in ("h1", "h2", "hv"):
        raise EstimationError(f"kind {kind!r} of averaged response; it must be 'h1', 'h2' or 'hv'. Give one of them")
    if reference and kind != "h1":
        raise EstimationError(f"kind {kind!r} with a reference, which replaces it. Omit one of the two")
    if noise_ratio is not None and (kind != "hv" or not noise_ratio > 0.0):
        raise EstimationError(
            f"noise_ratio {noise_ratio} with kind {kind!r}; it must be positive, for 'hv'. Correct it"
        )


def _found(
    spectra: CrossSpectra, n_y: int, n_u: int, kind: str, noise_ratio: float | None
) -> tuple[_Found, tuple[str, ...]]:
    S, n = spectra.density[_EDGE:-_EDGE], spectra.n_effective
    if S.shape[1] > n_y + n_u:
        return _with_reference(S, n_y, n_u, n)
    return _by_kind(S, n_y, n_u, kind, n, noise_ratio), ()


def _leakage(full: _Found, half: _Found, nu: float) -> tuple[str, ...]:
    """Return a warning where segments half as long, whose leakage is twice or more, give another response.

    Both share their data, so that without leakage the difference is well under what the sum of variances allows
    (a quarter of it on average for a Hann window).
    """
    k = 2 * np.arange(half[0].shape[0]) + _EDGE  # line i + 2 of half the length is line 2(i + 2) of the full one
    apart = np.abs(full[0][k] - half[0]) ** 2
    variance = [np.real(np.diagonal(c, axis1=1, axis2=2)).reshape(apart.shape) for c in (full[1][k], half[1])]
    share = apart / np.maximum(variance[0] + variance[1], np.finfo(float).tiny)
    # quantile of the F distribution with 2 and ν degrees of freedom, one false alarm in 1000 over all entries
    limit = 0.5 * nu * np.expm1(np.log(1e3 * share.size) * 2.0 / nu)
    if np.max(share) <= limit and np.mean(share) <= 0.6:
        return ()
    worst = float(np.sqrt(np.max(share)))
    return (
        f"segments half as long give another response, by up to {worst:.1f} standard deviations: leakage, which "
        "the variance does not include. Give longer segments, or use the local method (--method local)",
    )


def _with_reference(S: Complex, n_y: int, n_u: int, n: float) -> tuple[_Found, tuple[str, ...]]:
    n_z = n_y + n_u
    S_rr = S[:, n_z:, n_z:]
    _told_apart(S_rr)
    Z, covariance, noise = _regressed(S[:, :n_z, :n_z], S[:, :n_z, n_z:], S_rr, n)
    G, C = ratio(Z, covariance, n_y, weight=S_rr)
    coherence = _explained(noise, S, n_y, n, S_rr.shape[1])
    found = (G, C, coherence, "joint input-output with the reference (Welch)")
    return found, weak_inputs(Z, covariance, n_y)


def _by_kind(S: Complex, n_y: int, n_u: int, kind: str, n: float, noise_ratio: float | None) -> _Found:
    n_z = n_y + n_u
    S_yy, S_yu, S_uu = S[:, :n_y, :n_y], S[:, :n_y, n_y:], S[:, n_y:, n_y:]
    _told_apart(S_uu)
    G, covariance, noise = _regressed(S_yy, S_yu, S_uu, n)
    coherence = _explained(noise, S, n_y, n, n_u)
    if kind == "h1":
        return G, covariance, coherence, "H1 (Welch)"
    if kind == "h2":
        if n_y != n_u:
            raise EstimationError(f"H2 with {n_y} outputs and {n_u} inputs; it needs as many. Use kind='h1' or 'hv'")
        _told_apart(S_yy)
        # H2 is the inverse of H1 with inputs and outputs exchanged: G = F⁻¹, dG = -G dF G.
        F, C, _ = _regressed(S_uu, np.conj(np.swapaxes(S_yu, 1, 2)), S_yy, n)
        _told_apart(F)
        Z = np.concatenate([np.broadcast_to(np.eye(n_y, dtype=complex), F.shape), F], axis=1)
        joint = np.zeros((S.shape[0], n_z * n_y, n_z * n_y), dtype=complex)
        joint[:, n_y * n_y :, n_y * n_y :] = C
        return (*ratio(Z, joint, n_y), coherence, "H2 (Welch)")
    return (*_total_least_squares(S_yy, S_yu, S_uu, n, noise_ratio), coherence, "Hv (Welch)")


def _regressed(S_zz: Complex, S_zx: Complex, S_xx: Complex, n: float) -> tuple[Complex, Complex, Complex]:
    """Return S_zx S_xx⁻¹, its covariance, and the noise S_vv with the degrees of freedom of the fit taken off."""
    n_x = S_xx.shape[1]
    scale = np.sqrt(np.real(np.diagonal(S_xx, axis1=1, axis2=2)))  # units must not decide the condition of S_xx
    inverse = np.linalg.inv(S_xx / scale[:, :, None] / scale[:, None, :]) / scale[:, :, None] / scale[:, None, :]
    Z = S_zx @ inverse
    noise = (S_zz - Z @ np.conj(np.swapaxes(S_zx, 1, 2))) * (n / (n - n_x))
    noise = 0.5 * (noise + np.conj(np.swapaxes(noise, 1, 2)))
    return Z, product_covariance(noise, inverse) / n, noise


def _explained(noise: Complex, S: Complex, n_y: int, n: float, n_x: int) -> Array:
    """Return the multiple coherence 1 - S_vv/S_yy of each output, of the biased S_vv as is usual."""
    residual, power = (np.real(np.diagonal(m, axis1=1, axis2=2))[:, :n_y] for m in (noise, S))
    share = np.divide(residual * (n - n_x) / n, power, out=np.ones_like(power), where=power > 0)
    return np.asarray(np.clip(1.0 - share, 0.0, 1.0))  # round-off only: S is positive semidefinite


def _total_least_squares(
    S_yy: Complex, S_yu: Complex, S_uu: Complex, n: float, noise_ratio: float | None
) -> tuple[Complex, Complex]:
    """Return G and its covariance from the smallest eigenvector of each output's joint spectrum with the inputs.

    With noise covariance D on [y, u] and w = [1, -G], the smallest eigenvalue is the noise level, and to first order
    dG = Σ_segments (w·z)(x̂ᴴ)/n S₀⁻¹, where S₀ = S_uu - λ D_u is the spectrum without noise (Van Huffel and Vandewalle
    1991, sec. 8.5). Outputs are fitted one by one; between them the covariance is left at 0.
    """
    n_f, n_y, n_u = S_yu.shape
    G = np.empty((n_f, n_y, n_u), dtype=complex)
    C = np.zeros((n_f, n_y * n_u, n_y * n_u), dtype=complex)
    for i in range(n_y):
        joint = np.empty((n_f, 1 + n_u, 1 + n_u), dtype=complex)
        joint[:, 0, 0], joint[:, 0, 1:], joint[:, 1:, 0] = S_yy[:, i, i], S_yu[:, i], S_yu[:, i].conj()
        joint[:, 1:, 1:] = S_uu
        power = np.real(np.diagonal(joint, axis1=1, axis2=2))
        D = power if noise_ratio is None else np.broadcast_to(np.r_[1.0, np.full(n_u, noise_ratio)], power.shape)
        root = np.sqrt(D)
        level, vector = np.linalg.eigh(joint / root[:, :, None] / root[:, None, :])
        w = vector[:, :, 0].conj() / root  # w·z is what the fit leaves
        G[:, i] = -w[:, 1:] / w[:, :1]
        S_0 = S_uu - level[:, 0, None, None] * D[:, 1:, None] * np.eye(n_u)
        noise = level[:, 0] * (D[:, 0] + np.sum(np.abs(G[:, i]) ** 2 * D[:, 1:], axis=1)) * n / (n - n_u)
        inverse = np.linalg.inv(S_0)
        # E|v|² S_0⁻¹ (S_0 + what is left of the input noise) S_0⁻¹; the second part is what H1 has not.
        a = G[:, i].conj() * D[:, 1:] * level[:, :1]
        left = level[:, 0, None, None] * D[:, 1:, None] * np.eye(n_u)
        left = left - a[:, :, None] * a[:, None, :].conj() / (noise * (n - n_u) / n)[:, None, None]
        B = inverse + inverse @ left @ inverse
        block = slice(i * n_u, (i + 1) * n_u)
        C[:, block, block] = noise[:, None, None] * np.swapaxes(B, 1, 2) / n
    return G, C


def _told_apart(S: Complex) -> None:
    scale = np.sqrt(np.abs(np.diagonal(S, axis1=1, axis2=2)))
    if not np.all(scale > 0):
        raise EstimationError("a signal has no power at some line. Excite the whole band")
    worst = float(np.max(np.linalg.cond(S / scale[:, :, None] / scale[:, None, :])))
    if worst > 1e10:
        raise EstimationError(
            f"the spectra of the inputs (or outputs, for H2) are dependent, condition {worst:.1e}; below 1e10 is "
            "needed. Excite each input independently, or omit one"
        )


def _details(spectra: CrossSpectra, rate_hz: float) -> dict[str, object]:
    return {
        "segments": spectra.n_segments,
        "effective_averages": spectra.n_effective,
        "segment_samples": round(rate_hz / spectra.frequency_hz[1]),
    }
