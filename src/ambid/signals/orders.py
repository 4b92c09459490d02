"""Order tracking: the amplitudes a_k of x(t) = Re Σ_k a_k exp(j k angle(t)) while the speed changes, the angle counted
so that it rises, by least squares over blocks of whole turns; and the waterfall, spectra over the speed.

In a block order 1 may change linearly, so that its amplitude is the mean over the block whatever the acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError

_CHUNK = 200_000  # samples that are worked on at once
_PER_COLUMN = 2.0  # samples of a block for each column of its regression, at least
_CHANGES = 0.4  # of the speed from quarter to quarter of a block, at most: the first turns from rest are left out
_LEAST = 8  # blocks
_TURNS_BACK = 0.1  # of the highest speed, by which a run-up becomes a coast-down
_AROUND, _FEW = 15, 4  # blocks on either side that show the noise, at most and at least
_ALIKE = 0.25  # of the speed, within which the noise is the same
_TOP = 0.45  # of the rate, up to which an order is tracked
_RESOLUTION_HZ = 5.0  # of a waterfall
_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / np.sqrt(70.0)  # what is smooth over five blocks drops out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Orders:
    """Orders of some channels, block by block in the order of time; a block holds a number of whole turns."""

    first: NDArray[np.int64]  # (n_blocks,), first sample of each block
    stop: NDArray[np.int64]
    speed: Array  # (n_blocks,), mean of the block, rad/s, positive
    acceleration: Array  # (n_blocks,), rad/s²
    orders: tuple[int, ...]
    amplitude: Complex  # (n_blocks, n_orders, n_channels), mean over the block
    sd: Array  # (n_blocks, n_orders, n_channels), of real and of imaginary part
    rate_hz: float

    def part(self, blocks: slice) -> Orders:
        """Return some blocks."""
        arrays = ("first", "stop", "speed", "acceleration", "amplitude", "sd")
        return replace(self, **{name: getattr(self, name)[blocks] for name in arrays})

    def ways(self) -> tuple[Orders, ...]:
        """Return the stretches between which the speed turns back by more than a part of its highest."""
        w, least = self.speed, _TURNS_BACK * float(self.speed.max())
        edges, way, extreme = [0], 0, 0
        for k in range(w.size):
            far = w[k] - w[extreme]
            if way * far >= 0.0 and way:
                extreme = k
            elif abs(far) > least:
                if way:
                    edges.append(extreme)
                way, extreme = (1 if far > 0.0 else -1), k
        return tuple(self.part(slice(a, b)) for a, b in pairwise([*edges, w.size]) if b - a >= _LEAST)

    def of(self, order: int = 1) -> tuple[Complex, Array]:
        """Return amplitudes and standard deviations (n_blocks, n_channels) of an order."""
        k = self.orders.index(order)
        return self.amplitude[:, k], self.sd[:, k]


def track_orders(
    y: Array, angle: Array, rate_hz: float, *, turns: int = 8, orders: Sequence[int] = (1, 2, 3)
) -> Orders:
    """Return the orders of channels (n_samples, n_channels) of a rotor whose angle in rad, (n_samples,), is not
    wrapped; `turns`: of a block.
    """
    first, stop = _blocks(angle, turns, 2 * len(orders) + 4)
    length = stop - first
    time: Array = 0.5 * (first + stop - 1).astype(np.float64) / rate_hz
    speed: Array = np.abs(angle[stop - 1] - angle[first]) / (length - 1) * rate_hz
    used = tuple(k for k in orders if k * speed.max() < 2.0 * np.pi * _TOP * rate_hz)
    if 1 not in used:
        raise EstimationError(
            f"the rotor turns {speed.max() / (2.0 * np.pi):.4g} times a second, too fast for a rate of {rate_hz:g} Hz. "
            "Record faster"
        )
    solved = np.empty((first.size, 4 + 2 * len(used), y.shape[1]))
    sense = -1.0 if angle[-1] < angle[0] else 1.0
    for part in _parts(first, stop):
        a, b = first[part][0], stop[part][-1]
        solved[part] = _solved(y[a:b], sense * angle[a:b], first[part] - a, stop[part] - a, used)
    at = 2 + 2 * np.arange(len(used))
    amplitude = solved[:, at] + 1j * solved[:, at + 1]
    return Orders(
        first=first, stop=stop, speed=speed, acceleration=np.gradient(speed, time), orders=used, amplitude=amplitude,
        sd=_scatter(amplitude, length, speed), rate_hz=rate_hz,
    )  # fmt: skip


def _blocks(angle: Array, turns: int, columns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the blocks in which the rotor turns on by `turns` at a speed that changes little."""
    turned = np.abs(angle - angle[0])
    count = int(turned[-1] / (2.0 * np.pi * turns))
    if (np.diff(turned) < 0.0).any():
        turned = np.maximum.accumulate(turned)  # an encoder may jitter
    edges = np.searchsorted(turned, 2.0 * np.pi * turns * np.arange(count + 1)).astype(np.int64)
    first, stop = edges[:-1], edges[1:]
    quarters = first[:, None] + (stop - first)[:, None] * np.arange(5) // 4
    speeds = np.diff(turned[np.minimum(quarters, turned.size - 1)], axis=1)
    even = np.ptp(speeds, axis=1) < _CHANGES * speeds.mean(axis=1)
    good = (stop - first >= _PER_COLUMN * columns) & even
    if np.count_nonzero(good) < _LEAST:
        raise EstimationError(
            f"the rotor makes {turned[-1] / (2.0 * np.pi):.4g} turns in this record, of which {np.count_nonzero(good)} "
            f"blocks of {turns} turns can be used; orders need {_LEAST} blocks with more than "
            f"{_PER_COLUMN * columns:g} samples each. Record for longer, or faster"
        )
    return first[good], stop[good]


def _parts(first: NDArray[np.int64], stop: NDArray[np.int64]) -> list[slice]:
    """Return blocks that are worked on together."""
    parts, begin = list[slice](), 0
    for k in range(1, first.size + 1):
        if k == first.size or stop[k] - first[begin] > _CHUNK:
            parts.append(slice(begin, k))
            begin = k
    return parts


def _solved(y: Array, angle: Array, first: NDArray[np.int64], stop: NDArray[np.int64], orders: Sequence[int]) -> Array:
    """Return the coefficients (n_blocks, n_columns, n_channels) of 1, t, cos and -sin of each order, then t cos and -t
    sin of the first, t from -1 to 1 in a block.
    """
    place, length = np.arange(y.shape[0]), stop - first
    block = np.clip(np.searchsorted(first, place, "right") - 1, 0, first.size - 1)
    inside = (place >= first[block]) & (place < stop[block])
    t = np.where(inside, 2.0 * (place - first[block]) / np.maximum(length[block] - 1, 1) - 1.0, 0.0)
    turn = np.exp(1j * angle) * inside
    waves, power = [], turn
    for k in range(1, max(orders) + 1):
        if k in orders:
            waves += [power.real, -power.imag]
        power = power * np.where(inside, turn, 0.0)
    columns = [inside.astype(np.float64), t, *waves, t * turn.real, -t * turn.imag]
    p = len(columns)
    gram, right = np.empty((first.size, p, p)), np.empty((first.size, p, y.shape[1]))
    for i, x in enumerate(columns):
        right[:, i] = np.add.reduceat(x[:, None] * y, first, axis=0)
        for j in range(i + 1):
            gram[:, i, j] = gram[:, j, i] = np.add.reduceat(x * columns[j], first)
    return np.asarray(np.linalg.solve(gram, right))


def _scatter(amplitude: Complex, length: NDArray[np.int64], speed: Array) -> Array:
    """Return the standard deviation of real and imaginary part by the fourth difference of five blocks: of its power
    for one sample the median over blocks around, in which what changes smoothly, or in a narrow resonance, is no noise.
    """
    n, share = amplitude.shape[0], np.sqrt(length)[:, None, None]
    power = sum(c * (amplitude * share)[k : n - 4 + k] for k, c in enumerate(_DIFFERENCE))
    size = np.pad(np.abs(power) ** 2, ((2, 2), (0, 0), (0, 0)), mode="edge")
    middle = np.array([np.median(size[a:b], axis=0) for a, b in blocks_around(speed, _AROUND)])
    return np.asarray(np.sqrt(middle / (2.0 * np.log(2.0))) / share)


def blocks_around(speed: Array, most: int) -> list[tuple[int, int]]:
    """Return the blocks around each that show its noise: at most so many on either side, at nearly its speed, at which
    alone the noise of a loop is the same.
    """
    n, around = speed.size, []
    for k in range(n):
        near = np.abs(speed[max(0, k - most) : k + most + 1] - speed[k]) < _ALIKE * speed[k]
        at = k - max(0, k - most)
        low = at - int(np.argmin(near[at::-1])) + 1 if not near[: at + 1].all() else 0
        high = at + int(np.argmin(near[at:])) if not near[at:].all() else near.size
        first = max(0, k - most)
        around.append((max(0, min(first + low, k - _FEW)), min(n, max(first + high, k + _FEW + 1))))
    return around


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Waterfall:
    """Amplitude spectra of channels over the speed."""

    speed: Array  # (n_spectra,), rad/s, mean of each spectrum's samples
    frequency_hz: Array  # (n_frequencies,)
    amplitude: Array  # (n_spectra, n_frequencies, n_channels), of a sine, Hann window


def waterfall(
    y: Array, speed: Array, rate_hz: float, *, spectra: int = 120, highest_hz: float | None = None
) -> Waterfall:
    """Return `spectra` evenly over the record of channels (n_samples, n_channels), each as long as it resolves 5 Hz;
    `speed` (n_samples,), rad/s.
    """
    n = y.shape[0]
    size = min(n, max(16, round(2.0 * rate_hz / _RESOLUTION_HZ)))  # two bins: the half width of the window
    starts = np.unique(np.linspace(0, n - size, max(1, spectra)).round().astype(np.int64))
    window = np.hanning(size + 1)[:-1]
    frequency: Array = np.arange(size // 2 + 1, dtype=np.float64) * (rate_hz / size)
    top = frequency.size if highest_hz is None else int(np.searchsorted(frequency, highest_hz, "right"))
    amplitude = np.empty((starts.size, top, y.shape[1]))
    for k, a in enumerate(starts):
        part = y[a : a + size]
        lines = np.fft.rfft((part - part.mean(axis=0)) * window[:, None], axis=0)[:top]
        amplitude[k] = 2.0 / window.sum() * np.abs(lines)
    return Waterfall(
        speed=np.array([np.mean(np.abs(speed[a : a + size])) for a in starts]),
        frequency_hz=frequency[:top], amplitude=amplitude,
    )  # fmt: skip
