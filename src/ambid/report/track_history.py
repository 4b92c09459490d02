"""A track as columns of numbers: what a figure needs of it, in a tenth of the memory of its lines."""

from __future__ import annotations

from array import array
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.recursive.lines import Event, Track, TrackedValue, TrackHeader, TrackLine

STATES = ("tracking", "changed", "hold", "frozen")


class TrackHistory:
    """A track that is added to line by line."""

    def __init__(self, header: TrackHeader) -> None:
        """Begin before the first line."""
        self.header = header
        self.events: list[Event] = []
        self._t, self._error, self._state = array("d"), array("d"), array("b")
        self._columns: dict[str, tuple[array[float], array[float], array[int]]] = {}

    @classmethod
    def of(cls, track: Track) -> Self:
        """Take over a whole track."""
        history = cls(track.header)
        for line in track.lines:
            history.add(line)
        return history

    def add(self, line: TrackLine) -> None:
        """Add one line.

        `line`: numbers of `extra` stand behind the parameters; before their first line they are NaN.
        """
        self._t.append(line.t)
        self._error.append(line.error)
        self._state.append(STATES.index(line.state))
        self.events += line.events
        for name, value in line.parameters.items():
            self._put(name, value)
        for name, value in line.extra.items():
            self._put(name, value)

    def _put(self, name: str, v: TrackedValue) -> None:
        column = self._columns.get(name)
        if column is None:
            column = self._columns[name] = (array("d"), array("d"), array("b"))
        value, sd, stale = column
        missing = len(self._t) - 1 - len(value)
        if missing:
            value.extend([np.nan] * missing)
            sd.extend([np.nan] * missing)
            stale.extend([0] * missing)
        value.append(v.value)
        sd.append(v.sd)
        stale.append(v.stale)

    @property
    def n_lines(self) -> int:
        """Number of lines."""
        return len(self._t)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters, then what was tracked beside them."""
        return tuple(self._columns)

    @property
    def t(self) -> Array:
        """End of each reporting interval, shape (n_lines,), s of record."""
        return np.array(self._t)

    @property
    def error(self) -> Array:
        """Model error, shape (n_lines,), 1 where the model predicts as well as when it was identified."""
        return np.array(self._error)

    @property
    def state(self) -> NDArray[np.int8]:
        """Place in `STATES`, shape (n_lines,)."""
        return np.array(self._state)

    def values(self, name: str) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return one track.

        `name`: one of `names`. Returns `value, sd`: (n_lines,), SI, naN where it was not given; `stale`: (n_lines,),
        whether it was frozen for want of information.
        """
        value, sd, stale = self._columns[name]
        missing = self.n_lines - len(value)
        rest = np.full(missing, np.nan)
        frozen = np.concatenate([np.array(stale, dtype=bool), np.zeros(missing, dtype=bool)])
        return np.concatenate([value, rest]), np.concatenate([sd, rest]), frozen
