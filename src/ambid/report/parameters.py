"""The table of parameters, declared once: of estimates, rotors, tracks, the demo; and what calibration would move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import Estimate, EstimatedParameter, OutputFit
from ambid.estimation.result import Verdict
from ambid.report.document import Column, Part, Table, grid
from ambid.report.numbers import Quantity, quantity, sized
from ambid.report.text import WORDS, Cell, fraction, pure

if TYPE_CHECKING:
    from ambid.bearing.magnet_result import NonlinearBearingEstimate
    from ambid.rotor.estimate import RotorEstimate

USABLE = Verdict(word="usable", reasons=())


@dataclass(frozen=True, kw_only=True)
class ParameterRow:
    """A parameter as its table sees it; where the verdict on all of them is not good, none is called identified."""

    parameter: EstimatedParameter
    verdict: Verdict = USABLE
    meaning: str = ""

    @cached_property
    def quantity(self) -> Quantity:
        """The value, its standard deviation and interval, ready for print."""
        p = self.parameter
        return quantity(p.value, p.sd, p.unit, ci95=p.ci95)

    @property
    def text(self) -> str:
        """Value ± standard deviation."""
        return self.quantity.text

    @property
    def interval(self) -> str:
        """The 95 % interval; empty where there is none."""
        q = self.quantity
        return f"{q.low} … {q.high}" if q.low else ""

    def in_unit(self, interval: str) -> str:
        """Return an interval with its unit."""
        return f"{interval} {self.quantity.unit}" if interval and self.quantity.unit not in ("", "1") else interval

    @property
    def calibrated(self) -> str:
        """The 95 % interval with calibration; empty where the rig says nothing of it."""
        p = self.parameter
        if not p.sd_calibrated or p.ci95_calibrated is None:
            return ""
        q = quantity(p.value, p.sd_calibrated, p.unit, ci95=p.ci95_calibrated)
        return f"{q.low} … {q.high}" if q.low else ""

    @property
    def judged(self) -> Cell:
        """Where the value comes from in a word or two, such as ``"prior, 87 % data"``."""
        p, word = self.parameter, word_for_all(self.verdict)
        if p.role == "fixed":
            return "fixed", "dim"
        doubt = WORDS[self.verdict.word][1] if self.verdict.reasons else "bad"
        if word != "usable":
            return WORDS[word][0], doubt
        words = "identified" if p.identifiable else "not identifiable"
        if p.role == "prior":
            share = "" if p.data_share is None else f", {100 * p.data_share:.0f} % data"
            words = f"prior{share}" if p.identifiable else f"prior, not identifiable{share}"
        return words, "good" if p.identifiable else doubt


@dataclass(frozen=True, kw_only=True)
class TrueRow(ParameterRow):
    """A parameter beside its truth, SI."""

    truth: float

    @property
    def z(self) -> float:
        """The error in standard deviations."""
        return (self.parameter.value - self.truth) / self.parameter.sd

    @property
    def true_text(self) -> str:
        """The truth, with the digits of the value."""
        q = self.quantity
        scale, decimals = self.parameter.value / float(q.value), len(q.value.partition(".")[2])
        return f"{self.truth / scale:.{decimals}f} {q.unit}"


def word_for_all(verdict: Verdict) -> str:
    """Return the verdict on every parameter: what the record does not show concerns some of them alone."""
    alone = all(r.check == "identifiable" for r in verdict.reasons)
    return "usable" if alone and verdict.word == "caution" else verdict.word


PARAMETERS: Sequence[Column] = (
    Column(cell=lambda row: row.parameter.name, frame={"name": lambda row: row.parameter.name}),
    Column(label="meaning", cell=lambda row: (row.meaning, ""), page=True, sparse=True, about=True),
    Column(label="role", cell=lambda row: (row.parameter.role, ""), page=True),
    Column(
        label="value ± sd",
        cell=lambda row: row.text,
        frame={
            "value": lambda row: row.parameter.value,
            "sd": lambda row: row.parameter.sd,
            "unit": lambda row: row.parameter.unit,
            "role": lambda row: row.parameter.role,
            "identifiable": lambda row: row.parameter.identifiable,
        },
    ),
    Column(
        label="95 % interval",
        cell=lambda row: row.interval,
        wide=lambda row: row.in_unit(row.interval),
        right=True,
        frame={"ci95_low": lambda row: row.parameter.ci95[0], "ci95_high": lambda row: row.parameter.ci95[1]},
    ),
    Column(
        label="with calibration",
        cell=lambda row: row.calibrated,
        wide=lambda row: row.in_unit(row.calibrated),
        right=True,
        sparse=True,
        frame={
            "sd_calibrated": lambda row: row.parameter.sd_calibrated,
            "ci95_calibrated_low": lambda row: (row.parameter.ci95_calibrated or (None, None))[0],
            "ci95_calibrated_high": lambda row: (row.parameter.ci95_calibrated or (None, None))[1],
        },
    ),
    Column(label="in SI", cell=lambda row: row.quantity.si, spare=True),
    Column(label="verdict", cell=lambda row: row.judged),
)
"""Columns of every table of parameters: one that is added here appears wherever parameters are shown."""


def parameter_table(
    parameters: Sequence[EstimatedParameter],
    verdict: Verdict = USABLE,
    meanings: Mapping[str, str] | None = None,
    *,
    label: str = "",
) -> Table:
    """Return parameters as a table; `label`: of the column of names."""
    rows = [ParameterRow(parameter=p, verdict=verdict, meaning=(meanings or {}).get(p.name, "")) for p in parameters]
    return Table(columns=[replace(PARAMETERS[0], label=label), *PARAMETERS[1:]], rows=rows)


def varied(labels: Mapping[str, str | None], more: Mapping[str, Sequence[Column]]) -> list[Column]:
    """Return the columns of parameters, some renamed or, as None, left out, with `more` behind those of a label."""
    columns = list[Column]()
    for column in PARAMETERS:
        label = str(column.label)
        if labels.get(label, label) is not None:
            columns.append(replace(column, label=labels.get(label, label) or ""))
        columns += more.get(label, ())
    return columns


def short_numbers(parameters: Sequence[EstimatedParameter]) -> list[tuple[str, str]]:
    """Return name and value ± standard deviation of parameters, but fixed ones."""
    return [(p.name, quantity(p.value, p.sd, p.unit).text.removesuffix(" 1")) for p in parameters if p.role != "fixed"]


def fit_table(fits: Mapping[str, OutputFit], units: Mapping[str, str], no_simulation: str) -> Table:
    """Return a table of the fit of each output; `no_simulation` says why there may be no simulation."""
    return Table(
        columns=[
            Column(label="fit", cell=lambda row: row[0]),
            Column(label="one step", cell=lambda row: fraction(row[1].one_step)),
            Column(
                label="simulation",
                cell=lambda row: no_simulation if row[1].simulation is None else fraction(row[1].simulation),
            ),
            Column(label="innovations", cell=lambda row: f"{sized(row[1].innovation_sd, units[row[0]])} rms"),
        ],
        rows=list(fits.items()),
    )


def pole_table(
    poles: Sequence[tuple[complex, Array | None]], dt: float | None = None, *, times: bool = False
) -> list[Part]:
    """Return poles, each with its covariance or None, with frequency, damping and standard deviation.

    `dt` is the sampling interval in s of discrete ones, `times` adds time constants; of each pair one is given.
    """
    rows: list[Sequence[Cell]] = [(f"poles [{'z' if dt else 'rad/s'}]", "frequency", "damping", "")]
    for p, covariance in poles:
        sd = np.zeros(2) if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0))
        text = pure(p.real, float(sd[0])) + (f" ± j({pure(p.imag, float(sd[1]))})" if p.imag else "")
        if p == 0:
            rows.append((text, "", "", "delay" if dt else "integrator"))
            continue
        s = complex(np.log(p) / dt) if dt else p
        unstable = abs(p) > 1 if dt else p.real > 0
        frequency = sized(abs(s) / (2 * np.pi), "Hz") if abs(s) else "0 Hz"
        damping = f"{-s.real / abs(s):.3g}" if abs(s) else ""
        words = ["unstable"] if unstable else []
        if times and s.real and not s.imag:
            words.append(f"time constant {sized(1 / abs(s.real), 's')}")
        rows.append((text, frequency, damping, (", ".join(words), "bad" if unstable else "")))
    return [grid(rows)] if poles else []


_FELT, _LINEAR = 0.05, 100.0  # per cent: less is not shown, and more is of a number that the record does not show


def calibration_lines(estimate: Estimate | NonlinearBearingEstimate | RotorEstimate) -> list[str]:
    """Say what 1 % of each scale would move that the rig says nothing of; channels of one kind together."""
    e, stated = estimate, estimate.calibration_sd
    fixed = [name for name in e.calibration if any(p.name == name for p in e.parameters)]
    law = any(p.name == "x_offset" for p in e.parameters)  # of a nonlinear bearing, some of whose numbers may be unseen
    unseen = {p.name for p in e.parameters if law and p.sd > abs(p.value)}
    kinds, worst = dict[str, dict[str, float]](), dict[str, tuple[float, str]]()  # channels of a kind; by bearing
    for source, moves in e.calibration.items():
        bearing, dot, _ = source.partition(".")
        if source in stated or (dot and any(name.startswith(f"{bearing}.z") for name in stated)):
            continue
        if dot:
            name, x = max(_shown(moves).items(), key=lambda item: abs(item[1]), default=("", 0.0))
            worst[bearing] = max(worst.get(bearing, (0.0, "")), (abs(x), f"{source} {name} {_per_cent(x)}"))
            continue
        between = "places of records against each other" if source == "zeros" else ""
        own = f"{source} (fixed)" if source in fixed else between or source.rpartition("_")[2].rstrip("0123456789")
        kind = kinds.setdefault(own, dict.fromkeys(moves, 0.0))
        for name, x in moves.items():
            kind[name] += 0.0 if name in unseen else x
    words = [f"{kind} {moved}" for kind, moves in kinds.items() if (moved := _grouped(_shown(moves)))]
    planes = [text for x, text in worst.values() if x >= _FELT]
    first = "Some of the calibration is in no interval. " if stated else "Intervals are from this record alone. "
    lines = list[str]()
    if words:
        unweighed = not any(p.role != "free" and p.value for p in e.parameters) and any(
            p.name == "m" for p in e.parameters
        )
        weigh = ", or weigh one thing: with m fixed, a wrong factor or clock shows" if unweighed else ""
        weigh += f", and a prior with its sd for {', '.join(fixed)}" if fixed else ""
        lines.append(f"{first}1 % of gain moves: {'; '.join(words)}. Give gain_sd and rate_sd in the rig{weigh}")
    if planes:
        span = e.plant.span(e.numbers)  # type: ignore[union-attr]  # only rotors have planes
        off = f"{sized(0.01 * span, 'm')} along the shaft moves most: {'; '.join(planes)}"
        lines.append(f"{'' if words else first}{off}. Give z_sd or z_sensor_sd")
    offsets = [
        name.removesuffix(".offset") for name in stated if name.endswith(".offset") and name not in e.calibration
    ]
    only = "the number that stands for it" if law else "the operating point"
    return [*lines, *([f"An offset of {', '.join(offsets)} moves {only} alone"] if offsets else [])]


def _shown(moves: Mapping[str, float]) -> dict[str, float]:
    """Return what is shown of the numbers that move: frequencies of modes alone."""
    return {n: x for n, x in moves.items() if not n.startswith(("mode", "gyro")) or n.endswith(".omega")}


def _grouped(moves: Mapping[str, float]) -> str:
    """Return names by how far they move, those of all axes as one where they move alike."""
    groups, short = dict[str, dict[str, None]](), {name: name.rpartition(".")[2] for name in moves}
    for name, x in moves.items():
        by, alike = _per_cent(x), {_per_cent(y) for other, y in moves.items() if short[other] == short[name]}
        if _FELT <= abs(x) <= _LINEAR:
            groups.setdefault(by, {})[short[name] if len(alike) == 1 else name] = None
    return ", ".join(f"{', '.join(names)} {by}" for by, names in groups.items())


def _per_cent(x: float) -> str:
    return f"{x:+.1f}".removesuffix(".0") + " %"
