"""What a record holds, for the terminal: levels, resolution, noise, faults and excitation of each channel."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence

import numpy as np

from ambid.errors import AmbidError
from ambid.record import Channel, Record
from ambid.report.numbers import prefixed, sized
from ambid.report.text import WIDTH, Paint, columns, plain
from ambid.signals import find_dropouts, find_outliers, find_saturation, persistent_excitation, resolution, snr
from ambid.units import UNKNOWN

_ORDER = 20  # of persistent excitation: far above what a plant of three states needs
_LONGEST = 100_000  # samples from which the order of excitation is told


def record_text(record: Record, *, inputs: Sequence[str] = (), paint: Paint = plain) -> str:
    """Describe a record.

    `record`: any; `paint`: adds colour. Returns header, table of the channels, a sentence for each thing found, and the
    history.
    """
    name = record.provenance.get("file", "record")
    head = (
        f"{paint(name, 'strong')}: {record.n_samples} samples at {record.rate_hz:.6g} Hz, {record.duration_s:.6g} s"
        f" from {record.start_s:g} s"
    )
    rows: list[tuple[str, ...]] = [("channel", "unit", "min", "max", "mean", "sd", "step", "SNR")]
    rows += [_row(record, c, inputs) for c in record.channels]
    blocks = [[head], columns(rows, right=(2, 3, 4, 5, 6, 7)), _findings(record, inputs, paint)]
    blocks.append(["history: " + "; ".join(str(step) for step in record.history)] if record.history else [])
    return "\n\n".join("\n".join(_folded(block)) for block in blocks if block)


def _folded(lines: list[str]) -> list[str]:
    return [
        part
        for line in lines
        for part in (textwrap.wrap(line, WIDTH, subsequent_indent="  ") if len(line) > WIDTH else [line])
    ]


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
    driving = [] if c.name in inputs else [name for name in inputs if np.ptp(record[name]) > 0]
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
            lines.append(f"{paint('✗', 'bad')} {c.name}: no known unit [{c.source_unit}]; a rig can declare it")
        looks: tuple[Callable[[Record, str], object], ...] = (find_saturation, find_dropouts, find_outliers)
        for look in looks:
            try:
                found = look(record, c.name)
            except AmbidError:
                continue
            if found.count:  # type: ignore[attr-defined]
                lines.append(f"{paint('✗', 'bad')} {found}")
    if not lines:
        lines.append(f"{paint('✓', 'good')} no saturation, no drop-outs, no outliers")
    method = f"what 20 lags of the channel{' and of ' + ', '.join(inputs) if inputs else ''} do not predict"
    lines.append(f"SNR: noise is {method}{'' if inputs else '; without a rig a lower bound'}")
    lines += [_excitation(record, name) for name in inputs or record.names]
    return lines


def _excitation(record: Record, name: str) -> str:
    """Order of persistent excitation above the channel's own noise, and the band that holds its power."""
    u = record[name][:_LONGEST]
    centred = u - u.mean()
    power = np.cumsum(np.abs(np.fft.rfft(centred)) ** 2)
    if not power[-1] > 0:
        return f"{name}: constant, it excites nothing"
    low, high = (np.searchsorted(power, part * power[-1]) * record.rate_hz / u.size for part in (0.005, 0.995))
    band = f"99 % of its power between {sized(float(low), 'Hz')} and {sized(float(high), 'Hz')}"
    try:
        order = persistent_excitation(u, _ORDER, tolerance=1e-6)
    except AmbidError:
        return f"{name}: {band}"
    return f"{name}: {order}; {band}"
