"""Noise that a tracker begins with: that of the start estimate, where its predictor forgets soon enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.estimation.innovations import predictor_gain
from ambid.estimation.problem import NoiseForm, Scales
from ambid.physics.discretise import discretise
from ambid.physics.sensor_gain import SensorGains

MEMORY_S = 0.02  # longest memory of the predictor: it is deaf for ten of them after a gap, and slow to show a change
_LEAST_MEMORY = 200  # samples that the predictor may remember at any rate
_LOG_LEVEL_SD = 0.3  # of a log noise level taken over from an estimate that explains its record
_GAIN_SD = 0.1  # relative, of an entry of the predictor gain


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseNumbers:
    """The noise of a predictor."""

    form: NoiseForm
    numbers: Array  # (n_noise,), that describe it, and their standard deviations
    sd: Array
    gain: Array  # (n_states, n_outputs), predictor gain in scaled units


def rate_of(estimate: Estimate) -> float:
    """Return the sampling rate of the record behind an estimate.

    Returns hz.
    """
    return float(str(estimate.record["rate_hz"]))


def overdispersion_of(estimate: Estimate) -> float:
    """Return how much larger than the model says the variance of weighted innovations' sums is.

    Returns 1 where the model explains its record.
    """
    if estimate.covariance_method == "information":
        return 1.0
    return max(float(str(estimate.information.get("robust_over_information_sd", 1.0))) ** 2, 1.0)


def noise_numbers(plant: SensorGains, estimate: Estimate, scales: Scales) -> NoiseNumbers:
    """Return the noise with which tracking begins.

    Returns form "given" with a gain that forgets where the estimate's own predictor does not forget soon enough.
    """
    found = estimate.noise
    gain = found.gain * scales.output / scales.state[:, None]
    if found.form == "gain":
        entries = gain.ravel()
        return NoiseNumbers(form="gain", numbers=entries, sd=_GAIN_SD * (np.abs(entries) + 0.1), gain=gain)
    A, C, E = _discrete(plant, estimate, scales)
    longest = max(MEMORY_S * rate_of(estimate), _LEAST_MEMORY)
    if found.form == "levels":
        sensor = np.array([found.sensor_sd[o] for o in plant.outputs]) / scales.output
        held = np.array([found.disturbance_sd[d] for d in plant.disturbances]) / scales.disturbance
        with np.errstate(divide="ignore"):
            numbers = np.log(np.concatenate([held, sensor[1:]]) / sensor[0])
        if np.all(np.isfinite(numbers)) and _memory(A - gain @ C) <= longest:
            sd = np.full(numbers.size, _LOG_LEVEL_SD * np.sqrt(overdispersion_of(estimate)))
            return NoiseNumbers(form="levels", numbers=numbers, sd=sd, gain=gain)
    nothing = np.zeros(0)
    return NoiseNumbers(form="given", numbers=nothing, sd=nothing, gain=_bounded_gain(A, C, E, longest))


def _discrete(plant: SensorGains, estimate: Estimate, scales: Scales) -> tuple[Array, Array, Array]:
    """A, C and E of the sampled plant in scaled units."""
    at, _ = discretise(plant.matrices(estimate.values), 1.0 / rate_of(estimate))
    state = scales.state
    return (
        at.A * state / state[:, None],
        at.C * state / scales.output[:, None],
        at.E * scales.disturbance / state[:, None],
    )


def _memory(F: Array) -> float:
    """Memory of a predictor in samples."""
    radius = float(np.abs(np.linalg.eigvals(F)).max())
    return np.inf if radius >= 1.0 else 1.0 / (1.0 - radius)


def _bounded_gain(A: Array, C: Array, E: Array, longest: float) -> Array:
    """Gain of a predictor that forgets soon enough: disturbances are taken a little larger than they are.

    An estimate without disturbances remembers its initial state for ever. The larger variance of the innovations that
    this costs is about the number of states over the memory in samples.
    """
    for level in 10.0 ** np.arange(-4.0, 2.1, 0.25):
        try:
            gain = predictor_gain(A, C, level**2 * E @ E.T, np.eye(C.shape[0])).K
        except np.linalg.LinAlgError:
            continue
        if _memory(A - gain @ C) <= longest:
            return gain
    raise EstimationError("no predictor of this estimate forgets its start. Give a model whose states the outputs show")
