"""A plant in its loop with an excitation added to the commands: what moves, in steady state and from rest.

The state of plant, delay and controller goes by z+ = Z z + e r, the signals are rows z + through r (`excited_loop`).
From rest the signals are those of the steady state less rows Zᵏ z(0), z(0) the state of the steady state where the
period begins: where that is small, the transient is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.controller import controller_of_loop
from ambid.control.information import Innovation
from ambid.control.waves import Limited, Lines
from ambid.physics.loop import Loop
from ambid.simulation.plant import closed_loop_poles, excited_loop

SLEW = ".slew"
"""What follows the name of an input in that of its rate of change."""
_NOISE_LINES = 2048
_STARTS = 24  # beginnings of the period that are simulated
_PERIODS = 2  # in which a transient is looked at


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExcitedLoop:
    """A plant in its loop; signals: outputs, inputs, rates of change of the inputs."""

    plant: Plant
    loop: Loop
    Z: Array  # (n, n)
    e: Array  # (n, n_inputs)
    rows: Array  # (n_outputs + n_inputs, n)

    @classmethod
    def of(cls, plant: Plant, loop: Loop) -> ExcitedLoop:
        """Return the loop around a plant."""
        Z, command, e = excited_loop(plant.theta, loop, plant.rate_hz, of=plant.model)
        C = plant.space.C
        outputs = np.hstack([C, np.zeros((C.shape[0], Z.shape[0] - C.shape[1]))])
        return cls(
            plant=plant, loop=loop, Z=Z, e=e.reshape(Z.shape[0], -1),
            rows=np.vstack([outputs, command.reshape(-1, Z.shape[0])]),
        )  # fmt: skip

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals."""
        of = self.plant.model
        return (*of.outputs, *of.inputs, *(f"{name}{SLEW}" for name in of.inputs))

    @property
    def pole(self) -> float:
        """Largest modulus of the poles."""
        return float(np.abs(closed_loop_poles(self.plant.theta, self.loop, self.plant.rate_hz, of=self.plant.model)[0]))

    def states(self, lines: Lines, period: int, inputs: Lines) -> Complex:
        """Return the states by unit excitation of each line's input, (n_lines, n)."""
        z = np.exp(2j * np.pi * lines / period)[:, None, None]
        right = self.e.T[inputs][:, :, None].astype(complex)
        return np.asarray(np.linalg.solve(z * np.eye(self.Z.shape[0]) - self.Z, right)[:, :, 0])

    def response(self, lines: Lines, period: int, inputs: Lines) -> Complex:
        """Return the signals by unit excitation of each line's input, (n_lines, n_signals)."""
        T = self.states(lines, period, inputs) @ self.rows.T
        n_u = self.e.shape[1]
        T[:, -n_u:] += np.eye(n_u)[inputs]
        back = (1.0 - np.exp(-2j * np.pi * lines / period)) * self.plant.rate_hz
        return np.hstack([T, T[:, -n_u:] * back[:, None]])

    def decay(self, samples: int) -> Array:
        """Return what is left of a state, (samples, n_signals, n), by doubling."""
        found, power = self.rows[None], self.Z
        while found.shape[0] < samples:
            found = np.concatenate([found, found @ power])
            power = power @ power
        found, n_u = found[:samples], self.e.shape[1]
        inputs = found[:, -n_u:]
        slew = np.diff(inputs, axis=0, prepend=np.zeros((1, *inputs.shape[1:]))) * self.plant.rate_hz
        slew[0] = 0.0
        return np.concatenate([found, slew], axis=1)

    def noise_sd(self, noise: Innovation) -> Array:
        """Return the standard deviation that noise gives the signals as they are logged, (n_signals,)."""
        of, rate = self.plant.model, self.plant.rate_hz
        f = np.asarray((np.arange(_NOISE_LINES) + 0.5) * (0.5 * rate / _NOISE_LINES), dtype=np.float64)
        H, K = self.plant.sampled(f).transfer(), controller_of_loop(self.loop, of, rate).response(f)[0]
        V = np.asarray(np.linalg.inv(np.asarray(noise.whiten(self.plant, 2.0 * np.pi * f))))
        answer = -np.linalg.solve(np.eye(H.shape[2]) + K @ H, K @ V)
        slew = answer * (rate * np.abs(1.0 - np.exp(-2j * np.pi * f / rate)))[:, None, None]
        power = [np.mean(np.sum(np.abs(x) ** 2, axis=2), axis=0) for x in (H @ answer + V, answer, slew)]
        return np.asarray(np.sqrt(np.concatenate(power)))


def begin_at(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> tuple[int, Array]:
    """Return the sample at which the period best begins from rest, and the largest part of each signal from there."""
    starts = _candidates(excited, limited, c, inputs)
    found = from_rest(excited, limited, c, inputs, starts)
    best = int(np.argmin(found.max(axis=1)))
    return int(starts[best]), found[best]


def from_rest(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines, starts: Lines) -> Array:
    """Return the largest part of each signal from rest, the period begun at some samples, (n_starts, n_signals)."""
    waves, n, n_u = limited.waves(c), limited.period, excited.e.shape[1]
    z, decay, found = _steady(excited, limited, c, inputs), excited.decay(_PERIODS * n), []
    for start in starts:
        moved = np.tile(np.roll(waves, -start, axis=0), (_PERIODS, 1)) - decay @ z[start]
        moved[0, -n_u:] = moved[0, -2 * n_u : -n_u] * excited.plant.rate_hz  # from 0
        found.append(limited.part(moved).max(axis=0))
    return np.array(found)


def _steady(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> Array:
    """Return the states of the steady state, (period, n)."""
    X = excited.states(limited.lines, limited.period, inputs)
    unlimited = np.full(X.shape[1], np.inf)
    return Limited(lines=limited.lines, period=limited.period, T=X, low=-unlimited, high=unlimited).waves(c)


def _candidates(excited: ExcitedLoop, limited: Limited, c: Complex, inputs: Lines) -> Lines:
    """Return the beginnings whose states move the signals least over a period, by their squares over the limits."""
    size = np.minimum(-limited.low, limited.high)
    left = excited.decay(limited.period) / size[:, None]
    gram = np.einsum("tsi,tsj->ij", left, left)
    z = _steady(excited, limited, c, inputs)
    score = np.einsum("ti,ij,tj->t", z, gram, z)
    least = np.flatnonzero((score <= np.roll(score, 1)) & (score <= np.roll(score, -1)))
    return np.asarray(least[np.argsort(score[least])][:_STARTS])
