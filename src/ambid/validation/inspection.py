"""What a record holds, and what stands against using it, file schema ``ambid.inspection/1``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ambid.errors import AmbidError, RecordError, nearest
from ambid.estimation.result import Reason, Result
from ambid.record import Channel, Record
from ambid.rig.roles import Candidate
from ambid.settings.caller import setting
from ambid.signals import find_dropouts, find_outliers, find_saturation, persistent_excitation, resolution, snr
from ambid.units import UNKNOWN
from ambid.validation.facts import facts

SCHEMA = "ambid.inspection/1"
_ORDER = 20  # of persistent excitation: far above what a plant of three states needs
_LONGEST = 100_000  # samples from which the order of excitation is told
_REMEDIES: tuple[tuple[str, Callable[[Record, str], Any], str], ...] = (
    ("saturation", find_saturation, "Excite less, or widen the range"),
    ("drop-outs", find_dropouts, "Look at cable and sensor, or leave these samples out"),
    ("outliers", find_outliers, "Look at the line; {gaps} and {from_s} leave samples out"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelLook:
    """One channel of a record, in its unit."""

    name: str
    unit: str
    source_unit: str  # as the file names it
    least: float
    most: float
    mean: float
    sd: float
    step: float | None  # of the converter; None where none is seen
    snr: str  # signal over noise in words


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Inspection(Result):
    """What a record holds."""

    record: Mapping[str, object]  # ``file``, ``samples``, ``rate_hz``, ``start_s``, ``history``
    channels: tuple[ChannelLook, ...]
    faults: tuple[Reason, ...]
    roles: Mapping[str, tuple[str, ...]]  # role -> columns that are likely it, best first, each with the reason
    notes: tuple[str, ...]  # how the noise was told, and how rich the inputs are

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The faults of the channels."""
        return self.faults

    def __getitem__(self, name: str) -> ChannelLook:
        channel = next((c for c in self.channels if c.name == name), None)
        if channel is None:
            names = [c.name for c in self.channels]
            raise RecordError(
                f"the record has no channel {name!r}; it has {', '.join(names)}.{nearest(name, names)} Check the name"
            )
        return channel


class Guess(Protocol):
    """What columns are taken for, as `ambid.job.drafting.guess` tells."""

    @property
    def ranked(self) -> Mapping[str, Sequence[Candidate]]:
        """Columns by role."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Time and units that the record does not say, and what cannot be told."""


def inspect(record: Record, *, inputs: Sequence[str] = (), guess: Guess | None = None) -> Inspection:
    """Look through a record; `inputs`: those of a rig, through which it was read; `guess`: what its columns may be."""
    method = f"the part that 20 lags of the channel{' and of ' + ', '.join(inputs) if inputs else ''} do not predict"
    notes = [f"SNR: noise is {method}{'' if inputs else '; without a rig a lower bound'}"]
    notes += [_excitation(record, name) for name in inputs or record.names]
    ranked = {} if guess is None else guess.ranked
    notes += () if guess is None else guess.notes
    known = facts(record) if {"voltage", "current", "position"} <= set(record.names) else {}
    notes += [c.detail for name, c in known.items() if c.passed and name in ("ohm", "belonging", "weight")]
    against = [
        Reason(check=k, text=c.detail, grave=bool(inputs), cause=c.cause) for k, c in known.items() if not c.passed
    ]
    about = {
        "file": record.provenance.get("file"), "samples": record.n_samples, "rate_hz": record.rate_hz,
        "start_s": record.start_s, "history": [str(step) for step in record.history],
    }  # fmt: skip
    return Inspection(
        used=record,
        record=about,
        channels=tuple(_look(record, c, inputs) for c in record.channels),
        faults=(*against, *(fault for c in record.channels for fault in _faults(record, c, grave=bool(inputs)))),
        roles={
            role: tuple(f"{x.channel.name} (score {x.score:.2f}), because {x.why}" for x in candidates)
            for role, candidates in ranked.items()
        },
        notes=tuple(notes),
    )


def _look(record: Record, c: Channel, inputs: Sequence[str]) -> ChannelLook:
    x, steps = c.values, resolution(record, c.name)
    return ChannelLook(
        name=c.name, unit=c.unit, source_unit=c.source_unit, least=float(x.min()), most=float(x.max()),
        mean=float(x.mean()), sd=float(x.std()), step=steps.step if steps.quantised and steps.step > 0 else None,
        snr=_ratio(record, c, inputs),
    )  # fmt: skip


def _ratio(record: Record, c: Channel, inputs: Sequence[str]) -> str:
    if not np.ptp(c.values) > 0:
        return "–"
    driving = [] if c.name in inputs else [name for name in inputs if np.ptp(record[name].values) > 0]
    try:
        ratio = snr(record, c.name, inputs=driving)
    except AmbidError:
        return "too short"
    return f"{ratio.db:.1f} dB" if np.isfinite(ratio.db) else "no signal" if ratio.db < 0 else "no noise"


def _faults(record: Record, c: Channel, *, grave: bool) -> list[Reason]:
    """What is wrong with a channel; one that stands still is `grave` where the rig names it."""
    faults = []
    if c.unit == UNKNOWN:
        text = f"{c.name}: unknown unit [{c.source_unit}]; a rig can declare it"
        faults.append(Reason(check="unit", text=text))
    for check, look, remedy in _REMEDIES:
        try:
            look_result = look(record, c.name)
        except AmbidError:
            continue
        if look_result.count:
            advice = remedy.format(gaps=setting("gaps"), from_s=setting("from_s"))
            still = not np.ptp(c.values) > 0
            faults.append(Reason(check=check, text=f"{look_result}. {advice}", grave=still and grave))
    return faults


def _excitation(record: Record, name: str) -> str:
    """Order of persistent excitation above the channel's own noise, and the band that holds its power."""
    u = record[name].values[:_LONGEST]
    centred = u - u.mean()
    power = np.cumsum(np.abs(np.fft.rfft(centred)) ** 2)
    if not power[-1] > 0:
        return f"{name}: constant, no excitation"
    edges = (np.searchsorted(power, part * power[-1]) * record.rate_hz / u.size for part in (0.005, 0.995))
    low, high = (f"{float(f'{edge:.3g}'):g} Hz" for edge in edges)
    band = f"99 % of its power between {low} and {high}"
    try:
        order = persistent_excitation(u, _ORDER, tolerance=1e-6)
    except AmbidError:
        return f"{name}: {band}"
    return f"{name}: {order}; {band}"
