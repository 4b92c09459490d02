"""Plausibility: does the estimate describe a thing that can exist?"""

from __future__ import annotations

from collections.abc import Mapping

from ambid.physics.linear_model import LinearModel

_SIZES = {"m": (1e-5, 1e5), "k_x": (0.0, 1e11), "k_i": (0.0, 1e6), "R": (1e-4, 1e5), "L": (1e-7, 1e3), "c": (0.0, 1e8)}


def implausible(model: LinearModel, values: Mapping[str, float], sd: Mapping[str, float]) -> list[str]:
    """List what physics forbids in an estimate.

    Mass, resistance and inductance have to be positive: a coil with R > 0 and L > 0 is passive, it never gives out more
    energy than was put in; damping may not be negative beyond its uncertainty. Sizes outside what is built, from
    micro-bearings to turbines, are a slip of units.

    `values`, `sd`: parameters and their standard deviations, SI. Returns one line each; empty where all is well.
    """
    found = []
    for spec in model.parameters:
        value, spread = values[spec.name], sd.get(spec.name, 0.0)
        if spec.positive and value <= 0:
            found.append(f"{spec.name} = {value:.4g} {spec.unit} is not positive ({spec.meaning})")
        low, high = _SIZES.get(spec.name, (0.0, float("inf")))
        if not low <= abs(value) <= high:
            found.append(
                f"{spec.name} = {value:.4g} {spec.unit} is of a size that no bearing has: check the units of the "
                "columns, their calibration and the sampling rate"
            )
        if spec.name == "c" and value < -3.3 * spread:
            found.append(f"c = {value:.4g} {spec.unit} is negative: the rotor would gain energy by moving")
    return found
