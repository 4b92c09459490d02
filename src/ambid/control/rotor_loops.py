"""The figures of many rotors in their loop, and their slopes by the gains, for the search of `ambid.control.tuning`.

With H from the commands and G from forces at the magnets, to what is fed back y and to the magnets z, the controller
K = Σ_s M_s [k_s, kc_s] of the sets s, N = (I + K H)⁻¹ K and Z = I - H N:

    S = Z_xx,   x/f = G_z - H_z N G,   u/n = N,   dS = -H_x (I + K H)⁻¹ dK Z_x,   and likewise the others,

so that all slopes of a set follow from one product each. Every plant has frequencies of its own, close around its
resonances, open and closed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.design import FREQUENCIES, SETTLED, closed_loop_of
from ambid.control.gain_sets import GainSets
from ambid.control.lqg import SampledPlant
from ambid.physics.law import StateLaw
from ambid.physics.loop import Loop
from ambid.simulation.plant import fed_back

_SHARP = 200.0  # exponent of the smooth maximum over axes and frequencies
_STEP = 1e-5  # of the logarithms, for slopes of the law's matrices
_SILENT = 0.1  # ln(c/SETTLED) of a pole that hardly takes part
_EVEN = 30.0  # exponent of the smooth minimum over poles
_SAME = 1e-3  # of a frequency: what is nearer to another is left out


@dataclass(frozen=True, kw_only=True, eq=False)
class RotorLoops:
    """Many plants on many axes, of one rate."""

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
        law, found = self.sets.law(self.around), []
        for plant, of in zip(self.plants, self.sampled, strict=True):
            f = plant.grid(FREQUENCIES)
            own = np.abs(np.angle(np.linalg.eigvals(of.closed(law)))) * self.rate_hz / (2.0 * np.pi)
            own = np.concatenate([own * (1.0 + w) for w in (-0.01, -0.003, 0.0, 0.003, 0.01)])
            f = np.union1d(f, own[(own > f[0]) & (own < f[-1])])
            found.append(f[np.append(True, np.diff(f) > _SAME * f[1:])])
        size = max(f.size for f in found)
        return np.array([np.pad(f, (0, size - f.size), mode="edge") for f in found])

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
        seen = np.array(self.sets.current)
        return tuple((M, M[:, seen]) for M in map(self.sets.form.share, range(len(self.sets.form.names))))

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
        found = np.stack([tops[0][0], tops[1][0], 0.5 * np.log(mean[many, worst])], axis=1)
        slopes = np.zeros((*found.shape, at.size))
        back = sd * np.conj(N[many, :, worst])
        seen = (
            (moved[:, :, :n], Z[..., :n], tops[0][1] / S), (moved[:, :, n_y:], pushed, tops[1][1] / soft),
        )  # fmt: skip
        for k, ((_, rates), (M, by_current)) in enumerate(zip(gains, self.shares, strict=True)):
            for part, M_k in ((slice(0, n), M), (slice(n, n_y), by_current)):
                weights = [
                    -np.sum(w * np.sum((left @ M_k) * np.swapaxes(right[:, :, part], 2, 3), axis=3), axis=2)
                    for left, right, w in seen
                ]
                row = inner[many, :, worst] @ M_k  # (n_plants, n_f, n)
                noisy = np.einsum("pfv,pfvy,pfy->pf", row, Z[:, :, part], back)
                weights.append(noisy * _widths(self.frequency_hz) / mean[many, worst][:, None])
                for j, weight in enumerate(weights):
                    if part.start == 0:
                        slopes[:, j] += np.real(np.einsum("pf,pfm->pm", weight, rates))
                    else:
                        slopes[:, j, 5 * k + 3] += kc[k] * np.real(np.sum(weight, axis=1))
        return found, slopes

    def decays(self, at: Array, *, integrates: bool) -> tuple[Array, Array]:
        """Return how fast force steps settle on each plant, 1/s, and its slopes, (n_plants, n).

        A pole with the part c in a step over its peak is settled after ln(c/`SETTLED`)/decay: of all poles the slowest
        so (a smooth minimum: axes have almost the same poles), in decays of one with the whole step. c falls with the
        square of the frequency, as inertia does: a bending mode that hardly takes part may decay slowly.
        """
        laws, found, slopes = self._laws(at), [], []
        for of in self.sampled:
            n, (decay, values, left, right, scale) = of.A.shape[0], self._slow(of, laws[0], integrates)
            near = np.flatnonzero(decay < decay.min() + 10.0 * self._pace / _EVEN)
            share = np.exp(-_EVEN * (decay[near] - decay.min()) / self._pace)
            rates = []
            for k in near:
                w, x = left[:, k], right[:, k]
                (a, c), (b, d) = (w[:n] @ of.B, w[n:]), (of.C @ x[:n], x[n:])
                rates.append([
                    a @ ((p.D - m.D) @ b + (p.C - m.C) @ d) + c @ ((p.B - m.B) @ b + (p.A - m.A) @ d)
                    for p, m in zip(laws[1::2], laws[2::2], strict=True)
                ])  # fmt: skip
            by = -np.real(np.array(rates) / (2.0 * _STEP * values[near, None])) * scale[near, None]
            found.append(decay.min() - math.log(share.sum()) * self._pace / _EVEN)
            slopes.append(share @ by / share.sum())
        return np.array(found), np.array(slopes)

    @cached_property
    def _pace(self) -> float:
        """What decays are large or small against, 1/s: the slowest of the loop that is looked around."""
        law = self.sets.law(self.around)
        integrates = bool(self.sets.signs[1])
        return max(min(float(self._slow(of, law, integrates)[0].min()) for of in self.sampled), 1e-3)

    @cached_property
    def _stiff(self) -> float:
        """Twice the least stiffness, over the mass, of the loop that is looked around, 1/s²."""
        return 2.0 / (self.plants[0].theta["m"] * float(np.exp(self.figures(self.around)[0][0, 1])))

    def _slow(
        self, of: SampledPlant, law: StateLaw, integrates: bool
    ) -> tuple[Array, Complex, Complex, Complex, Array]:
        """Return decays as `decays` counts them, poles, left and right vectors, and decay over -ln|pole|."""
        values, right = np.linalg.eig(of.closed(law))
        left = np.linalg.inv(right).T  # axes that are alike have the same poles: vectors one by one would not fit
        part = 1.0 / (1.0 + (np.angle(values) * self.rate_hz) ** 2 / self._stiff)
        weight = np.maximum(np.log(part / SETTLED), _SILENT)
        scale = self.rate_hz * math.log(1.0 / SETTLED) / weight
        decay = -np.log(np.maximum(np.abs(values), _STEP)) * scale
        if not integrates:  # what nothing feeds stays where it is
            decay[np.abs(values - 1.0) < _STEP**2] = np.inf
        return decay, values, left, right, scale

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
    found = np.zeros(frequency_hz.shape)
    found[:, :-1] += gaps
    found[:, 1:] += gaps
    found[:, 0] += frequency_hz[:, 0]
    return found / frequency_hz[:, -1:]


def _mean(frequency_hz: Array, power: Array) -> Array:
    return np.asarray(np.einsum("pf,pfu->pu", _widths(frequency_hz), power))
