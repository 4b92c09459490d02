"""
A change found while the rotor levitates
========================================

A magnet loses 15 % of its force. The tracker finds it, names the parameter, and gives the new value with its band.
"""

# %%
# A bench in which something happens
# ----------------------------------
#
# The scenario ``change`` of the preset ``unstable-bearing``: k_i falls by 15 % after two seconds, in closed loop, at
# 20 kHz. The truth is logged beside the measured channels, for the comparison at the end.

import ambid
from ambid.simulation import simulate_scenario

bench = ambid.preset("unstable-bearing")
record = simulate_scenario("change", bench, duration_s=3.0, at_s=2.0, seed=1).record
record[1.9:2.1].plot()

# %%
# Followed as beside the machine
# ------------------------------
#
# The first second gives the starting estimate; from there on the record is followed block by block, without looking
# ahead. A new value is published only after later data have confirmed it.

track = ambid.track(record, start=1.0)
track

# %%
# Parameters with their 95 % bands, and the truth:

track.plot()

# %%
# What was decided, when, and why
# -------------------------------

for line in track.lines:
    for event in line.events:
        print(f"{event.t:.3f} s  {event.kind}: {event.why}")

# %%
# The values at the end, as a table:

track.to_dataframe().tail()
