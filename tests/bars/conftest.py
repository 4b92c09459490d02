"""The firmware and the emulated bench, built once, are those of tests/firmware."""

import numpy as np
import pytest

from tests.bars.host import prototype
from tests.firmware.conftest import avr_gcc, bench_program, firmware_elf, native_cc

__all__ = ["avr_gcc", "bench_program", "firmware_elf", "native_cc"]


@pytest.fixture
def rig(bench_program, firmware_elf):
    """The prototype's, where the emulated bench can run."""
    return prototype()


@pytest.fixture
def rng(request):
    """Randomness of a test's own, the same each time."""
    return np.random.default_rng(list(request.node.name.encode()))
