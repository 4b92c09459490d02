"""The two simulated benches on which everything is measured, and the same problem in ambid's and in SciPy's terms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.bearing.multistart import Signals, starts
from ambid.estimation.likelihood import search, weight_of
from ambid.estimation.predictor import PredictorProblem
from ambid.job import signals_of
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.rig import default_rig
from ambid.signals import multisine
from ambid.simulation import Simulation, largest_amplitude, noise_at_snr, simulate_preset

Array = NDArray[np.float64]

N_SAMPLES = 20_000
SEED = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """A record, its identification problem with 13 estimated numbers, and where the search for them begins and ends."""

    name: str
    simulation: Simulation
    signals: Signals
    problem: PredictorProblem
    start: Array
    vector: Array
    weight: Array

    def scipy_arguments(self) -> tuple[object, ...]:
        """What `scipy_baseline.residual` takes after the vector and the way to filter: the delay is taken off u."""
        problem, scales = self.problem, self.problem.scales
        u = problem.u[problem.skip - problem.delay : len(problem.u) - problem.delay, 0]
        return u, problem.y[problem.skip :], 1.0 / problem.rate_hz, self.scale(), self.weight / scales.output

    def scale(self) -> dict[str, Array]:
        scales = self.problem.scales
        return {
            "theta": self.problem.magnitude,
            "state": scales.state,
            "output": scales.output,
            "disturbance": scales.disturbance,
        }

    def nearby(self, n: int) -> list[Array]:
        """Vectors about the estimate that differ as those of a search do: no evaluation may profit from the last."""
        rng = np.random.default_rng(SEED)
        spread = np.where(np.arange(self.vector.size) < 5, 3e-3, 3e-2)
        return [self.vector + spread * rng.standard_normal(self.vector.size) for _ in range(n)]


def thesis_record(n: int = N_SAMPLES) -> Simulation:
    """The thesis rig in open loop: 10 kHz, multisine 1 to 2000 Hz, noise 40 dB below both outputs."""
    rig = preset("thesis")
    voltage = multisine(n, rig.rate_hz, band=(1.0, 2000.0), amplitude=1.0, shape="pink", seed=SEED)
    clean = simulate_preset(rig, voltage, seed=SEED, noise=Noise())
    return simulate_preset(rig, voltage, seed=SEED, noise=noise_at_snr(clean, 40.0))


def bearing_excitation(n: int = N_SAMPLES) -> Array:
    """A multisine of 1 s, 2 to 2000 Hz, as large as 60 % of the unstable bearing's limits allow, repeated to `n`."""
    bench = preset("unstable-bearing")
    shape = multisine(N_SAMPLES, bench.rate_hz, band=(2.0, 2000.0), amplitude=1.0, shape="pink", seed=SEED)
    respond: Callable[[Array], Simulation] = lambda e: simulate_preset(bench, e, seed=SEED)  # noqa: E731
    return np.resize(largest_amplitude(respond, shape, limits=bench.limits, fraction=0.6) * shape, n)


def bearing_record(n: int = N_SAMPLES) -> Simulation:
    """The unstable bearing under its controller at 20 kHz, with process and sensor noise."""
    return simulate_preset(preset("unstable-bearing"), bearing_excitation(n), seed=SEED)


def case(name: str, simulation: Simulation) -> Case:
    """Set up the problem with 5 physical numbers, 3 noise levels, 2 offsets and 3 initial states, and solve it."""
    plant = model("one-axis")
    signals = signals_of(simulation.record, plant)
    first = starts(plant, signals, default_rig().parameters, simulation.truth["delay"])[0]
    found = search(first.problem, first.vector)
    if found.status == "failed" or found.vector.size != 13:
        raise RuntimeError(f"{name}: no fit with 13 numbers ({found.status}, {found.vector.size})")
    start = first.vector.copy()
    start[5:7] = np.maximum(start[5:7], -4.0)  # at lower levels of disturbance SciPy's Riccati solver finds no gain
    return Case(
        name=name,
        simulation=simulation,
        signals=signals,
        problem=found.problem,
        start=start,
        vector=found.vector,
        weight=weight_of(found.covariance),
    )


def all_cases() -> list[Case]:
    return [
        case("thesis rig, 10 kHz, open loop", thesis_record()),
        case("unstable bearing, 20 kHz, closed loop", bearing_record()),
    ]
