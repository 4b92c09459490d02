"""Centres and widths: orthogonal least squares beside a search by hand, k-means, neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.nonlinear.polynomial import MatrixCandidates, select_terms
from ambid.nonlinear.rbf import k_means, neighbour_widths, ols_order, typical_size


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
    assert tuple(order) == select_terms(MatrixCandidates(matrix=candidates), y, most=6).order


def test_what_the_model_holds_already_is_not_taken_again() -> None:
    rng = np.random.default_rng(6)
    known, new = rng.standard_normal((50, 2)), rng.standard_normal((50, 1))
    candidates = np.hstack([known @ [[1.0], [2.0]], new, 3 * new, new + known[:, :1]])
    order = ols_order(candidates, known, new + 0.1 * rng.standard_normal((50, 1)), 4)
    assert len(order) == 1
    assert order[0] in (1, 2, 3)


def test_k_means_finds_clusters_for_every_seed() -> None:
    rng = np.random.default_rng(7)
    middles = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
    x = np.concatenate([m + 0.3 * rng.standard_normal((50, 2)) for m in middles])
    means = np.array([x[50 * k : 50 * k + 50].mean(axis=0) for k in range(4)])
    for seed in range(5):
        found = k_means(x, 4, np.random.default_rng(seed))
        np.testing.assert_allclose(found[np.lexsort(found.round().T[::-1])], means[np.lexsort(middles.T[::-1])])
    again = [k_means(x, 9, np.random.default_rng(1)) for _ in range(2)]
    np.testing.assert_array_equal(*again)
    spread = [np.sum(np.min(np.sum((x[:, None] - C) ** 2, axis=2), axis=1)) for C in (means, again[0])]
    assert spread[1] < 0.8 * spread[0]
    assert k_means(np.repeat(middles, 3, axis=0), 9, np.random.default_rng(0)).shape == (4, 2)


def test_widths_by_neighbours() -> None:
    C = np.array([[0.0], [1.0], [3.0], [3.0]])
    np.testing.assert_allclose(neighbour_widths(C, 2, 5.0), [np.sqrt(5.0), np.sqrt(2.5), np.sqrt(2.0), np.sqrt(2.0)])
    np.testing.assert_allclose(neighbour_widths(C, 1, 5.0), [1.0, 1.0, 5.0, 5.0])  # one on top of another
    np.testing.assert_allclose(neighbour_widths(C[:1], 2, 5.0), [5.0])
    assert typical_size(np.array([[1.0, 1.0], [-1.0, 1.0]])) == 1.0
