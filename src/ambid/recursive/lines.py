"""A track as it is written and looked at: one line per reporting interval, schema ``ambid.track/1`` (contracts.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, TypedDict

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, choices
from ambid.estimation.result import Reason, Result, interval_95
from ambid.physics.linear_model import model_names
from ambid.settings.caller import setting

RECENT_S, _OFTEN = 2.0, 3  # end of a record in which so many disturbances and changes leave no value to be trusted
_VAGUE = 0.25  # relative standard deviation above which data do not show a parameter

State = Literal["tracking", "frozen", "changed", "hold"]
EventKind = Literal[
    "change", "rejected", "accepted", "refused", "reverted", "frozen", "thawed", "operator", "disturbed",
]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedValue:
    """One parameter at one time, as accepted."""

    value: float  # SI
    sd: float
    stale: bool = False  # whether it is frozen for want of information: the value is the last that data showed


def is_vague(v: TrackedValue) -> bool:
    """Whether data do not show a parameter: its standard deviation is above a quarter of it."""
    return v.sd > _VAGUE * abs(v.value)


_UNKNOWN = TrackedValue(value=math.nan, sd=math.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened or was decided, with its reason.

    Attributes
    ----------
    kind : str
        ``change`` (a parameter moved), ``disturbed`` (offset, noise or something unexplained changed), ``rejected``
        (samples were not used), ``accepted`` and ``refused`` (a candidate passed its validation or not), ``reverted``,
        ``frozen`` and ``thawed`` (information went and came), ``operator`` (a flag was set).
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


class StartWords(TypedDict, total=False):
    """What the header of a track says of its start, as its fields."""

    warnings: tuple[str, ...]
    grave: tuple[str, ...]
    notes: tuple[str, ...]
    scale_sd: Mapping[str, float]


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
    grave: tuple[str, ...] = ()  # and why nothing that begins with it is to be used
    notes: tuple[str, ...] = ()  # what is in no interval, one line each
    # relative standard deviation that what the rig says of calibration adds to each parameter
    scale_sd: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def sd_calibrated(self, name: str, v: TrackedValue) -> float | None:
        """Return the standard deviation of a value with calibration, None where the rig says nothing of it."""
        if name not in self.scale_sd or not math.isfinite(v.sd):
            return None
        start = self.start.get(name, v)
        at = start if is_vague(start) else v  # a number that the start did not show is no measure of its error
        return math.hypot(v.sd, self.scale_sd[name] * at.value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """What an order of an operator would put in force."""

    t: float  # when these values were accepted, or formed, s of record
    parameters: Mapping[str, TrackedValue]


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
    choices : Mapping[str, Choice]
        What ``accept`` and ``revert`` of an operator would put in force; one that would be refused is not there. Not
        written to files.
    """

    t: float
    parameters: Mapping[str, TrackedValue]
    error: float
    state: State
    events: tuple[Event, ...] = ()
    extra: Mapping[str, TrackedValue] = field(default_factory=lambda: MappingProxyType({}))
    choices: Mapping[str, Choice] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """How long blocks waited and were worked on, s."""

    median: float  # from the arrival of a block to the end of its work
    p99: float
    largest: float
    late: int  # blocks that came before the work on the one before had ended
    overruns: int = 0  # blocks of a running bench that were lost because too many waited
    # largest of the first blocks, until the work had caught up, s: the numbers above leave them out. None: it never did
    start: float | None = None


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
    # changes after which no new value of that parameter was accepted
    unanswered: tuple[Event, ...] = ()
    recurring: int = 0  # times that a disturbance or a change was noticed in the last 2 s of record


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterTrack:
    """One tracked number: its last value and interval, and how it came there."""

    name: str
    unit: str  # SI
    value: float
    sd: float
    ci95: tuple[float, float]
    sd_calibrated: float | None  # with what the rig says of calibration; None where it says nothing
    ci95_calibrated: tuple[float, float] | None
    t: Array  # (n_lines,), end of each reporting interval, s of record
    values: Array  # (n_lines,)
    sds: Array  # (n_lines,)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Track(Result):
    """A whole track, file schema ``ambid.track/1``.

    Attributes
    ----------
    header : TrackHeader
    lines : tuple of TrackLine
        The last one at least, unless the record ended before it.
    totals : TrackSummary
    """

    header: TrackHeader
    lines: tuple[TrackLine, ...]
    totals: TrackSummary

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What is wrong at its end: values that the data contradict are not to be used."""
        if not self.lines:
            text = (
                "the record ends before the first reporting interval. Use a longer one, or a shorter "
                f"{setting('every_s')}"
            )
            return (Reason(check="lines", text=text, grave=True),)
        last, header, found = self.lines[-1], self.header, list[Reason]()
        if not self.totals.samples:
            text = "no sample of the record was used: these are the values of the start. Look at its events"
            found.append(Reason(check="samples", text=text, grave=True))
        for e in self.totals.unanswered:
            who = f"of {e.parameter} " if e.parameter else ""
            text = f"the change {who}at {e.t:.4g} s was not followed by new values that passed validation"
            found.append(Reason(check="change", text=f"{text}. Track on, or identify again", grave=True))
        if last.state == "changed" and not self.totals.unanswered:
            text = "the record ends while the data contradict the published values. Track on, or identify again"
            found.append(Reason(check="change", text=text, grave=True))
        if self.totals.recurring >= _OFTEN:
            text = f"the bench was disturbed or changed {self.totals.recurring} times in the last {RECENT_S:g} s"
            found.append(Reason(check="disturbed", text=f"{text}: the values may follow that. Track on"))
        if last.error > header.limit:
            text = f"the model error at the end is {last.error:.3g}, above the limit {header.limit:g}. Identify again"
            found.append(Reason(check="error", text=text, grave=True))
        elif math.isnan(last.error):
            found.append(Reason(check="error", text="the model error at the end is unknown. Track on"))
        if last.state == "frozen":
            text = "the record ends without excitation: the parameters are frozen at an earlier time. Excite more"
            found.append(Reason(check="frozen", text=text))
        vague = [n for n, v in last.parameters.items() if self.header.model in model_names() and is_vague(v)]
        if vague:
            text = f"not identifiable: {', '.join(vague)} (sd above {_VAGUE:.0%} of the value). Excite more"
            found.append(Reason(check="identifiable", text=text))
        found += [Reason(check="start", text=text, grave=True) for text in header.grave]
        return (*found, *(Reason(check="start", text=text) for text in header.warnings))

    def __getitem__(self, name: str) -> ParameterTrack:
        names = [] if not self.lines else [*self.lines[-1].parameters, *self.lines[-1].extra]
        if name not in names:
            raise EstimationError(f"the track has no parameter {name!r}; it has {choices(name, names)} Check the name")
        kept = [(x.t, {**x.parameters, **x.extra}.get(name, _UNKNOWN)) for x in self.lines]
        last = kept[-1][1]
        sd = self.header.sd_calibrated(name, last)
        return ParameterTrack(
            name=name, unit=self.header.units.get(name, ""), value=last.value, sd=last.sd,
            ci95=interval_95(last.value, last.sd), sd_calibrated=sd,
            ci95_calibrated=None if sd is None else interval_95(last.value, sd), t=np.array([t for t, _ in kept]),
            values=np.array([v.value for _, v in kept]), sds=np.array([v.sd for _, v in kept]),
        )  # fmt: skip
