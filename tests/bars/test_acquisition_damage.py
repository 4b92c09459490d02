"""Random bytes, mutated frames and senseless commands into the running firmware: counted, survived, limits kept."""

import pytest

from tests.bars import damage
from tests.tiers import ALL


def _levitated(found):
    return found.faults == () and found.state == "levitating" and found.largest_m < 0.2e-3


def test_random_bytes_between_signs_of_life(rig, rng, tmp_path):
    found = damage.random_bytes(rig, tmp_path, rng, 100_000 if ALL else 20_000)
    assert found.wrong == (), found
    assert found.expected > (300 if ALL else 60)
    assert _levitated(found), found


def test_random_bytes_are_no_sign_of_life(rig, rng, tmp_path):
    found = damage.random_bytes(rig, tmp_path, rng, 60_000, pings=False)
    assert found.wrong == (), found
    assert (found.faults, found.state) == (("host_silent",), "fault")


def test_mutated_commands(rig, rng, tmp_path):
    found = damage.mutated(rig, tmp_path, rng, 500 if ALL else 100)
    assert found.wrong == (), found
    assert found.expected > (250 if ALL else 50)
    assert _levitated(found), found


@pytest.mark.parametrize("n", [150])
def test_senseless_commands_are_answered_and_keep_to_the_limits(n, rig, rng, tmp_path):
    found = damage.senseless(rig, tmp_path, rng, n)
    assert found.wrong == (), found
    assert found.counted == 0
    assert found.state == "levitating"
