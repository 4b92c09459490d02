"""Poles of models of all orders: those of the plant stay where they are as the order grows, those of noise do not.

A pole is stable when the model of the order below has one of nearly the same frequency, damping and mode shape (modal
assurance criterion, Allemang and Brown 1982; Peeters and De Roeck 1999). Stable poles that many orders share are one
cluster, which is a mode of the plant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ambid.arrays import Complex


def assurance(one: Sequence[complex], other: Sequence[complex]) -> float:
    """Return the modal assurance criterion |a* b|^2 / (a* a b* b) of two mode shapes (Allemang and Brown 1982).

    Returns 1 for equal shapes, whatever their size; 0 for orthogonal ones.
    """
    a, b = np.asarray(one, dtype=np.complex128), np.asarray(other, dtype=np.complex128)
    size = float(np.vdot(a, a).real * np.vdot(b, b).real)
    return float(abs(np.vdot(a, b)) ** 2 / size) if size > 0 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoleCluster:
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
class TrialPole(PoleCluster):
    """One pole of one model."""

    shape: tuple[complex, ...]  # mode shape: the outputs that go with the pole, largest 1
    stable_frequency: bool = False  # whether the next lower order has a pole that agrees in that
    stable: bool = False  # whether it agrees in frequency, damping and shape

    @property
    def order(self) -> int:
        """Order of the model."""
        return self.orders[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """How near poles of neighbouring orders are to each other to count as one."""

    frequency: float = 0.01  # relative
    damping: float = 0.05  # relative to the damping, or to `least` where that is larger
    least: float = 0.1
    shape: float = 0.98  # assurance
    share: float = 0.4  # part of the orders, from a cluster's first one on, that must show it


def trial_poles(order: int, poles: Complex, shapes: Complex) -> list[TrialPole]:
    """Return poles of one model (n,), rad/s, with shapes (n, n_outputs), by their angle; those below the real axis are
    left out.
    """
    out = list[TrialPole]()
    for p, v in sorted(zip(poles, shapes, strict=True), key=lambda x: abs(x[0].imag)):
        if p.imag < 0:
            continue
        largest = v[np.argmax(np.abs(v))]
        shape = tuple(complex(x) for x in (v / largest if abs(largest) > 0 else v))
        out.append(TrialPole(orders=(order,), pole=complex(p), shape=shape))
    return out


def followed(rows: Sequence[Sequence[TrialPole]], near: Tolerance) -> list[TrialPole]:
    """Return the poles of all models, lowest order first, each compared with those of the order below."""
    found = list(rows[0])
    for before, after in pairwise(rows):
        found += [_mark(p, before, near) for p in after]
    return found


def _mark(p: TrialPole, before: Sequence[TrialPole], near: Tolerance) -> TrialPole:
    """Compare a pole with the nearest one of the order below that is of its kind."""
    same = [q for q in before if (q.pole.imag > 0) == (p.pole.imag > 0)]
    if not same:
        return p
    next_to = min(same, key=lambda q: abs(q.pole - p.pole))
    f, g, c, d = p.frequency_hz, next_to.frequency_hz, p.damping, next_to.damping
    same_frequency = abs(f - g) <= near.frequency * max(f, g, 1e-300)
    same_damping = abs(c - d) <= near.damping * max(abs(c), abs(d), near.least)
    stable = same_frequency and same_damping and assurance(p.shape, next_to.shape) >= near.shape
    return replace(p, stable_frequency=same_frequency, stable=stable)


def clusters(poles: Sequence[TrialPole], models: Sequence[int], near: Tolerance) -> tuple[PoleCluster, ...]:
    """Gather stable poles: from the highest order down, each joins the cluster it is near to, or begins one.

    `models`: their orders. Returns clusters that enough orders share, lowest frequency first.
    """
    gathered = list[list[TrialPole]]()
    for p in sorted((p for p in poles if p.stable), key=lambda p: -p.order):
        fitting = [c for c in gathered if _belongs(p, c, near)]
        if fitting:
            min(fitting, key=lambda c: abs(_centre(c) - p.pole)).append(p)
        else:
            gathered.append([p])
    out = list[PoleCluster]()
    for c in gathered:
        orders = sorted({p.order for p in c})
        if len(orders) < max(3, near.share * sum(n >= orders[0] for n in models)):
            continue
        out.append(PoleCluster(pole=_centre(c), orders=tuple(orders)))
    return tuple(sorted(out, key=lambda m: m.frequency_hz))


def _belongs(p: TrialPole, cluster: Sequence[TrialPole], near: Tolerance) -> bool:
    centre = _centre(cluster)
    size = max(abs(centre), abs(p.pole))
    same = (p.pole.imag > 0) == (cluster[0].pole.imag > 0) and all(q.order != p.order for q in cluster)
    reach = 2 * size * (near.frequency + near.damping * max(abs(p.damping), near.least))
    return same and abs(p.pole - centre) <= reach


def _centre(cluster: Sequence[TrialPole]) -> complex:
    values = np.array([p.pole for p in cluster])
    return complex(np.median(values.real), np.median(values.imag))
