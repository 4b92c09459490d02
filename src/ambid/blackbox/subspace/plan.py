"""What is decided before a subspace estimate: orders, delays, horizons, feedthrough; and the factors it starts from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.orders import Orders, known_orders, left_open, per_input, single
from ambid.blackbox.subspace.compress import Channels, Factors, channels, compress, merged, triangular
from ambid.blackbox.subspace.dependence import told_apart
from ambid.blackbox.subspace.order import autoregression_criterion
from ambid.errors import EstimationError

Method = Literal["n4sid", "moesp", "cva", "pbsid"]

_GROUPS = 20  # of time, for the jackknife: its standard deviations are good to 1 / sqrt(2 * 19)
_AUTO_MAX = 10  # largest order tried where none is given
_LONGEST = {"n4sid": 20, "moesp": 20, "cva": 20, "pbsid": 60}  # samples of past
_WIDEST = {"n4sid": 100, "moesp": 100, "cva": 100, "pbsid": 240}  # columns of past


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """All that an estimate needs."""

    method: Method
    n: int | None  # order; None to choose it
    n_max: int  # largest order that the horizons and the record allow, or that was asked for
    nk: tuple[int, ...]  # delay of every input in samples, at least 1
    past: int  # samples
    future: int
    feedthrough: bool
    channels: Channels
    factors: Factors
    total: Array  # (n_columns, n_columns), all groups together
    autoregression: int  # lags that an autoregression wants, and half as many again
    past_limited: bool  # whether the criterion wanted a longer past than was tried


def planned(
    method: Method,
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None,
    past: int | None,
    feedthrough: bool | None,
    n_max: int | None = None,
    tick: Callable[[], None] | None = None,
) -> Plan:
    """Check what was asked for, compress the record and choose what was left open.

    `horizon`, `past`: samples of future and past; chosen if missing; `n_max`: largest order to try; `tick`: called
    between steps.
    """
    n, nk = _orders(method, data, orders)
    _numbers(data)
    given = channels(data, tuple(k - 1 for k in nk))
    largest = n or n_max or _AUTO_MAX
    longest = _longest(method, data, given.n_samples, largest, horizon, past)
    length = _window(method, longest, horizon, past)
    factors = compress(given, length, _GROUPS)
    if tick is not None:
        tick()
    total = merged(factors.groups)
    told_apart(factors, total, data.inputs, 1)
    criterion = autoregression_criterion(factors, total)
    wanted = wanted_lags = int(np.argmin(criterion))
    least = _shortest(data, largest, bool(n or n_max))
    if method == "pbsid":  # the prior makes a long past cheap, and a short one is what leaves bias
        least, wanted = max(least, 20), wanted + wanted // 2
    chosen = past or min(max(wanted, least), longest)
    future = horizon or (min(chosen, longest) if method != "pbsid" else chosen)
    if method == "pbsid" and future > chosen:
        raise EstimationError(f"{method}: horizon {future} is longer than the past {chosen}. Lower it, or raise past")
    largest = min(largest, (future - 1) * data.n_outputs, chosen * (data.n_inputs + data.n_outputs))
    return Plan(
        method=method,
        n=n,
        n_max=largest,
        nk=nk,
        past=chosen,
        future=future,
        feedthrough=_feedthrough(data, factors, total, chosen) if feedthrough is None else feedthrough,
        channels=given,
        factors=factors,
        total=total,
        autoregression=max(20, wanted_lags + wanted_lags // 2),
        past_limited=past is None and wanted_lags >= length - 1,
    )


def _orders(method: str, data: IOData, orders: Orders) -> tuple[int | None, tuple[int, ...]]:
    """Return n (None for automatic) and nk for each input."""
    known_orders(method, orders, ("n", "nk"))
    n = None if left_open(orders, "n") else single(method, orders, "n", 1, remedy="Correct it, or say 'auto'")
    least, remedy = 1, "For an input that acts at once say feedthrough"
    return n, per_input(method, {"nk": least, **orders}, "nk", least, data.n_inputs, remedy=remedy)


def _numbers(data: IOData) -> None:
    """Refuse samples that are not numbers."""
    for values, names in ((data.u, data.inputs), (data.y, data.outputs)):
        bad = ~np.isfinite(values)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise EstimationError(f"sample {row} of {names[column]!r} is not a finite number. Mend or cut it")


def _longest(method: Method, data: IOData, n_samples: int, n: int, horizon: int | None, past: int | None) -> int:
    """Return the longest past to try: what the record carries at two rows for a column, within the method's bounds."""
    n_z = data.n_inputs + data.n_outputs
    spans = 1 if method == "pbsid" else 2
    carried = int(n_samples / (2.5 * spans * n_z + spans)) - 1
    needed = _shortest(data, n, strict=False)
    for what, value in (("horizon", horizon), ("past", past)):
        if value is not None and value < 2:
            raise EstimationError(f"{method}: {what} = {value} samples; it must be at least 2. Raise it")
    if horizon is not None and (horizon - 1) * data.n_outputs < n:
        raise EstimationError(
            f"{method}: a horizon of {horizon} samples shows at most {(horizon - 1) * data.n_outputs} states of "
            f"{data.n_outputs} output(s), not {n}. Raise it, or lower n"
        )
    asked = max(x for x in (horizon, past, needed) if x is not None)
    if carried < asked:
        raise EstimationError(
            f"{method}: {n_samples} samples carry horizons of {max(carried, 0)}; order {n} needs {asked}. "
            "Lower the order, or take a longer record"
        )
    bound = min(_LONGEST[method], _WIDEST[method] // n_z)
    return min(carried, max(bound, asked, needed + 5))


def _shortest(data: IOData, n: int, strict: bool = True) -> int:
    """Return the shortest horizon that shows n states; with some room where the order is settled and that is cheap."""
    least = max(-(-n // data.n_outputs) + 1, 2)
    return max(least, min(n + 5, 10)) if strict else least


def _window(method: Method, longest: int, horizon: int | None, past: int | None) -> int:
    if method == "pbsid":
        return (past or max(longest, horizon or 0)) + 1
    return (past or longest) + (horizon or longest)


def _feedthrough(data: IOData, factors: Factors, total: Array, past: int) -> bool:
    """Say whether u(t) acts on y(t) at once: by Bayes' criterion, and only where no feedback can feign it."""
    n_u, n_y = data.n_inputs, data.n_outputs
    if not (n_u and data.open_loop):
        return False
    now = factors.length - 1
    columns: Sequence[int] = [
        0,
        *factors.columns("z", now - min(past, now), now),
        *factors.columns("u", now, now + 1),
        *factors.columns("y", now, now + 1),
    ]
    y = triangular(total[:, columns])[-(n_u + n_y) :, -n_y:]
    without, with_it = (np.linalg.slogdet(e.T @ e / factors.n_rows + 1e-18 * np.eye(n_y))[1] for e in (y, y[n_u:]))
    return bool(factors.n_rows * (without - with_it) > n_u * n_y * np.log(factors.n_rows))
