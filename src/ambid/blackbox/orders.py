"""Orders of black-box models: how they are asked for, and the rules that every estimator reads them by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, nearest

Orders = Mapping[str, int | str | tuple[int, ...]]
"""Orders as a caller asks for them: one number, one for each input, or "auto" where the method can choose."""

UsedOrders = Mapping[str, int | tuple[int, ...]]
"""Orders as a fit used them: nothing left open."""

AUTO = "auto"


def known_orders(who: str, orders: Orders, allowed: Sequence[str], needed: Sequence[str] = ()) -> None:
    """Refuse unknown and missing orders.

    `who`: method.
    """
    takes = ", ".join(allowed)
    for name in orders:
        if name not in allowed:
            raise EstimationError(
                f"{who}: order {name!r} is not known; it takes {takes}.{nearest(name, allowed)} Leave it out"
            )
    for name in needed:
        if name not in orders:
            raise EstimationError(f"{who}: order {name} is missing; it takes {takes}. Give {name}=1, say")


def left_open(orders: Orders, name: str) -> bool:
    """Return whether the method is to choose an order: it is missing, or "auto"."""
    value = orders.get(name, AUTO)
    return isinstance(value, str) and value == AUTO


def single(who: str, orders: Orders, name: str, least: int, *, remedy: str = "Correct it") -> int:
    """Return an order that is one number.

    `least`: smallest allowed; `remedy`: what to do about a number that is not.
    """
    value = orders[name]
    values = set(value) if isinstance(value, tuple | list) else {value}
    if len(values) != 1:
        raise EstimationError(f"{who}: order {name} = {value}; it must be one whole number. Give {name}=N")
    return _whole(who, name, values.pop(), least, remedy)


def per_input(
    who: str, orders: Orders, name: str, least: int, n: int, *, of: str = "input", remedy: str = "Correct it"
) -> tuple[int, ...]:
    """Return an order for every input.

    `least`: smallest allowed; `n`: number of inputs; `of`: what has an order each, if not inputs; `remedy`: what to do
    about a number that is not.
    """
    value = orders[name]
    values = tuple(value) if isinstance(value, tuple | list) else (value,) * n
    if len(values) != n:
        raise EstimationError(
            f"{who}: order {name} has {_count(len(values), 'number')} for {_count(n, of)}. Give one number, or one for "
            f"each {of}"
        )
    return tuple(_whole(who, name, v, least, remedy) for v in values)


def shown(values: tuple[int, ...]) -> int | tuple[int, ...]:
    """Return orders of all inputs as a result tells them: a number where all agree."""
    return values[0] if len(set(values)) == 1 else values


def long_enough(who: str, data: IOData, rows: int, unknowns: int) -> None:
    """Refuse records that are too short, without inputs, or with a channel that stands still.

    `rows`: samples that are left after lags; `unknowns`: numbers to be estimated for one output.
    """
    if not data.n_inputs:
        raise EstimationError(f"{who}: no input is named; it estimates the way from inputs to outputs. Give --input")
    if rows < 4 * unknowns or rows < 20:
        raise EstimationError(
            f"{who}: {data.n_samples} samples for {unknowns} unknowns; at least {max(20, 4 * unknowns)} rows are "
            f"needed and {max(rows, 0)} are left after lags. Give a longer record, or lower the orders"
        )
    for names, values in ((data.inputs, data.u), (data.outputs, data.y), (data.references, data.reference)):
        for name, column in zip(names, np.ptp(values, axis=0), strict=True):
            if column == 0:
                raise EstimationError(
                    f"{who}: channel {name!r} is constant; nothing can be learned from it. Excite it, or leave it out"
                )


def _whole(who: str, name: str, value: object, least: int, remedy: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        if isinstance(value, str) and value == AUTO:
            remedy = f"{who} cannot choose it; give a number"
        raise EstimationError(
            f"{who}: order {name} = {value!r}; it must be a whole number of at least {least}. {remedy}"
        )
    return int(value)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
