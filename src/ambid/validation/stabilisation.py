"""Stabilisation diagram: poles of models of all orders; those of the plant stay where they are as the order grows.

A pole is stable when the model of the order below has one of nearly the same frequency, damping and mode shape (modal
assurance criterion, Allemang and Brown 1982; tolerances as in Peeters and De Roeck 1999). Stable poles that many orders
share are one cluster, which is a mode of the plant; the others are of noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.subspace import subspace_models
from ambid.errors import EstimationError, nearest
from ambid.estimation.modes import assurance

Complex = NDArray[np.complex128]
Method = Literal["n4sid", "moesp", "cva", "pbsid"]

_FREQUENCY, _DAMPING, _SHAPE = 0.01, 0.05, 0.98
_SHARE = 0.4  # part of the orders, from a cluster's first one on, that must show it


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A cluster of stable poles: a mode of the plant."""

    pole: complex  # in continuous time, log(z)/dt; of a complex pair the one above the real axis; median of a cluster
    orders: tuple[int, ...]  # models that show it

    @property
    def frequency_hz(self) -> float:
        """Natural frequency, |pole|/(2 pi)."""
        return abs(self.pole) / (2 * np.pi)

    @property
    def damping(self) -> float:
        """-Re(pole)/|pole|; negative for an unstable pole."""
        return -self.pole.real / abs(self.pole) if self.pole else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ModePole(Mode):
    """One pole of one model."""

    shape: tuple[complex, ...]  # mode shape: the outputs that go with the pole, largest 1
    stable_frequency: bool = False  # whether the next lower order has a pole that agrees in that
    stable: bool = False  # whether it agrees in frequency, damping and shape

    @property
    def order(self) -> int:
        """Order of the model."""
        return self.orders[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stabilisation:
    """Poles of models of all orders."""

    method: Method
    orders: tuple[int, ...]
    poles: tuple[ModePole, ...]  # lowest order first
    modes: tuple[Mode, ...]  # lowest frequency first
    singular_values: tuple[float, ...]  # by order
    criteria: tuple[float, ...]  # bayes' criterion by order, less is better

    @property
    def suggested(self) -> int:
        """Order of least criterion."""
        return self.orders[int(np.argmin(self.criteria))]


def stabilisation(
    data: IOData,
    method: str = "pbsid",
    n_max: int = 20,
    *,
    tick: Callable[[], None] | None = None,
) -> Stabilisation:
    """Identify models of all orders up to `n_max` and follow their poles.

    `method`: all but pbsid are biased under feedback; `tick`: called between steps; may raise to interrupt.
    """
    known = get_args(Method)
    if method not in known:
        raise EstimationError(f"method {method!r} is not one of {', '.join(known)}.{nearest(method, known)}")
    models = subspace_models(data, cast(Method, method), n_max, tick=tick)
    rows = [_poles(m.order, m.model.A, m.model.C, data) for m in models]
    found = list(rows[0])
    for before, after in pairwise(rows):
        found += [_mark(p, before) for p in after]
    return Stabilisation(
        method=cast(Method, method),
        orders=tuple(m.order for m in models),
        poles=tuple(found),
        modes=_modes(found, models[-1].order),
        singular_values=tuple(m.singular_value for m in models),
        criteria=tuple(m.criterion for m in models),
    )


def _poles(order: int, A: Array, C: Array, data: IOData) -> list[ModePole]:
    """Poles with their mode shapes, outputs in units of their standard deviations; poles at z = 0 are delays."""
    values, vectors = np.linalg.eig(A)
    shapes = (C / np.maximum(np.std(data.y, axis=0), 1e-300)[:, None]) @ vectors
    out = list[ModePole]()
    for z, v in sorted(zip(values, shapes.T, strict=True), key=lambda x: abs(np.angle(x[0]))):
        if z.imag < 0 or abs(z) < 1e-8:
            continue
        largest = v[np.argmax(np.abs(v))]
        shape = tuple(complex(x) for x in (v / largest if abs(largest) > 0 else v))
        out.append(ModePole(orders=(order,), pole=complex(np.log(complex(z)) / data.dt), shape=shape))
    return out


def _mark(p: ModePole, before: Sequence[ModePole]) -> ModePole:
    """Compare a pole with the nearest one of the order below that is of its kind."""
    same = [q for q in before if (q.pole.imag > 0) == (p.pole.imag > 0)]
    if not same:
        return p
    near = min(same, key=lambda q: abs(q.pole - p.pole))
    f, g, c, d = p.frequency_hz, near.frequency_hz, p.damping, near.damping
    same_frequency = abs(f - g) <= _FREQUENCY * max(f, g, 1e-300)
    same_damping = abs(c - d) <= _DAMPING * max(abs(c), abs(d), 0.1)
    stable = same_frequency and same_damping and assurance(p.shape, near.shape) >= _SHAPE
    return replace(p, stable_frequency=same_frequency, stable=stable)


def _modes(poles: Sequence[ModePole], largest: int) -> tuple[Mode, ...]:
    """Gather stable poles: from the highest order down, each joins the cluster it is near to, or begins one."""
    clusters = list[list[ModePole]]()
    for p in sorted((p for p in poles if p.stable), key=lambda p: -p.order):
        fitting = [c for c in clusters if _belongs(p, c)]
        if fitting:
            min(fitting, key=lambda c: abs(_centre(c) - p.pole)).append(p)
        else:
            clusters.append([p])
    out = list[Mode]()
    for c in clusters:
        orders = sorted({p.order for p in c})
        if len(orders) < max(3, _SHARE * (largest - orders[0] + 1)):
            continue
        out.append(Mode(pole=_centre(c), orders=tuple(orders)))
    return tuple(sorted(out, key=lambda m: m.frequency_hz))


def _belongs(p: ModePole, cluster: Sequence[ModePole]) -> bool:
    centre = _centre(cluster)
    size = max(abs(centre), abs(p.pole))
    same = (p.pole.imag > 0) == (cluster[0].pole.imag > 0) and all(q.order != p.order for q in cluster)
    reach = 2 * size * (_FREQUENCY + _DAMPING * max(abs(p.damping), 0.1))
    return same and abs(p.pole - centre) <= reach


def _centre(cluster: Sequence[ModePole]) -> complex:
    values = np.array([p.pole for p in cluster])
    return complex(np.median(values.real), np.median(values.imag))
