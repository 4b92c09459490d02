"""Calibration from what a column holds (duty, sensor volts, counts) to what the rig needs of it: a straight line, out =
gain · raw + offset, or a two-column table with linear interpolation between its points.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError, RecordError, UnitError
from ambid.record.csv_format import data_rows, find_header, read_values
from ambid.record.record import Channel, Step, file_bytes, sha256_of, utf8_text
from ambid.units import Unit, parse_unit

_EDGE = 1e-9  # of the table's span: rounding in the last digit is not outside the table


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """A map from raw to physical values; all numbers in SI units."""

    unit_in: str  # SI units of what goes in and comes out
    unit_out: str
    # out = gain · raw + offset, gain in `unit_out` per `unit_in`, offset in `unit_out`. Not used with a table.
    gain: float = 1.0
    offset: float = 0.0
    raw: Array | None = None  # (n_points,), or None, points of the table, `raw` increasing, in `unit_in` and `unit_out`
    out: Array | None = None
    extrapolate: bool = False  # continue the table's first and last piece outside it, instead of refusing values there
    source: str = ""  # path of the table's file, as it was found
    sha256: str = ""  # of the table's file

    def apply(self, channel: Channel) -> Channel:
        """Return a channel of raw values calibrated, of the same name and length, in `unit_out`."""
        if channel.unit != self.unit_in:
            where = f"the table {self.source} begins with" if self.raw is not None else "its calibration is for"
            raise UnitError(
                f"column {channel.name!r} is in [{channel.unit}]; {where} [{self.unit_in}]."
                " Fix the header, or the calibration"
            )
        values = self._interpolate(channel) if self.raw is not None else self.gain * channel.values + self.offset
        return Channel(name=channel.name, unit=self.unit_out, values=values, source_unit=channel.source_unit)

    def step(self, channel: str) -> Step:
        """Describe the calibration of one channel for a record's history, with everything to repeat it."""
        settings: dict[str, object] = {"channel": channel, "from": self.unit_in, "to": self.unit_out}
        if self.raw is None or self.out is None:
            settings |= {"gain": self.gain, "offset": self.offset}
        else:
            settings |= {"table": Path(self.source).name, "sha256": self.sha256, "extrapolate": self.extrapolate}
            settings |= {"raw": self.raw.tolist(), "out": self.out.tolist()}
        return Step(name="calibrate", settings=MappingProxyType(settings))

    def _interpolate(self, channel: Channel) -> Array:
        assert self.raw is not None
        assert self.out is not None
        x, low, high = channel.values, self.raw[0], self.raw[-1]
        margin = _EDGE * (high - low)
        outside = (x < low - margin) | (x > high + margin)
        if outside.any() and not self.extrapolate:
            k = int(np.argmax(outside))
            raise RecordError(
                f"column {channel.name!r}, sample {k}: {x[k]:.6g} [{self.unit_in}] is outside the table {self.source}"
                f" ({low:.6g} to {high:.6g}), as are {int(outside.sum())} samples in all. Extend the table, or set"
                " extrapolate = true"
            )
        piece = np.clip(np.searchsorted(self.raw, x, side="right") - 1, 0, self.raw.size - 2)
        slope = np.diff(self.out) / np.diff(self.raw)
        return np.asarray(self.out[piece] + slope[piece] * (x - self.raw[piece]), dtype=np.float64)


def read_calibration_table(path: str | Path, *, extrapolate: bool = False) -> Calibration:
    """Read a CSV file with two columns of ``name [unit]``, raw (rising or falling throughout) and physical, into rising
    `raw`; `extrapolate`: continue its first and last piece outside it.
    """
    path = Path(path)
    data = file_bytes(path, RecordError, "calibration table")
    lines = utf8_text(data, path, RecordError, "calibration table").split("\n")
    header = find_header(lines, path)
    if len(header.names) != 2:
        raise RecordError(
            f"calibration table {path} has {len(header.names)} columns ({', '.join(header.names)}); it needs two:"
            " raw and physical. Remove or add columns"
        )
    units = [_unit(path, name, text) for name, text in zip(header.names, header.unit_texts, strict=True)]
    values = read_values(data_rows(lines, header.row, path, 2), header, path, "error")
    raw, out = units[0].to_si(values[:, 0].copy()), units[1].to_si(values[:, 1].copy())
    steps = np.diff(raw)
    if np.all(steps < 0):
        raw, out = raw[::-1].copy(), out[::-1].copy()
    elif not np.all(steps > 0):
        k = int(np.argmax(np.sign(steps) != np.sign(steps[0]))) if steps[0] != 0 else 0
        raise RecordError(
            f"calibration table {path}, row {header.row + k + 2}: column {header.names[0]!r} goes from {raw[k]:.6g} to"
            f" {raw[k + 1]:.6g}; it must increase (or decrease) throughout. Sort the rows, remove doubles"
        )
    return Calibration(
        unit_in=units[0].si,
        unit_out=units[1].si,
        raw=raw,
        out=out,
        extrapolate=extrapolate,
        source=str(path),
        sha256=sha256_of(data),
    )


def _unit(path: Path, name: str, text: str | None) -> Unit:
    if text is None:
        raise RecordError(f"calibration table {path}: column {name!r} has no unit. Write '{name} [unit]' in its header")
    try:
        return parse_unit(text)
    except AmbidError as error:
        raise RecordError(f"calibration table {path}: column {name!r}: {error}") from None
