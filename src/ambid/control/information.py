"""What a periodic excitation tells of a model's parameters, line by line, before a record is made.

Of y = G u + H e, S = cov e, the prediction error moves as H⁻¹ dG/dθ u (Ljung 1999, sec. 9.4 and 13.4), without
parameters of H alone and offsets, which stand at frequency 0. Inputs T c exp(jωt) give of each sample

M = |c|² Re(Φ* S⁻¹ Φ)/2, Φ = H⁻¹ dG/dθ T, H⁻¹ = I - C (z - A + K C)⁻¹ K,

K the stationary predictor's gain: linear in the powers, a convex problem (Fedorov 1972; Goodwin and Payne 1977, ch. 6).
What feedback of the noise tells and what the initial state costs is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.errors import EstimationError
from ambid.estimation.predictor import predictor_gain, scales_for
from ambid.estimation.uncertainty import natural_sizes
from ambid.physics.linear_model import discretise
from ambid.physics.loop import Noise
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.unknowns import split_rows
from ambid.simulation.rotor_bench import kind_of

_ROUNDS = 2000  # of the multiplicative algorithm
_MOST_TERMS = 2e9  # that it adds up, of many lines and parameters in fewer rounds
_SETTLED = 1e-3  # of the equivalence theorem: largest slope over the mean


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Innovation:
    """The noise of a record: x[k+1] = A x + B u + K e, y = C x + e, SI."""

    gain: Array  # (n_states, n_outputs)
    covariance: Array  # (n_outputs, n_outputs)

    @classmethod
    def of(cls, plant: Plant, noise: Noise) -> Innovation:
        """Return that of a bench's noise; EstimationError where an output has none, and could be known exactly."""
        plant_model, force, voltage = plant.model, *noise.held_rms(plant.rate_hz)
        sensors = np.array([noise.sensor_rms(kind_of(role)) for role in plant_model.outputs])
        if not np.all(sensors > 0.0):
            silent = plant_model.outputs[int(np.argmin(sensors))]
            raise EstimationError(
                f"nothing is known of the noise of {silent!r}, and without noise any excitation would do. Give [noise] "
                "in the rig, or an estimate"
            )
        pushed = np.array([force if "force" in name else voltage for name in plant_model.disturbances])
        return cls.of_sources(plant, sensors, pushed)

    @classmethod
    def of_sources(cls, plant: Plant, sensors: Array, pushed: Array) -> Innovation:
        """Return that of the rms of each sensor's noise, and of each disturbance held over samples."""
        sc = scales_for(plant.model, plant.theta, np.ones(len(plant.model.inputs)), sensors, plant.rate_hz)
        d, _ = discretise(plant.space, 1.0 / plant.rate_hz)
        A, E, C = d.A * sc.state / sc.state[:, None], d.E * pushed / sc.state[:, None], d.C * sc.state
        at = predictor_gain(A, C / sensors[:, None], E @ E.T, np.eye(sensors.size))
        return cls(gain=sc.state[:, None] * at.K / sensors, covariance=at.S * np.outer(sensors, sensors))

    def whiten(self, plant: Plant, omega: Array) -> Complex:
        """Return W H⁻¹ at some frequencies in rad/s, W* W = S⁻¹, (n, n_outputs, n_outputs)."""
        d, _ = discretise(plant.space, 1.0 / plant.rate_hz)
        z = np.exp(1j * omega / plant.rate_hz)[:, None, None]
        inner = z * np.eye(d.A.shape[0]) - (d.A - self.gain @ d.C)
        right = np.broadcast_to(self.gain.astype(complex), (omega.size, *self.gain.shape))
        inverse = np.eye(d.C.shape[0]) - d.C @ np.linalg.solve(inner, right)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.covariance)) @ inverse)


def reported(name: str) -> bool:
    """Return whether an estimated number stands for itself; shapes and gyroscopic terms of modes are numbers beside."""
    return not name.startswith("gyro.") and (not name.startswith("mode") or name.endswith((".omega", ".zeta")))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Information:
    """Information of lines, each of one input, over the sizes of what is estimated; of one plant or of several."""

    names: tuple[str, ...]  # as estimated; the delay of an input is "<input>.delay", in samples
    sizes: Array  # (n,), what a standard deviation is judged against; of a delay one sample
    lines: Array  # (n_plants, n_lines, n, n), of one sample and unit squared amplitude
    prior: Array  # (n, n), what is known before
    weights: Array  # (n,), of the squared relative standard deviations in the criterion; their sum is 1

    @classmethod
    def of(
        cls, plants: Sequence[Plant], noises: Sequence[Innovation], frequency_hz: Array, driven: Sequence[Complex], *,
        prior_sd: Mapping[str, float], criterion: str = "all",
    ) -> Information:  # fmt: skip
        """Return the information of `names` of the plants; `driven` (n_lines, n_inputs): T of each line's input."""
        first = plants[0]
        roles, names = {f"{role}.delay" for role in first.model.inputs}, first.names
        numbers = [n for n in names if n not in roles]
        sizes = np.ones(len(names))
        sizes[[names.index(n) for n in numbers]] = natural_sizes(
            numbers, dict(first.theta), first.model.references(first.theta)
        )
        prior = np.array([sizes[k] / prior_sd[n] if n in prior_sd else 0.0 for k, n in enumerate(names)])
        chosen = [n for n in numbers if reported(n)] if criterion == "all" else [criterion]
        shapes = split_rows(first.model, first.theta, names) * sizes if isinstance(first.model, RotorModel) else None
        lines_of_plants = []
        for plant, noise, T in zip(plants, noises, driven, strict=True):
            rows = noise.whiten(plant, 2.0 * np.pi * frequency_hz) @ plant.slopes(plant.sampled(frequency_hz), T)
            rows = rows * sizes
            lines_of_plants.append(0.5 * np.real(np.swapaxes(rows.conj(), 1, 2) @ rows))
        return cls(
            names=names, sizes=sizes, lines=np.array(lines_of_plants),
            prior=np.diag(prior**2) + (0.0 if shapes is None else shapes.T @ shapes),
            weights=np.array([(n in chosen) / len(chosen) for n in names]),
        )  # fmt: skip

    def among(self, keep: NDArray[np.int64]) -> Information:
        """Return that of some of the lines."""
        return replace(self, lines=self.lines[:, keep])

    def total(self, power: Array, samples: float) -> Array:
        """Return the information of a record, priors included, (n_plants, n, n); `power`: squared amplitudes."""
        return np.asarray(samples * np.einsum("k,pkij->pij", power, self.lines) + self.prior)

    def relative_sd(self, power: Array, samples: float) -> Array:
        """Return what a record of the first plant will show, (n,); very large where it shows nothing."""
        M = self.total(power, samples)[0]
        scale = np.sqrt(np.maximum(np.diag(M), 1e-300))
        values, V = np.linalg.eigh(M / np.outer(scale, scale))
        return np.asarray(np.sqrt((V**2) @ (1.0 / np.maximum(values, 1e-16))) / scale)

    def judge(self, M: Array) -> tuple[float, Array]:
        """Return the criterion at informations (n_plants, n, n), meaned over the plants, and its slopes by them."""
        V = np.linalg.inv(M)
        value = (np.diagonal(V, axis1=1, axis2=2) * self.weights).sum(axis=1)
        return float(value.mean()), -(V * self.weights) @ V / value.size


def power_design(information: Information, cost: Array, samples: float) -> tuple[Array, float]:
    """Return powers (n_lines,) of the least criterion at a total cost of 1, `cost` being that of unit power, and the
    largest slope less the mean, over the mean: no design is better by more (equivalence theorem, Kiefer 1974). Each
    share of the cost grows with the root of its slope (Silvey, Titterington and Torsney 1978; Yu 2010).
    """
    lines = information.lines / cost[:, None, None]
    share, gap = np.full(cost.size, 1.0 / cost.size), np.inf
    for _ in range(min(_ROUNDS, int(_MOST_TERMS / lines.size))):
        _, slope = information.judge(samples * np.einsum("k,pkij->pij", share, lines) + information.prior)
        gain = -np.einsum("pkij,pij->k", lines, slope)
        mean = float(share @ gain)
        gap = float(np.max(gain)) / mean - 1.0
        if gap < _SETTLED:
            break
        share = share * np.sqrt(gain / mean)
        share /= share.sum()
    return share / cost, gap


def informed_lines(power: Array, cost: Array, count: int) -> NDArray[np.int64]:
    """Return which lines are kept of many: half those with the largest share of the cost, the rest evenly by octave."""
    if cost.size <= count:
        return np.arange(cost.size)
    best = np.argsort(-power * cost)[: count // 2]
    rest = np.setdiff1d(np.arange(cost.size), best)
    spread = rest[np.unique(np.geomspace(1, rest.size, 20 * count).round().astype(int)) - 1]
    places = np.linspace(0, spread.size - 1, min(count - best.size, spread.size)).round().astype(int)
    return np.union1d(best, spread[places])
