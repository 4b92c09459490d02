"""What the plots of a page show of a stretch of a record: envelopes, spectrum, waterfall, orbit; a rig's limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.console.envelope import WINDOWS, rounded, spectrum, window
from ambid.errors import AmbidError
from ambid.physics.law_magnet import BEARING_NUMBERS
from ambid.physics.linear_model import model, model_names
from ambid.record import Record
from ambid.record.record import cut
from ambid.record.words import is_set_point, quantities
from ambid.rig import Rig

_BINS = 1600  # envelopes of a channel: fewer samples are shown as they are
_LINES = 1200  # of a spectrum
_COLUMNS, _ROWS = 120, 200  # of a waterfall
_LONGEST_S = 1.0  # of samples that a column of a waterfall is made of
_ORBIT, _SPECTRUM = 3000, 1 << 21  # samples, the last ones
_WORDS = {"voltage": "limit of the amplifier", "current": "limit of the coil", "position": "the rotor touches"}
_TURNS = {"rad/s": 1.0 / (2.0 * np.pi), "Hz": 1.0}  # to turns a second


def look(
    record: Record, *, from_s: float | None = None, to_s: float | None = None, from_hz: float = 0.0,
    to_hz: float | None = None, weights: str = "Hann", channel: str = "", orbit: Sequence[str] = (),
) -> Mapping[str, Any]:  # fmt: skip
    """Return a stretch of a record to be drawn; `weights`: of a spectrum; `channel`: of the waterfall, the first where
    none of the name is there; `orbit`: two channels, the first in m by default.
    """
    whole = (record.start_s, record.start_s + (record.n_samples - 1) / record.rate_hz)
    begin = whole[0] if from_s is None else max(whole[0], from_s)
    end = whole[1] if to_s is None else min(whole[1], to_s)
    if (end - begin) * record.rate_hz < 1.0:
        raise AmbidError(f"there is no sample from {begin:g} to {end:g} s. Show a longer stretch")
    if not max(from_hz, 0.0) < min(to_hz or record.rate_hz / 2.0, record.rate_hz / 2.0):
        raise AmbidError(
            f"there is no line from {from_hz:g} to {to_hz or record.rate_hz / 2.0:g} Hz. Show a band up to "
            f"{record.rate_hz / 2.0:g} Hz"
        )
    part, names = cut(record, begin, end + 0.5 / record.rate_hz), [c.name for c in record.channels]
    signals, band = np.array([c.values for c in part.channels]), (from_hz, to_hz or record.rate_hz / 2.0)
    starts = np.arange(0, part.n_samples, max(1, -(-part.n_samples // _BINS)))
    low, high = np.minimum.reduceat(signals, starts, axis=1), np.maximum.reduceat(signals, starts, axis=1)
    k = names.index(channel) if channel in names else 0
    last = signals[:, -_SPECTRUM:]
    hz, amplitudes = spectrum(last, part.rate_hz, lines=_LINES, band=band, weights=weights)
    turning = _turning(part)
    pair = [n for n in orbit if n in names] or [c.name for c in part.channels if c.unit == "m"][:2]
    return {
        "whole": whole, "rate_hz": part.rate_hz, "samples": part.n_samples,
        "each": int(starts[1]) if starts.size > 1 else 1,
        "t": rounded(part.start_s + starts / part.rate_hz, 9),
        "channels": [{"name": c.name, "unit": c.unit, "low": rounded(a, 7), "high": rounded(b, 7)}
                     for c, a, b in zip(part.channels, low, high, strict=True)],
        "spectrum": {"hz": rounded(hz, 8), "amplitudes": [rounded(a) for a in amplitudes], "weights": weights,
                     "resolution": WINDOWS[weights][1] * part.rate_hz / last.shape[1],
                     "seconds": last.shape[1] / part.rate_hz if last.shape[1] < part.n_samples else None},
        "waterfall": {"name": names[k], "unit": part.channels[k].unit,
                      **_waterfall(signals[k], part, band, turning, weights)},
        "turning": None if turning is None else rounded(np.array([turning.min(), turning.max()])),
        "pair": pair, "orbit": [rounded(part[n].values[-_ORBIT:], 7) for n in pair] if len(pair) == 2 else None,
    }  # fmt: skip


def _turning(record: Record) -> Array | None:
    """Return turns a second where a channel has both the name and the unit of a speed, (n_samples,)."""
    for c in record.channels:
        if c.unit in _TURNS and "speed" in quantities(c.name) and not is_set_point(c.name):
            return np.abs(c.values) * _TURNS[c.unit]
    return None


def _waterfall(
    values: Array, record: Record, band: tuple[float, float], turning: Array | None, weights: str
) -> Mapping[str, Any]:
    """Return amplitudes over time and frequency: of each column the largest of the spectra that lie in it."""
    rate_hz, n = record.rate_hz, values.size
    length = int(min(n, max(64, min(2 * n // (_COLUMNS + 1), _LONGEST_S * rate_hz))))
    hops = np.arange(0, n - length + 1, max(1, length // 2))
    hz = np.fft.rfftfreq(length, 1.0 / rate_hz)
    first, last = min(int(np.searchsorted(hz, band[0])), hz.size - 2), int(np.searchsorted(hz, band[1], side="right"))
    edges = np.unique(np.linspace(max(1, first), max(last, first + 2), _ROWS + 1).astype(int))[:-1]
    shape = window(length, weights)
    columns, at, speeds = list[Array](), list[float](), list[float]()
    for part in np.array_split(hops, min(_COLUMNS, hops.size)):
        rows = values[part[:, None] + np.arange(length)]
        lines = np.abs(np.fft.rfft((rows - rows.mean(axis=1, keepdims=True)) * shape, axis=1)) * (2.0 / shape.sum())
        columns.append(np.maximum.reduceat(lines[:, : max(last, edges[-1] + 1)].max(axis=0), edges))
        middle = slice(int(part[0]), int(part[-1]) + length)
        at.append(record.start_s + (middle.start + middle.stop - 1) / 2.0 / rate_hz)
        speeds += [] if turning is None else [float(turning[middle].mean())]
    return {
        "t": rounded(np.array(at), 8), "hz": rounded(hz[edges]), "amplitudes": [rounded(c, 4) for c in columns],
        "turning": rounded(np.array(speeds)) if speeds else None, "resolution": WINDOWS[weights][1] * rate_hz / length,
        "top_hz": float(hz[min(last, hz.size) - 1]),
    }  # fmt: skip


def meanings(name: str) -> Mapping[str, str]:
    """Return what the parameters of a model are, of all models where the name is none."""
    known = [p for n in ([name] if name in model_names() else model_names()) for p in model(n).parameters]
    return {spec.name: spec.meaning for spec in (*known, *BEARING_NUMBERS)}


def limits(rig: Rig, *, columns: bool = False) -> Mapping[str, Sequence[Mapping[str, Any]]]:
    """Return lines that a rig draws for each role, or each column in the unit of the record: limits of the bench, and
    trips of the controller.
    """
    found = dict[str, Sequence[Mapping[str, Any]]]()
    for c in rig.channels:
        role: Any = c.role.rpartition("_")[2].rstrip("0123456789")  # of a rotor: of any axis
        words = [(getattr(rig.limits, role), _WORDS[role])] if rig.limits is not None and role in _WORDS else []
        words += [(rig.trip(role), "trip")] if rig.daq is not None and role in ("position", "current") else []
        calibration = c.calibration
        if columns and calibration is not None and (calibration.raw is not None or not calibration.gain):
            continue
        gain, offset = (calibration.gain, calibration.offset) if columns and calibration is not None else (1.0, 0.0)
        lines = [
            {"at": float((v - offset) / gain), "words": what} for ends, what in words for v in ends if np.isfinite(v)
        ]
        if lines:
            found[c.column if columns else c.role] = lines
    return found
