"""Levels of signals: how large an excitation may be, how large the noise is at a given signal-to-noise ratio."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.loop import Limits, Noise
from ambid.physics.nonlinear import OperatingPoint
from ambid.simulate.bench import Simulation


def noise_at_snr(clean: Simulation, snr_db: float) -> Noise:
    """Return the sensor noise that stands `snr_db` below each output of a simulation without noise.

    SNR = variance of the signal / variance of the noise (theory.md sec. 2.1).

    Parameters
    ----------
    clean : Simulation
        A simulation whose outputs are free of noise.
    snr_db : float
        Signal-to-noise ratio in dB.

    Returns
    -------
    Noise
        White noise of the position in m rms and of the current in A rms.
    """
    spread = {name: float(clean.states[:, j].std()) for j, name in enumerate(clean.state_names) if name != "velocity"}
    return Noise(**{name: s * 10.0 ** (-snr_db / 20.0) for name, s in spread.items()})


def largest_amplitude(
    respond: Callable[[Array], Simulation],
    shape: ArrayLike,
    *,
    limits: Limits,
    operating_point: OperatingPoint | None = None,
    fraction: float = 0.8,
    accuracy: float = 0.01,
) -> float:
    """Return the largest factor on an excitation that keeps a simulated bench within a part of its limits.

    Grows the factor until a limit is met, then bisects. Allowed is the part `fraction` of the way from the operating
    point to each end of `limits`, for the command and for the true current and position at the sampling instants;
    besides, no command may be limited and no stop touched.

    Parameters
    ----------
    respond : callable
        Takes an excitation, shape (n_samples,), returns its `Simulation`, with the same seed each time.
    shape : array_like, shape (n_samples,), in V
        Excitation of amplitude one.
    limits : Limits
        At least one end has to be finite.
    operating_point : OperatingPoint, optional
        Rest point in m, A, V; default zero.
    fraction : float
        Part of the limits that may be used, 0 < fraction <= 1.
    accuracy : float
        Relative accuracy of the result; the result itself is within the limits.

    Returns
    -------
    float
        The factor, in the unit of the excitation for a `shape` of amplitude one.

    Raises
    ------
    ModelError
        If nothing is limited, the excitation is zero, or the bench exceeds its limits without any excitation.
    """
    unit = np.asarray(shape, dtype=np.float64)
    ends = (limits.voltage, limits.current, limits.position)
    if not any(math.isfinite(end) for pair in ends for end in pair):
        raise ModelError("no limit is finite; the largest amplitude needs at least one. Give limits.voltage or another")
    if not unit.any():
        raise ModelError("the excitation is zero throughout; it must move the bench. Give another signal")
    if not 0.0 < fraction <= 1.0:
        raise ModelError(f"fraction is {fraction}; it must be above 0 and at most 1. Give for example 0.8")
    point = operating_point or OperatingPoint()

    def allowed(factor: float) -> bool:
        return _within(respond(factor * unit), limits, point, fraction)

    if not allowed(0.0):
        raise ModelError(
            f"the bench exceeds {fraction:g} of its limits without any excitation; nothing may be added. Lower the"
            " noise, or correct the loop or the limits"
        )
    low, high = 0.0, _first_guess(unit, limits, point)
    while allowed(high):
        low, high = high, 4.0 * high
        if not math.isfinite(high):
            raise ModelError(
                "no limit is met by any amplitude; the excitation moves nothing that is limited. Limit the voltage"
            )
    while high - low > accuracy * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return low


def _first_guess(unit: Array, limits: Limits, point: OperatingPoint) -> float:
    # Any start works; with a limited voltage this one is near the answer in open loop.
    room = [abs(end - point.voltage) for end in limits.voltage if math.isfinite(end)]
    return (min(room) if room and min(room) > 0.0 else 1.0) / float(np.abs(unit).max())


def _within(done: Simulation, limits: Limits, point: OperatingPoint, fraction: float) -> bool:
    if not done.within_limits:
        return False
    signals = {name: done.states[:, j] for j, name in enumerate(done.state_names) if name != "velocity"}
    signals |= {name: done.record[name] for name in done.record.names if name not in signals}
    for name, values in signals.items():
        (low, high), rest = getattr(limits, name), getattr(point, name)
        if values.min() < rest + fraction * (low - rest) or values.max() > rest + fraction * (high - rest):
            return False
    return True
