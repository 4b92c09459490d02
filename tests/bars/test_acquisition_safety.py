"""In its safe state within 2 ms, whatever happens to a levitating rotor, and there until told otherwise."""

import pytest

from tests.bars.safety import KINDS, trip

WITHIN_S = 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_safe_within_two_milliseconds(kind, rig, rng, tmp_path):
    for k in range(3):
        found = trip(kind, rig, tmp_path / f"{k}", rng)
        assert found.wrong == (), found
        assert 0.0 < found.delay_s <= WITHIN_S, found
