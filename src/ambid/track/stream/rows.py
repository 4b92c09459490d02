"""Samples that must not be used although they came in order: not a number, absurd, saturated, or of a frozen channel.

A frozen channel repeats its last value. It is noticed where a channel that normally moves holds one value much longer
than it ever did; the rows of such a run are refused from the first repetition on, so a run that has not been decided
at the end of a block is held back until the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.track.stream.outcome import RowKind

Mask = NDArray[np.bool_]
Stuck = Literal["auto"] | None | int | Sequence[int | Literal["auto"] | None]

ABSURD = 1e15  # no quantity of a bearing in SI units is that large; squares stay far from overflow
_NORMAL_RUN = 20  # a channel with longer runs in normal work (coarse steps, a set point) is not watched
_LEARN = 2000  # samples of normal work before a channel is watched
_SHORTEST = 16  # repetitions below this are never called frozen
_FACTOR = 4  # a frozen run is that many times longer than the longest normal one
_NEVER = np.iinfo(np.int64).max


class RowCheck:
    """Judges rows in the order of their numbers, remembering what each channel last held and how long.

    `limits`: (n_channels,), or float, largest credible magnitude of each channel, SI; `saturation`: (n_channels, 2).
    """

    def __init__(
        self,
        n_channels: int,
        *,
        limits: ArrayLike | None = None,
        saturation: ArrayLike | None = None,
        stuck: Stuck = "auto",
    ) -> None:
        if n_channels < 1:
            raise EstimationError(f"the stream has {n_channels} channels; it needs at least one. Correct n_channels")
        self._limits = np.full(n_channels, ABSURD) if limits is None else _per_channel(limits, n_channels, "limits")
        self._widest = float(self._limits.min())
        self._rails = None if saturation is None else _rails(saturation, n_channels)
        self._learns = np.zeros(n_channels, dtype=bool)
        self._threshold = np.full(n_channels, _NEVER, dtype=np.int64)
        self._set_stuck(stuck, n_channels)
        self._watches = bool(self._learns.any() or (self._threshold < _NEVER).any())
        self._usual = np.ones(n_channels, dtype=np.int64)  # longest run in normal work
        self._moving = np.zeros(n_channels, dtype=np.int64)  # samples of normal work
        self._last = np.full(n_channels, np.nan)
        self._run = np.zeros(n_channels, dtype=np.int64)

    def _set_stuck(self, stuck: Stuck, n_channels: int) -> None:
        if stuck is None:
            return
        if stuck == "auto":
            self._learns[:] = True
            return
        each = [stuck] * n_channels if isinstance(stuck, int) else list(stuck)
        wrong = any(n != "auto" if isinstance(n, str) else n is not None and n < 2 for n in each)
        if isinstance(stuck, str) or len(each) != n_channels or wrong:
            raise EstimationError(
                f"stuck = {stuck!r} does not fit {n_channels} channels; it must be 'auto', None or a run of at least"
                " 2 samples, for all or for each. Correct stuck"
            )
        self._learns[:] = [n == "auto" for n in each]
        self._threshold[:] = [n if isinstance(n, int) else _NEVER for n in each]

    def judge(self, values: Array, *, last: bool = False) -> tuple[dict[RowKind, Mask], int]:
        """Say which rows must not be used, and how many at the end are not decided yet.

        `values`: (n_samples, n_channels), follows on the rows that were decided before. Returns (n_samples,), rows
        refused, by kind; a kind without any is not there, and no row is in two kinds; rows at the end that have to be
        given again, before the next ones.
        """
        found = self.unsound(values)
        if not self._watches:
            return found, 0
        stuck, held = self._frozen(self._filled(values) if "nan" in found else values, last)
        if stuck is not None:
            _add(found, "stuck", stuck[:, None])
        return found, held

    def unsound(self, values: Array) -> dict[RowKind, Mask]:
        """Say which rows must not be used by their own values alone.

        `values`: (n_samples, n_channels). Returns (n_samples,), as `judge` gives it.
        """
        found: dict[RowKind, Mask] = {}
        # The peak is NaN if anything is: one comparison tells that all is well.
        if not np.abs(values).max() <= self._widest:
            _add(found, "nan", ~np.isfinite(values))
            _add(found, "range", np.abs(values) > self._limits)
        if self._rails is not None:
            _add(found, "saturated", (values <= self._rails[:, 0]) | (values >= self._rails[:, 1]))
        return found

    def _filled(self, values: Array) -> Array:
        """Return the values with each one that is no number replaced by the one before: no frozen run ends there."""
        known = np.isfinite(values)
        at = np.maximum.accumulate(np.where(known, np.arange(values.shape[0])[:, None], -1), axis=0)
        return np.where(at >= 0, np.take_along_axis(values, np.maximum(at, 0), axis=0), self._last)

    def _frozen(self, values: Array, last: bool) -> tuple[Mask | None, int]:
        """Return the rows of frozen runs (None without any) and the undecided rows; learn normal runs."""
        n = values.shape[0]
        same = np.empty(values.shape, dtype=bool)
        np.equal(values[0], self._last, out=same[0])
        np.equal(values[1:], values[:-1], out=same[1:])
        if not same.any():
            self._learn_all(np.maximum(self._run, 1), n)
            self._last[:], self._run[:] = values[-1], 1
            return None, 0
        stuck = np.zeros(n, dtype=bool)
        lengths = np.empty(values.shape, dtype=np.int64)
        held = 0
        for j in range(values.shape[1]):
            trailing = self._channel(j, same[:, j], lengths[:, j], stuck)
            held = max(held, 0 if last else trailing)
        decided = n - held
        if decided:
            self._last[:], self._run[:] = values[decided - 1], lengths[decided - 1]
        return (stuck if stuck.any() else None), held

    def _channel(self, j: int, same: Mask, lengths: NDArray[np.int64], stuck: Mask) -> int:
        """Fill in the running length of each row's run, mark frozen rows, and return the undecided ones at the end."""
        n = same.size
        rows = np.arange(n)
        change = np.where(same, -1, rows)
        start = np.maximum.accumulate(change)  # -1 while the run of the rows before goes on
        lengths[:] = np.where(start < 0, self._run[j] + rows + 1, rows - start + 1)
        ends = np.flatnonzero(~np.append(same[1:], False))  # the last one may go on in the next block
        total = lengths[ends]
        frozen = total >= self._threshold[j]
        if frozen.any():
            size = np.diff(np.concatenate([[-1], ends]))
            stuck |= np.repeat(frozen, size) & same
        if self._learns[j]:
            self._learn(j, total[:-1], n, int(total[-1]))
        undecided = bool(same[-1]) and not frozen[-1] and self._threshold[j] < _NEVER
        return n - 1 - int(start[-1]) if undecided else 0

    def _learn(self, j: int, finished: NDArray[np.int64], n: int, going: int) -> None:
        """Learn from runs of one channel that ended, and from the one that goes on."""
        below = finished[finished < self._threshold[j]]
        longest = max(int(below.max(initial=1)), int(self._usual[j]))
        if self._threshold[j] == _NEVER and max(longest, going) > _NORMAL_RUN:
            self._usual[j], self._moving[j] = 1, 0
            return
        self._usual[j] = min(longest, _NORMAL_RUN)
        self._moving[j] += n
        if self._moving[j] >= _LEARN:
            self._threshold[j] = max(_SHORTEST, _FACTOR * self._usual[j])

    def _learn_all(self, ended: NDArray[np.int64], n: int) -> None:
        """Learn from a block without any repetition: at most the runs before it ended."""
        if (self._learns & (self._moving < _LEARN)).any() or (ended > self._usual).any():
            for j in np.flatnonzero(self._learns):
                self._learn(int(j), ended[j : j + 1], n, 1)


def _add(found: dict[RowKind, Mask], kind: RowKind, cells: Mask) -> None:
    """Add the rows that hold such a cell and are of no other kind yet."""
    rows = np.asarray(cells.any(axis=1))
    for before in found.values():
        rows &= ~before
    if rows.any():
        found[kind] = rows


def _per_channel(limits: ArrayLike, n_channels: int, name: str) -> Array:
    try:
        each = np.array(np.broadcast_to(np.asarray(limits, dtype=np.float64), (n_channels,)))
    except ValueError:
        each = np.array([np.nan])
    if not (each > 0).all():
        raise EstimationError(f"{name} does not hold a positive number for each of {n_channels} channels. Correct it")
    return np.minimum(each, np.finfo(np.float64).max)


def _rails(saturation: ArrayLike, n_channels: int) -> Array:
    rails = np.asarray(saturation, dtype=np.float64)
    if rails.shape != (n_channels, 2) or (rails[:, 0] >= rails[:, 1]).any():
        raise EstimationError(
            f"saturation has shape {rails.shape}; it must hold a lower and a higher rail for each of {n_channels}"
            " channels. Correct it"
        )
    out = rails.copy()
    out[np.isnan(out[:, 0]), 0] = -np.inf
    out[np.isnan(out[:, 1]), 1] = np.inf
    return out
