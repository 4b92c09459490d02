"""A track as it is written and looked at: one line per reporting interval, schema ``ambid.track/1`` (contracts.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

State = Literal["tracking", "frozen", "changed", "hold"]
EventKind = Literal[
    "change", "rejected", "accepted", "refused", "reverted", "frozen", "thawed", "operator", "disturbed", "excluded",
    "restored",
]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedValue:
    """One parameter at one time, as accepted."""

    value: float  # SI
    sd: float
    stale: bool = False  # whether it is frozen for want of information: the value is the last that data showed


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened or was decided, with its reason.

    Attributes
    ----------
    kind : str
        ``change`` (a parameter moved), ``disturbed`` (offset, noise or something unexplained changed), ``rejected``
        (samples were not used), ``accepted`` and ``refused`` (a candidate passed its validation or not), ``reverted``,
        ``frozen`` and ``thawed`` (information went and came), ``operator`` (a flag was set), ``excluded`` and
        ``restored`` (a sensor is not used any more, is used again; `parameter` is its name).
    t : float
        When it happened, s of record; for a change the estimated onset.
    why : str
        One line for people.
    parameter : str or None
    samples : int or None
        How many were rejected.
    values : Mapping[str, float]
        Numbers behind the decision.
    """

    kind: EventKind
    t: float
    why: str
    parameter: str | None = None
    samples: int | None = None
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackHeader:
    """First line of a track."""

    rate_hz: float
    limit: float  # of `TrackLine.error`
    method: str
    model: str
    units: Mapping[str, str]  # SI unit of each tracked parameter
    every_s: float  # reporting interval, s
    start: Mapping[str, TrackedValue]  # parameters with which tracking began
    # ``file``, ``sha256``, ``samples``
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    # what to mistrust of the start, one line each: checks that failed, parameters hardly known
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackLine:
    """One reporting interval.

    Attributes
    ----------
    t : float
        Its end, s of record.
    parameters : Mapping[str, TrackedValue]
    error : float
        Root mean square of the normalised innovations: 1 where the model predicts as well as when it was identified,
        NaN where no recent data say.
    state : {"tracking", "frozen", "changed", "hold"}
    events : tuple of Event
        In the order in which they happened; the most important first.
    extra : Mapping[str, TrackedValue]
        Tracked numbers beside the parameters, such as unbalance amplitude and phase.
    """

    t: float
    parameters: Mapping[str, TrackedValue]
    error: float
    state: State
    events: tuple[Event, ...] = ()
    extra: Mapping[str, TrackedValue] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """How long blocks waited and were worked on, s."""

    median: float  # from the arrival of a block to the end of its work
    p99: float
    largest: float
    overruns: int  # blocks that were lost because the ring was full
    late: int  # blocks whose work ended after the next one had come


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSummary:
    """Last line of a track."""

    samples: int
    seconds_of_record: float
    computing_s: float
    updates: int  # times that the published parameters moved
    rejected_samples: int
    changes: tuple[Event, ...]  # of kind ``change``
    counts: Mapping[str, int]  # how many events of each kind there were
    latency: Latency | None = None
    complete: bool = True  # false where the run was stopped, or its file ends before the summary
    # computing time of the slowest search for a new value after a change, s; 0 where there was none
    update_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """A whole track, as kept for a figure or read back from a file.

    Attributes
    ----------
    header : TrackHeader
    lines : tuple of TrackLine
    summary : TrackSummary
    """

    header: TrackHeader
    lines: tuple[TrackLine, ...]
    summary: TrackSummary
