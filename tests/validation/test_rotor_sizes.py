"""Signs, sizes and lengths that no rotor has are said however well the record fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.physics.linear_model import Parameter
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.record import Channel, Record
from ambid.validation.rotor import plausible_checks

_MODEL = RotorModel(
    bearings=(
        Bearing(name="A", axes=("ax", "ay"), z=0.07, z_sensors=(0.05,)),
        Bearing(name="B", axes=("bx", "by"), z=0.34, z_sensors=(0.37,)),
    ),
    drives=("voltage",) * 4,
)
_AXIS = {"k_i": 60.0, "k_x": -1.5e5, "R": 0.9, "L": 0.012}
_NUMBERS = {
    "m": 6.2, "Id": 0.056, "z_cg": 0.2, "A.z": 0.07, "A.z_sensor": 0.05, "B.z": 0.34, "B.z_sensor": 0.37,
    **{f"{axis}.{q}": x for axis in _MODEL.axes for q, x in _AXIS.items()},
}  # fmt: skip


def _record(**gains: float) -> Record:
    rng = np.random.default_rng(0)
    sizes = {"voltage": (5.0, "V"), "current": (0.3, "A"), "position": (2e-5, "m")}
    channels = [
        Channel(name=f"{axis}_{q}", values=gains.get(q, 1.0) * size * rng.normal(size=500), unit=unit)
        for axis in _MODEL.axes
        for q, (size, unit) in sizes.items()
    ]
    return Record(channels=tuple(channels), rate_hz=1e4)


@pytest.mark.parametrize(
    ("numbers", "gains", "name", "said"),
    [
        ({}, {}, "", ""),
        ({"ax.k_i": -60.0, "bx.k_i": -60.0}, {}, "signs", "k_i of ax, bx is negative"),
        (
            {"m": 6.2e-6, **{f"{a}.k_i": 0.06 for a in _MODEL.axes}, **{f"{a}.k_x": -0.15 for a in _MODEL.axes}},
            {"position": 1e3}, "units", "channels.ax_position.gain",
        ),
        ({"B.z": 340.0}, {}, "units", "340 m apart"),
    ],
)  # fmt: skip
def test_what_no_rotor_is_is_said(numbers: dict[str, float], gains: dict[str, float], name: str, said: str) -> None:
    checks = plausible_checks(_MODEL, {**_NUMBERS, **numbers}, {}, (), _record(**gains))
    assert [k for k, c in checks.items() if not c.passed] == ([name] if name else [])
    assert not name or said in checks[name].detail


def test_a_negative_force_factor_that_the_rig_gives_is_no_reversed_sign() -> None:
    known = Parameter(name="ax.k_i", unit="N/A", role="prior", value=-60.0, sd=5.0)
    numbers = {**_NUMBERS, "ax.k_i": -60.0}
    assert plausible_checks(_MODEL, numbers, {}, (known,), _record())["signs"].passed
    free = replace(known, role="free", sd=None)
    assert not plausible_checks(_MODEL, numbers, {}, (free,), _record())["signs"].passed
