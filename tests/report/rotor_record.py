"""A small rotor in two bearings, simulated and identified once for all tests of what is shown of it."""

from __future__ import annotations

from functools import cache

import ambid
from ambid.record import Record
from ambid.rig import Rig, rig_from_text
from ambid.rotor import RotorEstimate

_AXES = ("ax", "ay", "bx", "by")
_MACHINE = {"m": (6.2, "kg"), "Id": (0.056, "kg m^2"), "z_cg": (0.2, "m")}
_AXIS = {"k_i": (60.0, "N/A"), "k_x": (-1.5e5, "N/m"), "R": (0.92, "ohm"), "L": (0.0121, "H")}


def rig(*, known: bool) -> Rig:
    """Return the rig: with all its numbers, or with planes alone."""
    numbers = {**_MACHINE, **{f"{axis}.{q}": x for axis in _AXES for q, x in _AXIS.items()}}
    values = "".join(
        f'"{n}" = {{ {f"value = {x}, " if known else ""}unit = "{unit}" }}\n' for n, (x, unit) in numbers.items()
    )
    channels = "".join(
        f'[channels.{axis}_{q}]\ncolumn = "{axis}_{q}"\n' + ("delay = 1\n" if q == "voltage" else "")
        for axis in _AXES for q in ("voltage", "current", "position", "reference")
    )  # fmt: skip
    text = f"""
schema = "ambid.rig/1"
name = "two radial bearings"
model = "rotor"
[bearings.A]
z = {{ value = 72, unit = "mm" }}
z_sensor = {{ value = 45, unit = "mm" }}
axes = ["ax", "ay"]
[bearings.B]
z = {{ value = 342, unit = "mm" }}
z_sensor = {{ value = 371, unit = "mm" }}
axes = ["bx", "by"]
[modes]
count = 0
{channels}
[parameters]
{values}
[loop]
kp = 294120.0
ki = 1200000.0
kd = 720.0
kc = 60.0
derivative_cutoff_hz = 2490
delay = 1
limits = {{ voltage = [-200.0, 200.0] }}
[noise]
position = 2e-7
current = 0.003
force = 0.007
voltage = 0.0007
[record]
rate_hz = 10000
"""
    return rig_from_text(text, "bench.toml")


@cache
def record(seed: int = 1) -> Record:
    """Return a record of three periods of half a second."""
    return ambid.simulate(rig(known=True), duration=1.5, periods=3, amplitude=12.0, band=(4.0, 800.0), seed=seed)


@cache
def estimate() -> RotorEstimate:
    """Return what is identified from the first record."""
    found = ambid.identify(record(), rig(known=False))
    assert isinstance(found, RotorEstimate)
    return found
