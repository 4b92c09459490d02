"""What a live view shows of the samples: smallest and largest of each hundredth of a second, and spectra.

A tap beside recorder and tracker: it takes what the run passes on, and hands on a frame every 50 ms.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ambid.acquisition.settings import BenchView
from ambid.arrays import Array
from ambid.console.feed import FeedWriter
from ambid.errors import AmbidError
from ambid.tracking.blocks import Block, Frame

_PER_SECOND = 200  # envelopes of a second
_EVERY_S = 0.048  # between two frames, a little less than the 50 ms that five blocks take
_SPECTRUM_S = 1.0  # of samples a spectrum is made of, and between two of them
_LINES = 160  # of a spectrum
_HEAD = struct.Struct("<QQIHHdd")  # first sample, samples lost, envelopes, channels, samples of each, end s, wall clock


class EnvelopeTap:
    """Takes the blocks of a run, and writes envelopes of its roles into a feed.

    `view`: of device and rig.
    """

    def __init__(self, feed: FeedWriter, view: BenchView) -> None:
        self._feed, self._view = feed, view
        self._group = max(1, round(view.rate_hz / _PER_SECOND))
        self._rows: list[Array] = []
        self._waiting = self._lost = 0
        self._origin: int | None = None
        self._next = self._first = 0
        self._written_s = 0.0
        self._recent: list[Array] = []
        self._recent_n, self._spectrum_at = 0, 0
        feed.tell(
            "signals",
            {"names": list(view.units), "units": list(view.units.values()), "rate_hz": view.rate_hz,
             "group": self._group},
            sticky="signals",
        )  # fmt: skip

    def take(self, frame: Frame) -> None:
        """Take a block."""
        block = frame.block
        if self._origin is None:
            self._origin = self._next = self._first = block.first
        if block.first > self._next:  # a gap is drawn as one
            self._lost += block.first - self._next
            self._flush(frame.arrived_s, 0)
            self._first = block.first
        self._next = block.first + len(block.values)
        self._rows.append(block.values)
        self._waiting += len(block.values)
        if frame.arrived_s - self._written_s >= _EVERY_S:
            self._flush(frame.arrived_s, self._waiting % self._group)
            self._written_s = frame.arrived_s

    def _flush(self, arrived_s: float, keep: int) -> None:
        """Write what waits, but for the last `keep` samples."""
        n = (self._waiting - keep) // self._group
        if not n:
            if not keep:
                self._rows, self._waiting = [], 0
            return
        rows = np.vstack(self._rows)
        seen = self._seen(rows[: n * self._group])
        self._remember(seen)
        cut = seen.reshape(len(seen), n, self._group)
        both = np.stack([cut.min(axis=2), cut.max(axis=2)], axis=2).transpose(1, 0, 2)  # (n, channels, 2)
        assert self._origin is not None
        end_s = (self._first + n * self._group - self._origin) / self._view.rate_hz
        wall = time.time() - (time.perf_counter() - arrived_s)
        head = _HEAD.pack(self._first - self._origin, self._lost, n, len(seen), self._group, end_s, wall)
        self._feed.envelope(head + both.tobytes())
        rest = rows[n * self._group :]
        self._first += n * self._group
        self._rows, self._waiting = ([rest] if len(rest) and keep else []), (len(rest) if keep else 0)

    def _seen(self, rows: Array) -> Array:
        """Return rows of the device as signals, (n_channels, n_samples), of four bytes each: enough for eyes."""
        try:
            values = self._view.block(Block(first=self._first, time_s=0.0, values=rows)).values
        except AmbidError:  # outside a calibration: nothing to be drawn
            values = np.full((len(rows), len(self._view.units)), np.nan)
        return np.ascontiguousarray(values.T, dtype="<f4")

    def _remember(self, seen: Array) -> None:
        """Make a spectrum of each second."""
        self._recent.append(seen)
        self._recent_n += seen.shape[1]
        if self._recent_n < _SPECTRUM_S * self._view.rate_hz:
            return
        signals = np.hstack(self._recent)
        self._recent, self._recent_n = [], 0
        hz, amplitudes = spectrum(signals, self._view.rate_hz)
        self._feed.tell("spectrum", {"hz": rounded(hz), "amplitudes": [rounded(a) for a in amplitudes]})


def spectrum(signals: Array, rate_hz: float) -> tuple[Array, list[Array]]:
    """Return about `_LINES` frequencies, Hz, and the largest amplitude of each signal near each of them.

    Amplitudes are peak values of a sine at the frequency (Hann window); `signals`: (n_signals, n_samples).
    """
    n = signals.shape[1]
    window = np.hanning(n).astype(signals.dtype)
    lines = np.abs(np.fft.rfft((signals - signals.mean(axis=1, keepdims=True)) * window)) * (2.0 / window.sum())
    edges = np.unique(np.round(np.geomspace(1, lines.shape[1], _LINES)).astype(int))
    top = [a + int(np.argmax(lines[0, a:b])) for a, b in pairwise(edges.tolist())]
    return np.array(top) * (rate_hz / n), list(np.maximum.reduceat(lines[:, : edges[-1]], edges[:-1], axis=1))


def rounded(values: Array, digits: int = 5) -> list[float | None]:
    """Return numbers to some digits for JSON; None where not finite."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def throttled(every_s: float, tell: Callable[..., object]) -> Callable[..., object]:
    """Call `tell` at most every so many seconds of this machine's clock."""
    last = [float("-inf")]

    def told(*args: object) -> None:
        now = time.perf_counter()
        if now - last[0] >= every_s:
            last[0] = now
            tell(*args)

    return told
