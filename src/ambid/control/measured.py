"""The sensitivity as a record itself shows it: from the responses to the references, without a model of the plant.

With x = T r at the position signals and the controller's K_p and F, S = I - T F⁻¹ K_p. A line at which one reference
alone has power gives its column of T at once; where several have, neighbouring lines are taken together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop
from ambid.rotor.spectra import PeriodSpectra, smoothed
from ambid.signals.response import FrequencyResponse

_SILENT = 1e-3  # of the largest line, below which a reference has no power
_COUPLED = 1e-6  # share of its own term below which another axis' term in the controller is left out
_LINES_PER_UNKNOWN = 3
_BOUND = 3.0  # standard deviations
_LEAST = 3  # lines on either side of a peak, to which a parabola is fitted first
_NEAR = 1.2  # factor on the frequency; over wider stretches a peak is no parabola
_LIKELY = 1.0  # standard deviations of the mean square of what a parabola leaves
_SEEN = 0.1  # relative standard deviation of a peak that the record shows


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredSensitivity:
    """|S_jj| of one axis at the lines of its reference, and its standard deviation."""

    frequency_hz: Array  # (n_lines,)
    ratio: Array
    sd: Array

    @property
    def peak(self) -> tuple[float, float, float] | None:
        """Ratio, frequency in Hz and standard deviation of the peak; None where noise hides it.

        It is sought at the line that surely stands highest: the largest of many noisy lines is that of the largest
        noise, the largest lower bound is not. Around it a parabola over the logarithm of the frequency is fitted to as
        many lines as it explains within their scatter, at most those up to a factor of `_NEAR` away, or the nearest.
        """
        f, sd = self.frequency_hz, np.sqrt(smoothed(self.sd[:, None] ** 2)[:, 0])
        k = int(np.argmax(self.ratio - _BOUND * sd))
        found = (float(self.ratio[k]), float(f[k]), float(sd[k]))
        half = int(np.max(np.abs(np.flatnonzero(np.abs(np.log(f / f[k])) < np.log(_NEAR)) - k), initial=_LEAST))
        while sd[k] > 0.0 and half >= _LEAST:
            near = slice(max(k - half, 0), k + half + 1)
            fit = _parabola(np.log(f[near] / f[k]), self.ratio[near], sd[near])
            if fit is not None:
                found = (fit[0], float(f[k] * np.exp(fit[1])), fit[2])
                break
            half = int(0.7 * half)
        return found if sd[k] <= _SEEN * self.ratio[k] else None


def _parabola(x: Array, y: Array, sd: Array) -> tuple[float, float, float] | None:
    """Return height, place and standard deviation of the top of a parabola; None where it does not fit, or has none."""
    level, freedom = float(np.sqrt(np.mean(sd**2))), x.size - 3
    rows = np.vander(x, 3, increasing=True) / level
    c, *_ = np.linalg.lstsq(rows, y / level, rcond=None)
    misfit = float(np.sum((rows @ c - y / level) ** 2)) / freedom
    if misfit > 1.0 + _LIKELY * np.sqrt(2.0 / freedom):
        return None
    ends = [float(x[0]), float(x[-1])]
    top = -c[1] / (2.0 * c[2]) if c[2] < 0.0 else ends[int(np.argmax(np.polyval(c[::-1], ends)))]
    at = np.vander([min(max(top, ends[0]), ends[1])], 3, increasing=True)[0]
    spread = max(misfit, 1.0) * (at @ np.linalg.pinv(rows.T @ rows) @ at)
    return float(at @ c), float(at[1]), float(np.sqrt(spread))


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
    """Return the sensitivity of axis `j`; the scatter is that of its own term."""
    at, f = np.flatnonzero(on[:, j]), spectra.frequency_hz
    through = C[at] @ loop.together[:, j]  # (n_lines, n_references): what a disturbance of the axis' sensors orders
    weights = loop.weights[at, j]  # (n_lines, n_p)
    S = 1.0 - np.sum(weights * columns[j], axis=2) * through[:, j]  # (n_periods, n_lines)
    for other, column in columns.items():
        if other == j or np.all(np.abs(through[:, other]) <= _COUPLED * np.abs(through[:, j])):
            continue
        mean = column.mean(axis=0)
        near = np.flatnonzero(on[:, other])
        found = np.stack([np.interp(f[at], f[near], x) for x in mean.T], axis=1)
        S = S - np.sum(weights * found, axis=1) * through[:, other]
    mean = S.mean(axis=0)
    scatter = np.var(S, axis=0, ddof=1) / S.shape[0] if S.shape[0] > 1 else np.zeros(at.size)
    return MeasuredSensitivity(frequency_hz=f[at], ratio=np.abs(mean), sd=np.sqrt(scatter / 2.0))


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
        ratio = np.abs(1.0 - np.einsum("kp,kpr,kr->k", weights, response.G, through))
        size = np.abs(weights)[:, :, None] * response.sd * np.abs(through)[:, None, :]
        sd = np.sqrt(np.sum(size**2, axis=(1, 2)) / 2.0)
        found.append(MeasuredSensitivity(frequency_hz=response.frequency_hz, ratio=ratio, sd=sd))
    return tuple(found)
