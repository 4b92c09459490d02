"""In its safe state within 2 ms, whatever happens to a levitating rotor, and there until told otherwise."""

from dataclasses import replace

import pytest

from ambid.physics.loop import Loop
from tests.bars.safety import KINDS, trip

WITHIN_S = 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_safe_within_two_milliseconds(kind, rig, rng, tmp_path):
    for k in range(3):
        found = trip(kind, rig, tmp_path / f"{k}", rng)
        assert found.wrong == (), found
        assert 0.0 < found.delay_s <= WITHIN_S, found


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_space_law_changes_nothing_of_it(kind, rig, rng, tmp_path):
    law = replace(rig, loop=Loop(law=rig.loop.as_law(2000.0), delay=rig.loop.delay))
    found = trip(kind, law, tmp_path, rng)
    assert found.wrong == (), found
    assert 0.0 < found.delay_s <= WITHIN_S, found
