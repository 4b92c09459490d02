"""Starts of joint filters about the truth of a simulated bench."""

from __future__ import annotations

import numpy as np

from ambid.recursive.joint import JointStart
from tests.bearing.benches import Bench


def start_of(
    bench: Bench, spread: float = 0.02, *, seed: int | None = None, free: tuple[str, ...] | None = None, **more: object
) -> JointStart:
    """A start with a relative standard deviation `spread`, drawn by it about the truth where a seed is given."""
    free = free or tuple(k for k, v in bench.truth.items() if v)
    values = dict(bench.truth)
    if seed is not None:
        draw = np.random.default_rng(seed).standard_normal(len(free))
        values |= {k: values[k] * (1 + spread * d) for k, d in zip(free, draw, strict=True)}
    of = bench.model
    return JointStart(
        model=of,
        rate_hz=bench.signals.rate_hz,
        values=values,
        free=free,
        covariance=np.diag([(spread * bench.truth[k]) ** 2 for k in free]),
        sensor_sd=dict(zip(of.outputs, bench.sensor, strict=True)),
        disturbance_sd=dict(zip(of.disturbances, bench.disturbance, strict=True)),
        delay=bench.delay,
        **more,
    )


def truth_of(bench: Bench, names: tuple[str, ...]) -> np.ndarray:
    """True values of a filter's numbers; offsets are zero."""
    return np.array([bench.truth.get(k, 0.0) for k in names])


def rates_of(share: dict[str, float], values: dict[str, float]) -> dict[str, float]:
    """Rates of random walks, as `JointStart` wants them, from the relative deviation gained in one second."""
    return {name: rate * abs(values[name]) for name, rate in share.items()}
