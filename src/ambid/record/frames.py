"""Records from tables in memory and back: pandas, polars, xarray, dicts of arrays, none imported unless a record
becomes one: what comes in is known by the module of its class. The rules are those of files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError, nearest
from ambid.record.clock import TIME_NAMES, timed
from ambid.record.record import Channel, Record
from ambid.record.sampling import (
    GapPolicy,
    Rows,
    Table,
    record_of_rows,
    refuse_gaps,
    uniform_record,
)
from ambid.record.words import is_time, label_of
from ambid.units import UNKNOWN

_EXACT = 2.0**53  # beyond it a float64 does not hold every whole number
_TABLES = (("pandas", "DataFrame"), ("polars", "DataFrame"), ("xarray", "Dataset"))
_REMEDIES = {
    ("pandas", "Series"): "Pass a DataFrame: series.to_frame()",
    ("polars", "Series"): "Pass a DataFrame: series.to_frame()",
    ("polars", "LazyFrame"): "Pass a DataFrame: frame.collect()",
    ("xarray", "DataArray"): "Pass a Dataset: array.to_dataset()",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Column:
    """A column of a table, or its index."""

    label: object  # as the table has it
    values: Any  # what NumPy makes an array of
    unit: str | None = None  # where the table itself says one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Parts:
    """A table taken apart."""

    what: str  # for messages
    columns: tuple[_Column, ...]
    index: _Column | None = None


def read_table(
    table: object,
    *,
    rate_hz: float | None = None,
    units: Mapping[str, str] | None = None,
    gaps: GapPolicy = "error",
) -> Record:
    """Take a record in SI from a DataFrame of pandas or polars, a Dataset of xarray or a mapping; `rate_hz`: where it
    holds no time; `units`: by column, beside or instead of ``name [unit]``.
    """
    rows = _table(_parts(table), units)
    if gaps == "error":
        refuse_gaps(rows)
    return uniform_record(rows, rate_hz, gaps)


def read_table_rows(table: object, *, rate_hz: float | None = None, units: Mapping[str, str] | None = None) -> Rows:
    """Take the rows of a table as they stand, whatever is missing and however time runs (`Rows`)."""
    return record_of_rows(_table(_parts(table), units), rate_hz)


def to_dataframe(record: Record) -> Any:
    """Return a record as a pandas DataFrame."""
    pandas = imported("pandas", "a DataFrame")
    columns = {(c.name if c.unit == UNKNOWN else f"{c.name} [{c.unit}]"): c.values for c in record.channels}
    return pandas.DataFrame(columns, index=pandas.Index(record.time_s, name="time [s]"))


def to_xarray(record: Record) -> Any:
    """Return a record as an xarray Dataset."""
    xarray = imported("xarray", "a Dataset")
    return xarray.Dataset(
        {c.name: ("time", c.values, {} if c.unit == UNKNOWN else {"units": c.unit}) for c in record.channels},
        coords={"time": ("time", record.time_s, {"units": "s"})},
        attrs={
            "rate_hz": record.rate_hz,
            "history": "\n".join(map(str, record.history)),
            **{f"source_{key}": text for key, text in record.provenance.items()},
        },
    )


def imported(name: str, what: str, extra: str = "frames") -> Any:
    """Import a package that is asked for, one of an extra."""
    try:
        return import_module(name)
    except ImportError:
        raise RecordError(f"{name} is not installed, and {what} needs it. Install {name}, or ambid[{extra}]") from None


def _class_of(x: object) -> tuple[str, str]:
    """Return the package and the name of the class of something, where the package is one that has tables."""
    libraries = {*_TABLES, *_REMEDIES}
    classes = ((c.__module__.partition(".")[0], c.__name__) for c in type(x).__mro__)
    return next((x for x in classes if x in libraries), ("", ""))


def _parts(table: Any) -> _Parts:
    """Take a table apart; refuse what is none."""
    kind = _class_of(table)
    if kind == ("pandas", "DataFrame"):
        return _of_pandas(table)
    if kind == ("polars", "DataFrame"):
        columns = tuple(_Column(label=name, values=table.get_column(name)) for name in table.columns)
        return _Parts(what="the DataFrame", columns=columns)
    if kind == ("xarray", "Dataset"):
        return _of_xarray(table)
    if isinstance(table, Mapping):
        columns = tuple(_Column(label=name, values=x, unit=_own_unit(x)) for name, x in table.items())
        return _Parts(what="the dict of arrays", columns=columns)
    remedy = _REMEDIES.get(kind, 'Pass a file, or a dict of arrays such as {"voltage [V]": u} with rate_hz=')
    raise RecordError(
        f"a record cannot be taken from what is of type {type(table).__name__}; a file, a Record, a DataFrame, a "
        f"Dataset or a dict of arrays can. {remedy}"
    )


def _own_unit(x: Any) -> str | None:
    """Return the unit that a channel or a labelled array has of itself."""
    if isinstance(x, Channel):
        return None if x.unit == UNKNOWN else x.unit
    attributes = getattr(x, "attrs", None)
    unit = attributes.get("units") if isinstance(attributes, Mapping) else None
    return unit if isinstance(unit, str) else None


def _of_pandas(table: Any) -> _Parts:
    for what, labels in (("column", table.columns), ("row", table.index)):
        if labels.nlevels > 1:
            raise RecordError(
                f"the DataFrame has a MultiIndex with {labels.nlevels} labels for each {what}; one is needed. Select a"
                " level first, or reset_index"
            )
    columns = tuple(_Column(label=x, values=table.iloc[:, j]) for j, x in enumerate(table.columns))
    return _Parts(what="the DataFrame", columns=columns, index=_Column(label=table.index.name, values=table.index))


def _plain(values: Any) -> np.ndarray:
    """Return an array; missing values as NaN, dates without a time zone. NumPy alone would take what lies under a mask,
    and make objects of columns that only pandas knows.
    """
    dtype: Any = getattr(values, "dtype", None)
    if np.ma.isMaskedArray(values):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    elif hasattr(values, "to_numpy") and not isinstance(dtype, np.dtype) and hasattr(dtype, "kind"):
        if dtype.kind in "iu" and not values.isna().any():
            values = values.to_numpy(dtype=f"{dtype.kind}8")
        elif dtype.kind in "iufb":
            values = values.to_numpy(dtype=np.float64, na_value=np.nan)
        elif dtype.kind == "M":
            values = values.to_numpy(dtype="datetime64[ns]")
    return np.asarray(values)


def _of_xarray(table: Any) -> _Parts:
    names = list(table.data_vars)
    for name in names:
        if table[name].dims != table[names[0]].dims or len(table[name].dims) != 1:
            raise RecordError(
                f"variable {name!r} of the Dataset has the dimensions {table[name].dims}; every channel has one,"
                " the same for all. Select from the others, or drop the variable"
            )
    columns = tuple(_Column(label=x, values=table[x].values, unit=_own_unit(table[x])) for x in names)
    dimension = table[names[0]].dims[0] if names else None
    index = None
    if dimension is not None and dimension in table.coords:
        along = table.coords[dimension]
        index = _Column(label=dimension, values=along.values, unit=_own_unit(along))
    return _Parts(what="the Dataset", columns=columns, index=index)


def _table(parts: _Parts, units: Mapping[str, str] | None) -> Table:
    """Check names, units and numbers, and find time."""
    if units is not None and not isinstance(units, Mapping):
        raise RecordError(f"units is {units!r}; it holds a unit by column. Write units={{'voltage': 'V'}}")
    names, texts, arrays = list[str](), list[str | None](), list[Array]()
    left, time, told = dict(units or {}), None, dict[str, object]()
    for column in parts.columns:
        name, text = _named(parts.what, column, left)
        if name in names:
            raise RecordError(f"{parts.what} has column {name!r} twice; names must differ. Rename one")
        values = _plain(column.values)
        if is_time(name) and (time is None or name.lower() in TIME_NAMES):
            time, text = len(names), _time_text(values, text)
        names.append(name)
        texts.append(text)
        arrays.append(numbers(parts.what, name, values, time=time == len(names) - 1))
    index = None if parts.index is None else _index(parts, parts.index, left)
    if index is not None and time is not None:
        raise RecordError(
            f"{parts.what} tells time twice, by its index and by column {names[time]!r}. Drop one of them"
        )
    if left:
        unknown = next(iter(left))
        raise RecordError(
            f"units names {unknown!r}, which is no column; {parts.what} has {', '.join(names) or 'none'}."
            f"{nearest(str(unknown), names)} Correct units"
        )
    if not names:
        raise RecordError(f"{parts.what} has no columns; a record needs at least one. Check what was selected")
    if index is not None:
        names, texts, arrays, time = ["time", *names], [index[0], *texts], [index[1], *arrays], 0
    sizes = {x.size for x in arrays}
    if len(sizes) > 1:
        listing = ", ".join(f"{name} {x.size}" for name, x in zip(names, arrays, strict=True))
        raise RecordError(f"columns differ in length ({listing}); all must have the same. Cut them")
    values = np.column_stack(arrays)
    if time is not None:
        values[:, time], told = timed(values[:, time], names[time], texts[time], "", parts.what)
    digest = hashlib.sha256(repr((names, texts)).encode() + values.tobytes()).hexdigest()
    return Table(
        where=parts.what, names=tuple(names), unit_texts=tuple(texts), values=values, first_row=0, time=time,
        provenance={"sha256": digest},
        settings={"format": parts.what.removeprefix("the "), "rows": values.shape[0], **told},
    )  # fmt: skip


def _named(what: str, column: _Column, units: dict[str, str]) -> tuple[str, str | None]:
    """Return name and unit of a column; what is taken from `units` is taken out of it."""
    if not isinstance(column.label, str) or not column.label.strip():
        raise RecordError(
            f"{what} has a column called {column.label!r}; a name is a text. Rename it, as 'voltage [V]' and so on"
        )
    name, inside = label_of(column.label)
    texts = {text for text in (inside, column.unit) if text is not None}
    texts |= {_text_of(name, units.pop(key)) for key in {name, column.label} if key in units}
    if len(texts) > 1:
        one, other = sorted(texts)[:2]
        raise RecordError(f"column {name!r} of {what} is declared in [{one}] and in [{other}]. Omit one of them")
    return name, next(iter(texts), None)


def _text_of(name: str, unit: object) -> str:
    if not isinstance(unit, str):
        raise RecordError(f"units gives {unit!r} for {name!r}; a unit is a text. Write units={{{name!r}: 'V'}}")
    return unit


def _time_text(values: np.ndarray, text: str | None) -> str | None:
    """Dates and time differences come in seconds, whatever unit they had."""
    return "s" if values.dtype.kind in "mM" else text


def numbers(what: str, name: str, values: np.ndarray, *, time: bool) -> Array:
    """Return a column as real numbers, dates and time differences in s; `what`: the table, for messages."""
    place, kind = f"column {name!r} of {what}", values.dtype.kind
    if values.ndim != 1:
        raise RecordError(f"{place} has shape {values.shape}; a channel is one column (n_samples,). Pass one column")
    if kind in "mM":
        if not time:
            raise RecordError(f"{place} holds times; a channel holds numbers. Call it 'time', or omit it")
        stamps = values[~np.isnat(values)]
        begin = stamps[0] if kind == "M" and stamps.size else np.timedelta64(0, "s")
        return np.asarray((values - begin) / np.timedelta64(1, "s"), dtype=np.float64)
    if kind == "c":
        raise RecordError(
            f"{place} holds complex numbers; a measured channel is real. Pass real and imaginary part as two columns"
        )
    if kind not in "iufb":
        others = [x for x in values.ravel() if not isinstance(x, (int, float))]
        what = f"no numbers (such as {str(others[0])[:20]!r})" if others else f"numbers as {values.dtype}s"
        raise RecordError(f"{place} holds {what}. Convert it with astype(float), or omit it")
    parsed = np.asarray(values, dtype=np.float64)
    if kind in "iu" and parsed.size and np.abs(parsed).max() > _EXACT:
        raise RecordError(
            f"{place} reaches {np.abs(parsed).max():.4g}; beyond 2^53 whole numbers lose digits. Subtract the first one"
        )
    return parsed


def _index(parts: _Parts, index: _Column, units: dict[str, str]) -> tuple[str | None, Array] | None:
    """Return unit and values of an index that is time; None for one that counts rows."""
    values = _plain(index.values)
    labelled = index.label is not None
    name, text = _named(parts.what, index, units) if labelled else ("time", None)
    if values.dtype.kind in "iu" and not (labelled and is_time(name)):
        if values.size > 1 and np.ptp(np.diff(values)):
            raise RecordError(
                f"the index of {parts.what} jumps: rows are missing, or were put together. Treat them as a gap with a"
                " column 'time [s]', or reset_index(drop=True) where none is missing"
            )
        return None
    if values.dtype.kind not in "iufmM" or (labelled and not is_time(name) and values.dtype.kind in "f"):
        called = f" {index.label!r}" if labelled else ""
        raise RecordError(
            f"the index{called} of {parts.what} is no time: it has to hold seconds, time differences or dates, and be"
            " called 'time'. Convert or rename it, or reset_index"
        )
    return _time_text(values, text) or "s", numbers(parts.what, "time", values, time=True)
