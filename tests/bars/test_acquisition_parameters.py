"""Parameters from data that came through converter, line and protocol agree with the bench's truth."""

import pytest
from scipy.stats import norm

from tests.bars.identified import chain

WITHIN, SECONDS = 0.05, 12.0
SEEDS = {"prototype": (0, 1), "heavy": (0,)}


@pytest.mark.parametrize(("bench", "seed"), [(bench, seed) for bench, seeds in SEEDS.items() for seed in seeds])
def test_identified_through_the_whole_chain(bench, seed, bench_program, firmware_elf, tmp_path):
    """Intervals hold 99.9 % for all parameters of all runs together: a sound build fails once in a thousand times."""
    found = chain(bench, tmp_path, seed, seconds=SECONDS)
    comparisons = sum(len(seeds) for seeds in SEEDS.values()) * len(found.value)
    widest = norm.isf(0.5e-3 / comparisons)
    assert (found.status, found.complete, found.lost, found.damaged) == ("converged", True, 0, 0)
    assert set(found.value) == {"m", "k_x", "k_i", "R", "L"}
    for name in found.value:
        assert abs(found.error(name)) < WITHIN, (name, found)
        assert abs(found.z(name)) < widest, (name, found)
