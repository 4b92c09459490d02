"""Many frames of samples to arrays at once, 16-bit tick numbers unwrapped, every gap counted. A jump is believed once
the next sample goes on from it: a damaged frame with a CRC right by chance (1 in 65536) would else look like a gap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.protocol import StreamColumn, table
from ambid.errors import DeviceError

_WRAP = 1 << 16  # ticks in a sample
_STATUS_WRAP = 1 << 32  # ticks in a status
_LEAK = 0.02  # how much slower than said the controller's clock may be, with much to spare


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Samples:
    """Samples in the order of their ticks."""

    ticks: NDArray[np.int64]  # (n_samples,), numbers of the ticks since start, strictly increasing
    states: NDArray[np.uint8]  # (n_samples,), values of enum ``state``
    causes: NDArray[np.uint8]  # (n_samples,), values of enum ``cause``
    values: NDArray[np.float64]  # (n_samples, n_columns), counts, in the order of the stream mask's bits
    # for each gap that ends in these samples: the number of the first sample that is missing, and how many are
    gaps: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.ticks)

    def runs(self) -> list[slice]:
        """Return the longest pieces without a gap, in their order."""
        if not len(self.ticks):
            return []
        cuts = (np.flatnonzero(np.diff(self.ticks) != 1) + 1).tolist()
        return [slice(a, b) for a, b in zip([0, *cuts], [*cuts, len(self.ticks)], strict=True)]


@dataclass(slots=True, kw_only=True)
class SampleCounters:
    """What became of the frames of samples, since the decoder was made."""

    samples: int = 0  # given out
    lost: int = 0  # ticks of which no sample was given out, between the first expected and the last given out
    gaps: int = 0  # runs of such ticks
    damaged: int = 0  # frames of samples whose length is not that of the stream, or whose state or cause does not exist
    misnumbered: int = 0  # frames whose number jumped and the next one did not go on from it: dropped
    repeated: int = 0  # frames with the number of the one before: dropped


def columns_of(mask: int) -> tuple[StreamColumn, ...]:
    """Return what a sample carries for a stream mask (``stream`` of ``configure``), in the order of its values."""
    stream = table().stream
    if mask < 0 or mask >> len(stream):
        raise DeviceError(f"stream mask {mask:#x} has unknown bits. Give bits 0 to {len(stream) - 1} only")
    return tuple(c for c in stream if mask >> c.bit & 1)


class SampleDecoder:
    """Turns frames of samples, by the configured stream mask, into arrays."""

    def __init__(self, mask: int, *, rate_hz: float | None = None) -> None:
        self._columns = columns_of(mask)
        self._layout = np.dtype(
            [("code", "u1"), ("tick", "<u2"), ("state", "u1"), ("values", "<u2", (len(self._columns),))]
        )
        self._code = table().messages["sample"].code
        self._signed = [j for j, column in enumerate(self._columns) if column.kind == "i16"]
        self._known = np.zeros(256, dtype=bool)
        for state in table().enums["state"]:
            for cause in table().enums["cause"]:
                self._known[state.value | cause.value << 4] = True
        self._rate = rate_hz or math.nan
        self.counters = SampleCounters()
        self._held = b""  # one sample whose number jumped, until the next one speaks for it
        self._held_s: float | None = None  # and when it arrived
        self.restart()

    @property
    def next_tick(self) -> int | None:
        """Number of the sample that is expected next; None before the first one of a stream joined on its way."""
        return None if self._last is None else self._last + 1

    def restart(self, first: int | None = 0) -> None:
        """Expect a new stream from number `first` on (None: any, joined on its way); counts stay, a held sample is
        misnumbered.
        """
        self._last = None if first is None else first - 1
        self.counters.misnumbered += bool(self._held)
        self._held = b""
        self._zero_s = math.inf  # earliest time, by the host's clock, that tick 0 can have had
        self._zero_at = 0.0

    def decode(self, payloads: Iterable[bytes], arrived_s: float | None = None) -> Samples:
        """Take the next sound frames of samples, in order; the result may be empty. A last sample whose number jumped
        comes with the next call, or with `finish`.
        """
        return self._take(payloads, arrived_s, final=False)

    def finish(self, ticks: int | None = None) -> Samples:
        """Give out what was held back at the end of a stream: one sample or none."""
        rest = self._take((), self._held_s, final=True)
        if ticks is None or self._last is None:
            return rest
        missing = (ticks - 1 - self._last) % _STATUS_WRAP
        if not 0 < missing < _STATUS_WRAP // 2:
            return rest
        gap = (self._last + 1, missing)
        self.counters.lost += missing
        self.counters.gaps += 1
        self._last += missing
        return replace(rest, gaps=(*rest.gaps, gap))

    def _take(self, payloads: Iterable[bytes], arrived_s: float | None, *, final: bool) -> Samples:
        raw = self._stack(payloads)
        if len(raw):
            raw = raw[self._sound(raw)]
        if self._held:
            raw = np.concatenate([np.frombuffer(self._held, dtype=self._layout), raw])
            self._held = b""
        numbers, gaps = self._number(raw, arrived_s, final=final)
        keep = numbers >= 0
        if not keep.all():
            raw, numbers = raw[keep], numbers[keep]
        self.counters.samples += len(raw)
        if len(raw):
            self._note_time(arrived_s)
        values = raw["values"].astype(np.float64)
        for j in self._signed:
            values[:, j] = raw["values"][:, j].astype(np.int16)
        states = raw["state"].astype(np.uint8)
        return Samples(
            ticks=numbers, states=states & np.uint8(15), causes=states >> np.uint8(4), values=values, gaps=tuple(gaps)
        )

    def _stack(self, payloads: Iterable[bytes]) -> NDArray[np.void]:
        size = self._layout.itemsize
        frames = list(payloads)
        sound = [p for p in frames if len(p) == size and p[0] == self._code]
        self.counters.damaged += len(frames) - len(sound)
        return np.frombuffer(b"".join(sound), dtype=self._layout)

    def _sound(self, raw: NDArray[np.void]) -> NDArray[np.bool_]:
        sound: NDArray[np.bool_] = self._known[raw["state"]]
        self.counters.damaged += len(raw) - int(np.count_nonzero(sound))
        return sound

    def _number(
        self, raw: NDArray[np.void], arrived_s: float | None, *, final: bool
    ) -> tuple[NDArray[np.int64], list[tuple[int, int]]]:
        """Return the number of each sample, -1 for those that are dropped or held, and the gaps."""
        ticks = raw["tick"].astype(np.int64)
        numbers = np.full(len(ticks), -1, dtype=np.int64)
        gaps: list[tuple[int, int]] = []
        if not len(ticks):
            return numbers, gaps
        cuts = [0, *(np.flatnonzero(np.diff(ticks) % _WRAP != 1) + 1).tolist(), len(ticks)]
        for begin, end in pairwise(cuts):  # of each piece the ticks follow one another
            tick = int(ticks[begin])
            last = tick - 1 if self._last is None else self._last
            short = (tick - last) % _WRAP
            step = short if short == 1 else short + _WRAP * self._wraps(last + short, arrived_s)
            if step == 0:
                self.counters.repeated += 1
                begin, step = begin + 1, 1
            elif step > 1 and end - begin == 1 and not (final and end == len(ticks)):
                if end == len(ticks):
                    self._held, self._held_s = raw[begin:].tobytes(), arrived_s
                    continue
                if 0 < (int(ticks[end]) - last) % _WRAP < short:
                    self.counters.misnumbered += 1
                    continue
            if step > 1:
                gaps.append((last + 1, step - 1))
                self.counters.lost += step - 1
                self.counters.gaps += 1
            numbers[begin:end] = last + step + np.arange(end - begin)
            self._last = last + step + end - begin - 1
        return numbers, gaps

    def _wraps(self, at_least: int, arrived_s: float | None) -> int:
        """Return how often 65536 ticks went by unseen, if the time says so. A sample can be late but never early: time
        counts from the earliest start that all so far allow, so that a host that slept does not take a full buffer for
        a gap.
        """
        if arrived_s is None or not math.isfinite(self._zero_s + self._rate):
            return 0
        newest = (arrived_s - self._zero_s) * self._rate
        return max(0, round((newest - at_least) / _WRAP))

    def _note_time(self, arrived_s: float | None) -> None:
        if arrived_s is None or self._last is None or not math.isfinite(self._rate):
            return
        zero = arrived_s - self._last / self._rate
        self._zero_s = min(zero, self._zero_s + _LEAK * (arrived_s - self._zero_at))
        self._zero_at = arrived_s
