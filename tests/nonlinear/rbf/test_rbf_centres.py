"""Centres and widths: orthogonal least squares beside a search by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.nonlinear.polynomial import select_terms
from ambid.nonlinear.rbf import ols_order, typical_size
from tests.nonlinear.systems import MatrixCandidates


def left(columns: np.ndarray, y: np.ndarray) -> float:
    return float(np.sum((y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) ** 2))


def greedy(candidates: np.ndarray, known: np.ndarray, y: np.ndarray, most: int) -> list[int]:
    """At each step every candidate is tried by least squares, and the one that leaves least is taken."""
    order: list[int] = []
    for _ in range(most):
        tried = [
            np.inf if k in order else left(np.hstack([known, candidates[:, [*order, k]]]), y)
            for k in range(candidates.shape[1])
        ]
        order.append(int(np.argmin(tried)))
    return order


@pytest.mark.parametrize("p", [1, 2])
def test_orthogonal_least_squares_takes_what_a_search_over_all_takes(p: int) -> None:
    rng = np.random.default_rng(p)
    x = rng.standard_normal((150, 2))
    candidates = np.exp(-0.5 * np.sum((x[:, None, :] - x[:40]) ** 2, axis=2) / 0.8**2)
    known = np.hstack([x, np.ones((150, 1))])
    y = np.stack([np.sin(2 * x[:, 0]) * x[:, 1], np.cos(x[:, 0] + 2 * x[:, 1])][:p], axis=1)
    y += 0.1 * rng.standard_normal(y.shape)
    assert ols_order(candidates, known, y, 8) == greedy(candidates, known, y, 8)


def test_the_order_is_that_of_the_terms_of_a_difference_equation() -> None:
    rng = np.random.default_rng(5)
    candidates, y = rng.standard_normal((200, 15)), rng.standard_normal(200)
    y += candidates[:, 3] - 0.5 * candidates[:, 8]
    order = ols_order(candidates, np.zeros((200, 1)), y[:, None], 6)
    assert tuple(order) == select_terms(MatrixCandidates(candidates), y, most=6).order


def test_what_the_model_holds_already_is_not_taken_again() -> None:
    rng = np.random.default_rng(6)
    known, new = rng.standard_normal((50, 2)), rng.standard_normal((50, 1))
    candidates = np.hstack([known @ [[1.0], [2.0]], new, 3 * new, new + known[:, :1]])
    order = ols_order(candidates, known, new + 0.1 * rng.standard_normal((50, 1)), 4)
    assert len(order) == 1
    assert order[0] in (1, 2, 3)


def test_the_size_of_data_is_their_distance_from_the_middle() -> None:
    assert typical_size(np.array([[1.0, 1.0], [-1.0, 1.0]])) == 1.0
