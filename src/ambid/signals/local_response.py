"""Frequency response from arbitrary excitation by the local polynomial method.

In a window of lines around each line, Z = G(q) X + T(q) + V with polynomials G and T of the distance q, where T is
the leakage: a smooth spectrum too (Pintelon and Schoukens 2012, sec. 7.2; Schoukens et al. 2009). Least squares by QR;
what it leaves gives the noise and the covariance of G. X are the inputs, or with feedback the references.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.signals.response import FEEDBACK, FrequencyResponse, Hold, checked, labels, ratio, weak_inputs

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
    """Estimate the frequency response by local polynomials of response and leakage in sliding windows.

    The resolution is that of the record, rate/n_samples; a resonance should be wider than the window. Errors of
    neighbouring lines are correlated over the window (`lines_per_independent`).

    Parameters
    ----------
    u : ndarray, shape (n_samples, n_u), any units
        Inputs, with a rough spectrum (noise, PRBS, multisine): a smooth one is not separated from leakage.
    y : ndarray, shape (n_samples, n_y), any units
        Outputs.
    rate_hz : float
        Sampling rate in Hz.
    r : ndarray, shape (n_samples, n_r), optional
        References: outer excitation of the loop, independent of the noise, at least as many as inputs.
    free : int, optional
        Least lines of a window beyond its unknowns: more gives a better variance and a wider window. By default 8, or
        4 more than there are signals.
    band : (float, float), optional
        Band in Hz in which the estimate is wanted.
    open_loop : bool
        Whether the record is known to be open loop.
    hold : {"zoh", "band-limited"}
        What the input does between samples; kept with the result.
    leave_out : bool
        Whether lines at which the excitation does not tell G from leakage are left out, and told, instead of refused.
    inputs, outputs : sequence of str, optional
        Names.
    units : Mapping[str, str], optional
        SI unit by name.

    Returns
    -------
    FrequencyResponse
        At every line of the record in the band, 0 and half the rate left out, and with `leave_out` those not told.

    Raises
    ------
    EstimationError
        If the record is shorter than a window, or the excitation does not tell G from leakage.
    """
    u, y, r = checked(u, y, r, rate_hz, inputs, outputs)
    n, n_y, n_u = u.shape[0], y.shape[1], u.shape[1]
    x, z = (u, y) if r is None else (r, np.concatenate([y, u], axis=1))
    X, Z = (np.fft.rfft(s, axis=0)[1 : (n + 1) // 2] / np.sqrt(n) for s in (x, z))
    plan = _plan(X, Z, free)
    frequency = np.arange(1, X.shape[0] + 1) * (rate_hz / n)
    wanted = _in_band(frequency, band)
    fitted = _fitted(X, Z, wanted, plan)
    told = _refuse_smooth(fitted.condition, frequency[wanted], leave_out=leave_out)
    left = () if told.all() else (_smooth(~told, frequency[wanted]) + "; they are left out",)
    wanted, fitted = wanted[told], fitted.at(told)
    warnings: tuple[str, ...]
    if r is None:
        G, covariance = fitted.Z, fitted.covariance
        warnings = () if open_loop else (f"local method: {FEEDBACK}",)
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


def _plan(X: Complex, Z: Complex, free: int | None) -> _Plan:
    free = max(8, Z.shape[1] + 4) if free is None else free
    if free < Z.shape[1]:
        raise EstimationError(
            f"local polynomials with {free} lines beyond the unknowns and {Z.shape[1]} signals; there must be at least "
            "as many lines as signals. Give more"
        )
    unknowns = (_DEGREE + 1) * (X.shape[1] + 1)
    half = max(unknowns + free, (_DEGREE + 2) * _apart(X)) // 2
    if X.shape[0] < 2 * half + 1:
        raise EstimationError(f"{X.shape[0]} lines in the record, {2 * half + 1} in a window. Use a longer record")
    return _Plan(half=half, unknowns=unknowns)


def _apart(X: Complex) -> int:
    """Return how many lines lie between those that excite the sparsest input: a zippered multisine leaves most out."""
    power = np.abs(X) ** 2
    loud = power > _LOUD * power.max(axis=0)
    gaps = [np.diff(np.flatnonzero(column)) for column in loud.T]
    return max((int(np.percentile(g, 90)) for g in gaps if g.size), default=1)


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
    found = np.empty((wanted.size, n_z, n_x), dtype=complex)
    covariance = np.empty((wanted.size, n_z * n_x, n_z * n_x), dtype=complex)
    spread = np.empty((wanted.size, n_x, n_x), dtype=complex)
    condition = np.empty(wanted.size)
    shared = np.zeros((X.shape[0], n_x), dtype=complex)
    for first in range(0, wanted.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        lines = wanted[part]
        # At the ends of the band the window is not centred on its line.
        window = np.clip(lines - plan.half, 0, X.shape[0] - width)[:, None] + np.arange(width)
        found[part], L, noise, condition[part] = _windows(X[window], Z[window], (window - lines[:, None]), plan)
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
        Z=found,
        covariance=np.asarray(0.5 * (covariance + np.conj(np.swapaxes(covariance, 1, 2))), dtype=complex),
        weight=np.asarray(weight, dtype=complex),
        condition=condition,
        # variance of the weighted mean over all lines, beside that of as many independent ones
        lines_per_independent=float(np.mean(np.sum(np.abs(shared) ** 2, axis=0) / own)),
    )


def _windows(X: Complex, Z: Complex, q: np.ndarray, plan: _Plan) -> tuple[Complex, Complex, Complex, Array]:
    """Fit all windows of a chunk: X (c, w, n_x), Z (c, w, n_z), q (c, w) distances in lines.

    Returns the responses (c, n_z, n_x), the rows L (c, n_x, w) that make them from Z, the noise (c, n_z, n_z)
    and the condition of the columns (c,).
    """
    powers = (q / plan.half)[:, :, None] ** np.arange(_DEGREE + 1)
    of_x = (X[:, :, None, :] * powers[:, :, :, None]).reshape(*X.shape[:2], -1)
    columns = np.concatenate([of_x, powers], axis=2)
    L, left, condition = _solved(columns, Z, X.shape[2])
    found = np.einsum("faw,fwi->fia", L, Z)
    noise = np.einsum("fwi,fwj->fij", left, left.conj()) / plan.free
    return found, L, noise, condition


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


def _refuse_smooth(condition: Array, frequency: Array, *, leave_out: bool) -> np.ndarray:
    """Return which lines the excitation tells from leakage; refuse others, where they are not to be left out."""
    told = condition < _WORST
    if not (told.all() or (leave_out and told.any())):
        raise EstimationError(
            f"{_smooth(~told, frequency)}. Give a band without them, or excite with noise or a multisine"
        )
    return told


def _smooth(bad: np.ndarray, frequency: Array) -> str:
    return (
        f"at {int(bad.sum())} of {bad.size} lines, {frequency[bad][0]:g} to {frequency[bad][-1]:g} Hz, the "
        "excitation is absent or too smooth to separate its response from leakage"
    )
