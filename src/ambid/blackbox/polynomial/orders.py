"""Orders of a polynomial model: what the user wrote, checked, and where each coefficient then stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.orders import Orders, UsedOrders, known_orders, left_open, per_input, shown, single
from ambid.blackbox.polynomial_model import PolynomialModel, Polynomials
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError, nearest

Key = tuple[str, int | None]

_PER_INPUT = ("nb", "nk", "nf")


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Orders of one output, and which of its coefficients are free."""

    na: int
    nb: tuple[int, ...]  # one for each input
    nc: int
    nd: int
    nf: tuple[int, ...]
    nk: tuple[int, ...]
    fixed: tuple[int, ...] = ()  # places of coefficients that the user fixed
    # everything was zero before the first sample: no initial states, no constant, and all samples count
    at_rest: bool = False
    # where each polynomial stands among all coefficients, in the order of `PolynomialModel.theta`
    places: Mapping[Key, slice] = field(init=False, repr=False, compare=False)
    # (n_free,), places of the estimated coefficients
    free: NDArray[np.int64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "places", _places(self))
        object.__setattr__(self, "free", _free(self))

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.nb)

    @property
    def n_theta(self) -> int:
        """Number of all coefficients, leading ones and zeros included."""
        return self.na + sum(self.nb) + sum(self.nk) + self.nc + self.nd + sum(self.nf) + 3 + self.n_inputs

    @property
    def first_row(self) -> int:
        """First sample whose regressors lie in the record, or are known to be zero."""
        if self.at_rest:
            return 0
        return max([self.na, *(b + k - 1 for b, k in zip(self.nb, self.nk, strict=True))])

    def free_lags(self, key: Key) -> tuple[int, ...]:
        """Return the lags of the coefficients of polynomial `key` that are estimated.

        `key`: letter and input.
        """
        place = self.places[key]
        first = self.nk[key[1]] if key[0] == "B" and key[1] is not None else 1
        return tuple(k for k in range(first, place.stop - place.start) if place.start + k not in self.fixed)

    def start(self) -> Array:
        """Return coefficients of a model that is zero: leading ones alone, shape (n_theta,)."""
        theta = np.zeros(self.n_theta)
        for (letter, _), place in self.places.items():
            theta[place.start] = float(letter != "B")
        return theta

    def polynomials(self, theta: Array) -> Polynomials:
        """Return the polynomials that `theta` holds.

        `theta`: (n_theta,).
        """
        p = self.places
        per_input = range(self.n_inputs)
        return Polynomials(
            A=theta[p["A", None]],
            B=tuple(theta[p["B", i]] for i in per_input),
            C=theta[p["C", None]],
            D=theta[p["D", None]],
            F=tuple(theta[p["F", i]] for i in per_input),
        )


def _places(layout: Layout) -> dict[Key, slice]:
    sizes: list[tuple[Key, int]] = [(("A", None), layout.na + 1)]
    sizes += [(("B", i), b + k) for i, (b, k) in enumerate(zip(layout.nb, layout.nk, strict=True))]
    sizes += [(("C", None), layout.nc + 1), (("D", None), layout.nd + 1)]
    sizes += [(("F", i), f + 1) for i, f in enumerate(layout.nf)]
    first, out = 0, {}
    for key, size in sizes:
        out[key] = slice(first, first + size)
        first += size
    return out


def _free(layout: Layout) -> NDArray[np.int64]:
    lags = [p.start + k for key, p in layout.places.items() for k in layout.free_lags(key)]
    out = np.array(lags, dtype=np.int64)
    out.flags.writeable = False
    return out


def read_orders(name: str, data: IOData, orders: Orders) -> dict[str, int | tuple[int, ...] | None]:
    """Check orders against structure and data; nk is None where it is to be estimated.

    `name`: structure.
    """
    known = structure(name).orders
    _check_inputs(name, data)
    known_orders(name, orders, known, [key for key in known if key != "nk"])
    found: dict[str, int | tuple[int, ...] | None] = {}
    for key in known:
        if key == "nk" and left_open(orders, key):
            found[key] = None
        elif key in _PER_INPUT:
            found[key] = per_input(name, orders, key, 1 if key == "nb" else 0, data.n_inputs)
        else:
            found[key] = single(name, orders, key, 0)
    if not any(found[key] for key in known if key != "nk"):
        raise EstimationError(f"{name}: all orders are 0; there is nothing to estimate. Raise one")
    return found


def layout_of(orders: Mapping[str, int | tuple[int, ...] | None], n_inputs: int, *, at_rest: bool = False) -> Layout:
    """Return the layout of checked orders.

    `orders`: of `read_orders`, nk a number for each input by now.
    """

    def one(key: str) -> int:
        value = orders.get(key, 0)
        return value if isinstance(value, int) else 0

    def each(key: str) -> tuple[int, ...]:
        value = orders.get(key)
        return value if isinstance(value, tuple) else (0,) * n_inputs

    return _layout(one("na"), each("nb"), one("nc"), one("nd"), each("nf"), each("nk"), at_rest)


@lru_cache(maxsize=256)
def _layout(
    na: int, nb: tuple[int, ...], nc: int, nd: int, nf: tuple[int, ...], nk: tuple[int, ...], at_rest: bool
) -> Layout:
    return Layout(na=na, nb=nb, nc=nc, nd=nd, nf=nf, nk=nk, at_rest=at_rest)  # fixed: see `fixed_places`


def shown_orders(name: str, layout: Layout) -> UsedOrders:
    """Return the orders as a result prints them: a number where all inputs agree."""
    out: dict[str, int | tuple[int, ...]] = {}
    for key in structure(name).orders:
        value = getattr(layout, key)
        out[key] = shown(value) if isinstance(value, tuple) else value
    return out


def fixed_places(name: str, layouts: tuple[Layout, ...], fixed: Mapping[str, float]) -> list[dict[int, float]]:
    """Find where the coefficients that the user fixed stand.

    `name`: structure; `layouts`: one for each output; `fixed`: by the names of `PolynomialModel.names`. Returns place
    and value, for each output.
    """
    if not fixed:
        return [{} for _ in layouts]
    outputs = tuple(layout.polynomials(layout.start()) for layout in layouts)
    names = PolynomialModel(outputs=outputs, dt=1.0).names
    free = {}
    first = 0
    for o, layout in enumerate(layouts):
        free.update({names[first + p]: (o, int(p)) for p in layout.free})
        first += layout.n_theta
    found: list[dict[int, float]] = [{} for _ in layouts]
    for key, value in fixed.items():
        if key not in free:
            raise EstimationError(
                f"{name}: no coefficient {key!r} can be fixed; there are {', '.join(free)}.{nearest(key, list(free))}"
            )
        if not np.isfinite(value):
            raise EstimationError(f"{name}: coefficient {key} is fixed at {value}; it must be a finite number")
        o, place = free[key]
        found[o][place] = float(value)
    return found


def _check_inputs(name: str, data: IOData) -> None:
    wants = structure(name).inputs
    if wants and not data.n_inputs:
        raise EstimationError(f"{name} needs an input and the data have none. Name one, or use arma")
    if not wants and data.n_inputs:
        raise EstimationError(
            f"{name} takes no inputs and the data have {data.n_inputs} ({', '.join(data.inputs)}). Leave them out, or "
            "use armax"
        )
