"""Tails of chi-squared are those of SciPy."""

import numpy as np
import pytest
from scipy.stats import chi2

from ambid.estimation.uncertainty import chi_squared_tail


@pytest.mark.parametrize("degrees", [1, 2, 3, 10, 25, 401, 2000])
def test_the_tail_of_chi_squared_is_that_of_scipy(degrees):
    places = degrees + np.array([-0.99, -0.5, 0.0, 1.0, 5.0, 20.0]) * np.sqrt(2.0 * degrees)
    for x in (*places[places > 0.0], 1e-8):
        assert chi_squared_tail(degrees, x) == pytest.approx(chi2.sf(x, degrees), rel=1e-9, abs=1e-300), x
    assert chi_squared_tail(degrees, 0.0) == 1.0
    assert chi_squared_tail(degrees, np.inf) == 0.0


def test_a_statistic_that_is_no_number_passes_no_test():
    assert not chi_squared_tail(3, float("nan")) >= 1e-3
