"""The record: uniformly sampled channels in SI units, with the history of what was done to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One line of a record's history.

    Attributes
    ----------
    name : str
        What was done, e.g. ``"lowpass"``.
    settings : Mapping[str, object]
        Its settings as JSON-able values, e.g. ``{"cutoff_hz": 500.0}``.
    """

    name: str
    settings: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        inside = ", ".join(f"{k}={v}" for k, v in self.settings.items())
        return f"{self.name}({inside})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channel:
    """One measured or simulated quantity.

    Attributes
    ----------
    name : str
        Column name in the file, or role (``voltage``, ``current``, ``position``) once a rig has named it.
    unit : str
        SI unit of `values`, e.g. ``"V"``; ``"1"`` for a plain number.
    values : ndarray, shape (n_samples,), float64, in `unit`
        Read-only.
    source_unit : str
        Unit the values had in the file, before conversion to SI.
    """

    name: str
    unit: str
    values: Array
    source_unit: str = ""

    def __post_init__(self) -> None:
        if np.iscomplexobj(self.values):
            raise RecordError(
                f"channel {self.name!r} holds complex numbers; a measured channel is real. Pass real part and imaginary"
                " part as two channels"
            )
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if values.ndim != 1:
            raise RecordError(
                f"channel {self.name!r} has shape {values.shape}; a channel is one column (n_samples,). Pass one column"
            )
        if values.flags.writeable:
            values = values.copy() if values is self.values else values
            values.flags.writeable = False
        object.__setattr__(self, "values", values)
        if not self.source_unit:
            object.__setattr__(self, "source_unit", self.unit)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Record:
    """Uniformly sampled channels in SI units. Never changed in place: each step returns a new record.

    Attributes
    ----------
    rate_hz : float
        Sampling rate in Hz.
    channels : tuple of Channel
        All of the same length, with distinct names, in file order.
    start_s : float
        Time of the first sample in s.
    history : tuple of Step
        What was done to the record since it was measured, oldest first.
    provenance : Mapping[str, str]
        Where it came from: ``file`` (name only), ``sha256`` (of the file's bytes), ``simulator`` and the like.
    """

    rate_hz: float
    channels: tuple[Channel, ...]
    start_s: float = 0.0
    history: tuple[Step, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise RecordError(
                f"the sampling rate is {self.rate_hz}; it must be a positive number of Hz. Correct --rate"
            )
        if not self.channels:
            raise RecordError("the record has no channels; it needs at least one. Check the file's columns")
        names = [c.name for c in self.channels]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise RecordError(f"channel {twice[0]!r} stands twice in the record; names must differ. Rename one column")
        lengths = {c.values.size for c in self.channels}
        if len(lengths) > 1:
            listing = ", ".join(f"{c.name} {c.values.size}" for c in self.channels)
            raise RecordError(f"channels differ in length ({listing}); all must have the same. Cut or resample them")

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel."""
        return int(self.channels[0].values.size)

    @property
    def duration_s(self) -> float:
        """Length in s, ``n_samples / rate_hz``."""
        return self.n_samples / self.rate_hz

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in order."""
        return tuple(c.name for c in self.channels)

    @property
    def time_s(self) -> Array:
        """Sampling instants in s, shape (n_samples,)."""
        return self.start_s + np.arange(self.n_samples) / self.rate_hz

    def channel(self, name: str) -> Channel:
        """Return the channel called `name`.

        Raises
        ------
        RecordError
            If there is none; the message lists those there are.
        """
        for c in self.channels:
            if c.name == name:
                return c
        raise RecordError(f"the record has no channel {name!r}; it has {', '.join(self.names)}. Check the name")

    def __getitem__(self, name: str) -> Array:
        return self.channel(name).values

    def with_step(self, step: Step, **changes: object) -> Record:
        """Return a copy with `changes` made and `step` added to its history."""
        return replace(self, history=(*self.history, step), **changes)  # type: ignore[arg-type]
