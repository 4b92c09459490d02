"""A closed loop in the frequency domain: an estimated plant and its controller; sensitivity, openings, compliance.

With positions p and other outputs q of y = H u, and u = F r - K y, the sensitivity at the positions, all else closed,
is

S = (I + P C)⁻¹, P C = H_p (I + K_q H_q)⁻¹ K_p,

without F: its diagonal is that of ISO 14839-3, an axis opened alone L = 1/S_jj - 1; at the commands (I + K H)⁻¹.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.controller import Controller
from ambid.estimation.estimate import Delay
from ambid.physics.linear_model import LinearModel, StateSpace
from ambid.physics.rotor_model import RotorModel, position_role
from ambid.rotor.response import Sampled
from ambid.rotor.spectra import PeriodSpectra, smoothed
from ambid.signals.response import FrequencyResponse

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
        rotor = self.model
        return tuple(
            tuple(outputs.index(position_role(axis, k)) for i, k in rotor.sensors if i == j)
            for j, axis in enumerate(rotor.axes)
        )

    @cached_property
    def space(self) -> StateSpace:
        """The matrices."""
        return self.model.matrices(self.theta)

    def sampled(self, frequency_hz: Array) -> Sampled:
        """Return the sampled response at some frequencies."""
        plant_model = self.model
        holds = plant_model.held if isinstance(plant_model, RotorModel) else (True,) * len(plant_model.inputs)
        return Sampled(
            space=self.space, omega=2.0 * np.pi * frequency_hz, rate_hz=self.rate_hz, delays=self.delays, held=holds
        )

    def slopes(self, at: Sampled, driven: Complex) -> Complex:
        """Return the derivatives of H by `names` at spectra of the inputs `driven` (n, n_u): (n, n_y, n_names)."""
        roles = [f"{role}.delay" for role in self.model.inputs]
        numbers = [n for n in self.names if n not in roles]
        slopes = at.slopes(driven, [self.model.derivative(self.theta, n) for n in numbers], len(roles))
        order = [len(numbers) + roles.index(n) if n in roles else numbers.index(n) for n in self.names]
        return np.asarray(slopes[:, :, order])

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
        """Return the loop on the plant's grid, closer where it resonates (det(I + K H) turns, however narrow), peaks,
        or passes a margin.
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
        weights = np.zeros((self.frequency_hz.size, len(self.plant.sensors), len(p)), dtype=complex)
        for j, group in enumerate(self.plant.sensors):
            at = [p.index(k) for k in group]
            own = self.K[:, j, list(group)]
            total = own.sum(axis=1, keepdims=True)
            weights[:, j, at] = np.where(total == 0.0, 1.0 / len(group), own / np.where(total == 0.0, 1.0, total))
        return weights

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
        S = np.linalg.inv(np.eye(self.H.shape[2]) + self.K @ self.H)
        return np.asarray(np.diagonal(S, axis1=1, axis2=2))

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
        """What outputs and magnets do in open loop, (n, n_y + n_axes, ...), by disturbances (the model's, held over a
        sample; then a harmonic force at each magnet, (j omega - A)⁻¹) and by inputs.
        """
        plant_model, space, n = self.plant.model, self.plant.space, len(self.plant.axes)
        if isinstance(plant_model, RotorModel):
            magnets = plant_model.rows(self.plant.theta)[0]
            rows = np.hstack([magnets, np.zeros((n, space.A.shape[0] - magnets.shape[1]))])
        else:
            rows = space.C[[plant_model.outputs.index("position")]]
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
        causes = np.concatenate([self.pushed[0][:, :n_y], noise], axis=2)
        return np.asarray(-np.linalg.solve(np.eye(self.H.shape[2]) + self.K @ self.H, self.K @ causes))

    @cached_property
    def motions(self) -> Complex:
        """What plant outputs and magnets do by the causes of `answers`; noise of the sensors is not added to them."""
        by_forces, by_inputs = self.pushed
        motions = by_inputs @ self.answers
        motions[:, :, : by_forces.shape[2]] += by_forces
        return np.asarray(motions)

    @cached_property
    def compliance(self) -> Complex:
        """The displacement at each magnet by a force there, the loop closed, (n, n_axes), m/N."""
        n_y, n, n_d = self.H.shape[1], len(self.plant.axes), self.plant.space.E.shape[1]
        return np.asarray(np.diagonal(self.motions[:, n_y:, n_d : n_d + n], axis1=1, axis2=2))

    def _sd_db(self, j: int) -> float:
        """Return the standard deviation of 20 lg |S_jj| at this loop's one frequency (delta method) by dS = -S [I, -H_p
        (I + K_q H_q)⁻¹ K_q] dH (I + K_q H_q)⁻¹ K_p S, and likewise by dK.
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
        outputs = np.zeros(H.shape[0], dtype=complex)
        outputs[p], outputs[q] = right, -H[q] @ driven
        weights = scale * (left @ H[p] @ inner)
        variance += self.controller.variance(self.frequency_hz, outputs, weights)
        return float(np.sqrt(max(variance, 0.0)))


def _too_far(watched: Complex, n: int) -> NDArray[np.bool_]:
    """Return between which frequencies and the next a loop changes too much, (n_frequencies - 1,)."""
    det, S = watched[:, 0], watched[:, 1 : 1 + n]
    far: NDArray[np.bool_] = np.abs(np.log(det[1:] / det[:-1])) > _TURN
    L = 1.0 / S - 1.0
    for side in (np.abs(L) > 1.0, L.imag > 0.0):
        far |= np.any(side[1:] != side[:-1], axis=1)
    peaks = np.argmax(watched[:, 1 + n :].real, axis=0)
    far[np.clip(np.concatenate([peaks - 1, peaks]), 0, far.size - 1)] = True
    return far


# The sensitivity as a record itself shows it: from the responses to the references, without a model of the plant.
#
# With x = T r at the position signals and the controller's K_p and F, S = I - T F⁻¹ K_p. A line at which one reference
# alone has power gives its column of T at once; where several have, neighbouring lines are taken together.

_SILENT = 1e-3  # of the largest line, below which a reference has no power
_COUPLED = 1e-6  # share of its own term below which another axis' term in the controller is left out
_LINES_PER_UNKNOWN = 3
_BOUND = 3.0  # standard deviations
_NEAR = 1.2  # factor on the frequency, around a peak
_HALVES = (6, 4, 3)  # lines on either side of a peak that are fitted, or all that are near; fewer where they do not fit
_ORDERS = (2, 6)  # of the polynomial, and at most half the lines
_MISFIT = 4.0  # mean square of what a fit leaves, over the scatter, from which it is none
_INNER = 0.5  # part of the fitted lines where the top is looked for: towards their ends a polynomial swings
_SEEN = 0.1  # relative standard deviation of a peak that the record shows
_DRAWS = 24  # of a fitted curve with noise
_TOGETHER = 6  # lines on either side of one that may hide a peak, whose powers are averaged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredSensitivity:
    """S_jj of one axis at the lines of its reference, and the standard deviation of its modulus."""

    frequency_hz: Array  # (n_lines,)
    ratio: Array
    sd: Array
    phase: Array = field(default_factory=lambda: np.zeros(0))  # rad; none in a file of an earlier version

    @property
    def peak(self) -> tuple[float, float, float] | None:
        """Ratio, frequency in Hz and standard deviation of the peak; None where noise hides it, as do lines too noisy
        to show a peak that together stand higher.
        """
        measured = self.ratio > 0.0
        relative = np.divide(self.sd, self.ratio, out=np.zeros_like(self.sd), where=measured)
        noise = np.sqrt(smoothed(relative[:, None] ** 2)[:, 0])
        top = self._found(measured, noise)
        if top is None:
            return None
        power = smoothed((self.ratio**2 - 2.0 * self.sd**2)[:, None], _TOGETHER)[:, 0]
        surely = power * (1.0 - 4.0 * noise / np.sqrt(2.0 * _TOGETHER + 1.0))  # by two standard deviations
        return None if np.any(surely[noise > _SEEN] > top[0] ** 2) else top

    def _found(self, measured: NDArray[np.bool_], noise: Array) -> tuple[float, float, float] | None:
        """Return the peak by the lines' relative noise, sought at the largest lower bound (the largest line is that of
        the largest noise). There a polynomial is fitted to 1/S, whose poles, plant's and controller's, are farther away
        than those of S, and whose noise is circular; that the top is sought on a noisy curve is taken off.
        """
        f = self.frequency_hz
        k = int(np.argmax(self.ratio * (1.0 - _BOUND * noise)))
        if noise[k] > _SEEN:
            return None
        wide = int(np.max(np.abs(np.flatnonzero(np.abs(np.log(f / f[k])) < np.log(_NEAR)) - k), initial=0))
        for half in (max(wide, _HALVES[0]), *_HALVES[1:]):
            near = np.flatnonzero(measured[max(k - half, 0) : k + half + 1]) + max(k - half, 0)
            if noise[k] == 0.0 or not self.phase.size or near.size < 2 * _ORDERS[0]:
                break
            S = self.ratio[near] * np.exp(1j * self.phase[near])
            top = _top(np.log(f[near] / f[k]), S, noise[near])
            if top is not None:
                height, sd = _as_if_known(top, np.log(f[near] / f[k]), noise[near])
                return height, float(f[k] * np.exp(top.place)), sd
        return float(self.ratio[k]), float(f[k]), float(noise[k] * self.ratio[k])


class _Top(NamedTuple):
    """The top of |S| by a polynomial of 1/S."""

    height: float
    place: float
    sd: float
    curve: Complex  # the polynomial at the lines, 1/S
    misfit: float  # mean square of what it leaves, over the scatter


def _top(x: Array, S: Complex, noise: Array) -> _Top | None:
    """Return the top of |S| by a polynomial of 1/S of Akaike's order, None where none fits; `noise`: relative standard
    deviation of |S|.
    """
    reach, weights = float(np.abs(x).max()), np.abs(S) / noise
    best: tuple[float, int, Any, Any, float] | None = None
    for order in range(_ORDERS[0], min(_ORDERS[1], x.size // 2) + 1):
        Q, R = np.linalg.qr(np.polynomial.chebyshev.chebvander(x / reach, order) * weights[:, None])
        projected = Q.T @ (weights / S)
        left = float(np.sum(np.abs(weights / S - Q @ projected) ** 2))
        score = left + 4.0 * order
        if best is None or score < best[0]:
            best = (score, order, np.linalg.solve(R, projected), R, left / (2.0 * (x.size - order - 1)))
    if best is None or best[4] > _MISFIT:
        return None
    _, order, coefficients, R, misfit = best
    at = np.linspace(max(float(x[0]) / reach, -_INNER), min(float(x[-1]) / reach, _INNER), 1001)
    rows = np.polynomial.chebyshev.chebvander(at, order)
    size = np.abs(rows @ coefficients)
    k = int(np.argmin(size))
    sd = np.linalg.norm(np.linalg.solve(R.T, rows[k])) * np.sqrt(max(misfit, 1.0))
    return _Top(
        height=float(1.0 / size[k]), place=float(at[k] * reach), sd=float(sd / size[k] ** 2),
        curve=np.polynomial.chebyshev.chebvander(x / reach, order) @ coefficients, misfit=max(misfit, 1.0),
    )  # fmt: skip


def _as_if_known(top: _Top, x: Array, noise: Array) -> tuple[float, float]:
    """Return height and standard deviation of a top freed of what seeking it on a noisy curve adds: so much higher are
    the tops of the curve with noise anew (parametric bootstrap, Efron and Tibshirani 1993, chap. 10).
    """
    rng = np.random.default_rng(0)
    e = rng.standard_normal((2, _DRAWS, x.size)) * noise * np.abs(top.curve) * np.sqrt(top.misfit)
    tops = [_top(x, 1.0 / (top.curve + one), noise) for one in e[0] + 1j * e[1]]
    heights = np.array([t.height for t in tops if t is not None])
    if heights.size < _DRAWS // 2:
        return top.height, top.sd
    bias = float(heights.mean()) - top.height
    return top.height - bias, float(np.hypot(max(float(heights.std()), top.sd), bias))


def measured_sensitivity(
    spectra: PeriodSpectra, loop: ClosedLoop, *, silent: float = _SILENT
) -> tuple[MeasuredSensitivity | None, ...]:
    """Return each axis's measured sensitivity, None without a reference of its own; of `loop`, at the spectra's lines,
    only the controller is used; `silent`: part of the largest line below which a reference has no power.
    """
    sensors = loop.plant.sensors
    if spectra.R is None or spectra.R.shape[1] != len(sensors):
        return (None,) * len(sensors)
    size = np.abs(spectra.R)
    on = size > silent * size.max()
    K, F = loop.controller.response(spectra.frequency_hz)
    p = [k for group in sensors for k in group]
    C = np.linalg.pinv(F) @ K[:, :, p]
    columns = {k: _column(spectra, on, k, p) for k in range(on.shape[1]) if np.any(on[:, k])}
    return tuple(_of_axis(spectra, loop, columns, C, on, j) if j in columns else None for j in range(len(sensors)))


def _of_axis(
    spectra: PeriodSpectra, loop: ClosedLoop, columns: dict[int, Complex], C: Complex, on: Array, j: int
) -> MeasuredSensitivity:
    """Return the sensitivity of axis `j`; other axes' terms are interpolated period by period, with the bend between
    their lines, so that the scatter is that of all.
    """
    at, f = np.flatnonzero(on[:, j]), spectra.frequency_hz
    through = C[at] @ loop.together[:, j]  # (n_lines, n_references): what a disturbance of the axis' sensors orders
    weights = loop.weights[at, j]  # (n_lines, n_p)
    S = 1.0 - np.sum(weights * columns[j], axis=2) * through[:, j]  # (n_periods, n_lines)
    for other, column in columns.items():
        if other == j or np.all(np.abs(through[:, other]) <= _COUPLED * np.abs(through[:, j])):
            continue
        lines = f[np.flatnonzero(on[:, other])]
        place = np.interp(f[at], lines, np.arange(lines.size))
        below = np.clip(place.astype(int), 0, max(lines.size - 2, 0))
        t = (place - below)[:, None]
        interpolated = (1.0 - t) * column[:, below] + t * column[:, np.minimum(below + 1, lines.size - 1)]
        if lines.size > 2:
            bend = np.pad(np.diff(column, 2, axis=1), ((0, 0), (1, 0), (0, 0)), mode="edge")
            interpolated = interpolated - 0.5 * t * (1.0 - t) * bend[:, below]
        S = S - np.sum(weights * interpolated, axis=2) * through[:, other]
    mean = S.mean(axis=0)
    scatter = np.var(S, axis=0, ddof=1) / S.shape[0] if S.shape[0] > 1 else np.zeros(at.size)
    return MeasuredSensitivity(
        frequency_hz=f[at], ratio=np.abs(mean), sd=np.sqrt(scatter / 2.0), phase=np.angle(mean)
    )  # fmt: skip


def _column(spectra: PeriodSpectra, on: Array, mine: int, p: list[int]) -> Complex:
    """Return positions over a reference at its lines, by period, (n_periods, n_lines of it, n_p)."""
    assert spectra.R is not None
    R, at = spectra.R, np.flatnonzero(on[:, mine])
    alone = np.asarray(spectra.Y[:, at][:, :, p] / R[at, mine][:, None])
    shared = np.flatnonzero(on[at].sum(axis=1) > 1)
    if not shared.size:
        return alone
    others = np.flatnonzero(np.any(on[at], axis=0))
    window = min(2 * _LINES_PER_UNKNOWN * others.size, R.shape[0])
    column = alone
    for m, k in zip(shared, at[shared], strict=True):
        first = int(np.clip(k - window // 2, 0, R.shape[0] - window))
        near = slice(first, first + window)
        run = (spectra.frequency_hz[near] - spectra.frequency_hz[k])[:, None] / np.ptp(spectra.frequency_hz[near])
        rows = np.hstack([R[near][:, others], run * R[near][:, others]])
        answers = np.linalg.lstsq(rows, spectra.Y[:, near][:, :, p].transpose(1, 0, 2).reshape(window, -1), rcond=None)
        column[:, m] = answers[0][int(np.flatnonzero(others == mine)[0])].reshape(spectra.n_periods, len(p))
    return column


def measured_locally(response: FrequencyResponse, loop: ClosedLoop) -> tuple[MeasuredSensitivity | None, ...]:
    """Return the sensitivity by a response (n, n_p, n_references) from references to positions, `loop` at its
    frequencies, of a record that is not periodic.
    """
    p = [k for group in loop.plant.sensors for k in group]
    K, F = loop.controller.response(response.frequency_hz)
    C = np.linalg.pinv(F) @ K[:, :, p]
    results = []
    for j in range(len(loop.plant.sensors)):
        through, weights = C @ loop.together[:, j], loop.weights[:, j]
        S = 1.0 - np.einsum("kp,kpr,kr->k", weights, response.G, through)
        size = np.abs(weights)[:, :, None] * response.sd * np.abs(through)[:, None, :]
        sd = np.sqrt(np.sum(size**2, axis=(1, 2)) / 2.0)
        results.append(
            MeasuredSensitivity(frequency_hz=response.frequency_hz, ratio=np.abs(S), sd=sd, phase=np.angle(S))
        )
    return tuple(results)
