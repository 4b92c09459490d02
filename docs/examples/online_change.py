"""A magnet that loses force
=========================

A magnet loses 15 % of its force while the rotor levitates: detected, named, found anew, accepted, on-line.

The unstable bearing is simulated in closed loop, excited throughout, with its truth. The first second identifies the
bench; from there on the record is tracked block by block, without looking ahead.

Run: ``python docs/examples/online_change.py``
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ambid import track
from ambid.physics.presets import preset
from ambid.recursive.lines import Event, Track
from ambid.report import track_figure
from ambid.simulation import Simulation, simulate_scenario, truth_columns

START_S, CHANGE_S, LENGTH_S = 1.0, 2.0, 4.0
CLOSE = 0.02  # what counts as found again


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What was said of the change, and how soon; s after it."""

    simulation: Simulation
    track: Track
    change: Event
    detected_s: float
    found_s: float
    k_i: float  # true, at the end


def main(seed: int = 1) -> Result:
    """Simulate, track, print the decisions and the last values beside the truth."""
    simulation = simulate_scenario(
        "change", preset("unstable-bearing"), duration_s=LENGTH_S, at_s=CHANGE_S, size=-0.15, seed=seed
    )
    followed = track(simulation.record, start=START_S)

    print(f"{simulation.record.n_samples} samples at {simulation.record.rate_hz:g} Hz, closed loop")
    for line in followed.lines:
        for event in line.events:
            print(f"{event.t:.4f} s  {event.kind}: {event.why}")
    k_i = truth_columns(simulation.record)["k_i"].values[-1]
    truth = {**simulation.truth, "k_i": k_i}
    for name, p in followed.lines[-1].parameters.items():
        print(
            f"{name:4} {p.value:11.5g} ± {p.sd:.2g}, truth {truth[name]:.5g}, {(p.value - truth[name]) / p.sd:+.1f} sd"
        )

    change = next(event for event in followed.totals.changes if event.parameter == "k_i")
    t = np.array([line.t for line in followed.lines])
    value = np.array([line.parameters["k_i"].value for line in followed.lines])
    off = t[(t > CHANGE_S) & (np.abs(value / k_i - 1) > CLOSE)].max(initial=CHANGE_S)
    result = Result(
        simulation=simulation,
        track=followed,
        change=change,
        detected_s=change.values["detected"] - CHANGE_S,
        found_s=float(t[t > off].min(initial=np.inf)) - CHANGE_S,
        k_i=float(k_i),
    )
    print(f"detected after {1e3 * result.detected_s:.1f} ms, within 2 % after {1e3 * result.found_s:.0f} ms")
    return result


def draw(result: Result) -> Figure:
    """Draw the parameters with their bands, k_i beside its truth."""
    record = result.simulation.record
    return track_figure(result.track, truth={"k_i": (record.time_s, truth_columns(record)["k_i"].values)})


if __name__ == "__main__":
    figure = draw(main())
