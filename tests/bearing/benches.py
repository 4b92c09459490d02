"""Small simulated benches of known truth, and predictor problems about that truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ambid.bearing.linear import Signals
from ambid.estimation.predictor import PredictorProblem, Scales
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.physics.loop import Loop, Noise
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import LinearPlant, simulate
from tests.estimation.reference import riccati, sampled

THESIS = dict(preset("thesis").parameters)
BEARING = dict(preset("unstable-bearing").parameters)
RMIT = dict(preset("rmit-axis").parameters)
COIL = {"R": 0.86 * 1.818, "L": 1.818e-3}
SPRUNG = {"m": 0.5, "k_x": 8.0e4, "k_i": 40.0, "c": 6.0}
FALLING = {"m": 4.0, "k_x": -1.29e5, "k_i": 55.7, "c": 0.0}


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """A record of a linear plant with all that its simulation knew; SI units."""

    model: LinearModel
    truth: Mapping[str, float]
    signals: Signals
    sensor: np.ndarray
    disturbance: np.ndarray
    delay: float
    states: np.ndarray = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """How a bench is run: excitation rms and band in Hz, loop, noise held over a sample."""

    model: str
    truth: Mapping[str, float]
    rate_hz: float
    rms: float
    band: tuple[float, float]
    loop: Loop
    noise: Mapping[str, float]


_BEARING_NOISE = {"position": 1e-7, "current": 2e-3, "force": 1.0, "voltage": 0.05}
SETTINGS = {
    # force and voltage noise are small but there: a level of zero has no logarithm
    "thesis": Setting(model="one-axis", truth=THESIS, rate_hz=10_000.0, rms=5.0, band=(1.0, 2000.0), loop=Loop(),
                      noise={"position": 5e-7, "current": 1e-4, "force": 1e-3, "voltage": 2e-3}),
    "bearing": Setting(model="one-axis", truth=BEARING, rate_hz=20_000.0, rms=6.0, band=(5.0, 2000.0),
                       loop=preset("unstable-bearing").loop, noise=_BEARING_NOISE),
    "rmit": Setting(model="one-axis", truth=RMIT, rate_hz=20_000.0, rms=8.0, band=(5.0, 2000.0),
                    loop=preset("rmit-axis").loop, noise={**_BEARING_NOISE, "current": 1e-3, "force": 0.5}),
    "coil": Setting(model="coil", truth=COIL, rate_hz=10_000.0, rms=2.0, band=(1.0, 3000.0), loop=Loop(),
                    noise={"current": 5e-3, "voltage": 0.02}),
    "sprung rotor": Setting(model="rotor", truth=SPRUNG, rate_hz=5000.0, rms=1.0, band=(2.0, 500.0), loop=Loop(),
                            noise={"position": 2e-7, "force": 0.2}),
    "falling rotor": Setting(model="rotor", truth=FALLING, rate_hz=10_000.0, rms=0.3, band=(2.0, 1000.0),
                             loop=Loop(kp=5000.0, kd=20.0, ki=5e4, derivative_cutoff_hz=2000.0, delay=1.0),
                             noise={"position": 1e-7, "force": 1.0}),
}  # fmt: skip


def run(
    name: str,
    n: int,
    seed: int,
    *,
    delay: float | None = None,
    excitation_seed: int | None = None,
    shape: Literal["flat", "pink"] = "flat",
    **changes: float,
) -> Bench:
    """Simulate a bench of `SETTINGS` under a multisine; `changes` are noise levels."""
    s = SETTINGS[name]
    noise, of = {**s.noise, **changes}, model(s.model)
    gains = {k: getattr(s.loop, k) for k in ("kp", "ki", "kd", "kc", "derivative_cutoff_hz")}
    loop = Loop(**gains, delay=s.loop.delay if delay is None else delay)
    u = multisine(
        n, s.rate_hz, amplitude=s.rms, band=(max(s.band[0], s.rate_hz / n), s.band[1]),
        seed=seed if excitation_seed is None else excitation_seed, amplitude_is="rms", shape=shape,
    )  # fmt: skip
    done = simulate(
        LinearPlant(model=of, parameters=s.truth),
        u,
        rate_hz=s.rate_hz,
        seed=seed,
        loop=loop,
        noise=Noise.held(rate_hz=s.rate_hz, **noise),
    )
    assert not done.warnings
    r = done.record
    return Bench(
        model=of,
        truth=s.truth,
        signals=Signals(
            u=np.stack([r[c] for c in of.inputs], axis=1),
            y=np.stack([r[c] for c in of.outputs], axis=1),
            rate_hz=s.rate_hz,
        ),
        sensor=np.array([noise[o] for o in of.outputs]),
        disturbance=np.array([noise[d] for d in of.disturbances]),
        delay=loop.delay,
        states=done.states,
    )


def parameters(
    bench: Bench, *, fixed: tuple[str, ...] = (), start: Mapping[str, float] | None = None
) -> list[Parameter]:
    """All free but `fixed` (at the truth); `start` gives start values."""
    start = start or {}
    return [
        Parameter(name=p.name, unit=p.unit, role="fixed", value=bench.truth[p.name])
        if p.name in fixed
        else Parameter(name=p.name, unit=p.unit, value=start.get(p.name))
        for p in bench.model.parameters
    ]


def problem_of(bench: Bench, **settings: object) -> tuple[PredictorProblem, np.ndarray]:
    """A problem with everything estimated, and its vector at the truth (offsets zero).

    Scales are chosen here, not by the estimator: results must not hang on them.
    """
    of, rate = bench.model, bench.signals.rate_hz
    state = np.array(
        [bench.sensor[of.outputs.index(s)] if s in of.outputs else bench.sensor[0] * rate / 30 for s in of.states]
    )
    scales = Scales(
        state=3 * state,
        input=np.std(bench.signals.u, axis=0),
        output=1.5 * bench.sensor,
        disturbance=0.7 * bench.disturbance,
    )
    names = tuple(settings.pop("estimated", tuple(p.name for p in of.parameters)))
    magnitude = np.array([abs(bench.truth[p]) or 1.0 for p in names])
    whole = int(bench.delay)
    common = {"delay": whole, "lag": bench.delay - whole, "skip": whole + 2, "prior_mean": np.zeros(len(names)),
              "prior_sd": np.full(len(names), np.inf)}  # fmt: skip
    if settings.get("fractional"):
        common["lag"] = 0.0
    problem = PredictorProblem(
        model=of, rate_hz=rate, u=bench.signals.u, y=bench.signals.y, estimated=names,
        known={k: v for k, v in bench.truth.items() if k not in names}, magnitude=magnitude, scales=scales,
        noise_center=np.zeros(len(of.disturbances) + len(of.outputs) - 1), **{**common, **settings},
    )  # fmt: skip
    return problem, vector_at(problem, bench)


def vector_at(problem: PredictorProblem, bench: Bench) -> np.ndarray:
    """The vector at the truth, with the stationary gain where the gain is free."""
    vector, sl, sc = np.zeros(problem.size), problem.slices, problem.scales
    vector[sl["physical"]] = [bench.truth[k] / s for k, s in zip(problem.estimated, problem.magnitude, strict=True)]
    if problem.fractional:
        vector[sl["fraction"]] = bench.delay - problem.delay
    if problem.noise == "levels":
        sensor = bench.sensor / sc.output
        vector[sl["noise"]] = np.log(np.r_[bench.disturbance / sc.disturbance / sensor[0], sensor[1:] / sensor[0]])
    elif problem.noise == "gain":
        vector[sl["noise"]] = stationary_gain(problem, bench).ravel()
    vector[sl["initial"]] = bench.states[problem.skip] / sc.state
    return vector


def stationary_gain(problem: PredictorProblem, bench: Bench) -> np.ndarray:
    """Kalman gain in scaled units for the bench's noise, over one step of the problem."""
    a, _, _, e, c = sampled(problem, dict(bench.truth), 0.0)
    whole, q = np.eye(a.shape[0]), np.zeros_like(a)
    noise = (e * (bench.disturbance / problem.scales.disturbance) ** 2) @ e.T
    for _ in range(problem.stride):
        q, whole = a @ q @ a.T + noise, a @ whole
    return riccati(whole, c, q, np.diag((bench.sensor / problem.scales.output) ** 2))[0]
