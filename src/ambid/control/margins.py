"""What is said of a closed loop: peaks of its sensitivity by axis, with their uncertainty and zone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ambid.control.closed import ClosedLoop
from ambid.control.measured import MeasuredSensitivity
from ambid.estimation.modes import NORMAL_95
from ambid.simulation.margins import zone_of


def sensitivity_by_axis(
    loop: ClosedLoop, measured: Sequence[MeasuredSensitivity | None] = ()
) -> dict[str, dict[str, Any]]:
    """Return the peak of the sensitivity of each axis as contracts have it: dB, Hz, zone of ISO 14839-3."""
    found: dict[str, dict[str, Any]] = {}
    for axis, peak, seen in zip(loop.plant.axes, loop.peaks(), measured or (None,) * len(loop.plant.axes), strict=True):
        value, sd = peak.decibel, peak.sd_db
        found[axis] = {
            "peak_db": {"value": value, "sd": sd, "ci95": [value - NORMAL_95 * sd, value + NORMAL_95 * sd]},
            "frequency_hz": peak.frequency_hz,
            "zone": zone_of(peak.ratio),
            "measured_peak_db": None if seen is None else float(20.0 * np.log10(seen.peak[0])),
        }
    return found
