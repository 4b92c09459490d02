"""An unstable bearing in closed loop
==================================

An unstable bearing in closed loop: five parameters and the delay from 1 s of record, without start values.

A differential bearing (138 turns, 470.3 mm2, bias 1 A, gap 0.432 mm) levitates under a PID with current feedback; the
voltage reaches the coils one sample late; disturbances act on rotor and amplifier, both sensors are noisy. A multisine
is added to the controller's output, as large as 60 % of all limits allow.

Run: ``python docs/examples/unstable_bearing.py``
"""

from __future__ import annotations

from dataclasses import dataclass

from ambid import identify
from ambid.estimation.estimate import Estimate
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import Simulation, largest_amplitude, simulate_preset

N_SAMPLES = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came out, beside what went in."""

    estimate: Estimate
    simulation: Simulation
    amplitude: float


def main(seed: int = 1) -> Result:
    """Simulate, identify, print truth beside estimate; return all three."""
    bench = preset("unstable-bearing")
    shape = multisine(N_SAMPLES, bench.rate_hz, band=(2.0, 2000.0), amplitude=1.0, shape="pink", seed=seed)
    volts = largest_amplitude(
        lambda excitation: simulate_preset(bench, excitation, seed=seed),
        shape,
        limits=bench.limits,
        fraction=0.6,
    )
    simulation = simulate_preset(bench, volts * shape, seed=seed)
    estimate = identify(simulation.record)

    truth, poles, fits = simulation.truth, estimate.continuous.poles, estimate.fit
    print(f"{simulation.record.duration_s:g} s at {bench.rate_hz:g} Hz, closed loop, excitation of {volts:.3g} V peak")
    print(f"{'':4} {'truth':>11} {'ambid':>11} {'sd':>9} {'error':>8} {'error/sd':>9}")
    for p in estimate.parameters:
        if p.role == "fixed":
            continue
        true, error = truth[p.name], p.value - truth[p.name]
        print(f"{p.name:4} {true:11.5g} {p.value:11.5g} {p.sd:9.2g} {error / true:8.2%} {error / p.sd:9.2f}  {p.unit}")
    delay = estimate.delay["voltage"]
    print(f"delay {delay.samples + delay.fraction:g} samples (truth {truth['delay']:g}), {delay.how}")
    print(f"the plant alone has a pole at {max(poles.real):+.1f} rad/s: it cannot be simulated from its input;")
    print(f"fit one step ahead: position {fits['position'].one_step:.4f}, current {fits['current'].one_step:.4f}")
    print("checks:", ", ".join(f"{name} {'passed' if c.passed else 'FAILED'}" for name, c in estimate.checks.items()))
    return Result(estimate=estimate, simulation=simulation, amplitude=volts)


if __name__ == "__main__":
    figure = main().estimate.plot()
