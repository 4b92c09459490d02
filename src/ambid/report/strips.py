"""Signals of a page that a reader can zoom into, down to the samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.result import NORMAL_95
from ambid.record import Record
from ambid.report.numbers import prefixed
from ambid.report.picture import Arrays
from ambid.report.signal_panels import Traces, worst_stretch

CLOSE = "Each sample predicted from all samples before it. Shaded: the stretch with the largest errors."
EVERY_SAMPLE = 50_000  # samples of a record, to which a page holds all of them
_STRETCHES = 5_000  # of a longer record, extremes of as many stretches are held, and as many samples around its errors
_VALUES = 20_000  # of all strips of records of many channels
_FEWEST = 400  # stretches of a record


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """One signal; what it shows is `values` less `less`, each held once however many lines use it."""

    label: str
    color: str  # as report.css names it
    values: Array  # (n_samples,)
    less: Array | None = None
    scaled: bool = True  # whether the axis makes room for it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strip:
    """Signals over one another, on one axis."""

    title: str
    unit: str
    scale: float  # of one unit, in that of the values
    lines: Sequence[Line]
    bound: float | None = None  # within ± this, 95 % are expected, in that of the values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Strips:
    """Strips below each other, on one axis of time."""

    title: str
    time_s: Array  # (n_samples,), evenly spaced
    strips: Sequence[Strip]
    worst: tuple[int, int]  # samples of the largest errors: first, and behind the last; equal where there are none
    every_sample: int = EVERY_SAMPLE
    stretches: int = _STRETCHES

    def packed(self) -> list[dict[str, Any]]:
        """Return what the page's script draws: every sample; of long records extremes, and a stretch in full."""
        n = self.time_s.size
        if n <= self.every_sample:
            return [self._packed(0, n, 1)]
        close = self.stretches
        first = max(0, min(sum(self.worst) // 2 - close // 2, n - close))
        return [self._packed(0, n, -(-n // self.stretches)), self._packed(first, first + close, 1)]

    def _packed(self, first: int, last: int, every: int) -> dict[str, Any]:
        arrays, near = Arrays(), slice(first, last)

        def shown(line: Line) -> dict[str, Any]:
            found: dict[str, Any] = {"label": line.label, "color": line.color, "scaled": line.scaled}
            if every == 1:
                found["less"] = None if line.less is None else arrays.add(line.less[near])
                return found | {"values": arrays.add(line.values[near])}
            x, edges = line.values if line.less is None else line.values - line.less, np.arange(0, last, every)
            return found | {
                "low": arrays.add(np.fmin.reduceat(x, edges)),
                "high": arrays.add(np.fmax.reduceat(x, edges)),
            }

        strips = [
            {"title": s.title, "unit": s.unit, "scale": s.scale, "bound": s.bound, "lines": [shown(x) for x in s.lines]}
            for s in self.strips
        ]
        title, whole = self.title, (first, last) == (0, self.time_s.size)
        if not whole and self.worst[0] == self.worst[1]:
            title = f"{title or 'record'}, from {self.time_s[first]:.4g} to {self.time_s[last - 1]:.4g} s"
        step = (float(self.time_s[-1]) - float(self.time_s[0])) / max(self.time_s.size - 1, 1)
        return {
            "title": title, "start_s": float(self.time_s[first]), "step_s": step, "samples": last - first,
            "every": every, "worst": [x - first for x in self.worst], "strips": strips, "arrays": arrays.packed,
        }  # fmt: skip


def record_strips(record: Record, records: int = 1) -> Strips:
    """Return the channels of one of so many records as strips."""
    strips = []
    for c in record.channels:
        scale, unit = prefixed(float(np.nanmax(np.abs(c.values))), c.unit)
        line = Line(label="measured", color="measured", values=c.values)
        strips.append(Strip(title=c.name, unit=unit, scale=scale, lines=[line]))
    n = record.n_samples
    time_s = record.start_s + np.arange(n) / record.rate_hz
    title = str(record.provenance.get("file") or "")
    room = max(_FEWEST, _VALUES // (max(len(strips), 1) * records))
    return Strips(
        title=title, time_s=time_s, strips=strips, worst=(n // 2, n // 2), every_sample=3 * room, stretches=room
    )


def strips_of(traces: Traces) -> Strips:
    """Return outputs beside their predictions, innovations and inputs of a record as strips."""
    strips: list[Strip] = []
    known = [j for j in range(len(traces.names)) if np.any(np.isfinite(traces.predicted[:, j]))]
    for j in known:
        y, e, sd = traces.measured[:, j], traces.errors[:, j], traces.sd[..., j]
        lines = [
            Line(label="measured", color="measured", values=y),
            Line(label="predicted one step ahead", color="predicted", values=y, less=e),
        ]
        if traces.simulated is not None:
            free = traces.simulated[:, j]
            lines.append(Line(label="simulated from the input", color="bound", values=free, scaled=False))
        scale, unit = traces.scale(j)
        strips.append(Strip(title=traces.names[j], unit=unit, scale=scale, lines=lines))
        if sd.ndim:
            e, bound, scale, unit = e / sd, NORMAL_95, 1.0, "sd"
        else:
            bound, (scale, unit) = NORMAL_95 * float(sd), prefixed(float(np.nanmax(np.abs(e))), traces.units[j])
        line = Line(label="innovation", color="measured", values=e)
        strips.append(Strip(title=f"{traces.names[j]}: innovation", unit=unit, scale=scale, lines=[line], bound=bound))
    inputs = () if traces.inputs is None else traces.inputs.T
    for name, unit, x in zip(traces.input_names, traces.input_units, inputs, strict=True):
        scale, unit = prefixed(float(np.max(np.abs(x))), unit)
        line = Line(label="input", color="measured", values=x)
        strips.append(Strip(title=name, unit=unit, scale=scale, lines=[line]))
    worst = worst_stretch(np.nan_to_num(traces.errors[:, known]))
    return Strips(title=traces.title, time_s=traces.time_s, strips=strips, worst=worst)
