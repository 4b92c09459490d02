"""Orthogonal least squares: the same choice as a plain one, however bad the conditioning."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.estimation.uncertainty import CRITERIA, information, penalty
from ambid.nonlinear.polynomial import candidates, lagged, products, select_terms, term_name
from tests.nonlinear.narmax.systems import polynomial
from tests.nonlinear.systems import MatrixCandidates


def plain(P: np.ndarray, y: np.ndarray, most: int) -> tuple[list[int], list[float]]:
    """Every candidate made orthogonal, twice, to every chosen one: slow and safe."""
    left, rest, order, err = P.copy(), y.copy(), [], []
    first = np.sum(P**2, axis=0)
    for _ in range(most):
        squared = np.sum(left**2, axis=0)
        live = squared > 1e-20 * first
        live[order] = False
        ratio = np.where(live, (left.T @ rest) ** 2 / np.where(live, squared, 1.0), -1.0)
        k = int(np.argmax(ratio))
        if ratio[k] < 0:
            break
        order.append(k)
        err.append(float(ratio[k] / (y @ y)))
        q = left[:, k] / np.sqrt(squared[k])
        for _ in range(2):
            left = left - np.outer(q, q @ left)
            rest = rest - q * (q @ rest)
    return order, err


def regression(n: int = 700, degree: int = 3) -> tuple[np.ndarray, np.ndarray, tuple]:
    data = polynomial(n, 1, c=0.0)
    terms = products(lagged(1, 1, ny=3, nu=3, nk=1, ne=0), degree)
    found = candidates(terms, [(data.y, data.u)], 3)
    return found.columns(range(len(terms))), data.y[3:, 0], terms


def test_the_choice_is_that_of_plain_orthogonalisation() -> None:
    P, y, _ = regression()
    order, err = plain(P, y, 20)
    found = select_terms(MatrixCandidates(P), y, most=20)
    assert list(found.order) == order
    np.testing.assert_allclose(found.err, err, rtol=1e-8)
    np.testing.assert_allclose(found.left[1:], 1 - np.cumsum(err), rtol=1e-6)
    assert found.passes == 1


def test_true_terms_are_chosen() -> None:
    P, y, terms = regression()
    found = select_terms(MatrixCandidates(P), y, most=20)
    names = {term_name(terms[k], 1, 1) for k in found.chosen}
    assert names >= {"y(t-1)", "y(t-2)", "u(t-1)*y(t-1)", "u(t-2)", "u(t-1)^2"}
    assert len(names) <= 10  # a forward choice may take a product of the equation with a polynomial in q^-1


def test_candidates_that_are_nearly_alike_are_told_apart_by_further_passes() -> None:
    rng = np.random.default_rng(0)
    x = 10 + 0.01 * rng.standard_normal((2000, 1))
    P = np.hstack([x**k for k in range(5)])
    y = P @ np.array([1.0, -2.0, 0.5, 0.1, 0.0]) + 1e-6 * rng.standard_normal(2000)
    found = select_terms(MatrixCandidates(P), y, most=3, criterion="bic")
    order, err = plain(P, y, 3)
    assert found.passes > 1
    assert list(found.order[:2]) == order[:2]
    np.testing.assert_allclose(found.err[:2], err[:2], rtol=1e-5)


def test_without_noise_the_rest_is_rounding_and_the_choice_ends() -> None:
    P, _, _ = regression()
    theta = np.zeros(P.shape[1])
    theta[[1, 5, 30]] = [1.0, -0.5, 1e-5]
    found = select_terms(MatrixCandidates(P), P @ theta, most=20, criterion="bic")
    assert set(found.order[:3]) >= {1, 5, 30} or set(found.chosen) >= {1, 5, 30}
    assert found.left[-1] < 1e-20


def test_copies_of_a_candidate_are_left_out() -> None:
    P, y, _ = regression(degree=1)
    twice = np.hstack([P, P, 2 * P])
    found = select_terms(MatrixCandidates(twice), y, most=30, criterion="aic")
    assert len({k % P.shape[1] for k in found.order}) == len(found.order) <= P.shape[1]


def test_candidates_given_first_stay_in() -> None:
    P, y, _ = regression()
    found = select_terms(MatrixCandidates(P), y, most=10, first=[40, 41])
    assert found.chosen[:2] == (40, 41)


def test_the_matrix_is_not_changed_and_blocks_do_not_matter() -> None:
    data = polynomial(9000, 2)
    terms = products(lagged(1, 1, ny=2, nu=2, nk=1, ne=0), 2)
    rows = candidates(terms, [(data.y[:5000], data.u[:5000]), (data.y[5000:], data.u[5000:])], 2)
    P = np.asfortranarray(rows.columns(range(len(terms))))
    before, y = P.copy(), np.concatenate([data.y[2:5000, 0], data.y[5002:, 0]])
    whole, blocks = select_terms(MatrixCandidates(P), y, most=8), select_terms(rows, y, most=8)
    np.testing.assert_array_equal(P, before)
    assert whole.order == blocks.order
    np.testing.assert_allclose(whole.err, blocks.err, rtol=1e-10)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_criteria_weigh_terms_against_errors(criterion: str) -> None:
    same = [information(criterion, 0.1, k, 1000, 50) for k in (1, 2, 3)]
    assert same[0] < same[1] < same[2]
    assert information(criterion, 0.05, 2, 1000, 50) < same[0]


def test_an_unknown_criterion_is_refused() -> None:
    P, y, _ = regression(degree=1)
    with pytest.raises(EstimationError, match="ebic"):
        select_terms(MatrixCandidates(P), y, most=3, criterion="ebik")


def test_no_criterion_makes_a_term_cheaper_than_none() -> None:
    # the number of choices falls beyond half of the candidates: all of 80 were as cheap as 14
    for criterion in CRITERIA:
        values = [penalty(criterion, k, 3000, 80) for k in range(81)]
        assert np.all(np.diff(values) > 0), criterion
