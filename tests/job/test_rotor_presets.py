"""Every rotor preset levitates, and is identified from its record with nothing known but the planes and the speed."""

from __future__ import annotations

from dataclasses import replace

import pytest

import ambid
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.physics.whirl import drawn_numbers
from ambid.rig import rig_of_preset
from ambid.rig.rotor import RigModes

_FAR = 3.8  # standard deviations


@pytest.mark.parametrize(("name", "modes"), [("rmit", 0), ("spindle", 0), ("central-mass", 1), ("utrc", 2)])
def test_a_preset_is_identified_blind(name: str, modes: int) -> None:
    rig = rig_of_preset(preset(name))
    assert rig.rotor is not None
    truth = {p.name: p.value for p in rig.parameters if p.value is not None}
    if rig.shaft is not None:
        truth |= drawn_numbers(rig.rotor.with_modes(0), rig.shaft, truth)
    blind = tuple(p if p.name in rig.rotor.places else Parameter(name=p.name, unit=p.unit) for p in rig.parameters)
    record = ambid.simulate(
        rig, duration=1.0, periods=4, excitation="zippered", band=(4.0, 700.0 if modes > 1 else 500.0), seed=2
    )
    found = ambid.identify(record, replace(rig, parameters=blind, modes=RigModes()))
    assert found.status == "converged"
    assert found.verdict.word == "usable" or name == "utrc", found.verdict.reasons  # sensors' poles stand at 8 kHz
    assert len(found.modes) == modes
    free = [p for p in found.parameters if p.role != "fixed"]
    assert len(free) > 15
    for p in free:
        assert abs(p.value - truth[p.name]) <= _FAR * p.sd, p
