"""Where a search may say that it has converged although no step goes down."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.estimation.search import search


class Likelihood:
    """A criterion about -1e7 whose steps promise `gain` and never go down, as where rounding hides the way."""

    def __init__(self, gain: float) -> None:
        self.gain, self.calls = gain, 0

    def cost(self, theta: np.ndarray) -> float:
        self.calls += 1
        return -1e7 + float(self.calls > 1)

    def triangle(self, theta: np.ndarray) -> np.ndarray:
        return np.array([[1.0, np.sqrt(self.gain)], [0.0, 0.0]])


@pytest.mark.parametrize(("gain", "status"), [(0.5, "converged"), (4.0, "stalled")])
def test_a_likelihood_converges_by_what_is_left_not_by_its_size(gain, status):
    # two standard deviations are left: 4 is far below a millionth of the criterion
    end = search(Likelihood(gain), np.zeros(1), settled=0.05, left=1.0)
    assert end.status == status
    assert end.theta == pytest.approx(0.0)


def test_a_sum_of_squares_converges_by_a_share_of_it():
    assert search(Likelihood(4.0), np.zeros(1)).status == "converged"
