"""Cost and widening where the covariance is itself estimated, or lines share their errors."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.frequency import check_lines, frf_ml
from ambid.errors import EstimationError
from tests.blackbox.frequency.responses import noisy, plant

F = np.linspace(5.0, 2000.0, 100)


@pytest.mark.parametrize(("n_y", "n_u", "freedom"), [(1, 1, 5), (2, 1, 6), (2, 2, 8)])
def test_moments_of_the_cost(n_y, n_u, freedom):
    # of each input its own Wishart matrix, as with one experiment for each
    rng, count = np.random.default_rng(1), 4000
    f = np.arange(1.0, count + 1)

    def circular(*shape: int) -> np.ndarray:
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    G = circular(count, n_y, n_u)
    draws = circular(count, n_u, n_y, freedom)
    each = draws @ np.swapaxes(draws, 2, 3).conj() / freedom
    covariance = np.zeros((count, n_y, n_u, n_y, n_u), dtype=complex)
    for k in range(n_u):
        covariance[:, :, k, :, k] = each[:, k]
    frf = replace(
        noisy(f, np.ones((count, n_y, n_u)), 1.0, 0),
        G=G,
        covariance=covariance.reshape(count, n_y * n_u, n_y * n_u),
        degrees_of_freedom=2.0 * freedom,
    )
    ln = check_lines(frf, 0)
    per_line = np.sum(ln.whitened(G).reshape(2, count, -1) ** 2, axis=(0, 2)) / 2
    values = ln.verdict(float(per_line.sum()), 0).values
    # heavy tails: the sum within four of its own standard deviations, those within a fifth
    assert abs(values["cost"] - values["expected_cost"]) < 4 * values["cost_sd"]
    if freedom > 2 * n_y + 3:
        assert per_line.std() * np.sqrt(count) == pytest.approx(values["cost_sd"], rel=0.2)


def test_whitened_errors_have_unit_variance():
    ln = check_lines(noisy(F, plant("unstable-bearing", F), 0.02, 1), 0)
    rows = [
        ln.whitened(noisy(F, plant("unstable-bearing", F), 0.02, seed).G - plant("unstable-bearing", F))
        for seed in range(50)
    ]
    assert np.std(rows) == pytest.approx(1.0, abs=0.02)


def test_lines_that_share_errors_widen_and_loosen():
    frf = noisy(F, plant("unstable-bearing", F), 0.02, 1)
    shared = replace(frf, lines_per_independent=4.0)
    one, two = (frf_ml(x, {"nf": 3, "nb": (1, 3)}) for x in (frf, shared))
    np.testing.assert_allclose(two.sd, 2 * one.sd, rtol=1e-9)
    assert two.details["cost_sd"] == pytest.approx(2 * one.details["cost_sd"])
    assert two.details["expected_cost"] == pytest.approx(one.details["expected_cost"])


def test_scatter_over_realisations_needs_more_of_them():
    frf = replace(noisy(F, np.ones((100, 2, 2)), 0.1, 1, freedom=5.0), details={"realisations": 6})
    with pytest.raises(EstimationError, match="4 number"):
        check_lines(frf, 2)
    assert check_lines(replace(frf, details={}), 2).together == 2
