"""What all conditioning steps share: choosing channels, refusing values that are not finite, making the new record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record, Step


def chosen(record: Record, names: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the channels meant by `names` (all of them for None), each looked up."""
    if names is None:
        return record.names
    listed = (names,) if isinstance(names, str) else tuple(names)
    if not listed:
        raise RecordError("the list of channels is empty; a step works on at least one. Name a channel, or pass None")
    return tuple(record.channel(n).name for n in listed)


def finite(record: Record, name: str) -> Array:
    """Return the channel's values, refusing NaN and infinity: every filter would spread them over the record."""
    values = record[name]
    bad = ~np.isfinite(values)
    if bad.any():
        first = int(np.argmax(bad))
        raise RecordError(
            f"channel {name!r} is not finite at sample {first} ({values[first]}), {int(bad.sum())} samples in all; "
            "numbers are needed. Repair them with replace_samples, or cut them off"
        )
    return values


def mapped(record: Record, names: Sequence[str], step: Step, function: Callable[[Array], Array]) -> Record:
    """Return the record with `function` applied to the named channels, and `step` in its history."""
    channels = tuple(
        replace(c, values=function(finite(record, c.name))) if c.name in names else c for c in record.channels
    )
    return record.with_step(step, channels=channels)


def runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and lengths of the runs of True in a boolean array, shape (n_runs,) each."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]


def equal_runs(values: Array) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and lengths of the runs of exactly equal samples that make up `values`."""
    starts = np.concatenate(([0], np.flatnonzero(np.diff(values)) + 1))
    return starts, np.diff(np.concatenate((starts, [values.size])))
