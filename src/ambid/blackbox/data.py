"""Inputs, outputs and orders as every black-box estimator takes them, and orders as they are written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from types import MappingProxyType
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError, counted, nearest
from ambid.record import Record
from ambid.settings.caller import by_name, setting

_LARGEST = 1e60  # squares of ratios of channels have to stay inside the range of floating-point numbers
_SMALLEST = 1e-60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IOData:
    """Inputs, outputs and, for methods that want it, the reference of a loop.

    Attributes
    ----------
    u, y : ndarray, shape (n_samples, n_inputs or n_outputs), SI
        `u` has no columns for a time series.
    dt : float, s
    inputs, outputs, references : tuple of str
        Names of the columns.
    units : Mapping[str, str]
        SI unit by name.
    open_loop : bool
        Whether the user declares the record open loop. False means "not told so".
    looped : bool
        Whether the loop of its rig says that the record was taken in it.
    reference : ndarray, shape (n_samples, n_references), SI
        Outer excitation of the loop, independent of the noise; no columns where there is none.
    record : Mapping[str, object]
        ``samples``, ``rate_hz``, ``sha256``, ``file`` of the record.
    start_s : float, s
        Time of the first sample in its record.
    """

    u: Array
    y: Array
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    open_loop: bool = False
    looped: bool = False
    reference: Array = field(default_factory=lambda: np.empty((0, 0)))
    references: tuple[str, ...] = ()
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise EstimationError(f"the sampling interval is {self.dt} s; it must be positive. Correct the rate")
        if not self.outputs or np.ndim(self.y) != 2 or np.shape(self.y)[0] < 1:
            raise EstimationError(
                "no output samples; a model needs at least one output. Name one, shape (n_samples, 1)"
            )
        n = int(np.shape(self.y)[0])
        for attribute, what, names in (
            ("u", "input", self.inputs),
            ("y", "output", self.outputs),
            ("reference", "reference", self.references),
        ):
            values = _columns(getattr(self, attribute), what, names, n)
            object.__setattr__(self, attribute, values)
        names = (*self.inputs, *self.outputs, *self.references)
        twice = sorted({x for x in names if names.count(x) > 1})
        if twice:
            raise EstimationError(
                f"channel {twice[0]!r} is named twice; inputs, outputs and references must differ. Omit one"
            )
        values, names = np.hstack([self.u, self.y]), (*self.inputs, *self.outputs)
        for i, k in combinations(range(len(names)), 2):  # channels that stand still are left to the estimators
            if np.array_equal(values[:, i], values[:, k]) and np.ptp(values[:, i]) > 0:
                raise EstimationError(
                    f"channels {names[i]!r} and {names[k]!r} hold the same values; a model cannot distinguish "
                    "them. Omit one"
                )

    @property
    def closed(self) -> bool:
        """Whether something says that there was feedback: the loop of a rig, or its reference."""
        return (self.looped or bool(self.references)) and not self.open_loop

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.y.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs, 0 for a time series."""
        return len(self.inputs)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    def part(self, first: int, last: int) -> IOData:
        """Return samples `first` to `last` (not included).

        Raises
        ------
        EstimationError
            If that is empty or outside the record.
        """
        if not 0 <= first < last <= self.n_samples:
            raise EstimationError(
                f"samples {first} to {last} of a record of {self.n_samples}; they must lie inside it. Correct the part"
            )
        cut = {name: getattr(self, name)[first:last] for name in ("u", "y", "reference")}
        return replace(self, start_s=self.start_s + first * self.dt, **cut)


def io_data(
    record: Record,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    references: Sequence[str] = (),
    open_loop: bool = False,
    looped: bool = False,
) -> IOData:
    """Take channels `inputs` (none for a time series), `outputs` and `references` (the loop's outer excitation) out of
    a record; `open_loop`: whether it is declared so.
    """
    if not outputs:
        raise EstimationError(f"no output was named; a model needs at least one. Give {setting('output', 'COLUMN')}")
    n = record.n_samples

    def columns(names: Sequence[str]) -> Array:
        return np.stack([record[x].values for x in names], axis=1) if names else np.empty((n, 0))

    return IOData(
        u=columns(inputs),
        y=columns(outputs),
        dt=1.0 / record.rate_hz,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        units={x: record.channel(x).unit for x in (*inputs, *outputs, *references)},
        open_loop=open_loop,
        looped=looped,
        reference=columns(references),
        references=tuple(references),
        record={
            "samples": n,
            "rate_hz": record.rate_hz,
            "sha256": record.provenance.get("sha256"),
            "file": record.provenance.get("file"),
            "history": [str(step) for step in record.history],
        },
        start_s=record.start_s,
    )


def _columns(values: Array, what: str, names: tuple[str, ...], n: int) -> Array:
    """Check one group of channels and return it as read-only (n, n_channels)."""
    array = np.array(values, dtype=np.float64, order="C")
    if not names and not array.size:
        return np.empty((n, 0))
    if array.shape != (n, len(names)):
        raise EstimationError(
            f"the {what}s have shape {array.shape} for {counted(len(names), 'name')} and {counted(n, 'sample')} of "
            "the outputs; they must be (n_samples, n_channels), time along axis 0. Pass one column for each name"
        )
    if not np.all(np.isfinite(array)):
        row, column = (int(i[0]) for i in np.nonzero(~np.isfinite(array)))
        raise EstimationError(
            f"{what} {names[column]!r} is not finite at sample {row}; every value must be a number. "
            "Cut the part out, or replace it (signals.replace_samples)"
        )
    for name, column in zip(names, array.T, strict=True):  # squares have to be numbers; what stands still may pass
        low, high = float(column.min()), float(column.max())
        peak, span = max(-low, high), high / 2 - low / 2
        if peak > _LARGEST or 0.0 < span < _SMALLEST:
            size = f"reaches {peak:.3g}" if peak > _LARGEST else f"varies by only {2 * span:.3g}"
            raise EstimationError(
                f"{what} {name!r} {size} in SI units; the computable range is {_SMALLEST:g} to {_LARGEST:g}. Check "
                "its unit, or scale it"
            )
    array.flags.writeable = False
    return array


Orders = Mapping[str, int | str | tuple[int, ...]]
"""Orders as a caller asks for them: one number, one for each input, or "auto" where the method can choose."""

UsedOrders = Mapping[str, int | tuple[int, ...]]
"""Orders as a fit used them: nothing left open."""

AUTO = "auto"


def check_order_names(who: str, orders: Orders, allowed: Sequence[str], needed: Sequence[str] = ()) -> None:
    """Refuse unknown and missing orders of the method `who`."""
    takes = ", ".join(allowed)
    for name in orders:
        if name not in allowed:
            raise EstimationError(
                f"{who}: order {name!r} is unknown; it takes {takes}.{nearest(name, allowed)} Omit it"
            )
    for name in needed:
        if name not in orders:
            raise EstimationError(f"{who}: order {name} is missing; it takes {takes}. Give {name}=1, say")


def left_open(orders: Orders, name: str) -> bool:
    """Return whether the method is to choose an order: it is missing, or "auto"."""
    value = orders.get(name, AUTO)
    return isinstance(value, str) and value == AUTO


def single_order(who: str, orders: Orders, name: str, least: int, *, remedy: str = "Correct it") -> int:
    """Return an order that is one number, at least `least`; `remedy`: what to do about one that is not."""
    value = orders[name]
    values = set(value) if isinstance(value, tuple | list) else {value}
    if len(values) != 1:
        raise EstimationError(f"{who}: order {name} = {value}; it must be one whole number. Give {name}=N")
    return _whole_number(who, name, values.pop(), least, remedy)


def order_per_input(
    who: str, orders: Orders, name: str, least: int, n: int, *, each: str = "input", remedy: str = "Correct it"
) -> tuple[int, ...]:
    """Return an order, at least `least`, for each of `n` inputs, or of what `each` names; `remedy`: what to do if it is
    none.
    """
    value = orders[name]
    values = tuple(value) if isinstance(value, tuple | list) else (value,) * n
    if len(values) != n:
        raise EstimationError(
            f"{who}: order {name} has {_count(len(values), 'number')} for {_count(n, each)}. Give one number, or one "
            f"for each {each}"
        )
    return tuple(_whole_number(who, name, v, least, remedy) for v in values)


def compact_order(values: tuple[int, ...]) -> int | tuple[int, ...]:
    """Return orders of all inputs as a result tells them: a number where all agree."""
    return values[0] if len(set(values)) == 1 else values


def check_length(who: str, data: IOData, rows: int, unknowns: int) -> None:
    """Refuse records without inputs, with a channel that stands still, or with too few `rows` (after lags) for the
    `unknowns` of one output.
    """
    if not data.n_inputs:
        raise EstimationError(
            f"{who}: no input was named; it estimates the path from inputs to outputs. Give {setting('input')}"
        )
    if rows < 4 * unknowns or rows < 20:
        raise EstimationError(
            f"{who}: {data.n_samples} samples for {unknowns} unknowns; at least {max(20, 4 * unknowns)} rows are "
            f"needed and {max(rows, 0)} are left after lags. Give a longer record, or lower the orders"
        )
    for names, values in ((data.inputs, data.u), (data.outputs, data.y), (data.references, data.reference)):
        for name, column in zip(names, np.ptp(values, axis=0), strict=True):
            if column == 0:
                raise EstimationError(
                    f"{who}: channel {name!r} is constant; it carries no information. Excite it, or omit it"
                )


def _whole_number(who: str, name: str, value: object, least: int, remedy: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        if isinstance(value, str) and value == AUTO:
            remedy = f"{who} cannot choose it; give a number"
        raise EstimationError(
            f"{who}: order {name} = {value!r}; it must be a whole number of at least {least}. {remedy}"
        )
    return int(value)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


Candidate = str | tuple[str, Orders | str | None]
"""A structure to compare: ``"arx:na=2,nb=2"``, ``"n4sid"``, or its name beside its orders."""


def orders_of(orders: Mapping[str, Any] | str | None) -> Orders | None:
    """Return orders by name; None where all are to be chosen."""
    if not isinstance(orders, str):
        return orders and by_name(orders, "orders")
    if orders.strip() == "auto":
        return None
    where, remedy = f"{setting('orders')} {orders!r}", "Write na=2,nb=2,nk=1 (nb=2/3 for two inputs), or auto"
    pairs = _pairs(orders.split(","), where, f"{where}: {{}} is not NAME=NUMBER", remedy)
    by_letter: dict[str, int | str | tuple[int, ...]] = {}
    for name, value in pairs.items():
        if value != "auto" and not all(n.strip().isdecimal() and len(n) < 7 for n in value.split("/")):
            raise EstimationError(f"{where}: {f'{name}={value}'!r} is not NAME=NUMBER. {remedy}")
        by_letter[name] = _read_first(value, int, _whole_numbers)
    return by_letter


def candidates_of(candidates: Sequence[Candidate]) -> list[tuple[str, Orders | None]]:
    """Return structures with their orders."""
    structures = list[tuple[str, Orders | None]]()
    for x in candidates:
        if isinstance(x, str):
            name, _, orders = x.partition(":")
            structures.append((name.strip(), orders_of(orders or "auto")))
        else:
            structures.append((x[0], orders_of(x[1])))
    return structures


def settings_of(orders: Mapping[str, Any] | str | None) -> dict[str, Any]:
    """Return the orders of a nonlinear structure by name; what is ``auto`` is left to the method."""
    if orders is None or not isinstance(orders, str):
        return dict(by_name(orders, "orders"))
    if orders.strip() in ("auto", ""):
        return {}
    where = f"{setting('orders')} {orders!r}"
    pairs = _pairs(orders.split(","), where, f"{where}: {{}} is not NAME=VALUE", "Write ny=2,nu=2,degree=3")
    return {name: _read_first(x, _whole_numbers, int, float) for name, x in pairs.items() if x != "auto"}


def fixed_of(coefficients: Mapping[str, float] | Sequence[str] | str | None) -> dict[str, float]:
    """Return known coefficients by name, from ``a1=-1.5`` and so on."""
    if isinstance(coefficients, Mapping):
        return dict(coefficients)
    rule, remedy = f"{setting('fix')} {{}} is not NAME=NUMBER", f"Give {setting('fix', 'a1=-1')}, for example"
    pairs = _pairs(
        coefficients.split(",") if isinstance(coefficients, str) else coefficients or (), setting("fix"), rule, remedy
    )
    values = {name: _read_first(value, float) for name, value in pairs.items()}
    for name, number in values.items():
        if isinstance(number, str):
            raise EstimationError(f"{rule.format(repr(f'{name}={number}'))}. {remedy}")
    return values


def _pairs(parts: Iterable[str], where: str, rule: str, remedy: str) -> dict[str, str]:
    """Read NAME=VALUE, each name once; ``{}`` in `rule` stands for a part that is not of that form."""
    values: dict[str, str] = {}
    for part in parts:
        name, _, value = (x.strip() for x in part.partition("="))
        if not (name and value):
            raise EstimationError(f"{rule.format(repr(part.strip()))}. {remedy}")
        if name in values:
            raise EstimationError(f"{where}: {name} is given twice. Omit one")
        values[name] = value
    return values


def _read_first(text: str, *kinds: Callable[[str], Any]) -> Any:
    """Read a text as the first kind that takes it; as it is where none does."""
    for kind in kinds:
        with suppress(ValueError):
            return kind(text)
    return text


def _whole_numbers(text: str) -> tuple[int, ...]:
    parts = [x.strip() for x in text.split("/")]
    if len(parts) < 2 or not all(x.isdecimal() for x in parts):
        raise ValueError(text)
    return tuple(map(int, parts))
