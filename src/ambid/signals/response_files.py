"""Frequency responses from CSV and universal files (UFF, UNV), dataset 58 in ASCII (SDRC, Universal File
Datasets Summary). Units are those of the axis labels; without one, of the quantity where dataset 164 says SI.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import RecordError, UnitError, choices
from ambid.record.csv_dialect import decoded, recognised
from ambid.record.record import check_rate, file_bytes, gunzipped, sha256_of
from ambid.record.words import label_of
from ambid.settings.caller import setting
from ambid.signals.response import FrequencyResponse, Hold, ratio
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
    """Read a frequency response, by default of all `inputs` and `outputs`; also file, SHA-256 and what was done.

    `references`: the inputs of its functions where the wanted ones are among its outputs (a closed loop): the responses
    to them are divided, which feedback does not bias. `rate_hz`: of the converters, for delays and a held input.
    """
    words = dict(layout or {})
    for word in words:
        if word not in WORDS:
            raise RecordError(
                f"{path}: layout {word!r} of a frequency response; it is one of {choices(word, WORDS)} Correct"
                " or omit it"
            )
    if hold == "zoh" and rate_hz is None:
        raise RecordError(
            f"{path}: a held input needs the rate of its converter. Give {setting('rate_hz')}, or "
            f"{setting('hold', 'band-limited')}"
        )
    data = file_bytes(path)
    uff = path.name.lower().endswith(ENDINGS)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by its line
        every, left = read_uff(path, data, words) if uff else (_csv(path, words, inputs, outputs), 0)
    functions, done = _checked(path, every, words)
    first = functions[0]
    ask = list(dict.fromkeys(references or inputs or [f.input for f in functions]))
    give = list(dict.fromkeys([*outputs, *(inputs if references else ())] or [f.output for f in functions]))
    table = {(f.output, f.input): f for f in functions}
    listed = ", ".join(f"{f.input} → {f.output}" for f in functions[:8])
    for o in give:
        for i in ask:
            if (o, i) not in table:
                raise RecordError(
                    f"{path} has no response {i} → {o}; it has {listed}. Choose by {setting('input')}, "
                    f"{setting('output')} and {setting('reference')}"
                )
    averages = _averages(path, words)
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
        raise RecordError(
            f"{path}: lines up to {first.frequency_hz[-1]:g} Hz; {setting('rate_hz')} {rate:g} Hz shows less than half"
        )
    if rate_hz is None:
        done.append(f"no rate: delays count in samples of {rate:.6g} Hz")
    if left:
        done.append(f"{left} other functions left out")
    response = FrequencyResponse(
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
    return response, record


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


def _averages(path: Path, words: Mapping[str, str]) -> int | None:
    if "averages" not in words:
        return None
    if not words["averages"].isdecimal() or not 2 <= int(words["averages"]) <= 10**6:
        raise RecordError(
            f"{path}: layout averages={words['averages']!r}; it is a number of spectra, 2 or more. Correct it"
        )
    return int(words["averages"])


def _checked(path: Path, functions: Sequence[Function], words: Mapping[str, str]) -> tuple[list[Function], list[str]]:
    """Return the chosen functions on one grid over 0 Hz, and what was done."""
    chosen, done = list(functions), list[str]()
    if "functions" in words:
        numbers = [x.strip() for x in words["functions"].split(",")]
        if not all(x.isdecimal() and 1 <= int(x) <= len(chosen) for x in numbers):
            raise RecordError(
                f"{path} has functions 1 to {len(chosen)}; layout functions={words['functions']!r}. Correct it"
            )
        chosen = [chosen[int(x) - 1] for x in numbers]
    if not chosen:
        raise RecordError(f"{path} holds no frequency response. Export it as dataset 58, function type 4, or as CSV")
    pairs = [(f.output, f.input) for f in chosen]
    twice = next((p for k, p in enumerate(pairs) if p in pairs[:k]), None)
    if twice is not None:
        at = ",".join(str(k) for k, p in enumerate(pairs, 1) if p == twice)
        raise RecordError(
            f"{path}: {twice[1]} → {twice[0]} occurs twice (functions {at}). Choose: "
            f"{setting('layout', 'functions=1,…')}"
        )
    grid = chosen[0].frequency_hz
    for f in chosen:
        where = f"{path}: {f.input} → {f.output}"
        if f.frequency_hz.size != grid.size or not np.allclose(f.frequency_hz, grid, rtol=1e-6, atol=0):
            raise RecordError(
                f"{where} has other frequencies than the first function. Choose: {setting('layout', 'functions=1,…')}"
            )
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
    how = f"; the file has coherence: {setting('layout', 'averages=N')} gives them" if unaveraged else ""
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


def _header(path: Path, words: Mapping[str, str]) -> tuple[list[str], list[str], int, str] | None:
    """Return the cells of the header, all lines, where rows begin, and the delimiter; None without a frequency."""
    data = file_bytes(path)
    text, _ = decoded(gunzipped(data, path) if path.name.lower().endswith(".gz") else data, path, _csv_words(words))
    lines = text.split("\n")
    first = next((k for k, x in enumerate(lines) if x.strip() and not x.startswith("#")), None)
    if first is None:
        return None
    delimiter = next((d for d in ("\t", ";", ",") if d in lines[first]), ",")
    cells, start = [x.strip() for x in lines[first].split(delimiter)], first + 1
    name, unit = label_of(cells[0].replace("(", "[").replace(")", "]"))
    if not (name.lower() in _FREQUENCY and unit in (None, "Hz", "kHz", "rad/s")):
        return None
    dialect = recognised(lines, path, _csv_words(words))
    if dialect is not None:
        units = dialect.units or (None,) * len(dialect.cells)
        cells = [x if u is None else f"{x} [{u}]" for x, u in zip(dialect.cells, units, strict=True)]
        return cells, dialect.lines, dialect.row, dialect.delimiter
    return cells, lines, start, delimiter


def _csv_words(words: Mapping[str, str]) -> dict[str, str]:
    return {k: v for k, v in words.items() if k in ("decimal", "separator", "thousands", "encoding", "units")}


def _csv(path: Path, words: Mapping[str, str], inputs: Sequence[str], outputs: Sequence[str]) -> list[Function]:
    header = _header(path, words)
    assert header is not None
    cells, lines, start, delimiter = header
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
        _of_columns(path, pair, parts, scale * table[:, 0], words, inputs, outputs) for pair, parts in groups.items()
    ]


def _of_columns(
    path: Path, pair: str, parts: Mapping[str, tuple[Array, str | None]], frequency_hz: Array, words: Mapping[str, str],
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
            if "magnitude" not in words:
                raise RecordError(
                    f"{path}: {pair} is in dB of what? Say the unit of 0 dB: {setting('layout', 'magnitude=m/A')}"
                )
            size, unit = 10 ** (size / 20), words["magnitude"]
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Function:
    """One response of a file, from one input to one output."""

    output: str
    input: str
    frequency_hz: Array
    values: Complex  # SI where the units are known
    units: tuple[str, str] = (UNKNOWN, UNKNOWN)  # of output and input, as the file has them
    sd: Array | None = None  # of the complex number
    coherence: Array | None = None


_NUMBER = re.compile(rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][+-]?\d+)?")
_DIRECTIONS = {0: "", 1: "X", 2: "Y", 3: "Z", 4: "RX", 5: "RY", 6: "RZ"}
_QUANTITIES = {8: "m", 9: "N", 11: "m/s", 12: "m/s^2", 13: "N", 15: "Pa"}  # SI units of specific data types
_FRF, _COHERENCE = (4, 5), 6  # function types; 5 is transmissibility


def read_uff(path: Path, data: bytes, words: Mapping[str, str]) -> tuple[list[Function], int]:
    """Return the responses of datasets 58, with the coherence of each, and how many other functions there are."""
    functions: list[Function] = []
    coherence: dict[tuple[str, str], Array] = {}
    left, system = 0, 0
    for number, body in _datasets(path, data):
        if number == 164:
            system = int(body[0][:10])
        if number != 58:
            continue
        kind, function = _function(path, body, len(functions) + left + 1, system, words)
        if kind == _COHERENCE:
            coherence[function.output, function.input] = function.values.real
        elif kind in _FRF:
            functions.append(function)
        else:
            left += 1
    return [replace(f, coherence=coherence.get((f.output, f.input))) for f in functions], left


def _datasets(path: Path, data: bytes) -> Iterator[tuple[int, list[bytes]]]:
    """Yield number and lines of each dataset."""
    at, count = 0, 0
    while True:
        begin = re.compile(rb"^ {4}-1[ \t]*\r?\n", re.M).search(data, at)
        if begin is None:
            break
        end_of_head = data.find(b"\n", begin.end())
        head = data[begin.end() : end_of_head].decode("latin-1")
        if head.strip() == "-1":  # an end too many: this one may be a beginning
            at = begin.end()
            continue
        count += 1
        if head[6:7].lower() == "b":
            raise RecordError(f"{path}: dataset {count} is binary (58b), which is not read. Export it as ASCII")
        try:
            number = int(head[:6])
        except ValueError:
            raise RecordError(
                f"{path}: dataset {count} begins with {head[:40]!r}, not with its number. It is damaged"
            ) from None
        end = re.compile(rb"^ {4}-1[ \t]*\r?$", re.M).search(data, end_of_head + 1)
        if end is None:
            raise RecordError(f"{path}: dataset {count} has no end (a line -1): it is cut off. Copy it again")
        yield number, data[end_of_head + 1 : end.start()].splitlines()
        at = end.end()
    if not count:
        raise RecordError(
            f"{path} is no universal file: no line holds -1 alone. Copy it again, or name its real format"
        )


def _function(
    path: Path, body: Sequence[bytes], count: int, system: int, words: Mapping[str, str]
) -> tuple[int, Function]:
    """Read a function of dataset 58: records 6 to 12."""
    where = f"{path}: function {count}"
    lines = [x.decode("latin-1").ljust(80) for x in body[:11]]
    if len(lines) < 11:
        raise RecordError(f"{where} has {len(lines)} of 11 lines of its head: it is cut off. Copy it again")
    try:
        kind = int(lines[5][:5])
        dofs = [_dof(lines[5][a : a + 24]) for a in (31, 56)]
        form, n, even = (int(lines[6][a : a + 10]) for a in (0, 10, 20))
        first, step = (float(lines[6][a : a + 13].replace("D", "E")) for a in (30, 43))
        axes = [(int(line[:10]), line[47:67].strip()) for line in lines[7:10]]
    except ValueError:
        raise RecordError(f"{where}: its head is damaged (records 6 to 10 of dataset 58). Export it again") from None
    if form not in (2, 4, 5, 6) or n < 1 or even not in (0, 1):
        raise RecordError(f"{where}: data type {form} or {n} values are none of dataset 58. It is damaged")
    if kind in _FRF and form not in (5, 6):
        raise RecordError(f"{where} is real; a frequency response has a phase. Export it complex")
    x, values = _values(where, body[11:], form, n, bool(even))
    frequency = np.asarray(first + step * np.arange(n) if x is None else x, dtype=np.float64)
    over = axes[0][1] or "Hz"
    if kind in _FRF and (axes[0][0] not in (0, 18) or over not in ("Hz", "kHz", "rad/s", "NONE")):
        raise RecordError(f"{where} is over [{over}], not over frequency. Export the frequency response")
    scale = {"kHz": 1e3, "rad/s": 1 / (2 * np.pi)}.get(over, 1.0)
    factor, units = 1.0, [UNKNOWN, UNKNOWN]
    for k, (quantity, text) in enumerate(axes[1:]):
        if text and text != "NONE" and kind in _FRF:
            if system > 1 and words.get("units") != "labels":
                raise RecordError(
                    f"{where} is labelled [{text}], and dataset 164 says units of system {system}, not SI. Say that "
                    f"the labels hold: {setting('layout', 'units=labels')}; or export in SI"
                )
            try:
                unit = parse_unit(text)
            except UnitError:
                continue
            if text != "g":
                units[k], factor = unit.symbol, factor * (unit.scale if k == 0 else 1 / unit.scale)
        elif system == 1 and quantity in _QUANTITIES:
            units[k] = _QUANTITIES[quantity]
    return kind, Function(
        output=dofs[0] or "output", input=dofs[1] or "input", frequency_hz=scale * frequency,
        values=factor * values, units=(units[0], units[1]),
    )  # fmt: skip


def _dof(text: str) -> str:
    """Return the name of a degree of freedom: entity, node and direction, such as ``12-Z``."""
    entity, node, direction = text[:10].strip(), int(text[10:20]), int(text[20:24])
    sign = "-" if direction < 0 else ""
    point = f"{node}{sign}{_DIRECTIONS[abs(direction)]}" if abs(direction) in _DIRECTIONS else f"{node}:{direction}"
    label = "" if entity in ("", "NONE") else entity
    return label if label and node == 0 and direction == 0 else f"{label} {point}".strip()


def _values(where: str, body: Sequence[bytes], form: int, n: int, even: bool) -> tuple[Array | None, Complex]:
    """Return abscissas where they are given, and the values."""
    pair = 2 if form in (5, 6) else 1
    width = pair if even else pair + 1
    text = b"\n".join(body)
    numbers = _NUMBER.findall(text)
    if _NUMBER.sub(b"", text).strip():
        bad = _NUMBER.sub(b"", text).split()[0].decode("latin-1")
        raise RecordError(f"{where}: {bad[:20]!r} among its values is not a number. It is damaged: export it again")
    flat = np.array([float(x.replace(b"D", b"E").replace(b"d", b"e")) for x in numbers])
    if flat.size != n * width:
        raise RecordError(
            f"{where} has {flat.size} of {n * width} numbers that its head announces: it is cut off. Copy it again"
        )
    rows = flat.reshape(n, width)
    values = np.asarray(rows[:, -2] + 1j * rows[:, -1] if pair == 2 else rows[:, -1], dtype=np.complex128)
    return None if even else rows[:, 0], values
