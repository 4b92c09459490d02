"""Points of a measured Campbell diagram: modes of the loop that noise excites in records at constant speed, forward and
backward, by the spectrum of x + jy without its synchronous part and without what an excitation repeats.

Around a pole the spectrum is B exp(D u) (1 + (A s² + C s u)/(u² + s²)), u = w - w_0: C where sensors are noisy, to
which the loop reacts. It is fitted by Whittle's likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.modes import EstimatedNumber
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.passage import sensor_planes
from ambid.rotor.synchronous import Separated, aperiodic

_SEGMENTS = 16  # at least, of the averaged spectrum in which peaks are sought
_STANDS_OUT = 2.0  # over the median of a band
_FIRST, _BANDS = 8, 50  # bin; bands of equal ratio from there on, for that median
_LONGEST_S = 2.0  # of a segment
_TAPER = 0.1  # of the record at both ends
_WIDTHS = 8.0  # half widths on either side that are fitted
_BINS = 30  # at least
_STEPS = 60
_GAIN = 20.0  # logarithm of the likelihood over that of a level alone
_TONE = 2.0  # bins: a peak that is not wider is a line, no mode
_DAMPED = 0.2  # damping ratio up to which a peak is that of a mode
_SAME = 0.01  # of the frequency, within which two planes show one mode
_SEEN = 0.5  # relative spread of a damping ratio, up to which a peak is taken
_SURE = 0.15  # relative spread up to which a damping ratio is identifiable
_TOP = 0.35  # of the rate


@dataclass(frozen=True, slots=True, kw_only=True)
class WhirlPoint:
    """A mode that noise excites in a record at constant speed: a point of a measured Campbell diagram."""

    speed: float  # rad/s
    frequency: EstimatedNumber  # damped, rad/s
    damping: EstimatedNumber  # ratio; a peak that hardly stands out looks too narrow: then it is not identifiable
    direction: int  # 1 forward, -1 backward, 0 of one axis alone
    plane: str  # of sensors, or the axis


def whirl_points(apart: Separated, model: RotorModel) -> tuple[WhirlPoint, ...]:
    """Return the modes that noise shows in a record at constant speed, its synchronous part apart, by frequency; modes
    with a damping ratio above 0.2 make no peak, and are not sought.
    """
    clean, excitation, speed = apart.record, apart.excitation, apart.speed
    points: list[WhirlPoint] = []
    for name, roles in sensor_planes(model, clean):
        y = np.column_stack([clean[role].values for role in roles])
        if excitation is not None:
            y = y[excitation.first : excitation.first + excitation.period * excitation.count]
            y = aperiodic(y, np.zeros(0, dtype=np.intp), excitation.count)
        z = y - y.mean(axis=0)
        motion = z[:, 0] + 1j * z[:, 1] if len(roles) == 2 else z[:, 0].astype(np.complex128)
        points += _of_motion(motion, clean.rate_hz, speed, name, two=len(roles) == 2)
    points.sort(key=lambda p: p.frequency.sd / p.frequency.value)
    kept: list[WhirlPoint] = []
    for p in points:
        like = (
            q for q in kept if q.direction == p.direction
            and abs(q.frequency.value - p.frequency.value) < _SAME * q.frequency.value
        )  # fmt: skip
        if next(like, None) is None:
            kept.append(p)
    return tuple(sorted(kept, key=lambda p: p.frequency.value))


def _of_motion(motion: Complex, rate_hz: float, speed: float, plane: str, *, two: bool) -> list[WhirlPoint]:
    """Return the peaks of one motion."""
    n, points = motion.size, []
    taper = _tukey(n)
    power = np.abs(np.fft.fft(motion * taper)) ** 2 / float(taper @ taper)
    inflation = n * float(np.sum(taper**4)) / float(taper @ taper) ** 2
    smooth, size = _averaged(motion, rate_hz)
    bins = 2.0 * np.pi * rate_hz / n
    for direction in (1, -1) if two else (0,):
        way = -1 if direction * np.sign(speed or 1.0) < 0 else 1
        side, mine = (x if way > 0 else np.concatenate([x[:1], x[:0:-1]]) for x in (smooth, power))
        side, mine = side[: size // 2], mine[: n // 2]
        for k, width in _tops(side, size):
            fit = _lorentzian(mine, k * n / size, width * n / size)
            if fit is None:
                continue
            (at, half), covariance = fit
            sd = np.sqrt(np.diag(covariance) * inflation) * bins
            w, s = at * bins, half * bins
            ratio = s / np.hypot(w, s)
            if half > _TONE and ratio < _DAMPED and w < 2.0 * np.pi * _TOP * rate_hz:
                points.append(
                    WhirlPoint(
                        speed=abs(speed), frequency=EstimatedNumber.of(w, float(sd[0])),
                        damping=EstimatedNumber.of(float(ratio), float(sd[1] / w), visible=sd[1] < _SURE * s),
                        direction=direction, plane=plane,
                    )
                )  # fmt: skip
    return [p for p in points if p.frequency.sd < _SAME * p.frequency.value and p.damping.sd < _SEEN * p.damping.value]


def _tukey(n: int) -> Array:
    """Return a window that is flat but at its ends."""
    edge = max(2, int(_TAPER * n))
    rise = 0.5 * (1.0 - np.cos(np.pi * (np.arange(edge) + 0.5) / edge))
    return np.concatenate([rise, np.ones(n - 2 * edge), rise[::-1]])


def _averaged(motion: Complex, rate_hz: float) -> tuple[Array, int]:
    """Return the spectrum averaged over overlapping segments, (size,), and its size."""
    size = min(2 * motion.size // (_SEGMENTS + 1), round(_LONGEST_S * rate_hz)) // 2 * 2
    window = np.hanning(size + 1)[:-1]
    starts = range(0, motion.size - size + 1, size // 2)
    return np.mean([np.abs(np.fft.fft(motion[a : a + size] * window)) ** 2 for a in starts], axis=0), size


def _tops(side: Array, size: int) -> list[tuple[int, float]]:
    """Return the bins that stand out of the median of their band, with half their width."""
    n = int(_TOP * size)
    edges = np.unique(np.geomspace(_FIRST, n, _BANDS).round().astype(int))
    level = [np.median(side[a:b]) for a, b in pairwise(edges)]
    ground = np.interp(np.arange(n), 0.5 * (edges[1:] + edges[:-1]), level)
    near = np.lib.stride_tricks.sliding_window_view(np.pad(side, 3, mode="edge"), 7).max(axis=1)[:n]
    top = np.flatnonzero((side[:n] == near) & (side[:n] > _STANDS_OUT * ground))
    tops = []
    for k in top[top >= _FIRST].tolist():
        below = np.flatnonzero(side[k:] < 0.5 * side[k])
        tops.append((k, max(1.0, float(below[0]) if below.size else 1.0)))
    return tops


def _lorentzian(power: Array, at: float, half: float) -> tuple[Array, Array] | None:
    """Return place and half width of a peak in bins, with their covariance, by scoring; None without one."""
    reach = max(_BINS, int(_WIDTHS * half))
    first, stop = max(1, int(at) - reach), min(power.size, int(at) + reach)
    x, seen = np.arange(first, stop, dtype=np.float64), power[first:stop]
    if x.size < 2 * _BINS:
        return None
    level = float(np.median(seen)) / np.log(2.0)
    height = max(float(np.mean(seen[np.abs(x - at) <= half + 1.0])) / level, 2.0)
    p, width = np.array([at, np.log(half), height, 0.0, np.log(level), 0.0]), float(reach)

    def spectrum(p: Array) -> tuple[Array, Array]:
        """Return the spectrum and its logarithmic derivatives."""
        s, u = np.exp(p[1]), x - p[0]
        size = u**2 + s**2
        S = 1.0 + (p[2] * s**2 + p[3] * s * u) / size
        by_u = p[3] * s / size - 2.0 * u * (p[2] * s**2 + p[3] * s * u) / size**2
        by_s = (2.0 * p[2] * s**2 + p[3] * s * u) / size - 2.0 * s**2 * (p[2] * s**2 + p[3] * s * u) / size**2
        slope = (x - at) / width
        rows = [-by_u / S, by_s / S, s**2 / size / S, s * u / size / S, np.ones(x.size), slope]
        return np.exp(p[4] + p[5] * slope) * S, np.array(rows)

    def likelihood(p: Array) -> float:
        S = spectrum(p)[0]
        return -float(np.sum(np.log(S) + seen / S)) if S.min() > 0.0 else -np.inf

    present = likelihood(p)
    for _ in range(_STEPS):
        S, rows = spectrum(p)
        F = rows @ rows.T
        step = np.linalg.solve(F + 1e-9 * np.diag(np.diag(F)), rows @ (seen / S - 1.0))
        room = np.array([half, 1.0, 1.0 + abs(p[2]), 1.0 + abs(p[2]), 1.0, 1.0])
        step *= min(1.0, 1.0 / max(float((np.abs(step) / room).max()), 1e-300))
        while likelihood(p + step) < present and np.abs(step).max() > 1e-9:
            step *= 0.5
        p = p + step
        before, present = present, likelihood(p)
        if present - before < 1e-9 * abs(present):
            break
    flat = -float(np.sum(np.log(seen.mean()) + seen / seen.mean()))
    if present - flat < _GAIN or not first < p[0] < stop or p[2] <= 0.0:
        return None
    rows = spectrum(p)[1]
    covariance = np.linalg.pinv(rows @ rows.T)[:2, :2]
    half = float(np.exp(p[1]))
    scale = np.array([1.0, half])
    return np.array([p[0], half]), np.asarray(covariance * np.outer(scale, scale), dtype=np.float64)
