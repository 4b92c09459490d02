"""Frequency responses from records: the choice of the method, and those for arbitrary excitation: local polynomials of
response and leakage (Pintelon and Schoukens 2012, sec. 7.2; Schoukens et al. 2009) and averaged spectra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.settings.caller import setting
from ambid.signals.periodic_response import find_period, frf_periodic
from ambid.signals.response import (
    FrequencyResponse,
    Hold,
    checked,
    feedback_caution,
    labels,
    product_covariance,
    ratio,
    weak_inputs,
)
from ambid.signals.spectra import CrossSpectra, cross_spectra

_DEGREE = 2  # of the polynomials
_LOUD = 1e-6  # power of a line over the largest, from which it is excited
_CHUNK = 2048  # lines fitted at a time: memory does not grow with the record
_WORST = 1e8  # condition (Frobenius) of a window's columns, each scaled to length 1


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """Half width h of the windows of 2h + 1 lines, and unknowns of each."""

    half: int
    unknowns: int

    @property
    def free(self) -> int:
        return 2 * self.half + 1 - self.unknowns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fitted:
    """Responses `Z` (n_f, n_z, n_x), covariance of vec(Z), per-line weight (n_f, n_x, n_x) and correlation."""

    Z: Complex
    covariance: Complex
    weight: Complex
    condition: Array
    lines_per_independent: float

    def at(self, lines: np.ndarray) -> _Fitted:
        """Return the fits at some of the lines."""
        return replace(
            self,
            Z=self.Z[lines],
            covariance=self.covariance[lines],
            weight=self.weight[lines],
            condition=self.condition[lines],
        )


def frf_local(
    u: Array,
    y: Array,
    rate_hz: float,
    *,
    r: Array | None = None,
    free: int | None = None,
    band: tuple[float, float] | None = None,
    open_loop: bool = False,
    hold: Hold = "zoh",
    leave_out: bool = False,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
) -> FrequencyResponse:
    """Estimate the frequency response by local polynomials: around each line Z = G(q) X + T(q) + V with polynomials G
    and leakage T of the distance q; X: inputs or, with feedback, references. A resonance should be wider than a window;
    errors of neighbours are correlated over it (`lines_per_independent`); the resolution is rate/n_samples.
    """
    u, y, r = checked(u, y, r, rate_hz, inputs, outputs)
    n, n_y, n_u = u.shape[0], y.shape[1], u.shape[1]
    x, z = (u, y) if r is None else (r, np.concatenate([y, u], axis=1))
    X, Z = (np.fft.rfft(s, axis=0)[1 : (n + 1) // 2] / np.sqrt(n) for s in (x, z))
    free = max(8, Z.shape[1] + 4) if free is None else free
    if free < Z.shape[1]:
        raise EstimationError(
            f"local polynomials with {free} lines beyond the unknowns and {Z.shape[1]} signals; there must be at least "
            "as many lines as signals. Give more"
        )
    unknowns = (_DEGREE + 1) * (X.shape[1] + 1)
    power = np.abs(X) ** 2
    loud = power > _LOUD * power.max(axis=0)
    gaps = [np.diff(np.flatnonzero(column)) for column in loud.T]
    # lines between those that excite the sparsest input: a zippered multisine leaves most out
    apart = max((int(np.percentile(g, 90)) for g in gaps if g.size), default=1)
    half = max(unknowns + free, (_DEGREE + 2) * apart) // 2
    if X.shape[0] < 2 * half + 1:
        raise EstimationError(f"{X.shape[0]} lines in the record, {2 * half + 1} in a window. Use a longer record")
    plan = _Plan(half=half, unknowns=unknowns)
    frequency = np.arange(1, X.shape[0] + 1) * (rate_hz / n)
    wanted = _in_band(frequency, band)
    fitted = _fitted(X, Z, wanted, plan)
    distinct = fitted.condition < _WORST
    if not (distinct.all() or (leave_out and distinct.any())):
        raise EstimationError(
            f"{_smooth(~distinct, frequency[wanted])}. Give a band without them, or excite with noise or a multisine"
        )
    left = () if distinct.all() else (_smooth(~distinct, frequency[wanted]) + "; they are left out",)
    wanted, fitted = wanted[distinct], fitted.at(distinct)
    warnings: tuple[str, ...]
    if r is None:
        G, covariance = fitted.Z, fitted.covariance
        warnings = () if open_loop else (f"local method: {feedback_caution()}",)
    else:
        G, covariance = ratio(fitted.Z, fitted.covariance, n_y, weight=fitted.weight)
        warnings = weak_inputs(fitted.Z, fitted.covariance, n_y)
    return FrequencyResponse(
        frequency_hz=frequency[wanted],
        G=G,
        covariance=covariance,
        method=f"local polynomial, degree {_DEGREE}" + ("" if r is None else ", joint input-output with the reference"),
        inputs=labels(inputs, "u", n_u),
        outputs=labels(outputs, "y", n_y),
        units=MappingProxyType(dict(units or {})),
        rate_hz=rate_hz,
        hold=hold,
        degrees_of_freedom=2.0 * plan.free,
        lines_per_independent=fitted.lines_per_independent,
        warnings=(*left, *warnings),
        details=MappingProxyType(
            {
                "degree": _DEGREE,
                "window_lines": 2 * plan.half + 1,
                "window_hz": (2 * plan.half + 1) * rate_hz / n,
                "condition": float(np.max(fitted.condition)),
            }
        ),
    )


def _in_band(frequency: Array, band: tuple[float, float] | None) -> np.ndarray:
    if band is None:
        return np.arange(frequency.size)
    wanted = np.flatnonzero((frequency >= band[0]) & (frequency <= band[1]))
    if not wanted.size:
        raise EstimationError(
            f"no line between {band[0]:g} and {band[1]:g} Hz; the record has {frequency[0]:g} to {frequency[-1]:g} Hz. "
            "Give another band"
        )
    return wanted


def _fitted(X: Complex, Z: Complex, wanted: np.ndarray, plan: _Plan) -> _Fitted:
    n_x, n_z, width = X.shape[1], Z.shape[1], 2 * plan.half + 1
    responses = np.empty((wanted.size, n_z, n_x), dtype=complex)
    covariance = np.empty((wanted.size, n_z * n_x, n_z * n_x), dtype=complex)
    spread = np.empty((wanted.size, n_x, n_x), dtype=complex)
    condition = np.empty(wanted.size)
    shared = np.zeros((X.shape[0], n_x), dtype=complex)
    for first in range(0, wanted.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        lines = wanted[part]
        # At the ends of the band the window is not centred on its line.
        window = np.clip(lines - plan.half, 0, X.shape[0] - width)[:, None] + np.arange(width)
        responses[part], L, noise, condition[part] = _windows(X[window], Z[window], (window - lines[:, None]), plan)
        product = np.einsum("faw,fbw->fab", L, L.conj())
        C = noise[:, :, None, :, None] * product[:, None, :, None, :]
        covariance[part] = C.reshape(lines.size, n_z * n_x, n_z * n_x)
        spread[part] = product
        for a in range(n_x):
            weighted = L[:, a] / np.real(spread[part][:, a, a])[:, None]
            np.add.at(shared[:, a], window.ravel(), weighted.ravel())
    own = np.sum(1.0 / np.real(np.diagonal(spread, axis1=1, axis2=2)), axis=0)
    try:
        weight = np.linalg.inv(np.swapaxes(spread, 1, 2))
    except np.linalg.LinAlgError:
        raise EstimationError(
            "at some lines the excitation does not move all inputs; a response needs each of them. Excite all inputs "
            "over the whole band, or give a narrower band"
        ) from None
    return _Fitted(
        Z=responses,
        covariance=np.asarray(0.5 * (covariance + np.conj(np.swapaxes(covariance, 1, 2))), dtype=complex),
        weight=np.asarray(weight, dtype=complex),
        condition=condition,
        # variance of the weighted mean over all lines, beside that of as many independent ones
        lines_per_independent=float(np.mean(np.sum(np.abs(shared) ** 2, axis=0) / own)),
    )


def _windows(X: Complex, Z: Complex, q: np.ndarray, plan: _Plan) -> tuple[Complex, Complex, Complex, Array]:
    """Fit windows X (c, w, n_x), Z (c, w, n_z), distances q (c, w) in lines. Returns responses (c, n_z, n_x), the rows
    L (c, n_x, w) that make them from Z, the noise (c, n_z, n_z) and the condition of the columns (c,).
    """
    powers = (q / plan.half)[:, :, None] ** np.arange(_DEGREE + 1)
    of_x = (X[:, :, None, :] * powers[:, :, :, None]).reshape(*X.shape[:2], -1)
    columns = np.concatenate([of_x, powers], axis=2)
    L, left, condition = _solved(columns, Z, X.shape[2])
    responses = np.einsum("faw,fwi->fia", L, Z)
    noise = np.einsum("fwi,fwj->fij", left, left.conj()) / plan.free
    return responses, L, noise, condition


def _solved(columns: Complex, Z: Complex, n_x: int) -> tuple[Complex, Complex, Array]:
    """Return the rows of the pseudo-inverse for the first `n_x` unknowns, what the fit leaves, and the condition."""
    scale = np.linalg.norm(columns, axis=1)
    scale[scale == 0.0] = 1.0
    Q, R = np.linalg.qr(columns / scale[:, None, :])
    diagonal = np.abs(np.diagonal(R, axis1=1, axis2=2))
    singular = diagonal.min(axis=1) < 1e-14 * diagonal.max(axis=1)
    R[singular] = np.eye(R.shape[1])  # refused afterwards, all such lines in one message
    inverse = np.linalg.inv(R)
    condition = np.linalg.norm(R, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
    Qh = np.conj(np.swapaxes(Q, 1, 2))
    L = inverse[:, :n_x] @ Qh / scale[:, :n_x, None]
    return L, Z - Q @ (Qh @ Z), np.where(singular, np.inf, condition)


def _smooth(bad: np.ndarray, frequency: Array) -> str:
    return (
        f"at {int(bad.sum())} of {bad.size} lines, {frequency[bad][0]:g} to {frequency[bad][-1]:g} Hz, the "
        "excitation is absent or too smooth to separate its response from leakage"
    )


_Found = tuple[Complex, Complex, Array, str]  # G, covariance, coherence, method
_LEAKAGE_FROM = 32  # shortest segment that is compared with its half
_EDGE = 2  # lines at 0 and at half the rate whose window reaches over the end, where errors are not circular


def frf_random(
    u: Array,
    y: Array,
    rate_hz: float,
    *,
    r: Array | None = None,
    segment: int | None = None,
    open_loop: bool = False,
    hold: Hold = "zoh",
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
) -> FrequencyResponse:
    """Estimate the frequency response by Welch's averages: G = S_yu S_uu⁻¹ (H1: noise at the output), or S_yr
    S_ur⁻¹ with a reference, which feedback does not bias.

    Variance (1 - γ²)/γ² |G|²/n of n independent averages (Bendat and Piersol 2010, sec. 9.2), n reduced for overlap
    (Welch 1967); of several inputs S_vv ⊗ S_uu⁻ᵀ/n. Leakage is not in it, but looked for by halving segments.
    """
    u, y, r = checked(u, y, r, rate_hz, inputs, outputs)
    z = np.concatenate([y, u] if r is None else [y, u, r], axis=1)
    spectra = cross_spectra(z, rate_hz, segment=segment)
    n_y, n_u, n_x = y.shape[1], u.shape[1], (u if r is None else r).shape[1]
    if spectra.n_effective <= n_x + 1 or spectra.frequency_hz.size < 2 * _EDGE + 2:
        raise EstimationError(
            f"{spectra.n_segments} segments, worth {spectra.n_effective:.1f} averages, with {n_x} inputs or "
            f"references; more than {n_x + 1} averages are needed. Use a longer record, or shorter segments"
        )
    estimate, warnings = _found(spectra, n_y, n_u)
    if r is None and not open_loop:
        warnings += (f"H1: {feedback_caution()}",)
    length = round(rate_hz / spectra.frequency_hz[1])
    if length % 2 == 0 and length >= _LEAKAGE_FROM:
        half = cross_spectra(z, rate_hz, segment=length // 2)
        warnings += _leakage(estimate, _found(half, n_y, n_u)[0], 2.0 * (spectra.n_effective - n_x))
    G, covariance, coherence, method = estimate
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
        details=MappingProxyType(
            {
                "segments": spectra.n_segments,
                "effective_averages": spectra.n_effective,
                "segment_samples": round(rate_hz / spectra.frequency_hz[1]),
            }
        ),
    )


def _found(spectra: CrossSpectra, n_y: int, n_u: int) -> tuple[_Found, tuple[str, ...]]:
    S, n = spectra.density[_EDGE:-_EDGE], spectra.n_effective
    if S.shape[1] > n_y + n_u:
        n_z = n_y + n_u
        S_rr = S[:, n_z:, n_z:]
        _told_apart(S_rr)
        Z, covariance, noise = _regressed(S[:, :n_z, :n_z], S[:, :n_z, n_z:], S_rr, n)
        G, C = ratio(Z, covariance, n_y, weight=S_rr)
        coherence = _explained(noise, S, n_y, n, S_rr.shape[1])
        estimate = (G, C, coherence, "joint input-output with the reference (Welch)")
        return estimate, weak_inputs(Z, covariance, n_y)
    S_yy, S_yu, S_uu = S[:, :n_y, :n_y], S[:, :n_y, n_y:], S[:, n_y:, n_y:]
    _told_apart(S_uu)
    G, covariance, noise = _regressed(S_yy, S_yu, S_uu, n)
    return (G, covariance, _explained(noise, S, n_y, n, n_u), "H1 (Welch)"), ()


def _leakage(full: _Found, half: _Found, nu: float) -> tuple[str, ...]:
    """Return a warning where segments half as long, with twice the leakage or more, give another response. Without
    leakage the difference is well under what the sum of variances allows (a quarter on average for a Hann window): data
    are shared.
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
        f"the variance does not include. Give longer segments, or use the local method ({setting('method', 'local')})",
    )


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


def _told_apart(S: Complex) -> None:
    scale = np.sqrt(np.abs(np.diagonal(S, axis1=1, axis2=2)))
    if not np.all(scale > 0):
        raise EstimationError("a signal has no power at some line. Excite the whole band")
    worst = float(np.max(np.linalg.cond(S / scale[:, :, None] / scale[:, None, :])))
    if worst > 1e10:
        raise EstimationError(
            f"the spectra of the inputs are dependent, condition {worst:.1e}; below 1e10 is "
            "needed. Excite each input independently, or omit one"
        )


Method = Literal["auto", "periodic", "random", "local"]


def frequency_response(
    u: Array | Sequence[Array],
    y: Array | Sequence[Array],
    rate_hz: float,
    *,
    r: Array | Sequence[Array] | None = None,
    method: Method = "auto",
    **options: object,
) -> FrequencyResponse:
    """Measure a frequency response by a named method, or by the one that the data allow.

    Parameters
    ----------
    u, y : ndarray, shape (n_samples, n_u) and (n_samples, n_y), or a sequence of them
        Inputs and outputs; a sequence holds the experiments of a periodic excitation.
    rate_hz : float
        Sampling rate in Hz.
    r : ndarray, shape (n_samples, n_r), or a sequence of them, optional
        References of a closed loop.
    method : {"auto", "periodic", "random", "local"}
        "auto" takes `frf_periodic` for several experiments, a given period, or an excitation (r, or u without it) of
        one input that repeats at least twice; else `frf_local`.
    **options
        All methods: `open_loop` (the record is known to be open loop), `hold` ("zoh" or "band-limited", what the input
        does between samples), and `inputs`, `outputs`, `units` (names, and SI unit by name). Local: `free` (least lines
        of a window beyond its unknowns), `band` in Hz, `leave_out` (lines at which the excitation does not tell G from
        leakage are left out instead of refused). Random: `segment` in samples. Periodic: `period` in samples, `lines`
        that are excited, `drop_periods` (a number, or "auto") that hold a transient.

    Returns
    -------
    FrequencyResponse

    Raises
    ------
    EstimationError
        If the method is unknown, several experiments are given to a method of one, or the method refuses the data.
    """
    several = not isinstance(u, np.ndarray)
    if method == "auto":
        periodic = several or "period" in options or "lines" in options or repeats(u if r is None else r)
        method = "periodic" if periodic else "local"
    if method == "periodic":
        return frf_periodic(u, y, rate_hz, r=r, **options)  # type: ignore[arg-type]
    if method not in ("random", "local"):
        raise EstimationError(
            f"frequency response by method {method!r}; it must be 'auto', 'periodic', 'random' or 'local'. Give one"
        )
    if several:
        raise EstimationError(f"method {method!r} takes one record, not several. Give one, or use method 'periodic'")
    function = frf_random if method == "random" else frf_local
    return function(u, y, rate_hz, r=r, **options)  # type: ignore[arg-type]


def repeats(x: object) -> bool:
    """Tell whether one excitation repeats at least twice; a constant or more than one column never does."""
    excitation = np.asarray(x, dtype=np.float64)
    if (excitation.ndim == 2 and excitation.shape[1] > 1) or np.ptp(excitation) == 0.0:
        return False
    try:
        return bool(2 * find_period(excitation) <= excitation.shape[0])
    except EstimationError:
        return False
