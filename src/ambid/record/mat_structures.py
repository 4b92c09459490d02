"""Signals in MATLAB's structures, with names and units: Simulink, timeseries, Simcenter Testlab, plain structs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError, UnitError
from ambid.record.clock import TIME_NAMES, clock_of, timed
from ambid.record.record import Record
from ambid.record.sampling import MIN_SAMPLES, GapPolicy
from ambid.record.streams import Stream, chosen_group, record_of
from ambid.record.words import is_time, label_of, unit_or_none
from ambid.settings.caller import setting
from ambid.units import parse_unit

_LONE = "signals"  # group of the structures that hold one signal each
_VECTORS = "vectors"
_UNITS = ("units", "Units", "unit", "Unit")
_REMEDIES = {
    "timeseries": "S = struct('Time', {0}.Time, 'Data', {0}.Data, 'Name', {0}.Name, 'units', {0}.DataInfo.Units)",
    "timetable": "S = struct('time', seconds({0}.Time), 'u', {0}.u, 'units', struct('u', 'V'))",
    "table": "S = struct('time', {0}.t, 'u', {0}.u, 'units', struct('u', 'V'))",
    "Simulink.SimulationData": "x = {0}{{1}}.Values; "
    "S(1) = struct('Time', x.Time, 'Data', x.Data, 'Name', x.Name, 'units', 'V') and so on",
}


@dataclass(frozen=True, slots=True)
class Foreign:
    """An object of a MATLAB class, whose content no library reads."""

    kind: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Signal:
    name: str
    values: np.ndarray
    units: Mapping[str, str]  # by the field that says them
    time: Array | None = None
    time_unit: str = "s"
    step: tuple[float, float] | None = None  # start and interval, where there is no time
    factor: tuple[float, float] = (1.0, 0.0)  # of a unit transformation, and its offset


def refuse_foreign(content: Mapping[str, Any], path: Path) -> None:
    """Refuse a file whose data are in objects, and say how they become structs."""
    for name, kind in _foreign(content):
        remedy = next((text.format(name) for word, text in _REMEDIES.items() if kind.startswith(word)), None)
        if remedy is not None:
            raise RecordError(
                f"record {path}: {name} is a MATLAB object of class {kind}, which can be read by MATLAB only. There: "
                f"{remedy}; save('{path.name}', 'S')"
            )


def _foreign(node: Any, name: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(node, Foreign):
        yield name, node.kind
    elif isinstance(node, Mapping):
        for key, x in node.items():
            yield from _foreign(x, f"{name}.{key}" if name else key)
    elif isinstance(node, list):
        for k, x in enumerate(node, 1):
            yield from _foreign(x, f"{name}{{{k}}}")


def structures(content: Mapping[str, Any], path: Path) -> dict[str, list[_Signal]]:
    """Return the signals of the file by group: by variable, those of variables with one signal each together."""
    groups: dict[str, list[_Signal]] = {}
    for name, node in content.items():
        signals = list(_lines(node)) if name.startswith("hgS_") else list(_signals(node, name, path))
        if signals:
            groups.setdefault(_LONE if len(signals) == 1 else name, []).extend(signals)
    vectors = {k: v for k, x in content.items() if (v := _vector(x)) is not None}
    if not groups and len(vectors) < 2:
        signals = list(_matrix(content))
        signals += [_Signal(name=k, values=v, units={}) for k, v in vectors.items() if signals]
        return {_VECTORS: signals} if signals else {}
    time = next((v for k, v in vectors.items() if is_time(k)), None)
    if time is not None:  # of models that save it apart
        groups = {
            k: [x if x.time is not None or x.step or x.values.size != time.size else replace(x, time=time) for x in own]
            for k, own in groups.items()
        }
    loose = {k: v for k, v in vectors.items() if not is_time(k)} if groups else {}
    if loose:
        groups[_VECTORS] = [_Signal(name=k, values=v, units={}, time=time) for k, v in loose.items()]
    return groups


def scalars(node: Any) -> dict[str, tuple[float, str | None]]:
    """Return the numbers that stand beside the data, by name."""
    found: dict[str, tuple[float, str | None]] = {}
    for key, x in node.items() if isinstance(node, Mapping) else ():
        if isinstance(x, np.ndarray) and x.size == 1 and x.dtype.kind in "fiu":
            found[key] = (float(x.reshape(-1)[0]), None)
        elif isinstance(x, Mapping):
            found |= scalars(x)
    return found


def _matrix(node: Mapping[str, Any]) -> Iterator[_Signal]:
    """Yield the columns of the one matrix of a struct: named by texts beside it, or by number."""
    matrices = {k: x for k, x in node.items() if isinstance(x, np.ndarray) and x.ndim == 2 and x.dtype.kind in "fiu"}
    matrices = {k: x if x.shape[0] >= x.shape[1] else x.T for k, x in matrices.items() if min(x.shape) > 1}
    large = {k: x for k, x in matrices.items() if x.shape[0] >= MIN_SAMPLES and x.shape[0] > x.shape[1]}
    if len(large) != 1:
        return
    key, matrix = next(iter(large.items()))
    n = matrix.shape[1]
    texts = [x for x in map(_texts, node.values()) if len(x) == n]
    units = next((x for x in texts if all(unit_or_none(t) for t in x if t) and any(x)), None)
    names = next((x for x in texts if x is not units and len(set(x)) == n), None)
    labels = [label_of(x) for x in names] if names else [(f"{key}({j + 1})", None) for j in range(n)]
    for j, (name, inside) in enumerate(labels):
        unit = inside or ("" if units is None else units[j])
        yield _Signal(name=name or f"column {j + 1}", values=matrix[:, j], units={"units": unit})


def _texts(value: Any) -> list[str]:
    """Return the texts of a cell array, or of rows of letters."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "US":
        value = value.reshape(-1).tolist()
    return (
        [_text(x) for x in value] if isinstance(value, list) and all(isinstance(x, str | list) for x in value) else []
    )


def _lines(node: Any) -> Iterator[_Signal]:
    """Yield the lines of a MATLAB figure."""
    for x in node if isinstance(node, list) else [node]:
        if not isinstance(x, Mapping):
            continue
        own = x.get("properties")
        along, values = (_vector(_at(own, k)) for k in ("XData", "YData"))
        if along is not None and values is not None and along.size == values.size:
            label, unit = label_of(_text(_at(own, "DisplayName")) or _text(_at(own, "Tag")))
            yield _Signal(name=label or "line", values=values, units={"label": unit or ""}, time=along)
        yield from _lines(x.get("children"))


def _dspace(fields: Mapping[str, Any], path: Path) -> Iterator[_Signal]:
    """Yield the signals of a measurement of dSPACE: X(k) are axes, Y(k) lie over X(Y(k).XIndex)."""
    axes, signals = (x if isinstance(x, list) else [x] for x in (fields["x"], fields["y"]))
    for k, y in enumerate(signals, 1):
        index = _at(y, "XIndex")
        at = int(index.reshape(-1)[0]) - 1 if isinstance(index, np.ndarray) and index.size else 0
        x = axes[min(max(at, 0), len(axes) - 1)]
        label, inside = label_of(_text(y.get("Name")) or f"Y({k})")
        yield from _columns(
            y["Data"], label, path, _units(y) or {"Name": inside or ""}, time=_vector(_at(x, "Data")),
            time_unit=_text(_at(x, "Unit")) or "s",
        )  # fmt: skip


def read_structures(
    path: Path, provenance: Mapping[str, str], groups: Mapping[str, list[_Signal]], layout: Mapping[str, str],
    rate_hz: float | None, gaps: GapPolicy, kind: str, beside: Mapping[str, tuple[float, str | None]],
) -> Record:  # fmt: skip
    """Make a record of the signals of one group."""
    group = chosen_group(path, {k: [s.name for s in v] for k, v in groups.items()}, layout.get("group"))
    every, told = groups[group], dict[str, object]()
    if all(s.time is None and s.step is None for s in every):
        every, told, rate_hz = _timed(every, path, layout, rate_hz, beside)
    twice = next((s.name for k, s in enumerate(every) if s.name in [x.name for x in every[:k]]), None)
    if twice is not None:
        raise RecordError(f"record {path}: {group} has two signals {twice!r}; names must differ. Rename one")
    names = [x.strip() for x in layout["channels"].split(",")] if "channels" in layout else [s.name for s in every]
    wanted = [s for s in every if s.name in names] or every
    streams = [_stream(s, path, layout) for s in wanted]
    clocks = [s for s in wanted if s.time is not None]
    for other in clocks[1:]:
        if not np.array_equal(clocks[0].time, other.time) or clocks[0].time_unit != other.time_unit:  # type: ignore[arg-type]
            raise RecordError(
                f"record {path}: {clocks[0].name!r} and {other.name!r} have different times ({_span(clocks[0])}, "
                f"{_span(other)}); all must have the same. Choose some: "
                f"{setting('layout', f'channels={clocks[0].name},…')}"
            )
    if clocks:
        time = np.asarray(clocks[0].time, dtype=np.float64)
        unit = frozenset({clocks[0].time_unit})
        streams.append(Stream(name="time", size=time.size, pieces=lambda: (time,), time=True, units=unit))
    return record_of(path, provenance, streams, {"format": kind, "group": group, **told}, layout, rate_hz, gaps)


def _timed(
    every: list[_Signal], path: Path, layout: Mapping[str, str], rate_hz: float | None,
    beside: Mapping[str, tuple[float, str | None]],
) -> tuple[list[_Signal], dict[str, object], float | None]:  # fmt: skip
    """Find the time of signals among them, or a rate beside them."""
    every = [x for x in every if x.values.size == max(y.values.size for y in every)]
    names, units = [x.name for x in every], [next(filter(None, x.units.values()), None) for x in every]
    columns = [x.values for x in every]
    clock = clock_of(names, units, columns, where=f"record {path}", rate_hz=rate_hz, beside=beside, layout=layout)
    if clock.column is None:
        told: dict[str, object] = {"time": clock.why} if clock.why else {}
        return every, told, rate_hz if clock.rate_hz is None else clock.rate_hz
    own = np.asarray(columns[clock.column], dtype=np.float64)
    time, told = timed(own, names[clock.column], units[clock.column], clock.why, f"record {path}", layout, rate_hz)
    return [replace(x, time=time) for j, x in enumerate(every) if j != clock.column], told, rate_hz


def _span(signal: _Signal) -> str:
    time = np.asarray(signal.time)
    return f"{time.size} samples, {time[0]:.6g} to {time[-1]:.6g} {signal.time_unit}"


def _stream(signal: _Signal, path: Path, layout: Mapping[str, str]) -> Stream:
    """Return a signal with its one unit; several that differ are asked back, and so is a transformation of it."""
    texts = {field: text for field, text in signal.units.items() if text}
    if "units" in layout:
        texts = {field: text for field, text in texts.items() if field == layout["units"]}
    if len(set(texts.values())) > 1:
        listed = ", ".join(f"{field} says [{text}]" for field, text in texts.items())
        raise RecordError(
            f"record {path}: signal {signal.name!r} has several units ({listed}). Say which field to believe: "
            f"{setting('layout', f'units={next(iter(texts))}')}, or {setting('layout', 'units=none')}"
        )
    values, unit = signal.values, next(iter(texts.values()), "")
    if signal.factor != (1.0, 0.0):
        if layout.get("values") not in ("si", "label"):
            raise RecordError(
                f"record {path}: signal {signal.name!r} is in [{unit}] with a unit transformation (factor "
                f"{signal.factor[0]:g}, offset {signal.factor[1]:g}). Say what values are in: "
                f"{setting('layout', 'values=si')}, or "
                f"{setting('layout', 'values=label')} for [{unit}]"
            )
        if layout["values"] == "si":
            unit = _si(unit)
    step, start = (signal.step[1], signal.step[0]) if signal.step else (0.0, 0.0)
    return Stream(
        name=signal.name, size=values.size, pieces=lambda: (values,), units=frozenset({unit} - {""}),
        rate_hz=float(f"{1 / step:.10g}") if 0 < step < np.inf else None, start=(start, ""),
    )  # fmt: skip


def _signals(node: Any, name: str, path: Path, above: Array | None = None) -> Iterator[_Signal]:
    """Yield all signals of a variable; `above`: the time of a struct that it is in.

    time, signals(k).values, .label          Simulink, "Structure with time"
    Time, Data, Name, units                  a timeseries as struct, alone, in arrays, fields or Elements{k}.Values
    x_values, y_values, function_record      Simcenter (LMS) Testlab
    X.Data, Y(k).Data, .Name, .Unit          dSPACE
    time, u, i, …, units.u                   a struct of columns, with or without time
    data, names                              a struct of a matrix
    """
    if isinstance(node, list):
        for k, x in enumerate(node, 1):
            yield from _signals(x, f"{name}({k})", path, above)
    if not isinstance(node, Mapping):
        return
    fields = {key.lower(): x for key, x in node.items()}
    clocks = (*TIME_NAMES, *filter(is_time, fields))
    own = next((v for key in clocks if (v := _vector(fields.get(key))) is not None), None)
    time = above if own is None else own
    if all(_at(x[0] if isinstance(x, list) and x else x, "Data") is not None for x in map(fields.get, "xy")):
        yield from _dspace(fields, path)
    elif "signals" in fields and "time" in fields:
        parts = fields["signals"] if isinstance(fields["signals"], list) else [fields["signals"]]
        for k, part in enumerate(parts, 1):
            if isinstance(part, Mapping) and "values" in part:
                label, inside = label_of(_text(part.get("label")))
                units = {"label": inside or "", **_units(part)}
                yield from _columns(part["values"], label or f"signals({k})", path, units, time=time)
    elif "data" in fields and time is not None:
        unit = _text(_at(fields, "timeinfo", "Units")) or _text(fields.get("timeunits")) or "s"
        called = _text(fields.get("name")) or name
        yield from _columns(fields["data"], called, path, _units(node), time=time, time_unit=unit)
    elif "x_values" in fields and "y_values" in fields:
        yield from _testlab(fields, name, path)
    elif time is not None:
        over = next((u for k in node if is_time(k) and (u := _beside(fields.get("units"), k)["units"])), "s")
        for key, x in node.items():
            vector = None if is_time(key) else _vector(x)
            if vector is not None and vector.size == time.size:
                by_name = _beside(fields.get("units"), key)
                yield _Signal(name=key, values=vector, units=by_name, time=time, time_unit=over)
            elif isinstance(x, Mapping | list):
                yield from _signals(x, key, path, time)
    elif len(vectors := {k: v for k, x in node.items() if (v := _vector(x, MIN_SAMPLES)) is not None}) > 1:
        for key, vector in vectors.items():
            yield _Signal(name=key, values=vector, units=_beside(fields.get("units"), key))
    elif signals := list(_matrix(node)):
        yield from signals
    else:
        for key, x in node.items():
            called = _text(fields.get("name")) if key.lower() == "values" else ""
            yield from _signals(x, called or (name if key.lower() in ("values", "elements") else key), path)


def _beside(units: Any, key: str) -> dict[str, str]:
    """Return the unit that a struct of units has for a field."""
    return {"units": _text(units.get(key)) if isinstance(units, Mapping) else ""}


def _testlab(fields: Mapping[str, Any], name: str, path: Path) -> Iterator[_Signal]:
    x, y = fields["x_values"], fields["y_values"]
    if not (isinstance(x, Mapping) and isinstance(y, Mapping) and "values" in y):
        return
    over = _text(_at(x, "quantity", "label")) or "s"
    if over not in ("s", "ms", "us"):
        raise RecordError(f"record {path}: {name} is over [{over}], not over time. Export the time signals")
    called = _at(fields, "function_record", "name")
    names = [_text(n) for n in called] if isinstance(called, list) else [_text(called) or name]
    try:
        start, step, count = (float(np.ravel(x[k])[0]) for k in ("start_value", "increment", "number_of_values"))
    except (KeyError, IndexError, TypeError, ValueError):
        raise RecordError(
            f"record {path}: {name}.x_values has no start_value, increment and number_of_values. Export it again"
        ) from None
    scale = {"s": 1.0, "ms": 1e-3, "us": 1e-6}[over]
    change = _at(y, "quantity", "unit_transformation")
    factor = tuple(float(np.ravel(_at(change, k))[0]) if _vector(_at(change, k), 1) is not None else usual
                   for k, usual in (("factor", 1.0), ("offset", 0.0)))  # fmt: skip
    unit = {"quantity.label": _text(_at(y, "quantity", "label"))}
    for signal in _columns(y["values"], names if len(names) > 1 else names[0], path, unit, length=int(count)):
        if signal.values.size != count:
            raise RecordError(
                f"record {path}: {signal.name!r} has {signal.values.size} values; number_of_values is {count:g}. It is "
                "cut off: export it again"
            )
        yield _Signal(
            name=signal.name, values=signal.values, units=unit, step=(start * scale, step * scale),
            factor=(factor[0], factor[1]),
        )  # fmt: skip


def _columns(
    values: Any, name: str | Sequence[str], path: Path, units: Mapping[str, str], *, time: Array | None = None,
    time_unit: str = "s", length: int | None = None,
) -> Iterator[_Signal]:  # fmt: skip
    """Yield the columns of a signal of one or more dimensions, named name(1), name(2), …"""
    called = name if isinstance(name, str) else ", ".join(name)
    if isinstance(values, Foreign) or not isinstance(values, np.ndarray) or values.dtype.kind not in "fiub":
        kind = "complex" if isinstance(values, np.ndarray) and values.dtype.kind == "c" else "not numeric"
        raise RecordError(
            f"record {path}: the values of {called!r} are {kind}; they must be real numbers. Save them so"
        )
    n = length if time is None else time.size
    array = values
    if array.ndim == 3:  # one matrix a sample
        array = array.reshape(-1, array.shape[2]).T if 1 in array.shape[:2] else array
    elif array.ndim == 2 and array.shape[0] == 1 and array.shape[1] == (n or array.shape[1]):
        array = array.T
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise RecordError(
            f"record {path}: {called!r} is a {' x '.join(map(str, values.shape))} array. Save its columns"
        )
    if n is not None and time is not None and array.shape[0] != n:
        raise RecordError(
            f"record {path}: {called!r} is {' x '.join(map(str, values.shape))}, its time has {n} samples. Save again"
        )
    many = array.shape[1]
    if not isinstance(name, str) and len(name) != many:
        raise RecordError(f"record {path}: {len(name)} names ({called}) for {many} columns. Export it again")
    for j in range(many):
        own = name[j] if not isinstance(name, str) else name if many == 1 else f"{name}({j + 1})"
        yield _Signal(name=own, values=array[:, j], units=units, time=time, time_unit=time_unit)


def _units(node: Mapping[str, Any]) -> dict[str, str]:
    """Return what a struct says of its unit, by field."""
    units = {key: _text(node.get(key)) for key in _UNITS}
    info = _at(node, "DataInfo", "Units")
    units["DataInfo.Units"] = _text(info) or _text(_at(info, "Name"))
    return {key: text for key, text in units.items() if text}


def _at(node: Any, *keys: str) -> Any:
    for key in keys:
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def _si(text: str) -> str:
    try:
        return parse_unit(text).si
    except UnitError:
        return text


def _text(value: Any) -> str:
    """Return a text, or nothing."""
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    return " ".join(value.split()) if isinstance(value, str) else ""  # names of blocks are written on two lines


def _vector(value: Any, least: int = 2) -> Array | None:
    """Return a numeric vector, shape (n,)."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.size >= least:
        return value.reshape(-1) if value.size == max(value.shape) else None
    return None
