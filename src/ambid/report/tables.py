"""Further tables for the terminal: what a record holds, structures side by side, how much each coefficient matters."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.errors import AmbidError, counted
from ambid.record import Channel, Record
from ambid.report.numbers import prefixed, sized
from ambid.report.text import WIDTH, Paint, columns, fraction, joined, plain, pure, wrapped
from ambid.rig.roles import rank_roles
from ambid.signals import find_dropouts, find_outliers, find_saturation, persistent_excitation, resolution, snr
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.validation.comparison import Comparison, Entry
    from ambid.validation.sensitivity import SensitivityAnalysis

_ORDER = 20  # of persistent excitation: far above what a plant of three states needs
_LONGEST = 100_000  # samples from which the order of excitation is told
_SHOWN = 24  # coefficients of a sensitivity analysis


def record_text(record: Record, *, inputs: Sequence[str] = (), paint: Paint = plain) -> str:
    """Describe a record: its channels, a sentence for each thing found, and its history."""
    name = record.provenance.get("file", "record")
    head = (
        f"{paint(name, 'strong')}: {counted(record.n_samples, 'sample')} at {record.rate_hz:.6g} Hz, "
        f"{record.duration_s:.6g} s from {record.start_s:g} s"
    )
    rows: list[tuple[str, ...]] = [("channel", "unit", "min", "max", "mean", "sd", "step", "SNR")]
    rows += [_row(record, c, inputs) for c in record.channels]
    blocks = [[head], columns(rows, right=(2, 3, 4, 5, 6, 7)), _findings(record, inputs, paint)]
    blocks += [] if inputs else [_roles(record, paint)]
    blocks.append(["history: " + "; ".join(str(step) for step in record.history)] if record.history else [])
    return joined(
        [[x for line in b for x in (wrapped([line], WIDTH, "  ") if len(line) > WIDTH else [line])] for b in blocks]
    )


def _roles(record: Record, paint: Paint) -> list[str]:
    """For each role the column that is likely it, with its score and the reason, and the others."""
    lines = []
    for role, found in rank_roles(record).items():
        for x in found:
            head = f"{role}: likely {x.channel.name}" if x is found[0] else f"  or {x.channel.name}"
            lines.append(f"{paint(head, 'strong' if x is found[0] else 'dim')} (score {x.score:.2f}), because {x.why}")
    return lines


def _row(record: Record, c: Channel, inputs: Sequence[str]) -> tuple[str, ...]:
    x = c.values
    size = float(np.max(np.abs(x)))
    scale, unit = (1.0, c.source_unit) if c.unit in (UNKNOWN, "1") else prefixed(size, c.unit)
    numbers = [f"{float(v) / scale:.5g}" for v in (x.min(), x.max(), x.mean(), x.std())]
    steps = resolution(record, c.name)
    step = f"{steps.step / scale:.3g}" if steps.quantised and steps.step > 0 else "–"
    return c.name, f"[{unit}]", *numbers, step, _ratio(record, c, inputs)


def _ratio(record: Record, c: Channel, inputs: Sequence[str]) -> str:
    if not np.ptp(c.values) > 0:
        return "–"
    driving = [] if c.name in inputs else [name for name in inputs if np.ptp(record[name].values) > 0]
    try:
        found = snr(record, c.name, inputs=driving)
    except AmbidError:
        return "too short"
    return f"{found.db:.1f} dB" if np.isfinite(found.db) else "no signal" if found.db < 0 else "no noise"


def _findings(record: Record, inputs: Sequence[str], paint: Paint) -> list[str]:
    """A line for each fault of a channel, how the noise was told, and how rich the input is."""
    lines: list[str] = []
    for c in record.channels:
        if c.unit == UNKNOWN:
            lines.append(f"{paint('✗', 'bad')} {c.name}: unknown unit [{c.source_unit}]; a rig can declare it")
        looks: tuple[Callable[[Record, str], object], ...] = (find_saturation, find_dropouts, find_outliers)
        for look in looks:
            try:
                found = look(record, c.name)
            except AmbidError:
                continue
            if found.count:  # type: ignore[attr-defined]
                lines.append(f"{paint('✗', 'bad')} {found}")
    if not lines:
        lines.append(f"{paint('✓', 'good')} no saturation, drop-outs or outliers")
    method = f"the part that 20 lags of the channel{' and of ' + ', '.join(inputs) if inputs else ''} do not predict"
    lines.append(f"SNR: noise is {method}{'' if inputs else '; without a rig a lower bound'}")
    lines += [_excitation(record, name) for name in inputs or record.names]
    return lines


def _excitation(record: Record, name: str) -> str:
    """Order of persistent excitation above the channel's own noise, and the band that holds its power."""
    u = record[name].values[:_LONGEST]
    centred = u - u.mean()
    power = np.cumsum(np.abs(np.fft.rfft(centred)) ** 2)
    if not power[-1] > 0:
        return f"{name}: constant, no excitation"
    low, high = (np.searchsorted(power, part * power[-1]) * record.rate_hz / u.size for part in (0.005, 0.995))
    band = f"99 % of its power between {sized(float(low), 'Hz')} and {sized(float(high), 'Hz')}"
    try:
        order = persistent_excitation(u, _ORDER, tolerance=1e-6)
    except AmbidError:
        return f"{name}: {band}"
    return f"{name}: {order}; {band}"


def comparison_text(comparison: Comparison, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a comparison for people, best structure first; colour does not change the layout."""
    name = comparison.record.get("file") or "record"
    signals = f"{', '.join(comparison.inputs)} → " if comparison.inputs else ""
    n, where = comparison.judged_samples, comparison.judged_on
    on = f"the {n} of a second record" if where == "second record" else f"{n} of the {where}"
    header = (
        f"{paint(str(name), 'strong')}: {signals}{', '.join(comparison.outputs)}; "
        f"{counted(comparison.fitted_samples, 'sample')} fitted, validated on {on}"
    )
    least = min((x.fit.criteria["bic"] for x in comparison.entries if x.fit and "bic" in x.fit.criteria), default=0.0)
    head = ("structure", "orders", "d", "BIC", "one-step", "simulation", "s", "checks")
    rows = [head, *(_entry(x, least) for x in comparison.entries if x.fit is not None)]
    table = columns(rows, right=(2, 3, 4, 5, 6))
    shown = [x for x in comparison.entries if x.fit is not None]
    painted = [table[0], *(paint(t, "dim") if x.failed else t for t, x in zip(table[1:], shown, strict=True))]
    remarks = [
        f"{x.structure} was not fitted: {x.refusal}"
        if x.fit is None
        else f"{x.structure} failed: {', '.join(x.failed)}"
        for x in comparison.entries
        if x.fit is None or x.failed
    ]
    meaning = (
        "d: estimated parameters; BIC: above the smallest, on the data fitted; one-step, simulation: fit on data "
        f"not used, 1 - |e|/|y - mean|; s: seconds, choice of orders included. {comparison.meaning}."
    )
    first = wrapped([header], width) if paint is plain else [header]
    return joined([first, painted, wrapped(remarks, width, "  "), wrapped([meaning], width)])


def _entry(entry: Entry, least: float) -> tuple[str, ...]:
    fit = entry.fit
    if fit is None:
        return (entry.structure,)
    bic = fit.criteria.get("bic")
    return (
        entry.structure,
        " ".join(f"{k}={_order(v)}" for k, v in entry.orders.items()),
        str(fit.n_estimated),
        "–" if bic is None else f"+{bic - least:.1f}" if abs(bic - least) < 1e5 else f"+{bic - least:.3g}",
        fraction(entry.one_step),
        fraction(entry.simulation),
        f"{entry.seconds:.2f}",
        f"{len(entry.failed)} failed" if entry.failed else "passed",
    )


def _order(value: object) -> str:
    return "/".join(str(v) for v in value) if isinstance(value, tuple) else str(value)


def sensitivity_text(found: SensitivityAnalysis, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a sensitivity analysis for people: the numbers that matter most first, then which belong together."""
    rows = [("", "value ± sd", "fit alone", "fit free", "poles", "response")]
    rows += [
        (
            x.name,
            pure(x.value, x.sd),
            f"{x.fit_alone:.3g}",
            f"{x.fit_free:.3g}",
            _percent(x.poles),
            _percent(x.response),
        )
        for x in found.influences[:_SHOWN]
    ]
    rest = len(found.influences) - _SHOWN
    more = [f"… and {rest} more of less effect; --json has them all"] if rest > 0 else []
    index = "infinite" if not np.isfinite(found.collinearity) else f"{found.collinearity:.3g}"
    pairs = "; ".join(f"{a} with {b} ({r:+.3f})" for a, b, r in found.pairs[:6]) or "none above 0.9"
    weakest = ", ".join(f"{name} {100 * part:+.3g} %" for name, part in found.weakest)
    notes = [
        "for a change of one coefficient by 1 %: rise of -2 log L with the others kept, and with the others "
        "refitted (below 4: within 2 sd); largest move of a pole; change of the frequency response",
        f"collinearity of all coefficients {index} (below 10 is good); correlated: {pairs}",
        *([f"least identifiable, relative to each other: {weakest}"] if weakest else []),
    ]
    text = [line for note in notes for line in textwrap.wrap(note, width)]
    return "\n".join([paint("sensitivity", "strong"), *columns(rows), *more, *text])


def _percent(x: float | None) -> str:
    return "–" if x is None or not np.isfinite(x) else f"{100 * x:.3g} %"
