"""Simulation: open and closed loop, linear and nonlinear, with noise, quantisation, delay and limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.simulate.bench import Simulation as Simulation
    from ambid.simulate.bench import largest_amplitude as largest_amplitude
    from ambid.simulate.bench import noise_at_snr as noise_at_snr
    from ambid.simulate.bench import simulate as simulate
    from ambid.simulate.plant import LinearPlant as LinearPlant
    from ambid.simulate.plant import closed_loop_matrix as closed_loop_matrix
    from ambid.simulate.plant import closed_loop_poles as closed_loop_poles
    from ambid.simulate.rig_bench import plant_of_rig as plant_of_rig
    from ambid.simulate.rig_bench import simulate_preset as simulate_preset
    from ambid.simulate.rig_bench import simulate_rig as simulate_rig
    from ambid.simulate.scenarios import Loss as Loss
    from ambid.simulate.scenarios import Scenario as Scenario
    from ambid.simulate.scenarios import ScenarioBlock as ScenarioBlock
    from ambid.simulate.scenarios import damage as damage
    from ambid.simulate.scenarios import losses as losses
    from ambid.simulate.scenarios import scenario as scenario
    from ambid.simulate.scenarios import scenario_blocks as scenario_blocks
    from ambid.simulate.scenarios import scenario_names as scenario_names
    from ambid.simulate.scenarios import simulate_scenario as simulate_scenario
    from ambid.simulate.scenarios import truth_columns as truth_columns
    from ambid.simulate.variation import Schedule as Schedule
    from ambid.simulate.variation import Unbalance as Unbalance
    from ambid.simulate.variation import Variation as Variation

__getattr__, __dir__, __all__ = exports(__name__)
