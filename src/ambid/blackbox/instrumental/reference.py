"""What the reference of a loop makes of inputs and outputs: signals without noise, for plants of any stability.

Solves: from r, u, y find the parts of u and y that r alone makes. The loop as a whole is stable even where the plant is
not, so a vector autoregression of [y; u] driven by r, simulated from r, gives both; nothing about the controller is
asked. Any function of r is a valid instrument; this one is close to the best (Gilson and Van den Hof 2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.kernels import state_scan
from ambid.signals.delay import lagged_triangle

_HIGHEST = 16  # lags of the autoregression that are looked at
_FORGOTTEN = 1e-6  # of an impulse response, where it is cut
_SMALL = 1e-3  # weight of that, relative to signals of unit spread
_ROUNDING = 1e-12  # variance, relative to the signal's, that counts as none: a controller without noise is exact


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferencePart:
    """Inputs and outputs without noise."""

    u: Array  # (n_samples, n_inputs)
    y: Array  # (n_samples, n_outputs)
    order: int  # lags of the autoregression
    memory: int  # samples after which the loop has forgotten an impulse of the reference


def wants_reference(who: str, data: IOData) -> None:
    """Refuse data without a reference."""
    if not data.references:
        raise EstimationError(
            f"{who}: no reference is named; its instruments come from the loop's outer excitation, which no noise "
            "reaches. Give --reference COLUMN, or use bj, armax or pbsid, which want none"
        )


def reference_part(who: str, data: IOData) -> ReferencePart:
    """Simulate inputs and outputs of the loop from its reference.

    `who`: method, for errors; `data`: means taken off.
    """
    wants_reference(who, data)
    w = np.hstack([data.y, data.u])
    scale = (w.std(axis=0), data.reference.std(axis=0))
    w, r = w / scale[0], data.reference / scale[1]
    n, n_w, n_r = data.n_samples, w.shape[1], r.shape[1]
    highest = min(_HIGHEST, n // (10 * (n_w + n_r)))
    if highest < 1:
        raise EstimationError(f"{who}: {n} samples are too few to see the loop. Give a longer record")
    R, width = _triangle(w, r, highest), n_w + n_r
    for p in _by_criterion(R, n - highest, n_w, n_r, highest):
        size = 1 + n_r + p * width
        # a reference of narrow band leaves its own lags open: keep their coefficients small
        small = np.sqrt(n) * _SMALL * np.diag(_of_reference(n_w, n_r, p).astype(np.float64))
        rows = np.vstack([R[:size, :size], small])
        target = np.vstack([R[:size, -n_w:], np.zeros((size, n_w))])
        theta = np.asarray(np.linalg.lstsq(rows, target, rcond=None)[0][1:], dtype=np.float64)
        found = _impulse(theta, n_w, n_r, p, n)
        if found is not None:
            from scipy.signal import oaconvolve

            out = sum(oaconvolve(found[:, :, j], r[:, j : j + 1], axes=0)[:n] for j in range(n_r)) * scale[0]
            n_y = data.n_outputs
            return ReferencePart(u=out[:, n_y:], y=out[:, :n_y], order=p, memory=found.shape[0])
    raise EstimationError(
        f"{who}: no stable loop from {', '.join(data.references)} to inputs and outputs fits this record. "
        "Check the reference column, or cut the part where the loop runs away"
    )


def _triangle(w: Array, r: Array, highest: int) -> Array:
    """R of the regression of w on 1, r(t) and lags 1, 2, ... of [w, r], lag by lag, so that orders are nested."""
    columns = [(np.ones(w.shape[0]), 0), *((x, 0) for x in r.T)]
    both = np.hstack([w, r])
    columns += [(x, k) for k in range(1, highest + 1) for x in both.T]
    return lagged_triangle([*columns, *((x, 0) for x in w.T)], highest)


def _by_criterion(R: Array, rows: int, n_w: int, n_r: int, highest: int) -> list[int]:
    """Orders, best first by Akaike's criterion."""
    score = []
    for p in range(1, highest + 1):
        size = 1 + n_r + p * (n_w + n_r)
        left = R[size:, -n_w:]
        _, logdet = np.linalg.slogdet(left.T @ left / rows + _ROUNDING * np.eye(n_w))
        score.append(rows * logdet + 2 * size * n_w)
    return [int(k) + 1 for k in np.argsort(score, kind="stable")]


def _of_reference(n_w: int, n_r: int, p: int) -> NDArray[np.bool_]:
    """Which coefficients, constant first, belong to the reference."""
    lag = [False] * n_w + [True] * n_r
    return np.array([False] + [True] * n_r + lag * p)


def _impulse(theta: Array, n_w: int, n_r: int, p: int, n: int) -> Array | None:
    """Impulse responses from r to w until forgotten, shape (m, n_w, n_r); None for an unstable loop."""
    width, n_s = n_w + n_r, p * n_w
    lags = [theta[n_r + k * width : n_r + (k + 1) * width].T for k in range(p)]
    F = np.zeros((n_s, n_s))
    F[:n_w] = np.hstack([m[:, :n_w] for m in lags])
    F[n_w:, :-n_w] = np.eye(n_s - n_w)
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    if radius > 1 + 1.0 / n:  # over one record a pole this near to the circle grows by less than e: still an instrument
        return None
    radius = min(radius, 1 - 1e-12)
    m = min(n, p + 50 + int(np.log(_FORGOTTEN) / np.log(max(radius, 1e-3))))
    drive = [theta[:n_r].T] + [lag[:, n_w:] for lag in lags]
    out = np.empty((m, n_w, n_r))
    M = np.ascontiguousarray(np.hstack([F, np.eye(n_s)[:, :n_w]]))
    for j in range(n_r):
        # the drive enters the newest output, which leads the state after the step
        work = np.zeros((m + 1, n_s + n_w))
        work[: p + 1, n_s:] = np.stack([d[:, j] for d in drive])[: m + 1]
        state_scan(M, work, np.zeros(n_s))
        out[:, :, j] = work[1:, :n_w]
    peak = np.max(np.abs(out), axis=(1, 2))
    last = int(np.nonzero(peak > _FORGOTTEN * peak.max())[0][-1]) + 1
    return out[:last]
