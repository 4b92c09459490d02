"""Lines that are none of the excitation, such as mains hum: found where the residuals of a fit stand out at a single
frequency, told by the direction in which they point, and taken out of all channels by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.record import Record, Step
from ambid.rotor.estimator import RotorFit
from ambid.rotor.likelihood import Experiment, Noise, Point, Weight, sampled, source_covariance, sources
from ambid.rotor.spectra import LEAST_LINES, Excitation, PeriodSpectra
from ambid.rotor.synchronous import aperiodic

_STANDS_OUT, _FOUND = 8.0, 12.0  # times the median of the lines around, to be taken out, and to be found
_AROUND, _NEAR = 20, 12  # lines on either side for that median, and of which it must hold nearly all power
_NARROW = 0.8
_BESIDES, _SHARP = 2, 0.1  # other lines among those, and what part of their power at most is three lines away
_LIKE, _ALONE = 8, 30.0  # excited lines on either side, over the largest of which one of them has to stand
_APART = 3  # lines that two are apart
_OF_ONE = 0.7  # part of a line's power from which it is of one channel
_GRIDS, _POINTS = (1.0, 0.1, 0.01), 21  # lines of the whole record on either side within which a frequency is sought
_BESIDE = (-9.5, -7.5, -5.5, 5.5, 7.5, 9.5)  # lines of the whole record away, where noise alone is
_OWN = 1e-9  # part of a wave that is not periodic, below which it is one with an excited line


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line, and the channel that it is in: an output, a force, a voltage, or "several channels"."""

    frequency_hz: float
    channel: str
    excited: bool = False  # whether it stands on an excited line, where a mode narrower than their spacing looks alike


def find_lines(fit: RotorFit) -> list[list[Line]]:
    """Return the lines in each experiment of a fit, the largest first."""
    pairs = zip(fit.problem.experiments, fit.problem.weights, strict=True)
    return [_lines(fit, e, w) for e, w in pairs]


def _lines(fit: RotorFit, e: Experiment, weight: Weight) -> list[Line]:
    if weight.noise is None:
        return []
    at, spectra = fit.point, e.spectra
    parts = [
        _whitened(fit, e, at, weight.noise, spectra.mean_u, np.sqrt(spectra.n_periods) * spectra.mean_y, False),
        _whitened(fit, e, at, weight.noise, spectra.between.U, spectra.between.Y, True),
    ]
    frequency = np.concatenate([spectra.frequency_hz, spectra.between.frequency_hz])
    order = np.argsort(frequency)
    frequency = frequency[order]
    w, ways = (np.concatenate([p[k] for p in parts])[order] for k in (0, 1))
    power, found, excited = np.sum(np.abs(w) ** 2, axis=1), dict[int, Line](), order < spectra.frequency_hz.size
    at_lines = np.flatnonzero(excited)
    for j in np.argsort(-power).tolist():
        around = power[max(0, j - _AROUND) : j + _AROUND + 1]
        if power[j] < _FOUND * float(np.median(around)):
            break
        level = float(np.median(around))
        over = power - level
        if excited[j]:  # what the model lacks shows at several lines
            k = int(np.searchsorted(at_lines, j))
            others = np.delete(at_lines[max(0, k - _LIKE) : k + _LIKE + 1], min(k, _LIKE))
            if power[j] < _ALONE * float(power[others].max()):
                continue
        if any(abs(j - other) < _APART for other in found):
            continue
        near = slice(max(0, j - _NEAR), j + _NEAR + 1)
        besides = _sharp(power[near], j - near.start, _FOUND * level)
        if float(over[max(0, j - 2) : j + 3].sum()) > _NARROW * float(over[near][~besides].sum()):
            shares = np.abs(np.sum(ways[j].conj() * w[j][:, None], axis=0)) ** 2
            shares /= np.maximum(np.sum(np.abs(ways[j]) ** 2, axis=0), 1e-300)
            k, names = int(np.argmax(shares)), (*fit.model.outputs, *fit.model.disturbances)
            one = shares[k] > _OF_ONE * power[j]
            channel = names[k] if one else "several channels"
            found[j] = Line(frequency_hz=float(frequency[j]), channel=channel, excited=bool(excited[j]))
    return list(found.values())


def _sharp(power: Array, own: int, least: float) -> NDArray[np.bool_]:
    """Return where the largest other lines beside the line `own` stand, which are as sharp as one."""
    beside: NDArray[np.bool_] = np.zeros(power.size, dtype=np.bool_)
    of_own = slice(max(0, own - 2), own + 3)
    for _ in range(_BESIDES):
        left = np.where(beside, 0.0, power)
        left[of_own] = 0.0
        k = int(np.argmax(left))
        sides = power[[x for x in (k - 3, k + 3) if 0 <= x < power.size and abs(x - own) > 2]]
        if left[k] < least or np.any(sides > _SHARP * left[k]):
            break
        beside[max(0, k - 2) : k + 3] = True
    beside[of_own] = False
    return beside


def _whitened(
    fit: RotorFit, e: Experiment, at: Point, noise: Noise, U: Complex, Y: Complex, between: bool
) -> tuple[Complex, Complex]:
    """Return whitened residuals (n, n_y) of one period's variance, and how each source shows, (n, n_y, n_sources)."""
    of = sampled(e, fit.model, at, between=between)
    scale = 1.0 if between else np.sqrt(e.spectra.n_periods)
    left = Y - scale * (of.transfer() @ U[:, :, None])[:, :, 0]
    g = sources(of)
    root = np.linalg.inv(np.linalg.cholesky(source_covariance(g, noise.at(of.omega))))
    return np.asarray((root @ left[:, :, None])[:, :, 0], dtype=np.complex128), np.asarray(root @ g)


def without_lines(
    record: Record, excitation: Excitation, roles: Sequence[str], lines: Sequence[Line]
) -> tuple[Record, tuple[Line, ...]]:
    """Return a record without some lines, and these with their frequencies as the samples between the excited lines
    show them. What is one with an excited line stays: that line is to be left out.
    """
    used = slice(excitation.first, excitation.first + excitation.count * excitation.period)
    y = np.column_stack([record[role].values for role in roles])
    size, t = np.std(y[used], axis=0), np.arange(-excitation.first, record.n_samples - excitation.first)
    target = aperiodic(y[used] - y[used].mean(axis=0), np.zeros(0, dtype=np.intp), excitation.count) / size
    step, taken, sharper = record.rate_hz / target.shape[0], np.zeros_like(y), list[Line]()
    for line in lines:
        f = line.frequency_hz
        for reach in _GRIDS:
            tried = f + reach * step * np.linspace(-1.0, 1.0, _POINTS)
            f = float(max(tried, key=lambda x: _fitted(target, x / record.rate_hz, excitation.count)[1]))
        a, explained = _fitted(target, f / record.rate_hz, excitation.count)
        beside = [_fitted(target, (f + k * step) / record.rate_hz, excitation.count)[1] for k in _BESIDE]
        if explained < _STANDS_OUT * float(np.median(beside)):
            sharper.append(line)
            continue
        wave = np.exp(2j * np.pi * f / record.rate_hz * t)
        target = target - aperiodic(np.real(wave[used, None] * a), np.zeros(0, dtype=np.intp), excitation.count)
        taken += np.real(wave[:, None] * (a * size))
        sharper.append(replace(line, frequency_hz=f))
    channels = tuple(
        replace(c, values=c.values - taken[:, roles.index(c.name)]) if c.name in roles else c for c in record.channels
    )
    done = Step(name="without_lines", settings={"frequency_hz": [x.frequency_hz for x in sharper]})
    return replace(record, channels=channels, history=(*record.history, done)), tuple(sharper)


def _fitted(target: Array, turns: float, periods: int) -> tuple[Complex, float]:
    """Return the amplitude in each channel of a wave of some turns a sample, and the power that it explains."""
    turn = 2.0 * np.pi * turns * np.arange(target.shape[0])
    own = aperiodic(np.column_stack([np.cos(turn), -np.sin(turn)]), np.zeros(0, dtype=np.intp), periods)
    gram = own.T @ own
    if np.trace(gram) < _OWN * target.shape[0]:
        return np.zeros(target.shape[1], dtype=complex), 0.0
    along = own.T @ target
    solved = np.linalg.lstsq(gram, along, rcond=1e-9)[0]
    return solved[0] + 1j * solved[1], float(np.sum(solved * along))


def apart(spectra: PeriodSpectra, lines: Sequence[Line]) -> PeriodSpectra:
    """Return spectra without the excited lines that a line falls on, roughly within one of the whole record."""
    reach = 1.5 * spectra.rate_hz / spectra.period / spectra.n_periods
    far: NDArray[np.bool_] = np.ones(spectra.frequency_hz.size, dtype=np.bool_)
    for line in lines:
        far &= np.abs(spectra.frequency_hz - line.frequency_hz) >= reach
    if np.count_nonzero(far) < LEAST_LINES:
        raise EstimationError(
            f"the excitation of the record has {far.size} lines, on {np.count_nonzero(~far)} of which hum or another "
            f"tone stands; a rotor needs {LEAST_LINES} others. Excite more lines: a multisine with whole periods"
        )
    return spectra.lines(far)
