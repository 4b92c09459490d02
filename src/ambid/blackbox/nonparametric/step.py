"""Step responses: the running sum of an impulse response with its band, or read from a record that holds a step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.nonparametric.impulse import ImpulseResponse
from ambid.errors import EstimationError

_EDGE = 20.0  # a step is a change of the input this many times larger than what goes on before and after it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepResponse:
    """Response to a unit step, with its spread."""

    time_s: Array  # (n_times,), s, from the step
    values: Array  # (n_times, n_outputs, n_inputs), output unit per input unit
    sd: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    def rise_time_s(self, output: int = 0, channel: int = 0) -> float | None:
        """Return the time from 10 to 90 % of the last value in s.

        `output`, `channel`: which output, and which input. Returns none where the last value is within two standard
        deviations of zero, or is never reached.
        """
        s = self.values[:, output, channel]
        if abs(s[-1]) <= 2 * self.sd[-1, output, channel]:
            return None
        part = s / s[-1]
        low, high = np.nonzero(part >= 0.1)[0], np.nonzero(part >= 0.9)[0]
        return float(self._crossing(part, int(high[0]), 0.9) - self._crossing(part, int(low[0]), 0.1))

    def overshoot(self, output: int = 0, channel: int = 0) -> float:
        """Return how far the response goes beyond its last value, as a part of that.

        `output`, `channel`: which output, and which input.
        """
        s = self.values[:, output, channel]
        return max(0.0, float(np.max(s / s[-1]) - 1.0)) if s[-1] != 0 else 0.0

    def _crossing(self, part: Array, k: int, level: float) -> float:
        if k == 0:
            return float(self.time_s[0])
        share = (level - part[k - 1]) / (part[k] - part[k - 1])
        return float(self.time_s[k - 1] + share * (self.time_s[k] - self.time_s[k - 1]))


def step_response(impulse: ImpulseResponse) -> StepResponse:
    """Sum an impulse response.

    Parameters
    ----------
    impulse : ImpulseResponse

    Returns
    -------
    StepResponse
        Its band takes the correlation between taps into account.
    """
    summed = np.cumsum(np.cumsum(impulse.covariance, axis=2), axis=3)
    sd = np.moveaxis(np.sqrt(np.maximum(np.diagonal(summed, axis1=2, axis2=3), 0.0)), 2, 0)
    return StepResponse(
        time_s=impulse.time_s,
        values=np.cumsum(impulse.values, axis=0),
        sd=sd,
        inputs=impulse.inputs,
        outputs=impulse.outputs,
        units=impulse.units,
        warnings=impulse.warnings,
    )


def measured_step(data: IOData) -> StepResponse:
    """Read the step response off a record whose only input holds one step.

    `data`: rest, a step of the input, and what follows. Returns over the step's height; its spread is the noise of a
    sample before the step, that of the rest level, and that of the height.
    """
    if data.n_inputs != 1:
        raise EstimationError(f"a step record has one input; {data.n_inputs} are named. Name the one that steps")
    u = data.u[:, 0]
    change = np.abs(np.diff(u))
    at = int(np.argmax(change)) + 1
    before, after = u[:at], u[at:]
    usual = np.median(np.abs(np.concatenate([np.diff(before), np.diff(after), [0.0]])))
    rough = max(float(before.std()), float(after.std()))
    height = float(after.mean() - before.mean())
    if change[at - 1] == 0 or change[at - 1] < _EDGE * usual or abs(height) < 5 * rough:
        raise EstimationError(
            f"input {data.inputs[0]!r} holds no single step. Cut the record to one step, or use impulse_response"
        )
    if at < 10 or after.size < 10:
        raise EstimationError(f"the step is at sample {at} of {u.size}; 10 samples before and after it are needed")
    rest, noise = data.y[:at].mean(axis=0), data.y[:at].std(axis=0, ddof=1)
    values = (data.y[at:] - rest) / height
    spread_u = np.sqrt(before.var() / before.size + after.var() / after.size) / abs(height)
    sd = np.sqrt((noise / height) ** 2 * (1 + 1 / at) + (values * spread_u) ** 2)
    warnings = (
        () if data.open_loop else ("a step of the input under feedback is no step of the plant's: open loop only",)
    )
    return StepResponse(
        time_s=np.arange(after.size, dtype=np.float64) * data.dt,
        values=values[:, :, None],
        sd=sd[:, :, None],
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        warnings=warnings,
    )
