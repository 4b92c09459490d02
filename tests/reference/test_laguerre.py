"""What the Laguerre operator is for (thesis eq. 1.7-1.8): the conditioning of the rows of a subspace method."""

import numpy as np
import pytest

from ambid.blackbox.frequency_subspace import best_conditioned, block_rows_condition, laguerre_operator
from ambid.errors import EstimationError

ORDERS = np.arange(2, 21)
BANDS = {
    "linear": 2 * np.pi * np.linspace(5.0, 2000.0, 400),
    "three decades": 2 * np.pi * np.geomspace(1.0, 1000.0, 400),
    "few lines": 2 * np.pi * np.geomspace(5.0, 2000.0, 60),
}


def test_the_operator_is_an_all_pass():
    w = laguerre_operator(np.array([0.0, 50.0, 1e9]), 50.0)
    np.testing.assert_allclose(np.abs(w), 1.0)
    np.testing.assert_allclose(w, [-1.0, 1j, 1.0], atol=1e-6)


@pytest.mark.parametrize("band", BANDS)
def test_powers_of_frequency_grow_exponentially(band):
    sizes = np.log10([block_rows_condition(BANDS[band], n) for n in ORDERS])
    below = sizes < 15  # above, only round-off is left of the smallest singular value
    slope = np.polyfit(ORDERS[below], sizes[below], 1)[0]
    assert slope > 0.4  # at least 2.5 times for each order
    assert np.all(np.diff(sizes[below]) > 0.2)
    assert sizes[-1] > 8.0


@pytest.mark.parametrize("band", BANDS)
def test_powers_of_the_operator_grow_modestly(band):
    omega = BANDS[band]
    sizes = np.array([block_rows_condition(omega, n, best_conditioned(omega, n)) for n in ORDERS])
    assert sizes.max() < 10.0
    # no faster than in proportion to the order
    assert np.all(sizes / sizes[0] <= ORDERS / ORDERS[0] + 1e-9)


def test_p_may_be_off_by_an_octave():
    omega = BANDS["three decades"]
    best = best_conditioned(omega, 20)
    for factor in (0.5, 2.0):
        assert block_rows_condition(omega, 20, factor * best) < 20.0


def test_the_best_p_of_a_symmetric_band_is_its_middle():
    # geometric lines from 1 to 1000 Hz look the same from both ends under w -> -w*
    assert best_conditioned(BANDS["three decades"], 12) == pytest.approx(2 * np.pi * np.sqrt(1000.0), rel=0.02)


@pytest.mark.parametrize("p", [0.0, -1.0, np.nan])
def test_p_must_be_positive(p):
    with pytest.raises(EstimationError, match="positive"):
        laguerre_operator(BANDS["linear"], p)


def test_more_rows_than_lines_are_refused():
    with pytest.raises(EstimationError, match="twice the lines"):
        block_rows_condition(np.array([1.0, 2.0]), 4)
