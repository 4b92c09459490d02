"""PIDs as one law, of one axis or many: the same gains on all, or a set a bearing. A filter in the position of every
set, around a bending mode, is a notch, or turns the phase where zeros and poles stand apart:

F(s) = (w_p/w_z)² (s² + 2 zeta_z w_z s + w_z²)/(s² + 2 zeta_p w_p s + w_p²), s = (2/T) (z - 1)/(z + 1),

in frequencies that are bent beforehand (Franklin, Powell and Workman 1998, sec. 6.1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.design import FREQUENCIES, SETTLED, closed_loop_of
from ambid.physics.law import StateLaw, beside
from ambid.physics.linear_model import LinearModel, delayed
from ambid.physics.loop import Loop
from ambid.physics.rotor_model import RotorModel
from ambid.simulation.plant import fed_back, signals_fed_back

FORMS = ("axes", "bearings")
"""One set for all axes, or one a bearing."""
_WIDE = 0.5  # damping of zeros and poles of a filter that does nothing
_STEP = 1e-5  # of the logarithms, for slopes of responses and of the law's matrices


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pid:
    """What may change in a loop: its numbers, with the signs of the present ones."""

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

    def numbers(self, at: Array) -> Array:
        """Return kp, ki T, q, kc and p."""
        tau, T = math.exp(at[4]), self.period
        return np.append(self.signs * np.exp(at[:4]), tau / (tau + T) if self.signs[2] else 0.0)

    def loop(self, at: Array, present: Loop) -> Loop:
        """Return the loop."""
        v = self.numbers(at)
        tau = math.exp(at[4])
        return replace(
            present, kp=float(v[0]), ki=float(v[1] / self.period), kd=float(v[2] * (tau + self.period)),
            kc=float(v[3]), derivative_cutoff_hz=1.0 / (2.0 * math.pi * tau) if self.signs[2] else math.inf,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Form:
    """Which set of gains each axis has."""

    sets: tuple[int, ...]  # of each axis
    names: tuple[str, ...]  # of the sets

    def share(self, k: int) -> Array:
        """Return the projection on the axes of set `k`, (n_axes, n_axes)."""
        return np.diag(np.array(self.sets) == k).astype(np.float64)


def form_of(plant_model: LinearModel, name: str) -> Form:
    """Return a form of `FORMS` for a model."""
    if not isinstance(plant_model, RotorModel) or name == "axes":
        return Form(sets=(0,) * len(plant_model.inputs), names=("all axes",))
    names = tuple(b.name for b in plant_model.bearings)
    return Form(sets=tuple(names.index(b.name) for b, _ in plant_model.placed), names=names)


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
        current = tuple(bool(k >= 0) for k in fed_back(model)[:, 1])
        return cls(form=form, pid=Pid.of(loop, rate_hz), current=current, filters=filters)

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
        laws = []
        for k, with_current in zip(self.form.sets, self.current, strict=True):
            loop = self.pid.loop(gains[k], Loop())
            law = replace(loop, kc=0.0).as_law(1.0 / self.pid.period, current=False)
            for one in filters:
                law = _filtered(law, one)
            if with_current:
                law = replace(law, B=np.pad(law.B, ((0, 0), (0, 1))), D=np.append(law.D, [[-loop.kc]], axis=1))
            laws.append(law)
        return beside(laws)

    def current_gain(self, at: Array, k: int) -> float:
        """Return kc of set `k`."""
        return float(self.pid.numbers(self.parts(at)[0][k])[3])

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
        kp, ki, q, _, p = self.pid.numbers(gains[k])
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


# The figures of many plants in their loop, and their slopes by the gains, for the search of `ambid.control.tuning`.
#
# With H from the commands and G from forces at the magnets, to what is fed back y and to the magnets z, the controller
# K = Σ_s M_s [k_s, kc_s] of the sets s, N = (I + K H)⁻¹ K and Z = I - H N:
#
#     S = Z_xx,   x/f = G_z - H_z N G,   u/n = N,   dS = -H_x (I + K H)⁻¹ dK Z_x,   and likewise the others,
#
# so that all slopes of a set follow from one product each. Every plant has frequencies of its own, close around its
# resonances, open and closed.

_SHARP = 200.0  # exponent of the smooth maximum over axes and frequencies
_SILENT = 0.1  # ln(c/SETTLED) of a pole that hardly takes part
_EVEN = 30.0  # exponent of the smooth minimum over poles
_SAME = 1e-3  # of a frequency: what is nearer to another is left out


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPlant:
    """A plant over one sample, its states followed by the commands on their way; outputs as a `StateLaw` sees them."""

    A: Array
    B: Array
    C: Array

    @classmethod
    def of(cls, plant: Plant) -> SampledPlant:
        """Return the plant with the delay of each input, whole and fraction."""
        d = delayed(plant.space, 1.0 / plant.rate_hz, plant.delays)
        return cls(A=d.A, B=d.B, C=d.C[signals_fed_back(plant.model)])

    def closed(self, law: StateLaw) -> Array:
        """Return the matrix of the closed loop, states of the plant before those of the law."""
        return np.block([[self.A + self.B @ law.D @ self.C, self.B @ law.C], [law.B @ self.C, law.A]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Loops:
    """Many plants of one rate, on the same axes."""

    plants: Sequence[Plant]
    noise: tuple[float, float]  # of position and current, m and A rms
    sets: GainSets
    around: Array  # numbers of a loop whose resonances are looked at too

    @cached_property
    def rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.plants[0].rate_hz

    @cached_property
    def sampled(self) -> tuple[SampledPlant, ...]:
        """Each plant over one sample."""
        return tuple(SampledPlant.of(p) for p in self.plants)

    @cached_property
    def frequency_hz(self) -> Array:
        """Frequencies of each plant, (n_plants, n), the last one repeated where there are fewer."""
        law, grids = self.sets.law(self.around), []
        for plant, sampled in zip(self.plants, self.sampled, strict=True):
            f = plant.grid(FREQUENCIES)
            own = np.abs(np.angle(np.linalg.eigvals(sampled.closed(law)))) * self.rate_hz / (2.0 * np.pi)
            own = np.concatenate([own * (1.0 + w) for w in (-0.01, -0.003, 0.0, 0.003, 0.01)])
            f = np.union1d(f, own[(own > f[0]) & (own < f[-1])])
            grids.append(f[np.append(True, np.diff(f) > _SAME * f[1:])])
        size = max(f.size for f in grids)
        return np.array([np.pad(f, (0, size - f.size), mode="edge") for f in grids])

    @cached_property
    def responses(self) -> tuple[Complex, Complex]:
        """From commands, and from forces, to positions, currents and magnets, (n_plants, n, n_p + n_i + n_p, ...)."""
        H, G = [], []
        for plant, f in zip(self.plants, self.frequency_hz, strict=True):
            (by_forces, by_inputs), n = closed_loop_of(plant, Loop(), f).pushed, len(plant.axes)
            position, current = fed_back(plant.model).T
            rows = [*position, *current[current >= 0], *range(len(plant.model.outputs), by_inputs.shape[1])]
            first = plant.space.E.shape[1]
            H.append(by_inputs[:, rows])
            G.append(by_forces[:, rows, first : first + n])
        return np.array(H), np.array(G)

    @cached_property
    def shares(self) -> tuple[tuple[Array, Array], ...]:
        """Of each set where it acts by positions, and by the currents that are measured, (n, n) and (n, n_i)."""
        current = np.array(self.sets.current)
        return tuple((M, M[:, current]) for M in map(self.sets.form.share, range(len(self.sets.form.names))))

    def figures(self, at: Array) -> tuple[Array, Array]:
        """Return the logarithms of peak, compliance and noise, (n_plants, 3), and their slopes, (n_plants, 3, n)."""
        (H, G), n = self.responses, len(self.sets.current)
        n_y = H.shape[2] - n
        gains = [self.sets.slopes(at, k, self.frequency_hz) for k in range(len(self.shares))]
        kc = [self.sets.current_gain(at, k) for k in range(len(self.shares))]
        K = np.concatenate([
            sum(k[..., None, None] * M for (k, _), (M, _) in zip(gains, self.shares, strict=True)),
            np.broadcast_to(sum(c * M for c, (_, M) in zip(kc, self.shares, strict=True)), (*H.shape[:2], n, n_y - n)),
        ], axis=3)  # fmt: skip
        inner = np.linalg.inv(np.eye(n) + K @ H[:, :, :n_y])
        N = inner @ K
        Z = np.eye(n_y) - H[:, :, :n_y] @ N
        pushed = Z @ G[:, :, :n_y]
        moved = H @ inner  # of positions, currents and magnets by what is added to the commands
        S, soft = _diagonal(Z[:, :, :n, :n]), _diagonal(G[:, :, n_y:] - H[:, :, n_y:] @ N @ G[:, :, :n_y])
        sd = np.repeat(self.noise, (n, n_y - n)) ** 2
        power = np.sum(np.abs(N) ** 2 * sd, axis=3)
        mean = _mean(self.frequency_hz, power)
        worst = np.argmax(mean, axis=1)
        many = np.arange(worst.size)
        tops = [_smooth_maximum(np.log(np.abs(x))) for x in (S, soft)]
        figures = np.stack([tops[0][0], tops[1][0], 0.5 * np.log(mean[many, worst])], axis=1)
        slopes = np.zeros((*figures.shape, at.size))
        back = sd * np.conj(N[many, :, worst])
        parts = (
            (moved[:, :, :n], Z[..., :n], tops[0][1] / S), (moved[:, :, n_y:], pushed, tops[1][1] / soft),
        )  # fmt: skip
        for k, ((_, rates), (M, by_current)) in enumerate(zip(gains, self.shares, strict=True)):
            for part, M_k in ((slice(0, n), M), (slice(n, n_y), by_current)):
                weights = [
                    -np.sum(w * np.sum((left @ M_k) * np.swapaxes(right[:, :, part], 2, 3), axis=3), axis=2)
                    for left, right, w in parts
                ]
                row = inner[many, :, worst] @ M_k  # (n_plants, n_f, n)
                noisy = np.einsum("pfv,pfvy,pfy->pf", row, Z[:, :, part], back)
                weights.append(noisy * _widths(self.frequency_hz) / mean[many, worst][:, None])
                for j, weight in enumerate(weights):
                    if part.start == 0:
                        slopes[:, j] += np.real(np.einsum("pf,pfm->pm", weight, rates))
                    else:
                        slopes[:, j, 5 * k + 3] += kc[k] * np.real(np.sum(weight, axis=1))
        return figures, slopes

    def decays(self, at: Array, *, integrates: bool) -> tuple[Array, Array]:
        """Return how fast force steps settle on each plant, 1/s, and its slopes, (n_plants, n). A pole of part c in a
        step over its peak takes ln(c/`SETTLED`)/decay; the slowest counts (a smooth minimum), in decays of one with the
        whole step. c falls with the squared frequency: a bending mode that hardly takes part may decay slowly.
        """
        laws, decays, slopes = self._laws(at), [], []
        for sampled in self.sampled:
            n, (decay, values, left, right, moved) = sampled.A.shape[0], self._slow(sampled, laws[0], integrates)
            near = np.flatnonzero(decay < decay.min() + 10.0 * self._pace / _EVEN)
            share = np.exp(-_EVEN * (decay[near] - decay.min()) / self._pace)
            rates = []
            for k in near:
                w, x = left[:, k], right[:, k]
                (a, c), (b, d) = (w[:n] @ sampled.B, w[n:]), (sampled.C @ x[:n], x[n:])
                rates.append([
                    a @ ((p.D - m.D) @ b + (p.C - m.C) @ d) + c @ ((p.B - m.B) @ b + (p.A - m.A) @ d)
                    for p, m in zip(laws[1::2], laws[2::2], strict=True)
                ])  # fmt: skip
            rises = np.real(np.array(rates) / (2.0 * _STEP * values[near, None]) * moved[near, None])
            decays.append(decay.min() - math.log(share.sum()) * self._pace / _EVEN)
            slopes.append(share @ rises / share.sum())
        return np.array(decays), np.array(slopes)

    @cached_property
    def _pace(self) -> float:
        """What decays are large or small against, 1/s: the slowest of the loop that is looked around."""
        law = self.sets.law(self.around)
        integrates = bool(self.sets.signs[1])
        return max(min(float(self._slow(sampled, law, integrates)[0].min()) for sampled in self.sampled), 1e-3)

    @cached_property
    def _stiff(self) -> float:
        """Twice the least stiffness, over the mass, of the loop that is looked around, 1/s²."""
        return 2.0 / (self.plants[0].theta["m"] * float(np.exp(self.figures(self.around)[0][0, 1])))

    def _slow(
        self, sampled: SampledPlant, law: StateLaw, integrates: bool
    ) -> tuple[Array, Complex, Complex, Complex, Complex]:
        """Return decays as `decays` counts them, poles, left and right vectors, and what the real part of it times the
        relative change of a pole is the change of its decay.
        """
        values, right = np.linalg.eig(sampled.closed(law))
        left = np.linalg.inv(right).T  # axes that are alike have the same poles: vectors one by one would not fit
        turn = np.angle(values) * self.rate_hz**2 / self._stiff
        part = 1.0 / (1.0 + np.angle(values) * turn)
        weight = np.maximum(np.log(part / SETTLED), _SILENT)
        scale = self.rate_hz * math.log(1.0 / SETTLED) / weight
        decay = -np.log(np.maximum(np.abs(values), _STEP)) * scale
        bends = np.where(weight > _SILENT, 2.0 * decay / weight * turn * part, 0.0)  # with the frequency
        if not integrates:  # what nothing feeds stays where it is
            decay[np.abs(values - 1.0) < _STEP**2] = np.inf
        return decay, values, left, right, -scale - 1j * bends

    def _laws(self, at: Array) -> list[StateLaw]:
        """Return the law, then those with each number a little larger and smaller."""
        steps = [s * _STEP * e for e in np.eye(at.size) for s in (1.0, -1.0)]
        return [self.sets.law(at), *(self.sets.law(at + s) for s in steps)]


def _diagonal(x: Complex) -> Complex:
    return np.asarray(np.diagonal(x, axis1=2, axis2=3))


def _smooth_maximum(ln: Array) -> tuple[Array, Array]:
    """Return a smooth maximum over all but the first axis, and the weights of its slopes."""
    top = ln.max(axis=(1, 2), keepdims=True)
    weight = np.exp(_SHARP * (ln - top))
    total = weight.sum(axis=(1, 2), keepdims=True)
    return (top + np.log(total) / _SHARP)[:, 0, 0], weight / total


def _widths(frequency_hz: Array) -> Array:
    """Return the weights of a mean over the frequencies, (n_plants, n), by the trapezoidal rule from rest on."""
    gaps = np.diff(frequency_hz, axis=1) / 2.0
    widths = np.zeros(frequency_hz.shape)
    widths[:, :-1] += gaps
    widths[:, 1:] += gaps
    widths[:, 0] += frequency_hz[:, 0]
    return widths / frequency_hz[:, -1:]


def _mean(frequency_hz: Array, power: Array) -> Array:
    return np.asarray(np.einsum("pf,pfu->pu", _widths(frequency_hz), power))
