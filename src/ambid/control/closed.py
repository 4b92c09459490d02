"""A closed loop in the frequency domain: an estimated plant and its controller; sensitivity, openings, compliance.

With positions p and other outputs q of the plant y = H u, and the controller u = F r - K y, the sensitivity at the
position signals with all else closed is

    S = (I + P C)⁻¹,   P C = H_p (I + K_q H_q)⁻¹ K_p,

in which F cancels: its diagonal is what ISO 14839-3 measures axis by axis. The loop of one axis, opened alone while the
others stay closed, is L = 1/S_jj - 1. At the commands the same is said of (I + K H)⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.controller import Controller
from ambid.estimation.estimate import Delay
from ambid.physics.linear_model import LinearModel, StateSpace
from ambid.physics.rotor_model import RotorModel, position_role
from ambid.rotor.response import Sampled

_SPAN = 1e-4  # of the rate: the lowest frequency that is shown
_FREQUENCIES = 1200
_ENDS = 1e-6  # of the rate: how near the frequencies come to rest and to half the rate
_BELOW = 60  # frequencies below those shown
_AROUND = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0])  # half widths of a resonance
_PASSES = 4  # by which the frequencies come closer where something happens, each by a factor of 9
_WITHIN = np.arange(1, 9) / 9.0
_TURN = 0.25  # change of the logarithm of det(I + K H) between neighbours, from which they are too far apart
DECIBEL = 20.0 / np.log(10.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant:
    """A model with its numbers as an estimate gives them; delays in samples."""

    model: LinearModel
    theta: Mapping[str, float]
    delays: Array  # (n_inputs,)
    rate_hz: float
    names: tuple[str, ...] = ()  # what was estimated, delays included, in the order of `covariance`
    covariance: Array | None = None

    @classmethod
    def of(
        cls, model: LinearModel, theta: Mapping[str, float], delay: Mapping[str, Delay], rate_hz: float,
        names: tuple[str, ...] = (), covariance: Array | None = None,
    ) -> Plant:  # fmt: skip
        """Return the plant of an estimate's parts."""
        delays = [delay[role].samples + delay[role].fraction if role in delay else 0.0 for role in model.inputs]
        return cls(
            model=model, theta=theta, delays=np.array(delays, dtype=np.float64), rate_hz=rate_hz, names=names,
            covariance=covariance,
        )  # fmt: skip

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes; of a model of one axis, "x"."""
        return self.model.axes if isinstance(self.model, RotorModel) else ("x",)

    @property
    def sensors(self) -> tuple[tuple[int, ...], ...]:
        """The outputs that are positions of each axis; none of a model without a position."""
        outputs = self.model.outputs
        if not isinstance(self.model, RotorModel):
            return ((outputs.index("position"),),) if "position" in outputs else ()
        of = self.model
        return tuple(
            tuple(outputs.index(position_role(axis, k)) for i, k in of.sensors if i == j)
            for j, axis in enumerate(of.axes)
        )

    @cached_property
    def space(self) -> StateSpace:
        """The matrices."""
        return self.model.matrices(self.theta)

    def sampled(self, frequency_hz: Array) -> Sampled:
        """Return the sampled response at some frequencies."""
        of = self.model
        held = of.held if isinstance(of, RotorModel) else (True,) * len(of.inputs)
        return Sampled(
            space=self.space, omega=2.0 * np.pi * frequency_hz, rate_hz=self.rate_hz, delays=self.delays, held=held
        )

    def slopes(self, at: Sampled, driven: Complex) -> Complex:
        """Return the derivatives of H by `names` at spectra of the inputs `driven` (n, n_u): (n, n_y, n_names)."""
        roles = [f"{role}.delay" for role in self.model.inputs]
        known = [n for n in self.names if n not in roles]
        found = at.slopes(driven, [self.model.derivative(self.theta, n) for n in known], len(roles))
        order = [len(known) + roles.index(n) if n in roles else known.index(n) for n in self.names]
        return np.asarray(found[:, :, order])

    def grid(self, n: int = _FREQUENCIES) -> Array:
        """Return `n` frequencies up to half the rate, and more around the plant's resonances."""
        poles = np.linalg.eigvals(self.space.A)
        size = np.abs(poles)
        narrow = (np.abs(poles.imag) > 0.9 * size) & (poles.imag > 0.0)
        around = [
            (size[k] + side * width * abs(poles[k].real)) / (2.0 * np.pi)
            for k in np.flatnonzero(narrow) for side in (-1.0, 1.0) for width in _AROUND
        ]  # fmt: skip
        low, high = _SPAN * self.rate_hz, 0.499 * self.rate_hz
        near = [f for f in around if low < f < high]
        below = np.geomspace(_ENDS * self.rate_hz, low, _BELOW)
        return np.unique(np.r_[below, np.geomspace(low, high, n), near, (0.5 - _ENDS) * self.rate_hz])


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """The peak of the sensitivity of one axis."""

    ratio: float
    frequency_hz: float
    sd_db: float

    @property
    def decibel(self) -> float:
        """Its size in dB."""
        return float(20.0 * np.log10(self.ratio))


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedLoop:
    """Plant and controller at some frequencies; without frequencies of its own, on the plant's grid."""

    plant: Plant
    controller: Controller
    frequency_hz: Array

    @classmethod
    def of(cls, plant: Plant, controller: Controller) -> ClosedLoop:
        """Return the loop on the plant's grid, closer where the loop resonates, peaks, or passes a margin.

        A resonance of the loop between two frequencies turns det(I + K H), however narrow it is.
        """
        f = plant.grid()
        loop = cls(plant=plant, controller=controller, frequency_hz=f)
        watched = loop._watched()
        for _ in range(_PASSES):
            k = np.flatnonzero(_too_far(watched, len(plant.axes) + len(plant.model.inputs)))
            new = (f[k, None] + (f[k + 1] - f[k])[:, None] * _WITHIN).ravel()
            order = np.argsort(np.concatenate([f, new]))
            f = np.concatenate([f, new])[order]
            watched = np.concatenate([watched, loop.at(new)._watched()])[order]
        return loop.at(f)

    def _watched(self) -> Complex:
        """Return det(I + K H), the sensitivities, and the sizes that peak, (n, columns)."""
        det = np.linalg.det(np.eye(self.H.shape[2]) + self.K @ self.H)
        S = np.hstack([self.of_axes, self.at_commands])
        return np.column_stack([det, S, np.abs(S), np.abs(S - 0.5), self.singular, np.abs(self.compliance)])

    def at(self, frequency_hz: Array) -> ClosedLoop:
        """Return the loop at other frequencies."""
        return replace(self, frequency_hz=frequency_hz)

    @property
    def shown(self) -> NDArray[np.intp]:
        """Which frequencies are worth showing."""
        return np.flatnonzero(self.frequency_hz >= _SPAN * self.plant.rate_hz)

    @cached_property
    def sampled(self) -> Sampled:
        """The plant."""
        return self.plant.sampled(self.frequency_hz)

    @cached_property
    def H(self) -> Complex:
        """From inputs to outputs, (n, n_y, n_u)."""
        return self.sampled.transfer()

    @cached_property
    def K(self) -> Complex:
        """From outputs to inputs, without sign, (n, n_u, n_y)."""
        return self.controller.response(self.frequency_hz)[0]

    @cached_property
    def _parts(self) -> tuple[list[int], list[int], Complex, Complex]:
        """Positions p, other outputs q, (I + K_q H_q)⁻¹ K_p, and S over all sensors."""
        p = [k for group in self.plant.sensors for k in group]
        q = [k for k in range(self.H.shape[1]) if k not in p]
        inner = np.eye(self.H.shape[2]) + self.K[:, :, q] @ self.H[:, q]
        back = np.linalg.solve(inner, self.K[:, :, p])
        S = np.linalg.inv(np.eye(len(p)) + self.H[:, p] @ back)
        return p, q, back.astype(np.complex128), S.astype(np.complex128)

    @property
    def positions(self) -> list[int]:
        """The outputs that are positions, in the order of `weights`."""
        return self._parts[0]

    @cached_property
    def weights(self) -> Complex:
        """How the controller of each axis weighs its sensors, (n, n_axes, n_p): 1 for a single one."""
        p = self._parts[0]
        found = np.zeros((self.frequency_hz.size, len(self.plant.sensors), len(p)), dtype=complex)
        for j, group in enumerate(self.plant.sensors):
            at = [p.index(k) for k in group]
            own = self.K[:, j, list(group)]
            total = own.sum(axis=1, keepdims=True)
            found[:, j, at] = np.where(total == 0.0, 1.0 / len(group), own / np.where(total == 0.0, 1.0, total))
        return found

    @cached_property
    def together(self) -> Array:
        """Which sensors an axis has, (n_p, n_axes)."""
        p = self._parts[0]
        return np.array([[1.0 * (k in group) for group in self.plant.sensors] for k in p])

    @cached_property
    def sensitivity(self) -> Complex:
        """S of the axes at their position signals, (n, n_axes, n_axes); sensors of one axis are taken together."""
        return np.asarray(self.weights @ self._parts[3] @ self.together)

    @cached_property
    def at_commands(self) -> Complex:
        """The sensitivity at the inputs, diagonal of (I + K H)⁻¹, (n, n_u)."""
        found = np.linalg.inv(np.eye(self.H.shape[2]) + self.K @ self.H)
        return np.asarray(np.diagonal(found, axis1=1, axis2=2))

    @property
    def of_axes(self) -> Complex:
        """The diagonal of `sensitivity`, (n, n_axes)."""
        return np.asarray(np.diagonal(self.sensitivity, axis1=1, axis2=2))

    @cached_property
    def singular(self) -> Array:
        """The largest singular value of `sensitivity`, (n,)."""
        return np.asarray(np.linalg.norm(self.sensitivity, ord=2, axis=(1, 2)))

    def peaks(self) -> tuple[Peak, ...]:
        """Return the peak of each axis."""
        size = np.abs(self.of_axes)
        at = [(j, int(k)) for j, k in enumerate(np.argmax(size, axis=0))]
        return tuple(
            Peak(
                ratio=float(size[k, j]), frequency_hz=float(self.frequency_hz[k]),
                sd_db=self.at(self.frequency_hz[k : k + 1])._sd_db(j),
            )
            for j, k in at
        )  # fmt: skip

    @cached_property
    def pushed(self) -> tuple[Complex, Complex]:
        """What plant outputs and magnets do in open loop, (n, n_y + n_axes, ...), by disturbances and by inputs.

        Disturbances: those of the model, held over a sample; then a harmonic force at each magnet, (j omega - A)⁻¹.
        """
        of, space, n = self.plant.model, self.plant.space, len(self.plant.axes)
        if isinstance(of, RotorModel):
            magnets = of.rows(self.plant.theta)[0]
            rows = np.hstack([magnets, np.zeros((n, space.A.shape[0] - magnets.shape[1]))])
        else:
            rows = space.C[[of.outputs.index("position")]]
        wide = replace(self.sampled, space=replace(space, C=np.vstack([space.C, rows])))
        values, V, inverse = wide.eigen
        h = 1.0 / (1j * wide.omega[:, None] - values)
        harmonic = (h[:, None, :] * (wide.space.C @ V)) @ (inverse @ space.E[:, :n])
        return np.concatenate([wide.disturbed(), harmonic], axis=2), wide.transfer()

    @cached_property
    def answers(self) -> Complex:
        """What the inputs do, (n, n_u, ...), by the disturbances of `pushed`, then by the noise of each output."""
        n_y = self.H.shape[1]
        noise = np.broadcast_to(np.eye(n_y), (self.H.shape[0], n_y, n_y))
        seen = np.concatenate([self.pushed[0][:, :n_y], noise], axis=2)
        return np.asarray(-np.linalg.solve(np.eye(self.H.shape[2]) + self.K @ self.H, self.K @ seen))

    @cached_property
    def motions(self) -> Complex:
        """What plant outputs and magnets do by the causes of `answers`; noise of the sensors is not added to them."""
        by_forces, by_inputs = self.pushed
        found = by_inputs @ self.answers
        found[:, :, : by_forces.shape[2]] += by_forces
        return np.asarray(found)

    @cached_property
    def compliance(self) -> Complex:
        """The displacement at each magnet by a force there, the loop closed, (n, n_axes), m/N."""
        n_y, n, n_d = self.H.shape[1], len(self.plant.axes), self.plant.space.E.shape[1]
        return np.asarray(np.diagonal(self.motions[:, n_y:, n_d : n_d + n], axis1=1, axis2=2))

    def _sd_db(self, j: int) -> float:
        """Return the standard deviation of 20 lg |S_jj| at the one frequency of this loop (delta method).

        dS = -S [I, -H_p (I + K_q H_q)⁻¹ K_q] dH (I + K_q H_q)⁻¹ K_p S, and likewise by dK.
        """
        p, q, back, S = self._parts
        H, K = self.H[0], self.K[0]
        inner = np.linalg.inv(np.eye(H.shape[1]) + K[:, q] @ H[q])
        right, left = S[0] @ self.together[:, j], self.weights[0, j] @ S[0]
        driven = back[0] @ right  # what the inputs do, without sign
        row = np.zeros(H.shape[0], dtype=complex)
        row[p], row[q] = left, -left @ H[p] @ inner @ K[:, q]
        scale = -DECIBEL / self.of_axes[0, j]
        variance = 0.0
        covariance = self.plant.covariance
        if covariance is not None and self.plant.names:
            g = np.real(scale * (row @ self.plant.slopes(self.sampled, driven[None, :])[0]))
            variance += float(g @ covariance @ g)
        seen = np.zeros(H.shape[0], dtype=complex)
        seen[p], seen[q] = right, -H[q] @ driven
        weights = scale * (left @ H[p] @ inner)
        variance += self.controller.variance(self.frequency_hz, seen, weights)
        return float(np.sqrt(max(variance, 0.0)))


def _too_far(watched: Complex, n: int) -> NDArray[np.bool_]:
    """Return between which frequencies and the next a loop changes too much, (n_frequencies - 1,)."""
    det, S = watched[:, 0], watched[:, 1 : 1 + n]
    found: NDArray[np.bool_] = np.abs(np.log(det[1:] / det[:-1])) > _TURN
    L = 1.0 / S - 1.0
    for of in (np.abs(L) > 1.0, L.imag > 0.0):
        found |= np.any(of[1:] != of[:-1], axis=1)
    peaks = np.argmax(watched[:, 1 + n :].real, axis=0)
    found[np.clip(np.concatenate([peaks - 1, peaks]), 0, found.size - 1)] = True
    return found
