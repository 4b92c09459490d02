"""Simulation: open and closed loop, linear and nonlinear, with noise, quantisation, delay and limits."""

from ambid.simulate.bench import Simulation, simulate, simulate_preset
from ambid.simulate.damage import Loss, damage, losses
from ambid.simulate.levels import largest_amplitude, noise_at_snr
from ambid.simulate.plant import LinearPlant
from ambid.simulate.poles import closed_loop_matrix, closed_loop_poles
from ambid.simulate.rig_bench import simulate_rig
from ambid.simulate.rig_magnet import plant_of_rig
from ambid.simulate.scenario_run import ScenarioBlock, scenario_blocks, simulate_scenario, truth_columns
from ambid.simulate.scenarios import Scenario, scenario, scenario_names
from ambid.simulate.schedule import Schedule
from ambid.simulate.variation import Unbalance, Variation
from ambid.simulate.varying import Stretch, VaryingLoop, simulate_varying

__all__ = [
    "LinearPlant",
    "Loss",
    "Scenario",
    "ScenarioBlock",
    "Schedule",
    "Simulation",
    "Stretch",
    "Unbalance",
    "Variation",
    "VaryingLoop",
    "closed_loop_matrix",
    "closed_loop_poles",
    "damage",
    "largest_amplitude",
    "losses",
    "noise_at_snr",
    "plant_of_rig",
    "scenario",
    "scenario_blocks",
    "scenario_names",
    "simulate",
    "simulate_preset",
    "simulate_rig",
    "simulate_scenario",
    "simulate_varying",
    "truth_columns",
]
