"""The sensitivity as a record itself shows it: from the responses to the references, without a model of the plant.

With x = T r at the position signals and the controller's K_p and F, S = I - T F⁻¹ K_p. A line at which one reference
alone has power gives its column of T at once; where several have, neighbouring lines are taken together.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop
from ambid.rotor.spectra import PeriodSpectra, smoothed
from ambid.signals.response import FrequencyResponse

_SILENT = 1e-3  # of the largest line, below which a reference has no power
_COUPLED = 1e-6  # share of its own term below which another axis' term in the controller is left out
_LINES_PER_UNKNOWN = 3
_BOUND = 3.0  # standard deviations
_NEAR = 1.2  # factor on the frequency, around a peak
_HALVES = (6, 4, 3)  # lines on either side of a peak that are fitted, or all that are near; fewer where they do not fit
_ORDERS = (2, 6)  # of the polynomial, and at most half the lines
_MISFIT = 4.0  # mean square of what a fit leaves, over the scatter, from which it is none
_INNER = 0.5  # part of the fitted lines where the top is looked for: towards their ends a polynomial swings
_SEEN = 0.1  # relative standard deviation of a peak that the record shows
_TOGETHER = 6  # lines on either side of one that may hide a peak, whose powers are averaged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredSensitivity:
    """S_jj of one axis at the lines of its reference, and the standard deviation of its modulus."""

    frequency_hz: Array  # (n_lines,)
    ratio: Array
    sd: Array
    phase: Array = field(default_factory=lambda: np.zeros(0))  # rad; none in a file of an earlier version

    @property
    def peak(self) -> tuple[float, float, float] | None:
        """Ratio, frequency in Hz and standard deviation of the peak; None where noise hides it.

        It is hidden too where lines that are too noisy to show a peak stand higher, taken together, than the one found.
        """
        known = self.ratio > 0.0
        relative = np.divide(self.sd, self.ratio, out=np.zeros_like(self.sd), where=known)
        noise = np.sqrt(smoothed(relative[:, None] ** 2)[:, 0])
        top = self._found(known, noise)
        if top is None:
            return None
        power = smoothed((self.ratio**2 - 2.0 * self.sd**2)[:, None], _TOGETHER)[:, 0]
        surely = power * (1.0 - 4.0 * noise / np.sqrt(2.0 * _TOGETHER + 1.0))  # by two standard deviations
        return None if np.any(surely[noise > _SEEN] > top[0] ** 2) else top

    def _found(self, known: NDArray[np.bool_], noise: Array) -> tuple[float, float, float] | None:
        """Return the peak by the relative noise of the lines.

        It is sought at the line that surely stands highest: the largest of many noisy lines is that of the largest
        noise, the largest lower bound is not. Around it a polynomial is fitted to 1/S, whose poles, those of the plant
        and the controller, are farther away than the poles of S; the noise of 1/S is circular, and has no bias.
        """
        f = self.frequency_hz
        k = int(np.argmax(self.ratio * (1.0 - _BOUND * noise)))
        if noise[k] > _SEEN:
            return None
        wide = int(np.max(np.abs(np.flatnonzero(np.abs(np.log(f / f[k])) < np.log(_NEAR)) - k), initial=0))
        for half in (max(wide, _HALVES[0]), *_HALVES[1:]):
            near = np.flatnonzero(known[max(k - half, 0) : k + half + 1]) + max(k - half, 0)
            if noise[k] == 0.0 or not self.phase.size or near.size < 2 * _ORDERS[0]:
                break
            S = self.ratio[near] * np.exp(1j * self.phase[near])
            top = _top(np.log(f[near] / f[k]), S, noise[near])
            if top is not None:
                return top[0], float(f[k] * np.exp(top[1])), top[2]
        return float(self.ratio[k]), float(f[k]), float(noise[k] * self.ratio[k])


def _top(x: Array, S: Complex, noise: Array) -> tuple[float, float, float] | None:
    """Return height, place and standard deviation of the top of |S| by a polynomial of 1/S; None where none fits.

    `noise`: relative standard deviation of |S|. The order is Akaike's.
    """
    reach, weights = float(np.abs(x).max()), np.abs(S) / noise
    best: tuple[float, int, Any, Any, float] | None = None
    for order in range(_ORDERS[0], min(_ORDERS[1], x.size // 2) + 1):
        Q, R = np.linalg.qr(np.polynomial.chebyshev.chebvander(x / reach, order) * weights[:, None])
        projected = Q.T @ (weights / S)
        left = float(np.sum(np.abs(weights / S - Q @ projected) ** 2))
        score = left + 4.0 * order
        if best is None or score < best[0]:
            best = (score, order, np.linalg.solve(R, projected), R, left / (2.0 * (x.size - order - 1)))
    if best is None or best[4] > _MISFIT:
        return None
    _, order, found, R, misfit = best
    at = np.linspace(max(float(x[0]) / reach, -_INNER), min(float(x[-1]) / reach, _INNER), 1001)
    rows = np.polynomial.chebyshev.chebvander(at, order)
    size = np.abs(rows @ found)
    k = int(np.argmin(size))
    sd = np.linalg.norm(np.linalg.solve(R.T, rows[k])) * np.sqrt(max(misfit, 1.0))
    return float(1.0 / size[k]), float(at[k] * reach), float(sd / size[k] ** 2)


def measured_sensitivity(
    spectra: PeriodSpectra, loop: ClosedLoop, *, silent: float = _SILENT
) -> tuple[MeasuredSensitivity | None, ...]:
    """Return the sensitivity of each axis as measured, None of an axis without a reference of its own.

    `loop`: at the lines of the spectra; its controller is used, its plant is not; `silent`: part of the largest line
    below which a reference has no power.
    """
    sensors = loop.plant.sensors
    if spectra.R is None or spectra.R.shape[1] != len(sensors):
        return (None,) * len(sensors)
    size = np.abs(spectra.R)
    on = size > silent * size.max()
    K, F = loop.controller.response(spectra.frequency_hz)
    p = [k for group in sensors for k in group]
    C = np.linalg.pinv(F) @ K[:, :, p]
    columns = {k: _column(spectra, on, k, p) for k in range(on.shape[1]) if np.any(on[:, k])}
    return tuple(_of_axis(spectra, loop, columns, C, on, j) if j in columns else None for j in range(len(sensors)))


def _of_axis(
    spectra: PeriodSpectra, loop: ClosedLoop, columns: dict[int, Complex], C: Complex, on: Array, j: int
) -> MeasuredSensitivity:
    """Return the sensitivity of axis `j`.

    Other axes' terms are interpolated period by period, with the bend between their lines, so that the scatter is that
    of all terms together.
    """
    at, f = np.flatnonzero(on[:, j]), spectra.frequency_hz
    through = C[at] @ loop.together[:, j]  # (n_lines, n_references): what a disturbance of the axis' sensors orders
    weights = loop.weights[at, j]  # (n_lines, n_p)
    S = 1.0 - np.sum(weights * columns[j], axis=2) * through[:, j]  # (n_periods, n_lines)
    for other, column in columns.items():
        if other == j or np.all(np.abs(through[:, other]) <= _COUPLED * np.abs(through[:, j])):
            continue
        known = f[np.flatnonzero(on[:, other])]
        place = np.interp(f[at], known, np.arange(known.size))
        below = np.clip(place.astype(int), 0, max(known.size - 2, 0))
        t = (place - below)[:, None]
        found = (1.0 - t) * column[:, below] + t * column[:, np.minimum(below + 1, known.size - 1)]
        if known.size > 2:
            bend = np.pad(np.diff(column, 2, axis=1), ((0, 0), (1, 0), (0, 0)), mode="edge")
            found = found - 0.5 * t * (1.0 - t) * bend[:, below]
        S = S - np.sum(weights * found, axis=2) * through[:, other]
    mean = S.mean(axis=0)
    scatter = np.var(S, axis=0, ddof=1) / S.shape[0] if S.shape[0] > 1 else np.zeros(at.size)
    return MeasuredSensitivity(
        frequency_hz=f[at], ratio=np.abs(mean), sd=np.sqrt(scatter / 2.0), phase=np.angle(mean)
    )  # fmt: skip


def _column(spectra: PeriodSpectra, on: Array, mine: int, p: list[int]) -> Complex:
    """Return positions over a reference at its lines, by period, (n_periods, n_lines of it, n_p)."""
    assert spectra.R is not None
    R, at = spectra.R, np.flatnonzero(on[:, mine])
    alone = np.asarray(spectra.Y[:, at][:, :, p] / R[at, mine][:, None])
    shared = np.flatnonzero(on[at].sum(axis=1) > 1)
    if not shared.size:
        return alone
    others = np.flatnonzero(np.any(on[at], axis=0))
    window = min(2 * _LINES_PER_UNKNOWN * others.size, R.shape[0])
    found = alone
    for m, k in zip(shared, at[shared], strict=True):
        first = int(np.clip(k - window // 2, 0, R.shape[0] - window))
        near = slice(first, first + window)
        run = (spectra.frequency_hz[near] - spectra.frequency_hz[k])[:, None] / np.ptp(spectra.frequency_hz[near])
        rows = np.hstack([R[near][:, others], run * R[near][:, others]])
        answers = np.linalg.lstsq(rows, spectra.Y[:, near][:, :, p].transpose(1, 0, 2).reshape(window, -1), rcond=None)
        found[:, m] = answers[0][int(np.flatnonzero(others == mine)[0])].reshape(spectra.n_periods, len(p))
    return found


def measured_locally(response: FrequencyResponse, loop: ClosedLoop) -> tuple[MeasuredSensitivity | None, ...]:
    """Return the sensitivity by a measured response from references to positions, of a record that is not periodic.

    `response`: (n, n_p, n_references); `loop`: at its frequencies.
    """
    p = [k for group in loop.plant.sensors for k in group]
    K, F = loop.controller.response(response.frequency_hz)
    C = np.linalg.pinv(F) @ K[:, :, p]
    found = []
    for j in range(len(loop.plant.sensors)):
        through, weights = C @ loop.together[:, j], loop.weights[:, j]
        S = 1.0 - np.einsum("kp,kpr,kr->k", weights, response.G, through)
        size = np.abs(weights)[:, :, None] * response.sd * np.abs(through)[:, None, :]
        sd = np.sqrt(np.sum(size**2, axis=(1, 2)) / 2.0)
        found.append(MeasuredSensitivity(frequency_hz=response.frequency_hz, ratio=np.abs(S), sd=sd, phase=np.angle(S)))
    return tuple(found)
