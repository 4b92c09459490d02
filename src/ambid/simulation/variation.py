"""What changes while a bench runs: parameters, sensors and loads by schedule, in s of the record, at the nearest
sample, and the matrices that follow, on a grid of the record, so that no number depends on how it is cut up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError, choices
from ambid.physics.linear_model import LinearModel, discretise
from ambid.simulation.plant import Equations


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule:
    """A piecewise linear function of time, constant before its first and after its last knot.

    Attributes
    ----------
    times_s : tuple of float
        Knots in s, not falling; the same time twice is a jump, at which the later value holds.
    values : tuple of float
        One for each knot, in the unit of what is scheduled.
    """

    times_s: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        t, v = np.asarray(self.times_s, dtype=np.float64), np.asarray(self.values, dtype=np.float64)
        if t.size == 0 or t.shape != v.shape or not (np.isfinite(t).all() and np.isfinite(v).all()):
            raise ModelError(
                f"a schedule has {t.size} times and {v.size} values; it needs as many finite values as times, at "
                "least one. Correct them"
            )
        if (np.diff(t) < 0.0).any():
            raise ModelError("the times of a schedule fall; they must rise or stay (a jump). Sort them")

    @classmethod
    def constant(cls, value: float) -> Self:
        """Return the schedule that is `value` always."""
        return cls(times_s=(0.0,), values=(value,))

    @classmethod
    def step(cls, before: float, after: float, at_s: float) -> Self:
        """Return a jump.

        Parameters
        ----------
        before, after : float
            Values before and from `at_s` on.
        at_s : float, s

        Returns
        -------
        Schedule, with two knots
        """
        return cls(times_s=(at_s, at_s), values=(before, after))

    @classmethod
    def ramp(cls, before: float, after: float, from_s: float, to_s: float) -> Self:
        """Return a straight line between two levels.

        Parameters
        ----------
        before, after : float
            Values until `from_s` and after `to_s`.
        from_s, to_s : float, s

        Returns
        -------
        Schedule, with two knots
        """
        return cls(times_s=(from_s, to_s), values=(before, after))

    def knots(self, rate_hz: float) -> Array:
        """Return the knots in whole samples at `rate_hz` in Hz, shape (n_knots,)."""
        return np.rint(np.asarray(self.times_s) * rate_hz)

    def at(self, samples: Array, rate_hz: float, *, before: bool = False) -> Array:
        """Return the values at sample numbers, fractions allowed; at a jump the later value.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Sample numbers since the record began.
        rate_hz : float
            Sampling rate in Hz.
        before : bool
            At a jump the earlier value instead.

        Returns
        -------
        ndarray, shape (n,), in the unit of the schedule
        """
        knots, values = self.knots(rate_hz), np.asarray(self.values)
        if values.size == 1:
            return np.full(samples.shape, values[0])
        after = _segments(knots, samples, "left" if before else "right")
        start, length = knots[after - 1], knots[after] - knots[after - 1]
        # Beyond the ends, and at a jump that is the last knot, the clip holds the end value.
        jumped = samples > start if before else samples >= start
        part = np.where(length > 0.0, (samples - start) / np.where(length > 0.0, length, 1.0), jumped)
        part = np.clip(part, 0.0, 1.0)
        return np.asarray(values[after - 1] + part * (values[after] - values[after - 1]))

    def integral(self, samples: Array, rate_hz: float) -> Array:
        """Return the integral from the record's beginning, exactly.

        Parameters
        ----------
        samples : ndarray, shape (n,)
            Sample numbers since the record began, zero or positive, fractions allowed.
        rate_hz : float
            Sampling rate in Hz.

        Returns
        -------
        ndarray, shape (n,), unit of the schedule times s
            The angle, for a schedule of a speed.
        """
        inside = self.knots(rate_hz)
        edges = np.concatenate(([0.0], np.unique(inside[inside > 0.0])))
        # A line is integrated exactly by its middle: strictly inside a stretch there is no jump.
        ends = np.append(edges[1:], edges[-1] + 2.0)
        area = np.concatenate(([0.0], np.cumsum((ends - edges) * self.at(0.5 * (edges + ends), rate_hz))[:-1]))
        k = _segments(np.append(edges, np.inf), samples, "right") - 1
        return np.asarray((area[k] + (samples - edges[k]) * self.at(0.5 * (edges[k] + samples), rate_hz)) / rate_hz)


def _segments(knots: Array, samples: Array, side: Literal["left", "right"]) -> NDArray[np.intp]:
    """Return the knot that ends the segment of each sample, shape (n,), or (1,) where all lie in one segment."""
    ends = np.searchsorted(knots, [samples.min(), samples.max()] if samples.size else samples, side=side)
    if samples.size and ends[0] != ends[1]:  # else all lie in one segment: nothing to look up for each sample
        ends = np.searchsorted(knots, samples, side=side)
    elif samples.size:
        ends = ends[:1]
    return np.asarray(np.clip(ends, 1, knots.size - 1), dtype=np.intp)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unbalance:
    """A rotor that is out of balance and turns: f = moment speed^2 cos(angle + phase).

    The angle is the exact integral of the speed from the record's beginning. As every disturbance of the simulator the
    force is held over a sample, at its value in the middle of it. The tangential part, moment times the angular
    acceleration, is left out: after a steady start from rest it is 1/(2 angle) of the whole.

    Attributes
    ----------
    moment : float
        Mass times eccentricity in kg m.
    phase : float
        In rad, of the heavy spot against the mark of the angle.
    speed : Schedule
        In rad/s.
    """

    moment: float
    speed: Schedule
    phase: float = 0.0


_NOTHING: Mapping[str, Schedule] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """What changes while a bench runs.

    Attributes
    ----------
    parameters : Mapping[str, Schedule]
        Parameters of the model, SI; the others stay as the plant has them.
    gains : Mapping[str, Schedule]
        Of the sensors by output: logged = gain times true value + noise, and the controller sees the logged one.
    force : Schedule or None
        Load in N beside the process noise.
    unbalance : Unbalance or None
        Of a turning rotor.
    """

    parameters: Mapping[str, Schedule] = field(default_factory=lambda: _NOTHING)
    gains: Mapping[str, Schedule] = field(default_factory=lambda: _NOTHING)
    force: Schedule | None = None
    unbalance: Unbalance | None = None


def check_variation(variation: Variation, model: LinearModel) -> None:
    """Refuse a variation of what a model does not have."""
    specs = {s.name: s for s in model.parameters}
    for name, schedule in variation.parameters.items():
        if name not in specs:
            raise ModelError(
                f"model {model.name!r} has no parameter {name!r} that could vary; it has {choices(name, specs)}"
                " Correct the variation"
            )
        if specs[name].positive and min(schedule.values) <= 0.0:
            raise ModelError(
                f"parameter {name!r} falls to {min(schedule.values):.6g} {specs[name].unit}; it must stay positive."
                " Change it less"
            )
    for name in variation.gains:
        if name not in model.outputs:
            raise ModelError(
                f"model {model.name!r} has no sensor of {name!r}; it has {choices(name, model.outputs)} Correct the"
                " variation"
            )
    if (variation.force is not None or variation.unbalance is not None) and "force" not in model.disturbances:
        raise ModelError(f"model {model.name!r} has no rotor that a force could act on. Leave force and unbalance out")


Integers = NDArray[np.int64]

_DEGREE = 14  # at a norm of 0.5 the Taylor polynomial of the exponential is right to 3e-17
_NODE = 20  # cells from one exact discretisation to the next


class Pieces(NamedTuple):
    """What the loop needs for some samples: `edges` (n_pieces + 1,), and matrices and values for each piece."""

    edges: Integers
    gains: Array
    equations: Equations
    theta: Mapping[str, Array]


Matrices = tuple[Array, Array, Array, Array]


class Tables:
    """Cuts a record into stretches, and gives their matrices."""

    def __init__(
        self,
        model: LinearModel,
        fixed: Mapping[str, float],
        parameters: Mapping[str, Schedule],
        gains: Mapping[str, Schedule],
        rate_hz: float,
        fraction: float,
        grid: int,
    ) -> None:
        self._of, self._fixed, self._rate, self._fraction, self._grid = model, dict(fixed), rate_hz, fraction, grid
        self._schedules = {**parameters, **{f"gain_{name}": s for name, s in gains.items()}}
        knots = [s.knots(rate_hz) for s in self._schedules.values()]
        inside = np.unique(np.concatenate([np.zeros(1), *knots]))
        self._corners = inside[inside >= 0.0].astype(np.int64)
        self._moving = []  # by corner, whether anything changes up to the next
        for begin, end in pairwise(self._corners):
            near = begin + np.array([0.25, 0.75]) * (end - begin)
            values = [s.at(near, rate_hz) for s in self._schedules.values()]
            self._moving.append(any(v[0] != v[1] for v in values))
        self._moving.append(False)
        # the largest 1-norm at the corners: in between the parameters, and about so the norm, are smaller
        at = self._corners.astype(np.float64)
        thetas = self._parameters(at) + self._parameters(at, before=np.ones(at.size, dtype=np.bool_))
        norm = float(np.abs(self._stacked(thetas)).sum(axis=1).max())
        self._halvings = max(0, math.ceil(math.log2(max(norm, 1e-9) / 0.5)))
        self._known: dict[tuple[float, ...], Matrices] = {}

    @property
    def corners(self) -> Integers:
        """Samples at which anything begins or ends to change, shape (n_corners,), the first of them 0."""
        return self._corners

    def pieces(self, first: int, stop: int) -> Pieces:
        """Return the stretches of samples `first` to `stop`, counted from `first`."""
        edges: list[int] = [first]
        places, parts = list[Array](), list[Matrices]()
        j = int(np.searchsorted(self._corners, first, side="right")) - 1
        while edges[-1] < stop:
            begin = int(self._corners[j])
            end = int(self._corners[j + 1]) if j + 1 < self._corners.size else max(stop, begin + 1)
            if self._moving[j]:
                middle, matrices, ends = self._drifting(begin, end, edges[-1], min(end, stop))
                edges.extend(ends)
            else:
                middle = np.array([begin + 0.5])
                matrices = self._still(middle)
                edges.append(min(end, stop))
            places.append(middle)
            parts.append(matrices)
            j += 1
        middles = np.concatenate(places)
        a, b, late, e = (np.ascontiguousarray(np.concatenate(m)) for m in zip(*parts, strict=True))
        theta = {name: s.at(middles, self._rate) for name, s in self._schedules.items()}
        one = np.ones(middles.size)
        gains = np.ascontiguousarray(np.column_stack([theta.get(f"gain_{o}", one) for o in self._of.outputs]))
        return Pieces(np.array(edges, dtype=np.int64) - first, gains, (a, b, late, e), theta)

    def _still(self, middle: Array) -> Matrices:
        """Return the matrices of one stretch, to the last bit as `Standing.equations` has them."""
        (theta,) = self._parameters(middle)
        key = tuple(theta.values())
        if key not in self._known:
            d, _ = discretise(self._of.matrices(theta), 1.0 / self._rate, fraction=self._fraction)
            self._known[key] = (d.A[None], d.B[None, :, 0], d.B_late[None, :, 0], d.E[None])
        return self._known[key]

    def _drifting(self, begin: int, end: int, first: int, stop: int) -> tuple[Array, Matrices, list[int]]:
        """Return middles, matrices and ends of the cells of an interval in which something moves. Matrices are exact
        every `_NODE` cells and linear between: right to second order from node to node, held ones to first order over a
        cell.
        """
        cells = np.arange((first - begin) // self._grid, -((begin - stop) // self._grid))
        starts = begin + cells * self._grid
        ends = np.minimum(starts + self._grid, end)
        middles = np.asarray(0.5 * (starts + ends), dtype=np.float64)
        stride = _NODE * self._grid
        numbers = np.arange(cells[0] // _NODE, cells[-1] // _NODE + 2)
        nodes = np.minimum(begin + numbers * stride, end).astype(np.float64)
        at = cells // _NODE - numbers[0]
        weight = (middles - nodes[at]) / (nodes[at + 1] - nodes[at])
        stack = self._stacked(self._parameters(nodes, before=nodes > begin))
        n, inside = len(self._of.states), slice(0, len(self._of.states))
        full = exponentials(stack, self._halvings)
        now = full if self._fraction == 0.0 else exponentials(stack * (1.0 - self._fraction), self._halvings)
        exact = full[:, inside, :n], now[:, inside, n], full[:, inside, n] - now[:, inside, n], full[:, inside, n + 1 :]
        a, b, late, e = (m[at] + weight.reshape(-1, *[1] * (m.ndim - 1)) * (m[at + 1] - m[at]) for m in exact)
        return middles, (a, b, late, e), np.minimum(ends, stop).tolist()

    def _parameters(self, samples: Array, before: NDArray[np.bool_] | None = None) -> list[dict[str, float]]:
        """Return all parameters of the model at sample numbers; where `before`, the value ahead of a jump."""
        values = {name: s.at(samples, self._rate) for name, s in self._schedules.items() if name in self._fixed}
        if before is not None:
            ahead = {name: self._schedules[name].at(samples, self._rate, before=True) for name in values}
            values = {name: np.where(before, ahead[name], v) for name, v in values.items()}
        rows = zip(*(v.tolist() for v in values.values()), strict=True) if values else [()] * samples.size
        return [{**self._fixed, **dict(zip(values, row, strict=True))} for row in rows]

    def _stacked(self, thetas: list[dict[str, float]]) -> Array:
        spaces = [self._of.matrices(theta) for theta in thetas]
        n, nd = spaces[0].E.shape
        stack = np.zeros((len(spaces), n + 1 + nd, n + 1 + nd))
        stack[:, :n, :n] = [s.A for s in spaces]
        stack[:, :n, n] = [s.B[:, 0] for s in spaces]
        stack[:, :n, n + 1 :] = [s.E for s in spaces]
        return np.asarray(stack / self._rate)


def exponentials(stack: Array, halvings: int) -> Array:
    """Return exp of each matrix of (n_matrices, n, n) by a Taylor polynomial of 2^-halvings times it, squared as often:
    SciPy's expm waits for linear algebra threads, on a busy machine a hundred times as long; products stay on this one.
    """
    x = stack * 0.5**halvings
    unit = np.eye(x.shape[1])
    result = unit + x / _DEGREE
    for k in range(_DEGREE - 1, 0, -1):
        result = unit + np.matmul(x, result) / k
    for _ in range(halvings):
        result = np.matmul(result, result)
    return np.asarray(result)
