"""
A change found while the rotor levitates
========================================

A magnet loses 15 % of its force. The tracker finds it, names the parameter, and gives the new value with its band.
"""

import ambid
from ambid.report import track_figure
from ambid.simulation import simulate_scenario

bench = ambid.preset("unstable-bearing")
record = simulate_scenario("change", bench, duration_s=3.0, at_s=2.0, seed=1).record
track = ambid.track(record, start_s=1.0)
track_figure(track)
