"""Simulation: open and closed loop, linear and nonlinear, with noise, quantisation, delay and limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.simulation.bench import Simulation as Simulation
    from ambid.simulation.bench import largest_amplitude as largest_amplitude
    from ambid.simulation.bench import noise_at_snr as noise_at_snr
    from ambid.simulation.bench import simulate as simulate
    from ambid.simulation.plant import LinearPlant as LinearPlant
    from ambid.simulation.plant import closed_loop_matrix as closed_loop_matrix
    from ambid.simulation.plant import closed_loop_poles as closed_loop_poles
    from ambid.simulation.rig_bench import plant_of_rig as plant_of_rig
    from ambid.simulation.rig_bench import simulate_preset as simulate_preset
    from ambid.simulation.rig_bench import simulate_rig as simulate_rig
    from ambid.simulation.scenarios import simulate_scenario as simulate_scenario
    from ambid.simulation.scenarios import truth_columns as truth_columns
    from ambid.simulation.variation import Schedule as Schedule
    from ambid.simulation.variation import Unbalance as Unbalance
    from ambid.simulation.variation import Variation as Variation

__getattr__, __dir__, __all__ = exports(__name__)
