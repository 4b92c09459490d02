"""What is estimated from what: data, model, and the layout of the vector of estimated numbers.

The vector holds, in this order: free and prior physical parameters (over their magnitudes), the delay where it is
estimated, the noise description (log levels, or the gain itself), constant disturbances (offsets), initial state.
States, inputs and outputs are scaled to order one before anything is factorised.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.physics.linear_model import LinearModel

Array = NDArray[np.float64]
NoiseForm = Literal["levels", "gain", "given"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scales:
    """Units in which the predictor works.

    Attributes
    ----------
    state : ndarray, shape (n_states,)
    input : ndarray, shape (n_inputs,)
    output : ndarray, shape (n_outputs,)
        About the sensor noise of each output.
    disturbance : ndarray, shape (n_disturbances,)
        Level at which a disturbance moves an output by about its noise within a few samples.
    """

    state: Array
    input: Array
    output: Array
    disturbance: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictorProblem:
    """Data, model and what is to be estimated.

    Attributes
    ----------
    model : LinearModel
    rate_hz : float
    u : ndarray, shape (n_samples, n_inputs), deviations from the operating point, SI
    y : ndarray, shape (n_samples, n_outputs), deviations from the operating point, SI
    estimated : tuple of str
        Physical parameters in the vector.
    known : Mapping[str, float]
        The others, SI.
    magnitude : ndarray, shape (n_estimated,)
        Scale of each estimated physical parameter, SI.
    prior_mean, prior_sd : ndarray, shape (n_estimated,), SI
        Standard deviation infinite where there is no prior.
    scales : Scales
    delay : int
        Whole samples of delay on all inputs.
    lag : float
        Fraction of a sample of delay on top, 0 <= lag < 1, where it is not estimated.
    fractional : bool
        Whether the delay is estimated as a real number near `delay`: delay - 1 < total < delay + 2.
    skip : int
        Samples left out at the start, so that fits with different delays see the same data; at least ``delay + 2``.
    stride : int
        The predictor sees every stride-th output (all inputs act); more than 1 only with noise "gain" or "given".
    noise : {"levels", "gain", "given"}
        Noise as disturbance and sensor levels through the Riccati equation, as a free predictor gain, or as `gain`.
    noise_center : ndarray, shape (n_noise,)
        Centre of the weak prior on the log noise levels.
    gain : ndarray, shape (n_states, n_outputs)
        Predictor gain in scaled units, for noise "given".
    """

    model: LinearModel
    rate_hz: float
    u: Array
    y: Array
    estimated: tuple[str, ...]
    known: Mapping[str, float]
    magnitude: Array
    prior_mean: Array
    prior_sd: Array
    scales: Scales
    delay: int = 0
    lag: float = 0.0
    fractional: bool = False
    skip: int = 2
    stride: int = 1
    noise: NoiseForm = "levels"
    noise_center: Array = field(default_factory=lambda: np.zeros(0))
    gain: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        if self.skip < self.delay + 2 or self.y.shape[0] <= self.skip:
            raise ValueError(f"skip {self.skip} must exceed the delay {self.delay} by two and leave samples")
        if self.stride > 1 and self.noise == "levels":
            raise ValueError("a stride above 1 wants the noise as a gain")

    @property
    def n_physical(self) -> int:
        """Number of estimated physical parameters."""
        return len(self.estimated)

    @property
    def slices(self) -> dict[str, slice]:
        """Places of the groups in the vector."""
        n, n_y, n_d = len(self.model.states), len(self.model.outputs), len(self.model.disturbances)
        sizes = {
            "physical": self.n_physical,
            "fraction": int(self.fractional),
            "noise": {"levels": n_d + n_y - 1, "gain": n * n_y, "given": 0}[self.noise],
            "offset": n_d,
            "initial": n,
        }
        edges = [0]
        for size in sizes.values():
            edges.append(edges[-1] + size)
        return {name: slice(a, b) for name, a, b in zip(sizes, edges[:-1], edges[1:], strict=True)}

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

        Parameters
        ----------
        vector : ndarray, shape (size,)

        Returns
        -------
        dict of str to float
        """
        values = vector[self.slices["physical"]] * self.magnitude
        return {**self.known, **dict(zip(self.estimated, values.tolist(), strict=True))}

    def lag_at(self, vector: Array) -> float:
        """Return the delay in samples beyond `delay` at a vector.

        Parameters
        ----------
        vector : ndarray, shape (size,)

        Returns
        -------
        float
        """
        return float(vector[self.slices["fraction"]][0]) if self.fractional else self.lag

    def delay_samples(self, vector: Array) -> float:
        """Return the whole delay in samples at a vector.

        Parameters
        ----------
        vector : ndarray, shape (size,)

        Returns
        -------
        float
        """
        return self.delay + self.lag_at(vector)
