"""Frequency responses from files of analysers: UFF/UNV dataset 58, ASCII and binary, and CSV of complex values.

Standard deviations come from the file (a column, or coherence and the number of averages); else from how far lines lie
from a parabola through their neighbours, which the result says. `G` is that of the continuous plant (hold
"band-limited") unless told otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import RecordError, UnitError, nearest
from ambid.record.csv_dialect import decoded, recognised
from ambid.record.frames import label_of
from ambid.record.record import check_rate, file_bytes, gunzipped, sha256_of
from ambid.signals.response import FrequencyResponse, Hold, ratio
from ambid.signals.uff import Function, read_uff
from ambid.units import UNKNOWN, Unit, parse_unit

ENDINGS = (".uff", ".unv", ".u58")
WORDS = ("functions", "averages", "magnitude", "units", "decimal", "separator", "thousands", "encoding")
_FREQUENCY = ("frequency", "freq", "f")
_PARTS = {"real": "real", "re": "real", "imag": "imag", "imaginary": "imag", "im": "imag", "magnitude": "magnitude",
          "mag": "magnitude", "abs": "magnitude", "amplitude": "magnitude", "phase": "phase", "coherence": "coherence",
          "sd": "sd"}  # fmt: skip
_WINDOW = 9  # lines of a local parabola
_FINEST = 1e-6  # of |G|: digits of single precision, below which no scatter is believed
_MOST = 1e100  # of frequencies and values, beyond which a number is damage
_RATE = 2.56  # times the highest frequency: the usual rate of an analyser, where none is told
_ALIKE = 2.0  # lines with one error where spectra were averaged: 1.94 under a Hann window and noise


def is_response_file(source: object) -> bool:
    """Tell whether a source is a file of frequency responses: by its name, a CSV by its first column."""
    if not isinstance(source, str | Path):
        return False
    name = str(source).lower()
    if name.endswith(ENDINGS):
        return True
    if not name.endswith((".csv", ".csv.gz")) or not Path(source).is_file():
        return False
    try:
        return _header(Path(source), {}) is not None
    except RecordError:
        return False


def read_response(
    path: Path, *, inputs: Sequence[str] = (), outputs: Sequence[str] = (), references: Sequence[str] = (),
    layout: Mapping[str, str] | None = None, hold: Hold = "band-limited", rate_hz: float | None = None,
) -> tuple[FrequencyResponse, dict[str, object]]:  # fmt: skip
    """Read a frequency response.

    `inputs`, `outputs`: names in the file, by default all; `references`: the inputs of its functions where the wanted
    ones are among its outputs (a closed loop): the responses to them are divided, which feedback does not bias;
    `rate_hz`: of the plant's converters, for delays in samples and a held input. Returns also file, SHA-256 and what
    was done.
    """
    told = dict(layout or {})
    for word in told:
        if word not in WORDS:
            raise RecordError(
                f"{path}: layout {word!r} of a frequency response; it is one of {', '.join(WORDS)}."
                f"{nearest(word, WORDS)} Correct or omit it"
            )
    if hold == "zoh" and rate_hz is None:
        raise RecordError(f"{path}: a held input needs the rate of its converter. Give --rate, or --hold band-limited")
    data = file_bytes(path)
    uff = path.name.lower().endswith(ENDINGS)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by its line
        every, left = read_uff(path, data, told) if uff else (_csv(path, told, inputs, outputs), 0)
    functions, done = _checked(path, every, told)
    first = functions[0]
    ask = list(dict.fromkeys(references or inputs or [f.input for f in functions]))
    give = list(dict.fromkeys([*outputs, *(inputs if references else ())] or [f.output for f in functions]))
    table = {(f.output, f.input): f for f in functions}
    listed = ", ".join(f"{f.input} → {f.output}" for f in functions[:8])
    for o in give:
        for i in ask:
            if (o, i) not in table:
                raise RecordError(
                    f"{path} has no response {i} → {o}; it has {listed}. Choose by --input, --output and --reference"
                )
    averages = _averages(path, told)
    Z = np.stack([np.stack([table[o, i].values for i in ask], axis=1) for o in give], axis=1)
    variance, freedom, assumed = _variance([table[o, i] for o in give for i in ask], averages)
    covariance = np.asarray(np.eye(len(give) * len(ask))[None] * variance[:, None, :], dtype=np.complex128)
    units = _units_of(path, [table[o, i] for o in give for i in ask])
    if references:
        n_y = len(give) - len(inputs)
        if not 0 < len(inputs) <= len(references) or n_y < 1:
            raise RecordError(
                f"{path}: {len(references)} references for {len(inputs)} inputs. Name inputs, and a reference each"
            )
        Z, covariance = ratio(Z, covariance, n_y)
        both = "errors of the responses to the reference are assumed independent, and feedback correlates them"
        assumed = f"{assumed}; {both}" if assumed else both
        give, ask = give[:n_y], list(inputs)
    apart = () if len(give) * len(ask) == 1 else (
        "a file does not say how errors of its functions are correlated: they are taken as independent",
    )  # fmt: skip
    coherent = [next((f.coherence for f in functions if f.output == o and f.coherence is not None), None) for o in give]
    rate = _RATE * float(first.frequency_hz[-1]) if rate_hz is None else check_rate(rate_hz)
    if first.frequency_hz[-1] >= 0.5 * rate:
        raise RecordError(f"{path}: lines up to {first.frequency_hz[-1]:g} Hz; --rate {rate:g} Hz shows less than half")
    if rate_hz is None:
        done.append(f"no rate: delays count in samples of {rate:.6g} Hz")
    if left:
        done.append(f"{left} other functions left out")
    found = FrequencyResponse(
        frequency_hz=first.frequency_hz, G=Z, covariance=covariance,
        coherence=np.stack(coherent, axis=1) if coherent and all(c is not None for c in coherent) else None,  # type: ignore[arg-type]
        method="file, joint input-output with the reference" if references else "file", inputs=tuple(ask),
        outputs=tuple(give), rate_hz=rate,
        units=MappingProxyType({x: _si(units[x]) for x in (*ask, *give)}),
        hold=hold, degrees_of_freedom=freedom, warnings=(*apart, *done),
        details=MappingProxyType({"assumed": assumed} if assumed else {}),
        lines_per_independent=1.0 if np.isinf(freedom) else _ALIKE,
    )  # fmt: skip
    record: dict[str, object] = {
        "file": path.name, "sha256": sha256_of(data), "rate_hz": rate, "history": done, "units": units,
    }  # fmt: skip
    return found, record


def _si(text: str) -> str:
    return UNKNOWN if text == UNKNOWN else parse_unit(text).si


def _units_of(path: Path, functions: Sequence[Function]) -> dict[str, str]:
    """Return the unit of each channel as the file has it, which must be of one kind in all functions."""
    units: dict[str, str] = {}
    for f in functions:
        for name, unit in ((f.output, f.units[0]), (f.input, f.units[1])):
            if _si(units.setdefault(name, unit)) != _si(unit):
                raise RecordError(
                    f"{path}: {name} is in [{units[name]}] in one function and in [{unit}] in another. Export alike"
                )
    return units


def _averages(path: Path, told: Mapping[str, str]) -> int | None:
    if "averages" not in told:
        return None
    if not told["averages"].isdecimal() or not 2 <= int(told["averages"]) <= 10**6:
        raise RecordError(
            f"{path}: layout averages={told['averages']!r}; it is a number of spectra, 2 or more. Correct it"
        )
    return int(told["averages"])


def _checked(path: Path, functions: Sequence[Function], told: Mapping[str, str]) -> tuple[list[Function], list[str]]:
    """Return the chosen functions on one grid over 0 Hz, and what was done."""
    chosen, done = list(functions), list[str]()
    if "functions" in told:
        numbers = [x.strip() for x in told["functions"].split(",")]
        if not all(x.isdecimal() and 1 <= int(x) <= len(chosen) for x in numbers):
            raise RecordError(
                f"{path} has functions 1 to {len(chosen)}; layout functions={told['functions']!r}. Correct it"
            )
        chosen = [chosen[int(x) - 1] for x in numbers]
    if not chosen:
        raise RecordError(f"{path} holds no frequency response. Export it as dataset 58, function type 4, or as CSV")
    pairs = [(f.output, f.input) for f in chosen]
    twice = next((p for k, p in enumerate(pairs) if p in pairs[:k]), None)
    if twice is not None:
        at = ",".join(str(k) for k, p in enumerate(pairs, 1) if p == twice)
        raise RecordError(
            f"{path}: {twice[1]} → {twice[0]} occurs twice (functions {at}). Choose: --layout functions=1,…"
        )
    grid = chosen[0].frequency_hz
    for f in chosen:
        where = f"{path}: {f.input} → {f.output}"
        if f.frequency_hz.size != grid.size or not np.allclose(f.frequency_hz, grid, rtol=1e-6, atol=0):
            raise RecordError(f"{where} has other frequencies than the first function. Choose: --layout functions=1,…")
        for what, x in (("frequency", f.frequency_hz), ("value", f.values)):
            bad = np.flatnonzero(~(np.abs(x) < _MOST))
            if bad.size:
                raise RecordError(f"{where}: the {what} of line {bad[0] + 1} is not finite, or absurd. Remove the line")
        if f.sd is not None and not np.all(f.sd > 0):
            raise RecordError(f"{where}: a standard deviation is not positive. Correct the column sd")
        if f.coherence is not None and f.coherence.size != f.frequency_hz.size:
            raise RecordError(
                f"{where}: its coherence has {f.coherence.size} lines, not {f.frequency_hz.size}. Export both again"
            )
        if f.coherence is not None and not np.all((f.coherence >= 0) & (f.coherence <= 1 + 1e-6)):
            raise RecordError(f"{where}: a coherence is not between 0 and 1. Correct the column coherence")
    if np.any(np.diff(grid) <= 0) or grid[0] < 0:
        raise RecordError(f"{path}: the frequencies must rise from 0 or above. Sort the lines")
    if grid[0] == 0.0:
        done.append("line at 0 Hz left out")
        chosen = [_from(f, 1) for f in chosen]
    if chosen[0].frequency_hz.size < _WINDOW:
        raise RecordError(f"{path} has {chosen[0].frequency_hz.size} lines over 0 Hz; at least {_WINDOW} are needed")
    return chosen, done


def _from(f: Function, k: int) -> Function:
    cut = {name: x[k:] for name in ("frequency_hz", "values", "sd", "coherence") if (x := getattr(f, name)) is not None}
    return replace(f, **cut)


def _variance(functions: Sequence[Function], averages: int | None) -> tuple[Array, float, str]:
    """Return E|dG|² of each function, (n_f, n), its real degrees of freedom, and what is assumed."""
    columns, freedom, assumed, unaveraged = [], np.inf, [], False
    for f in functions:
        if f.sd is not None:
            columns.append(f.sd**2)
        elif f.coherence is not None and averages is not None:
            g = np.clip(f.coherence, 1e-12, 1 - 1e-9)  # Bendat and Piersol 2010, eq. 9.90, of the complex number
            columns.append(np.abs(f.values) ** 2 * (1 - g) / (g * averages))
            freedom = min(freedom, 2.0 * (averages - 1))
        else:
            unaveraged |= f.coherence is not None
            assumed.append(f"{f.input} → {f.output}")
            columns.append(_scatter(f.values))
            freedom = min(freedom, 2.0 * (_WINDOW - 3))
    if not assumed:
        return np.stack(columns, axis=1), freedom, ""
    how = "; the file has coherence: --layout averages=N gives them" if unaveraged else ""
    text = f"standard deviations of {', '.join(assumed)} are assumed, from the scatter of neighbouring lines{how}"
    return np.stack(columns, axis=1), freedom, text


def _scatter(values: Complex) -> Array:
    """Return E|dG|² from the residuals of parabolas through windows of lines."""
    t = np.linspace(-1.0, 1.0, _WINDOW)
    q, _ = np.linalg.qr(np.stack([t**0, t, t**2], axis=1))
    windows = np.lib.stride_tricks.sliding_window_view(values, _WINDOW)
    power = np.sum(np.abs(windows @ (np.eye(_WINDOW) - q @ q.T)) ** 2, axis=1) / (_WINDOW - 3)
    at = np.clip(np.arange(values.size) - _WINDOW // 2, 0, power.size - 1)
    return np.asarray(np.maximum(power[at], (_FINEST * np.abs(values)) ** 2))


# ---- CSV


def _header(path: Path, told: Mapping[str, str]) -> tuple[list[str], list[str], int, str] | None:
    """Return the cells of the header, all lines, where rows begin, and the delimiter; None without a frequency."""
    data = file_bytes(path)
    text, _ = decoded(gunzipped(data, path) if path.name.lower().endswith(".gz") else data, path, _csv_words(told))
    lines = text.split("\n")
    first = next((k for k, x in enumerate(lines) if x.strip() and not x.startswith("#")), None)
    if first is None:
        return None
    delimiter = next((d for d in ("\t", ";", ",") if d in lines[first]), ",")
    cells, start = [x.strip() for x in lines[first].split(delimiter)], first + 1
    if not _is_frequency(cells[0]):
        return None
    dialect = recognised(lines, path, _csv_words(told))
    if dialect is not None:
        units = dialect.units or (None,) * len(dialect.cells)
        cells = [x if u is None else f"{x} [{u}]" for x, u in zip(dialect.cells, units, strict=True)]
        return cells, dialect.lines, dialect.row, dialect.delimiter
    return cells, lines, start, delimiter


def _csv_words(told: Mapping[str, str]) -> dict[str, str]:
    return {k: v for k, v in told.items() if k in ("decimal", "separator", "thousands", "encoding", "units")}


def _is_frequency(cell: str) -> bool:
    name, unit = label_of(cell.replace("(", "[").replace(")", "]"))
    return name.lower() in _FREQUENCY and unit in (None, "Hz", "kHz", "rad/s")


def _csv(path: Path, told: Mapping[str, str], inputs: Sequence[str], outputs: Sequence[str]) -> list[Function]:
    found = _header(path, told)
    assert found is not None
    cells, lines, start, delimiter = found
    rows = []
    for k, line in enumerate(lines[start:], start + 1):
        if line.strip():
            parts = line.split(delimiter)
            try:
                rows.append([float(x) for x in parts])
            except ValueError:
                raise RecordError(f"{path}, row {k}: {line[:60]!r} is not a row of numbers. Correct it") from None
            if len(parts) != len(cells):
                raise RecordError(f"{path}, row {k}: {len(parts)} cells, {len(cells)} columns. Correct the row")
    if not rows:
        raise RecordError(f"{path} has a header and no lines. Export it again")
    table = np.array(rows)
    _, unit = label_of(cells[0])
    if unit is None:
        raise RecordError(f"{path}, column {cells[0]!r}: write its unit, 'frequency [Hz]' or [rad/s]")
    scale = {"Hz": 1.0, "kHz": 1e3, "rad/s": 1 / (2 * np.pi)}[unit]
    groups: dict[str, dict[str, tuple[Array, str | None]]] = {}
    for j, cell in enumerate(cells[1:], 1):
        label, unit = label_of(cell)
        pair, _, word = label.rpartition(" ")
        part = _PARTS.get(word.strip("()").lower())
        if part is None:
            raise RecordError(
                f"{path}, column {cell!r}: its name must end in real, imag, magnitude, phase, coherence or sd, such as "
                "'position/current real [m/A]'. Rename it"
            )
        if part in groups.setdefault(pair.strip(), {}):
            raise RecordError(f"{path}: {pair} has two columns {part}. Rename one")
        groups[pair.strip()][part] = table[:, j], unit
    return [
        _of_columns(path, pair, parts, scale * table[:, 0], told, inputs, outputs) for pair, parts in groups.items()
    ]


def _of_columns(
    path: Path, pair: str, parts: Mapping[str, tuple[Array, str | None]], frequency_hz: Array, told: Mapping[str, str],
    inputs: Sequence[str], outputs: Sequence[str],
) -> Function:  # fmt: skip
    output, slash, source = (x.strip() for x in pair.partition("/"))
    if not slash:
        output = output or (outputs[0] if len(outputs) == 1 else "output")
        source = inputs[0] if len(inputs) == 1 else "input"
    if {"real", "imag"} <= set(parts):
        (re_, unit), (im, other) = parts["real"], parts["imag"]
        if unit != other:
            raise RecordError(f"{path}: {pair} real is in [{unit}], imag in [{other}]; they have one unit. Correct it")
        values = re_ + 1j * im
    elif {"magnitude", "phase"} <= set(parts):
        (size, unit), (phase, angle) = parts["magnitude"], parts["phase"]
        if angle not in ("deg", "rad"):
            raise RecordError(
                f"{path}: {pair} phase is in [{angle or 'no unit'}]; write 'phase [deg]' or 'phase [rad]'"
            )
        if unit == "dB":
            if "magnitude" not in told:
                raise RecordError(f"{path}: {pair} is in dB of what? Say the unit of 0 dB: --layout magnitude=m/A")
            size, unit = 10 ** (size / 20), told["magnitude"]
        elif np.any(size < 0):
            raise RecordError(f"{path}: {pair} has a negative magnitude: is it in dB? Write 'magnitude [dB]'")
        values = size * np.exp(1j * (np.deg2rad(phase) if angle == "deg" else phase))
    else:
        raise RecordError(f"{path}: {pair or 'the response'} needs real and imag, or magnitude and phase. Add a column")
    factor, units = _ratio_units(path, pair, unit)
    sd, coherence = parts.get("sd"), parts.get("coherence")
    if sd is not None and sd[1] not in (unit, "%"):
        raise RecordError(f"{path}: {pair} sd is in [{sd[1]}]; it must be in [{unit}] or [%]. Correct it")
    return Function(
        output=output, input=source, frequency_hz=frequency_hz, units=units,
        values=np.asarray(factor * values, dtype=np.complex128),
        sd=None if sd is None else 0.01 * sd[0] * np.abs(factor * values) if sd[1] == "%" else factor * sd[0],
        coherence=None if coherence is None else coherence[0],
    )  # fmt: skip


def _ratio_units(path: Path, pair: str, text: str | None) -> tuple[float, tuple[str, str]]:
    """Return the factor to SI of a unit like ``um/A``, and the SI units of output and input."""
    if text is None:
        return 1.0, (UNKNOWN, UNKNOWN)
    over, _, under = text.partition("/")
    try:
        top, bottom = _unit(over), _unit(under or "1")
    except UnitError as failure:
        raise RecordError(f"{path}: {pair} is in [{text}]: {failure}") from None
    return top.scale / bottom.scale, (top.symbol, bottom.symbol)


def _unit(text: str) -> Unit:
    return parse_unit(text.strip().strip("()"))
