"""The vector that a search for a rotor's parameters moves, and what it means under the names of the model. Positive
numbers go as logarithms, others over their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ambid.arrays import Array
from ambid.physics.linear_model import Parameter
from ambid.physics.rotor_model import RotorModel

_GAUGE_SD = 0.05  # of ln(|b|/|s|): which of the two is longer is a convention
_SPLIT_SD = 1.0  # prior of l
_LEAST_LENGTH = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknowns:
    """What is searched: `known` are the rig's parameters, `scales` the sizes of numbers that may change their sign. A
    mode has shape exp(l) b at bearings, exp(-l) s at sensors, prior N(0, 1) on l: positions see the product alone, so b
    and s are kept equally long, and run off without it where no voltage shows the bearings' part.
    """

    model: RotorModel
    known: tuple[Parameter, ...]
    scales: Mapping[str, float]
    free_delays: tuple[int, ...] = ()  # inputs whose delay is searched
    held_modes: bool = False  # whether frequencies and dampings of modes rest
    chosen: tuple[str, ...] | None = None  # with `held_modes`: numbers that are searched, shapes of modes among them

    @cached_property
    def logs(self) -> tuple[str, ...]:
        """Numbers that go as logarithms."""
        positive = {p.name for p in self.model.parameters if p.positive}
        damping = [f"mode{r}.zeta" for r in self._modes]
        return tuple(n for n in (*self._free, *damping) if n in positive or n in damping)

    @cached_property
    def linear(self) -> tuple[str, ...]:
        """Numbers that go over their size."""
        return tuple(n for n in self._free if n not in self.logs)

    @cached_property
    def shapes(self) -> tuple[tuple[int, tuple[str, ...], tuple[str, ...]], ...]:
        """Of each mode its number, the places at bearings, those at sensors."""
        radial = [b for b in self.model.bearings if not b.axial]
        at, n = self.model.places, len(radial)
        return tuple((r, at[:n], at[n:]) for r in self._modes)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What the entries of the vector are."""
        shaped = [
            name for r, b, s in self.shapes
            for name in (*(f"mode{r}.b.{x}" for x in b), *(f"mode{r}.s.{x}" for x in s), f"mode{r}.l")
        ]  # fmt: skip
        delays = [f"{self.model.inputs[k]}.delay" for k in self.free_delays]
        return (*self.logs, *self.linear, *shaped, *delays)

    def pack(self, theta: Mapping[str, float], delays: Array) -> Array:
        """Return the vector of numbers by name and delays in samples."""
        v = [np.log(theta[n]) for n in self.logs] + [theta[n] / self.scales[n] for n in self.linear]
        for r, at, read in self.shapes:
            b = np.array([theta[f"mode{r}.{x}"] for x in at])
            s = np.array([theta[f"mode{r}.{x}"] for x in read])
            long = [max(float(np.linalg.norm(x)), _LEAST_LENGTH) for x in (b, s)]
            split = 0.5 * np.log(long[0] / long[1])
            v += [*(b * np.exp(-split)), *(s * np.exp(split)), split]
        return np.array([*v, *delays[list(self.free_delays)]], dtype=np.float64)

    def unpack(self, v: Array, theta: Mapping[str, float], delays: Array) -> tuple[dict[str, float], Array]:
        """Return numbers by name and delays; those that do not move are taken from `theta` and `delays`."""
        numbers, k = dict(theta), len(self.logs)
        numbers |= {n: float(np.exp(x)) for n, x in zip(self.logs, v[:k], strict=True)}
        for n in self.linear:
            numbers[n] = float(v[k] * self.scales[n])
            k += 1
        for r, at, read in self.shapes:
            split = float(v[k + len(at) + len(read)])
            for places, sign in ((at, 1.0), (read, -1.0)):
                for x in places:
                    numbers[f"mode{r}.{x}"] = float(v[k] * np.exp(sign * split))
                    k += 1
            k += 1
        moved = delays.copy()
        moved[list(self.free_delays)] = v[k:]
        return numbers, moved

    def chain(self, v: Array) -> tuple[tuple[str, ...], Array]:
        """Return names of the model, and the derivatives of these, then of all delays, by the vector."""
        shaped = [f"mode{r}.{x}" for r, at, read in self.shapes for x in (*at, *read)]
        names = (*self.logs, *self.linear, *shaped)
        n_d = len(self.model.inputs)
        slopes = np.zeros((len(names) + n_d, v.size))
        k = len(self.logs)
        slopes[np.arange(k), np.arange(k)] = np.exp(v[:k])
        sizes = [self.scales[n] for n in self.linear]
        slopes[k + np.arange(len(sizes)), k + np.arange(len(sizes))] = sizes
        row = k = k + len(sizes)
        for _, at, read in self.shapes:
            l_at = k + len(at) + len(read)
            for places, sign in ((at, 1.0), (read, -1.0)):
                long = np.exp(sign * v[l_at])
                for _ in places:
                    slopes[row, k], slopes[row, l_at] = long, sign * long * v[k]
                    row, k = row + 1, k + 1
            k += 1
        slopes[row + np.array(self.free_delays, dtype=int), k + np.arange(len(self.free_delays))] = 1.0
        return names, slopes

    def estimated(self, v: Array) -> tuple[tuple[str, ...], Array]:
        """Return names of all that is estimated, delays last, and the derivatives by the vector."""
        names, slopes = self.chain(v)
        late = [f"{self.model.inputs[k]}.delay" for k in self.free_delays]
        return (*names, *late), slopes[[*range(len(names)), *(len(names) + k for k in self.free_delays)]]

    def priors(self, v: Array) -> tuple[Array, Array]:
        """Return the rows of priors, slopes (n, n_v) and residuals (n,), both over their standard deviations."""
        rows, left, k = [], [], 0
        at = {name: j for j, name in enumerate(self.names)}
        for p in self.known:
            if p.role == "prior" and p.name in at and p.value is not None and p.sd is not None:
                row, k = np.zeros(v.size), at[p.name]
                log = p.name in self.logs
                value = float(np.exp(v[k])) if log else float(v[k] * self.scales[p.name])
                row[k] = (value if log else self.scales[p.name]) / p.sd
                rows.append(row)
                left.append((p.value - value) / p.sd)
        for r, bearings, sensors in self.shapes:
            l_at = at[f"mode{r}.l"]
            of_b = [at[f"mode{r}.b.{x}"] for x in bearings]
            of_s = [at[f"mode{r}.s.{x}"] for x in sensors]
            row = np.zeros(v.size)
            row[l_at] = 1.0 / _SPLIT_SD
            rows.append(row)
            left.append(-v[l_at] / _SPLIT_SD)
            row, b, s = np.zeros(v.size), v[of_b], v[of_s]
            b2, s2 = max(float(b @ b), _LEAST_LENGTH), max(float(s @ s), _LEAST_LENGTH)
            row[of_b], row[of_s] = b / b2 / _GAUGE_SD, -s / s2 / _GAUGE_SD
            rows.append(row)
            left.append(-0.5 * float(np.log(b2 / s2)) / _GAUGE_SD)
        return np.array(rows).reshape(-1, v.size), np.array(left)

    @property
    def _modes(self) -> Sequence[int]:
        return () if self.held_modes else range(1, self.model.n_modes + 1)

    @cached_property
    def _free(self) -> tuple[str, ...]:
        """Numbers but shapes and dampings of modes."""
        if self.chosen is not None:
            return self.chosen
        roles = {p.name: p.role for p in self.known}
        of_modes = [f"mode{r}.omega" for r in self._modes]
        of_modes += [p.name for p in self.model.mode_parameters if p.name.startswith("gyro.")]
        return tuple(
            [p.name for p in self.model.parameters if roles.get(p.name, "mode") in ("free", "prior")] + of_modes
        )


def split_rows(model: RotorModel, theta: Mapping[str, float], names: Sequence[str]) -> Array:
    """Return the priors of the shapes' parts over numbers by `names`, as rows over their sd, (n_modes, n_names):
    ln(|bearings' part| / |sensors' part|) is 2 l with the convention's scatter.
    """
    n, rows = sum(not b.axial for b in model.bearings), np.zeros((model.n_modes, len(names)))
    sd = float(np.hypot(2.0 * _SPLIT_SD, _GAUGE_SD))
    for r, row in enumerate(rows, 1):
        for at, sign in ((model.places[:n], 1.0), (model.places[n:], -1.0)):
            part = np.array([theta[f"mode{r}.{x}"] for x in at])
            for x, slope in zip(at, sign * part / max(float(part @ part), _LEAST_LENGTH) / sd, strict=True):
                if f"mode{r}.{x}" in names:
                    row[names.index(f"mode{r}.{x}")] = slope
    return rows
