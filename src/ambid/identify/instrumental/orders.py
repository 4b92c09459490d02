"""Orders and data of the instrumental variable methods, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.errors import EstimationError, nearest
from ambid.identify.blackbox.data import IOData

Orders = Mapping[str, int | tuple[int, ...]]


def known_orders(who: str, orders: Orders, allowed: tuple[str, ...], needed: tuple[str, ...]) -> None:
    """Refuse unknown and missing orders.

    Parameters
    ----------
    who : str
        Method.
    orders : Mapping[str, int or tuple of int]
    allowed, needed : tuple of str

    Raises
    ------
    EstimationError
        Naming the order.
    """
    for name in orders:
        if name not in allowed:
            raise EstimationError(
                f"{who}: order {name!r} is not known; it takes {', '.join(allowed)}.{nearest(name, list(allowed))}"
            )
    for name in needed:
        if name not in orders:
            raise EstimationError(f"{who}: order {name} is missing; it takes {', '.join(allowed)}. Give {name}=...")


def single(who: str, orders: Orders, name: str, least: int) -> int:
    """Return an order that is one number.

    Parameters
    ----------
    who, name : str
    orders : Mapping[str, int or tuple of int]
    least : int
        Smallest allowed.

    Returns
    -------
    int

    Raises
    ------
    EstimationError
        If it is not one whole number of at least `least`.
    """
    value = orders[name]
    values = set(value) if isinstance(value, tuple) else {value}
    if len(values) != 1:
        raise EstimationError(f"{who}: order {name} = {value}; it must be one whole number. Give {name}=N")
    return _checked(who, name, values.pop(), least)


def per_input(who: str, orders: Orders, name: str, least: int, n_inputs: int) -> tuple[int, ...]:
    """Return an order for every input.

    Parameters
    ----------
    who, name : str
    orders : Mapping[str, int or tuple of int]
    least : int
        Smallest allowed.
    n_inputs : int

    Returns
    -------
    tuple of int

    Raises
    ------
    EstimationError
        If there is not one for each input, or one is too small.
    """
    value = orders[name]
    values = value if isinstance(value, tuple) else (value,) * n_inputs
    if len(values) != n_inputs:
        raise EstimationError(
            f"{who}: order {name} has {len(values)} number(s) for {n_inputs} input(s); give one, or one for each input"
        )
    return tuple(_checked(who, name, v, least) for v in values)


def long_enough(who: str, data: IOData, rows: int, unknowns: int) -> None:
    """Refuse records that are too short, without inputs, or with a channel that stands still.

    Parameters
    ----------
    who : str
    data : IOData
    rows : int
        Samples that are left after lags.
    unknowns : int
        Numbers to be estimated for one output.

    Raises
    ------
    EstimationError
        Naming the channel or the length.
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


def _checked(who: str, name: str, value: object, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise EstimationError(f"{who}: order {name} = {value!r}; it must be a whole number of at least {least}")
    return int(value)
