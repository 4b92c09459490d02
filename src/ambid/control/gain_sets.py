"""PIDs on many axes as one law: the same gains on all, a set a bearing, or sets for parallel and tilting motion.

The axes are turned into coordinates c = T y by an orthogonal T, each coordinate has the PID of one set, and commands
go back by its transpose: equal sets are the decentralised loop, whatever T is. Of the bearings of a plane, those forces
p with the smallest squares that push without tilting, p = R⁺ (1, 0) with the rows R of ones and of levers z_b - z_cg,
make the parallel coordinate (of two bearings their mean weighted with the other's lever); all else of the plane tilts.
As P = pp'/p'p is symmetric, the damping takes energy out wherever sensors and magnets stand together.

A filter in the position of every set, around a bending mode, is a notch where its zeros and poles meet, and turns the
phase where they stand apart:

    F(s) = (w_p/w_z)² (s² + 2 zeta_z w_z s + w_z²)/(s² + 2 zeta_p w_p s + w_p²),   s = (2/T) (z - 1)/(z + 1),

in frequencies that are bent beforehand (Franklin, Powell and Workman 1998, sec. 6.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.physics.law import StateLaw, beside
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import Loop
from ambid.physics.rotor_model import RotorModel
from ambid.simulation.plant import fed_back

FORMS = ("axes", "bearings", "tilt")
"""One set for all axes, one a bearing, or parallel and tilting motion apart; the axial bearing then has its own."""
_WIDE = 0.5  # damping of zeros and poles of a filter that does nothing
_STEP = 1e-5  # of the logarithms, for slopes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pid:
    """What may change in a loop: its numbers as `AxisLoops` takes them, with the signs of the present ones."""

    signs: Array  # (4,): of kp, ki, kd, kc; 0 where the present loop has none, and keeps none
    period: float

    @classmethod
    def of(cls, loop: Loop, rate_hz: float) -> Pid:
        """Return the structure of a loop."""
        return cls(signs=np.sign([loop.kp, loop.ki, loop.kd, loop.kc]), period=1.0 / rate_hz)

    @property
    def free(self) -> Array:
        """Which of the five numbers are searched."""
        return np.append(self.signs != 0.0, self.signs[2] != 0.0)

    def at(self, loop: Loop) -> Array:
        """Return the logarithms of |kp|, |ki| T, |q|, |kc| and tau; of a loop without filter, a tau of T/10."""
        T = self.period
        tau = max(loop.filter_s, T / 10.0)
        sizes = np.abs([loop.kp, loop.ki * T, loop.kd / (loop.filter_s + T), loop.kc, tau])
        return np.asarray(np.log(np.where(sizes > 0.0, sizes, 1.0)))

    def numbers(self, at: Array) -> tuple[Array, Array]:
        """Return kp, ki T, q, kc and p, and their slopes by the logarithms."""
        tau, T = math.exp(at[4]), self.period
        v = np.append(self.signs * np.exp(at[:4]), tau / (tau + T) if self.signs[2] else 0.0)
        return v, np.append(v[:4], tau * T / (tau + T) ** 2 if self.signs[2] else 0.0)

    def loop(self, at: Array, present: Loop) -> Loop:
        """Return the loop."""
        v, _ = self.numbers(at)
        tau = math.exp(at[4])
        return replace(
            present, kp=float(v[0]), ki=float(v[1] / self.period), kd=float(v[2] * (tau + self.period)),
            kc=float(v[3]), derivative_cutoff_hz=1.0 / (2.0 * math.pi * tau) if self.signs[2] else math.inf,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Form:
    """Orthogonal coordinates of the axes, and the set of gains of each."""

    transform: Array  # (n_axes, n_axes), a row a coordinate
    sets: tuple[int, ...]  # of each coordinate
    names: tuple[str, ...]  # of the sets

    def share(self, k: int) -> Array:
        """Return the projection of the axes on the coordinates of set `k`, (n_axes, n_axes)."""
        T = self.transform[np.array(self.sets) == k]
        return np.asarray(T.T @ T)


def form_of(of: LinearModel, theta: Mapping[str, float], name: str) -> Form:
    """Return a form of `FORMS` for a model."""
    if not isinstance(of, RotorModel) or name == "axes":
        n = len(of.inputs)
        return Form(transform=np.eye(n), sets=(0,) * n, names=("all axes",))
    if name == "bearings":
        names = tuple(b.name for b in of.bearings)
        return Form(transform=np.eye(len(of.axes)), sets=tuple(names.index(b.name) for b, _ in of.placed), names=names)
    T, sets = np.eye(len(of.axes)), [2] * len(of.axes)
    for plane in (0, 1):
        own = [j for j, (_, p) in enumerate(of.placed) if p == plane]
        if len(own) < 2:
            raise EstimationError(
                f"{len(own)} axes hold plane {'xy'[plane]}; tilting takes two bearings. Give another form of gains"
            )
        levers = np.array([theta[f"{of.placed[j][0].name}.z"] - theta["z_cg"] for j in own])
        p = np.linalg.pinv(np.vstack([np.ones(len(own)), levers]))[:, 0]
        turn = np.linalg.svd(p[None])[2]
        T[np.ix_(own, own)] = turn * np.where(turn @ np.ones(len(own)) < 0.0, -1.0, 1.0)[:, None]
        for k, j in enumerate(own):
            sets[j] = int(k > 0)
    names = ("parallel", "tilt", *(["axial"] if 2 in sets else []))
    return Form(transform=T, sets=tuple(sets), names=names)


@dataclass(frozen=True, kw_only=True, eq=False)
class GainSets:
    """What may change: of every set the logarithms of `Pid`, then of every filter those of w_z, w_p, zeta_z, zeta_p."""

    form: Form
    pid: Pid
    current: tuple[bool, ...]  # whether each axis feeds its current back
    filters: int = 0

    @classmethod
    def of(cls, loop: Loop, model: LinearModel, rate_hz: float, form: Form, filters: int = 0) -> GainSets:
        """Return the structure that holds the gains of a loop in a form."""
        seen = tuple(bool(k >= 0) for k in fed_back(model)[:, 1])
        return cls(form=form, pid=Pid.of(loop, rate_hz), current=seen, filters=filters)

    @property
    def signs(self) -> Array:
        """Those of the gains, (4,)."""
        return self.pid.signs

    @cached_property
    def free(self) -> Array:
        """Which numbers are searched."""
        return np.concatenate([np.tile(self.pid.free, len(self.form.names)), np.ones(4 * self.filters, dtype=bool)])

    def at(self, loop: Loop, around: tuple[float, ...] = ()) -> Array:
        """Return the numbers of a loop in all sets; `around`: frequencies in rad/s of filters that do nothing yet."""
        idle = [np.log([w, w, _WIDE, _WIDE]) for w in around]
        return np.concatenate([*[self.pid.at(loop)] * len(self.form.names), *idle])

    def numbers(self, at: Array) -> tuple[Array, Array]:
        """Return the numbers as `RotorLoops` takes them, the logarithms, and their slopes by them."""
        return at, np.ones(at.size)

    def parts(self, at: Array) -> tuple[Array, Array]:
        """Return the numbers by set, (n_sets, 5), and by filter, (n_filters, 4)."""
        n = 5 * len(self.form.names)
        return at[:n].reshape(-1, 5), np.exp(at[n:]).reshape(-1, 4)

    def loop(self, at: Array, present: Loop) -> Loop:
        """Return the loop: gains where one set without a filter holds them, else a law."""
        if len(self.form.names) == 1 and not self.filters:
            return self.pid.loop(at, present)
        return Loop(delay=present.delay, law=self.law(at))

    def law(self, at: Array) -> StateLaw:
        """Return the law over all axes."""
        gains, filters = self.parts(at)
        T, rate = self.form.transform, 1.0 / self.pid.period
        ends = np.cumsum([0, *(1 + c for c in self.current)])
        position, current = ends[:-1], ends[:-1] + 1
        laws, rows = [], []
        for c, k in enumerate(self.form.sets):
            of = np.flatnonzero(T[c])
            with_current = all(self.current[j] for j in of)
            loop = self.pid.loop(gains[k], Loop())
            law = replace(loop, kc=0.0).as_law(rate, current=False)
            for one in filters:
                law = _filtered(law, one)
            row = np.zeros((1 + with_current, ends[-1]))
            row[0, position[of]] = T[c, of]
            if with_current:
                row[1, current[of]] = T[c, of]
                law = replace(law, B=np.pad(law.B, ((0, 0), (0, 1))), D=np.append(law.D, [[-loop.kc]], axis=1))
            laws.append(law)
            rows.append(row)
        return beside(laws).through(np.vstack(rows), T.T)

    def current_gain(self, at: Array, k: int) -> float:
        """Return kc of set `k`."""
        return float(self.pid.numbers(self.parts(at)[0][k])[0][3])

    def slopes(self, at: Array, k: int, frequency_hz: Array) -> tuple[Complex, Complex]:
        """Return the position's response of set `k` without sign, and its slopes by all numbers, (..., n_numbers)."""
        base, own = self._response(at, k, frequency_hz), np.zeros((*frequency_hz.shape, at.size), dtype=complex)
        mine = [*range(5 * k, 5 * k + 3), 5 * k + 4, *range(5 * len(self.form.names), at.size)]
        for j in mine:
            step = np.zeros(at.size)
            step[j] = _STEP
            ends = [self._response(at + s * step, k, frequency_hz) for s in (1.0, -1.0)]
            own[..., j] = (ends[0] - ends[1]) / (2.0 * _STEP)
        return base, own

    def _response(self, at: Array, k: int, frequency_hz: Array) -> Complex:
        gains, filters = self.parts(at)
        (kp, ki, q, _, p), _ = self.pid.numbers(gains[k])
        back = np.exp(-2j * np.pi * frequency_hz * self.pid.period)
        K = kp + ki * back / (1.0 - back) + q * (1.0 - back) / (1.0 - p * back)
        for one in filters:
            num, den = _coefficients(one, self.pid.period)
            K = K * np.polyval(num[::-1], back) / np.polyval(den[::-1], back)
        return np.asarray(K)


def _coefficients(one: Array, period: float) -> tuple[Array, Array]:
    """Return numerator and denominator of a filter in 1/z, the first of the denominator 1."""
    z, p = (2.0 * np.tan(min(w * period / 2.0, 1.5)) for w in one[:2])  # over 1/T
    num, den = (
        np.array([4.0 + 4.0 * d * w + w * w, 2.0 * w * w - 8.0, 4.0 - 4.0 * d * w + w * w])
        for w, d in ((z, one[2]), (p, one[3]))
    )
    return num * (p / z) ** 2 / den[0], den / den[0]


def _filtered(law: StateLaw, one: Array) -> StateLaw:
    """Return a law of one command behind a filter; what is not ordered does not reach the filter."""
    b, a = _coefficients(one, 1.0 / law.rate_hz)
    A, B = np.array([[-a[1], 1.0], [-a[2], 0.0]]), np.array([[b[1] - a[1] * b[0]], [b[2] - a[2] * b[0]]])
    C = np.array([[1.0, 0.0]])
    return StateLaw(
        A=np.block([[law.A, np.zeros((law.order, 2))], [B @ law.C, A]]), B=np.vstack([law.B, B @ law.D]),
        C=np.hstack([b[0] * law.C, C]), D=b[0] * law.D, G=np.vstack([law.windup, np.zeros((2, 1))]),
        rate_hz=law.rate_hz,
    )  # fmt: skip
