"""One rotor that is identified once for all tests of its loop."""

from dataclasses import replace

import pytest

import ambid
from tests.control.test_closed import SHORT, free_rig, record_of
from tests.rotor_benches import truth


@pytest.fixture(scope="session")
def rigid():
    """A bench and what is identified of its record alone."""
    bench = replace(truth.BENCHES["rigid"], **SHORT)
    return bench, ambid.identify(record_of(bench), free_rig(bench))
