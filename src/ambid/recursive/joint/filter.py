"""What the two joint filters share: scales, memory, shapes, and what they say of themselves."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.scaling import scales_for
from ambid.recursive.joint.start import JointStart, parameter_scales

EVERY = 32  # samples between two steps of the random walk, and two looks at the linearisation point
_SETTLED, _OFF = 4096, 0.1  # samples before a level of the innovations is judged, and how far off it may be
_WIDE = 1e4  # units of the states, about their sensor noise: what is known of a state that is lost
_LARGEST = 0.1  # a number's walk rests while its relative standard deviation is above this, and above its start


class JointFilter:
    """A Kalman filter of plant states, parameters and offsets at once, in square-root form; see its two kinds.

    Parameters that must be positive are carried as logarithms: they cannot leave, and no step has to be refused.
    Parameters and offsets make a step of their random walk every 32 samples, counted from the first; the walk of a
    number rests while its standard deviation is over a tenth of its size (or over that at the start), so that the
    covariance does not wind up where nothing excites.

    A sample of which one output is missing is used with the other. One without any output moves only the state. One
    without input is rejected, and the state begins anew from the next outputs, as it does after 32 samples without
    outputs and after an innovation of both outputs that no noise makes (a thousand standard deviations). Smaller
    errors of sensors are taken for noise: screen the samples before.

    `names`: parameters, then offsets of the disturbances.
    """

    def __init__(self, start: JointStart) -> None:
        self.start, self.names = start, start.names
        model, p = start.model, len(start.free)
        n_d = len(model.disturbances)
        sensor = np.array([start.sensor_sd[r] for r in model.outputs])
        disturbance = np.array([start.disturbance_sd[r] for r in model.disturbances])
        scales = scales_for(model, start.values, np.ones(len(model.inputs)), sensor, start.rate_hz)
        self._state, self._disturbance = scales.state, scales.disturbance
        positive = {s.name for s in model.parameters if s.positive}
        self._logs = np.array([k in positive for k in start.free])
        self._size = parameter_scales(start)
        self._values0 = np.array([start.values[k] for k in start.free])
        unit = np.r_[self._size, scales.disturbance]
        roles = (*model.inputs, *model.outputs)
        self._io = np.array(
            [
                [start.operating_point.get(r, 0.0) for r in roles],
                np.r_[np.ones(len(model.inputs)), sensor],
                np.ones(len(roles)),
            ]
        )
        self._C = np.ascontiguousarray(model.matrices(start.values).C * scales.state / sensor[:, None])
        self._dist = disturbance / scales.disturbance
        self._wide = np.full(len(model.states), _WIDE)
        whole = int(np.floor(start.delay))
        self._fraction = float(start.delay - whole)
        self._past = np.zeros((whole + 2, len(model.inputs)))
        self._z = np.r_[np.where(self._logs, 0.0, self._values0 / self._size), np.zeros(n_d + len(model.states))]
        given = np.array([start.offset_sd.get(r, 0.0) for r in model.disturbances])
        offset = np.where(given > 0, given, np.where(disturbance > 0, 10 * disturbance, scales.disturbance))
        factor = np.zeros((self._z.size, self._z.size))
        factor[:p, :p] = np.linalg.cholesky(start.covariance / np.outer(self._size, self._size))
        np.fill_diagonal(factor[p:, p:], np.r_[offset / scales.disturbance, self._wide])
        self._T = np.ascontiguousarray(factor.T)
        rates = np.array([start.rates.get(k, 0.0) for k in self.names])
        spread = np.sqrt(np.sum(factor[: p + n_d] ** 2, axis=1))
        self._walk = np.array(
            [rates / unit * np.sqrt(EVERY / start.rate_hz), np.maximum(spread, np.r_[np.full(p, _LARGEST), offset * 0])]
        )
        self._counts = np.zeros(9, dtype=np.int64)
        self._counts[5] = 1

    @property
    def estimate(self) -> Array:
        """Parameters and offsets, shape (p,), SI; a copy."""
        p = self._logs.size
        q = self._z[: len(self.names)].copy()
        q[:p] = np.where(self._logs, self._values0 * np.exp(q[:p]), q[:p] * self._size)
        q[p:] *= self._disturbance
        return np.asarray(q)

    @property
    def covariance(self) -> Array:
        """Covariance of `estimate`, shape (p, p), SI; a copy. To first order where a logarithm is carried."""
        unit = self._unit()
        s = unit.size
        factor = self._T[:s, :s].T * unit[:, None]
        return np.asarray(factor @ factor.T)

    @property
    def values(self) -> dict[str, float]:
        """All parameters of the model, those that stand still too, SI."""
        return {**self.start.values, **dict(zip(self.start.free, self.estimate.tolist(), strict=False))}

    @property
    def state(self) -> Array:
        """Plant state before the next sample, shape (n_states,), SI deviations from the operating point; a copy."""
        return np.asarray(self._z[len(self.names) :] * self._state)

    @property
    def n_used(self) -> int:
        """Samples that were used, those included that only filled the memory of inputs."""
        return int(self._counts[1])

    @property
    def n_rejected(self) -> int:
        """Samples without input, without any output, or with an absurd innovation."""
        return int(self._counts[2])

    @property
    def n_partial(self) -> int:
        """Used samples of which an output was missing."""
        return int(self._counts[3])

    @property
    def error(self) -> float:
        """Root mean square of the innovations over what the filter expects of them, over about 1000 samples.

        One where model and noise levels are right. It does not show every wrong estimate: sixty thousand innovations
        can be ordinary to a per cent and yet speak against an estimate by many standard deviations.
        """
        return float(np.sqrt(np.mean(self._io[2, self._past.shape[1] :])))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers; empty where nothing is known against them."""
        error = self.error
        if self.n_used < _SETTLED or abs(error - 1.0) < _OFF:
            return ()
        kind = "small" if error > 1.0 else "large"
        return (
            f"innovations are {error:.2f} times what the filter expects: its noise levels are too {kind}, and its "
            "standard deviations with them; where the plant is hardly excited, its parameters are moved too",
        )

    def _unit(self) -> Array:
        """Derivative of `estimate` by the scaled numbers."""
        p = self._logs.size
        size = np.where(self._logs, self._values0 * np.exp(np.where(self._logs, self._z[:p], 0.0)), self._size)
        return np.asarray(np.r_[size, self._disturbance])

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Take in one sample or a block.

        `inputs`: (n_inputs,), or (n_samples, n_inputs) for a block, SI, a number, or (n_samples,), where there is one
        input; `outputs`: (n_outputs,), or (n_samples, n_outputs) for a block, SI, a number, or (n_samples,), where
        there is one output. Returns innovations, made before each sample was used; NaN where nothing was predicted.
        """
        u, y = np.asarray(inputs, dtype=np.float64), np.asarray(outputs, dtype=np.float64)
        shape, n_u, n_y = y.shape, self._past.shape[1], self._C.shape[0]
        rows = shape[0] if y.ndim == 2 or (y.ndim == 1 and n_y == 1) else 1
        if y.size != rows * n_y or u.size != rows * n_u or y.ndim > 2 or u.ndim > 2 or (u.ndim == 2 and len(u) != rows):
            raise EstimationError(
                f"inputs have shape {u.shape} and outputs {y.shape}; there are {n_u} inputs and {n_y} outputs. Give "
                f"({n_u},) and ({n_y},), or ({rows}, {n_u}) and ({rows}, {n_y}) for a block"
            )
        e = np.empty((rows, n_y))
        self._run(_rows(u, rows, n_u), _rows(y, rows, n_y), e)
        return e.reshape(shape)

    def _run(self, u: Array, y: Array, e: Array) -> None:
        raise NotImplementedError

    def copy(self) -> Self:
        """Return an independent filter in the same state."""
        twin = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(twin, name, value.copy())
        return twin


def _rows(values: Array, rows: int, columns: int) -> Array:
    """Return values as a plain block: the compiled loop knows one kind of array only."""
    block = np.ascontiguousarray(values).reshape(rows, columns)
    return block if block.flags.writeable else block.copy()


def rates_of(share: Mapping[str, float], values: Mapping[str, float]) -> dict[str, float]:
    """Return rates of random walks from relative ones.

    `share`: by parameter: relative standard deviation gained in one second, s^(-1/2); `values`: parameters, SI. Returns
    as `JointStart.rates` wants them.
    """
    return {name: rate * abs(values[name]) for name, rate in share.items()}
