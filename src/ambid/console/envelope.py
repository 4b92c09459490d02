"""What a live view shows of the samples: smallest and largest of each hundredth of a second, and spectra.

A tap beside recorder and tracker: it takes what the run passes on, and hands on a frame every 50 ms.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from ambid.acquisition.settings import BenchView
from ambid.arrays import Array
from ambid.console.feed import FeedWriter
from ambid.errors import AmbidError
from ambid.tracking.blocks import Block, Frame

_PER_SECOND = 200  # envelopes of a second
_EVERY_S = 0.048  # between two frames, a little less than the 50 ms that five blocks take
_SPECTRUM_S = 1.0  # of samples a spectrum is made of, and between two of them
_LINES = 400  # of a spectrum
_INSIDE_S = 1.0  # after which a limit that is passed is told again
_TINY = 1e-290  # what is smaller is shown as zero
_HEAD = struct.Struct("<QQIHHdd")  # first sample, samples lost, envelopes, channels, samples of each, end s, wall clock


@dataclass(slots=True, kw_only=True)
class _Stretch:
    """Samples without a gap that wait to be shown."""

    first: int  # number of the first one
    rows: list[Array] = field(default_factory=list)
    n: int = 0


class Journal(Protocol):
    """What stores a run: `stored`, whether the last block found room; `written`, the number of the sample up to which
    nothing that found room is lost where the process dies.
    """

    stored: bool

    @property
    def written(self) -> int:
        """See above."""
        ...


class EnvelopeTap:
    """Takes the blocks of a run, and writes envelopes of its roles into a feed, of a sample once the journal has it.

    `view`: of device and rig; `journal`: takes each block before; `limits`: of roles, where an alarm is told; `beside`:
    also given the rows that are shown, as the device has them, and the time after them.
    """

    def __init__(
        self, feed: FeedWriter, view: BenchView, journal: Journal,
        limits: Mapping[str, Sequence[Mapping[str, Any]]] = MappingProxyType({}),
        beside: Callable[[Array, float], object] | None = None,
    ) -> None:  # fmt: skip
        self._feed, self._view, self._journal, self._beside = feed, view, journal, beside
        self._group = max(1, round(view.rate_hz / _PER_SECOND))
        self._stretches = deque[_Stretch]()
        self._lost = self._next = 0
        self._origin: int | None = None
        self._written_s = 0.0
        self._recent: list[Array] = []
        self._recent_n, self._lost_told = 0, (0, float("-inf"))  # samples that were told as lost, and when
        self._limits = [(k, role, line) for k, role in enumerate(view.units) for line in limits.get(role, ())]
        self._beyond: dict[int, float] = {}  # limits that were passed, and when last
        feed.tell(
            "signals",
            {"names": list(view.units), "units": list(view.units.values()), "rate_hz": view.rate_hz,
             "group": self._group, "limits": dict(limits), "resolution": WINDOWS["Hann"][1] / _SPECTRUM_S},
            sticky="signals",
        )  # fmt: skip

    def take(self, frame: Frame) -> None:
        """Take a block."""
        block = frame.block
        if self._origin is None:
            self._origin = self._next = block.first
            self._begin(block.first)
        if block.first > self._next:  # a gap is drawn as one
            self._lost += block.first - self._next
            self._begin(block.first)
        self._next = block.first + len(block.values)
        if self._journal.stored:
            self._stretches[-1].rows.append(block.values)
            self._stretches[-1].n += len(block.values)
        else:
            self._lost += len(block.values)
            self._begin(self._next)
        if frame.arrived_s - self._written_s >= _EVERY_S and self._flush(frame.arrived_s):
            self._written_s = frame.arrived_s

    def end(self) -> None:
        """Show the last samples, which the journal has by now."""
        self._flush(time.perf_counter())

    def _begin(self, first: int) -> None:
        self._stretches.append(_Stretch(first=first))

    def _flush(self, arrived_s: float) -> bool:
        """Write what the journal has, in whole envelopes; whether there was any."""
        some, written = False, self._journal.written
        while self._stretches:
            part = self._stretches[0]
            n = min(part.n, max(0, written - part.first)) // self._group
            if n:
                some = True
                self._write(part, n, arrived_s)
            if len(self._stretches) == 1 or part.n >= self._group:
                break
            self._stretches.popleft()
        return some

    def _write(self, part: _Stretch, n: int, arrived_s: float) -> None:
        """Write the first `n` envelopes of a stretch."""
        rows, end = np.vstack(part.rows), n * self._group
        seen = self._seen(rows[:end])
        self._remember(seen)
        cut = seen.reshape(len(seen), n, self._group)
        self._watch(seen, part.first)
        both = np.stack([cut.min(axis=2), cut.max(axis=2)], axis=2).transpose(1, 0, 2)  # (n, channels, 2)
        assert self._origin is not None
        first, part.first = part.first - self._origin, part.first + end
        part.rows, part.n = [rows[end:]], part.n - end
        rate_hz = self._view.rate_hz
        wall = time.time() - (time.perf_counter() - arrived_s) - (self._next - part.first) / rate_hz
        head = _HEAD.pack(first, self._lost, n, len(seen), self._group, (first + end) / rate_hz, wall)
        self._feed.envelope(head + both.tobytes())
        if self._beside is not None:
            self._beside(rows[:end], (first + end) / rate_hz)

    def _watch(self, seen: Array, first: int) -> None:
        """Tell an alarm where samples were lost, or a signal passes a limit; again once it was inside for a second."""
        assert self._origin is not None
        rate_hz = self._view.rate_hz
        t = (first - self._origin) / rate_hz
        before, then = self._lost_told
        if self._lost > before and t - then > _INSIDE_S:
            self._lost_told = self._lost, t
            why = f"{self._lost - before} samples lost"
            self._feed.tell("alarm", {"t": round(t, 4), "what": "lost", "why": why})
        for j, (k, role, line) in enumerate(self._limits):
            values, at = seen[k], line["at"]
            past = values.max() > at if at > 0 else values.min() < at
            if past and t - self._beyond.get(j, -np.inf) > _INSIDE_S:
                i = int(np.argmax(values > at if at > 0 else values < at))
                why = f"{role} passed {at:.4g} {self._view.units[role]}: {line['words']}"
                self._feed.tell("alarm", {"t": round(t + i / rate_hz, 4), "what": "limit", "why": why})
            if past:
                self._beyond[j] = t

    def _seen(self, rows: Array) -> Array:
        """Return rows of the device as signals, (n_channels, n_samples), of four bytes each: enough for eyes."""
        try:
            values = self._view.block(Block(first=0, time_s=0.0, values=rows)).values
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


WINDOWS: Mapping[str, tuple[tuple[float, ...], float]] = {
    "Hann": ((0.5, 0.5), 1.5),
    "flat top": ((0.21557895, 0.41663158, 0.277263158, 0.083578947, 0.006947368), 3.77),
}
"""Cosine terms of each window, and its noise bandwidth in lines. A sine between two lines comes out up to 15 % low with
Hann's, 0.1 % with the flat top: D'Antona, Ferrero (2006), Digital Signal Processing for Measurement Systems."""


@lru_cache(maxsize=2)
def window(n: int, weights: str = "Hann") -> Array:
    """Return a window (n,) over whole periods."""
    phase = 2.0 * np.pi * np.arange(n) / n
    terms = np.array([(-1) ** k * a * np.cos(k * phase) for k, a in enumerate(WINDOWS[weights][0])])
    shape = np.asarray(terms.sum(axis=0))
    shape.flags.writeable = False  # it is kept for all who ask
    return shape


def spectrum(
    signals: Array, rate_hz: float, *, lines: int = _LINES, band: tuple[float, float] | None = None,
    weights: str = "Hann",
) -> tuple[Array, list[Array]]:  # fmt: skip
    """Return about as many `lines`, Hz, inside a `band`, and the largest amplitude of each signal near each of them.

    Amplitudes are peak values of a sine at the frequency; `signals`: (n_signals, n_samples).
    """
    n = signals.shape[1]
    shape = window(n, weights).astype(signals.dtype)
    found = np.abs(np.fft.rfft((signals - signals.mean(axis=1, keepdims=True)) * shape)) * (2.0 / shape.sum())
    first, last = (1.0, found.shape[1] - 1.0) if band is None else np.clip(np.array(band) * n / rate_hz, 1.0, n // 2)
    edges = np.unique(np.round(np.geomspace(first, max(last, first + 1.0) + 1.0, lines)).astype(int))
    edges = edges[edges <= found.shape[1]]
    share = (found / np.maximum(found.max(axis=1, keepdims=True), np.finfo(float).tiny)).max(axis=0)
    top = [a + int(np.argmax(share[a:b])) for a, b in pairwise(edges.tolist())]
    return np.array(top) * (rate_hz / n), list(np.maximum.reduceat(found[:, : edges[-1]], edges[:-1], axis=1))


def rounded(values: Array, digits: int = 5) -> list[float | None]:
    """Return numbers to some digits for JSON; None where not finite."""
    x = np.asarray(values, dtype=float)
    with np.errstate(all="ignore"):
        places = digits - 1 - np.floor(np.log10(np.maximum(np.abs(x), _TINY)))
        size = 10.0 ** np.abs(places)
        x = np.where(places < 0, np.round(x / size) * size, np.round(x * size) / size)
    return [v if np.isfinite(v) else None for v in x.tolist()]


def throttled(every_s: float, tell: Callable[..., object]) -> Callable[..., object]:
    """Call `tell` at most every so many seconds of this machine's clock."""
    last = [float("-inf")]

    def told(*args: object) -> None:
        now = time.perf_counter()
        if now - last[0] >= every_s:
            last[0] = now
            tell(*args)

    return told
