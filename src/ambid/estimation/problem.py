"""What is estimated from what: data, model, and the layout of the vector of estimated numbers.

The vector holds, in this order: free and prior physical parameters (over their magnitudes), the delay where it is
estimated, the noise description (log levels, or the gain itself), constant disturbances (offsets), initial state.
States, inputs and outputs are scaled to order one before anything is factorised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import LinearModel, StateSpace

_BLOCK = 8192  # rows that are looked at at once: they stay in the cache
NoiseForm = Literal["levels", "gain", "given"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scales:
    """Units in which the predictor works."""

    state: Array  # (n_states,)
    input: Array  # (n_inputs,)
    output: Array  # (n_outputs,), about the sensor noise of each output
    # (n_disturbances,), level at which a disturbance moves an output by about its noise within a few samples
    disturbance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorProblem:
    """Data, model and what is to be estimated."""

    model: LinearModel
    rate_hz: float
    u: Array  # (n_samples, n_inputs), deviations from the operating point, SI
    y: Array  # (n_samples, n_outputs), deviations from the operating point, SI
    estimated: tuple[str, ...]  # physical parameters in the vector
    known: Mapping[str, float]  # the others, SI
    magnitude: Array  # (n_estimated,), scale of each estimated physical parameter, SI
    prior_mean: Array  # (n_estimated,), SI, standard deviation infinite where there is no prior
    prior_sd: Array
    scales: Scales
    delay: int = 0  # whole samples of delay on all inputs
    lag: float = 0.0  # fraction of a sample of delay on top, 0 <= lag < 1, where it is not estimated
    # whether the delay is estimated as a real number near `delay`: delay - 1 < total < delay + 2
    fractional: bool = False
    # samples left out at the start, so that fits with different delays see the same data; at least ``delay + 2``
    skip: int = 2
    # the predictor sees every stride-th output (all inputs act); more than 1 only with noise "gain" or "given"
    stride: int = 1
    # noise as disturbance and sensor levels through the Riccati equation, as a free predictor gain, or as `gain`
    noise: NoiseForm = "levels"
    # (n_noise,), centre of the weak prior on the log noise levels
    noise_center: Array = field(default_factory=lambda: np.zeros(0))
    # (n_states, n_outputs), predictor gain in scaled units, for noise "given"
    gain: Array = field(default_factory=lambda: np.zeros((0, 0)))

    slices: Mapping[str, slice] = field(init=False)  # places of the groups in the vector

    def __post_init__(self) -> None:
        if self.skip < self.delay + 2 or self.y.shape[0] <= self.skip:
            raise ValueError(f"skip {self.skip} must exceed the delay {self.delay} by two and leave samples")
        if self.stride > 1 and self.noise == "levels":
            raise ValueError("a stride above 1 wants the noise as a gain")
        n, n_y, n_d = len(self.model.states), len(self.model.outputs), len(self.model.disturbances)
        sizes = {
            "physical": self.n_physical,
            "fraction": int(self.fractional),
            "noise": {"levels": n_d + n_y - 1, "gain": n * n_y, "given": 0}[self.noise],
            "offset": n_d,
            "initial": n,
        }
        ends = list(accumulate(sizes.values(), initial=0))
        object.__setattr__(self, "slices", {name: slice(*ends[j : j + 2]) for j, name in enumerate(sizes)})

    @property
    def n_physical(self) -> int:
        """Number of estimated physical parameters."""
        return len(self.estimated)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return int(self.slices["initial"].stop)

    @property
    def taps(self) -> tuple[int, ...]:
        """Lags beyond `delay`, in samples, at which the input acts over one sample."""
        if self.fractional:
            return (-1, 0, 1, 2)
        return (0, 1) if self.lag else (0,)

    @property
    def lags(self) -> tuple[int, ...]:
        """Lags beyond `delay` at which the input enters one step of the recursion, which is `stride` samples long."""
        return tuple(range(self.taps[0] - (self.stride - 1), self.taps[-1] + 1))

    @property
    def n_used(self) -> int:
        """Samples of each output that enter the fit."""
        return int(-(-(self.y.shape[0] - self.skip) // self.stride))

    def parameters(self, vector: Array) -> dict[str, float]:
        """Return all physical parameters in SI at `vector`.

        `vector`: (size,).
        """
        values = vector[self.slices["physical"]] * self.magnitude
        return {**self.known, **dict(zip(self.estimated, values.tolist(), strict=True))}

    def lag_at(self, vector: Array) -> float:
        """Return the delay in samples beyond `delay` at a vector.

        `vector`: (size,).
        """
        return float(vector[self.slices["fraction"]][0]) if self.fractional else self.lag

    def delay_samples(self, vector: Array) -> float:
        """Return the whole delay in samples at a vector.

        `vector`: (size,).
        """
        return self.delay + self.lag_at(vector)


def noise_floor(y: Array) -> Array:
    """Return about the white noise of each output.

    Third differences remove smooth motion and amplify white noise by sqrt(1 + 9 + 9 + 1).

    `y`: (n_samples, n_outputs). Returns (n_outputs,), positive, in the unit of `y`.
    """
    squares, rows = np.zeros(y.shape[1]), max(y.shape[0] - 3, 1)
    for first in range(0, y.shape[0] - 3, _BLOCK):
        part = y[first : first + _BLOCK + 3]
        third = part[3:] - part[:-3] - 3.0 * (part[2:-1] - part[1:-2])
        squares += np.einsum("ij,ij->j", third, third)
    floor = np.sqrt(squares / rows / 20)
    return np.asarray(np.maximum(floor, 1e-9 * np.std(y, axis=0)))


def scales_for(
    model: LinearModel, values: Mapping[str, float], inputs: Array, outputs: Array, rate_hz: float
) -> Scales:
    """Return the scales of a predictor.

    Sensor noise for outputs and states; for disturbances, what moves the outputs by that within two samples.

    `values`: rough parameters, SI; `inputs`: (n_inputs,), SI, standard deviations of the inputs; `outputs`:
    (n_outputs,), SI, about the noise of the outputs, see `noise_floor`.
    """
    return all_scales(model, [values], inputs, outputs, rate_hz)[0]


def all_scales(
    model: LinearModel, places: Sequence[Mapping[str, float]], inputs: Array, outputs: Array, rate_hz: float
) -> list[Scales]:
    """Return the scales of predictors at several places, see `scales_for`."""
    spaces = [model.matrices(values) for values in places]
    A, B, E = (np.array(matrices) for matrices in zip(*((s.A, s.B, s.E) for s in spaces), strict=True))
    discrete, _ = discretise(StateSpace(A=A, B=B, E=E, C=spaces[0].C), 1.0 / rate_hz)
    reach = np.maximum(np.abs(discrete.C @ discrete.E), np.abs(discrete.C @ discrete.A @ discrete.E))
    state = np.array([outputs[model.outputs.index(s)] if s in model.outputs else 0.0 for s in model.states])
    state[state == 0] = outputs[0] * rate_hz / 20  # velocity, the only state that is not measured
    return [
        Scales(state=state, input=inputs, output=outputs, disturbance=disturbance)
        for disturbance in 1 / np.max(reach / outputs[:, None], axis=1)
    ]
