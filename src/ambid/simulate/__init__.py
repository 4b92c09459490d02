"""Simulation: open and closed loop, linear and nonlinear, with noise, quantisation, delay and limits."""

from ambid.simulate.bench import Simulation, simulate, simulate_preset
from ambid.simulate.levels import largest_amplitude, noise_at_snr
from ambid.simulate.plant import LinearPlant
from ambid.simulate.poles import closed_loop_matrix, closed_loop_poles
from ambid.simulate.rig_bench import simulate_rig
from ambid.simulate.schedule import Schedule
from ambid.simulate.variation import Unbalance, Variation
from ambid.simulate.varying import Stretch, VaryingLoop, simulate_varying

__all__ = [
    "LinearPlant",
    "Schedule",
    "Simulation",
    "Stretch",
    "Unbalance",
    "Variation",
    "VaryingLoop",
    "closed_loop_matrix",
    "closed_loop_poles",
    "largest_amplitude",
    "noise_at_snr",
    "simulate",
    "simulate_preset",
    "simulate_rig",
    "simulate_varying",
]
