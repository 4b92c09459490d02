"""One suite over all recursive estimators: what every one of them promises (`ambid.recursive.estimator`)."""

from __future__ import annotations

import importlib
import pickle
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.estimator import RecursiveEstimator
from tests.recursive.cases import Case

MODULES = sorted(path.stem for path in Path(__file__).parent.glob("cases_*.py"))
ALL: list[Case] = [case for module in MODULES for case in importlib.import_module(f"tests.recursive.{module}").CASES]

pytestmark = pytest.mark.parametrize("case", ALL, ids=lambda case: case.name)


def fed(case: Case, n: int | None = None, seed: int = 1) -> RecursiveEstimator:
    """The estimator after one block of its usual signals."""
    estimator = case.make()
    estimator.update(*case.signals(n or case.n, seed))
    return estimator


def largest(errors: np.ndarray) -> float:
    """Size of the largest error; 0 where nothing was predicted."""
    return float(np.abs(errors[np.isfinite(errors)]).max(initial=0.0))


def assert_same_state(a: RecursiveEstimator, b: RecursiveEstimator, tolerance: float = 0.0) -> None:
    np.testing.assert_allclose(a.estimate, b.estimate, rtol=tolerance, atol=tolerance * np.abs(b.estimate).max())
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=tolerance, atol=tolerance * np.abs(b.covariance).max())
    assert (a.n_used, a.n_rejected) == (b.n_used, b.n_rejected)


def assert_sound(estimator: RecursiveEstimator) -> None:
    """Estimate finite, covariance symmetric and positive definite once scaled to correlations."""
    P = estimator.covariance
    assert np.isfinite(estimator.estimate).all()
    assert np.isfinite(P).all()
    np.testing.assert_array_equal(P, P.T)
    sd = np.sqrt(np.diag(P))
    assert (sd > 0).all()
    np.linalg.cholesky(P / np.outer(sd, sd) + 1e-12 * np.eye(sd.size))


@pytest.mark.parametrize("sizes", [(1,), (7, 1, 64, 3), (1000,)], ids=["samples", "odd blocks", "halves"])
def test_any_split_of_a_stream_gives_the_same_numbers(case: Case, sizes: tuple[int, ...]) -> None:
    inputs, outputs = case.signals(case.n, 1)
    whole, split = case.make(), case.make()
    errors, parts, start, turn = whole.update(inputs, outputs), [], 0, 0
    while start < case.n:
        size = min(sizes[turn % len(sizes)], case.n // 2)
        if size == 1:
            parts.append(np.asarray(split.update(inputs[start], outputs[start]))[None])
        else:
            parts.append(split.update(inputs[start : start + size], outputs[start : start + size]))
        start, turn = start + size, turn + 1
    assert errors.shape == outputs.shape
    together = np.concatenate(parts)
    scale = largest(errors)
    np.testing.assert_allclose(together, errors, rtol=case.tolerance, atol=case.tolerance * scale)
    assert_same_state(split, whole, case.tolerance)


def test_inputs_are_not_modified_and_results_repeat(case: Case) -> None:
    inputs, outputs = case.signals(case.n, 1)
    before = inputs.copy(), outputs.copy()
    inputs.flags.writeable = outputs.flags.writeable = False
    first, second = case.make(), case.make()
    np.testing.assert_array_equal(first.update(inputs, outputs), second.update(inputs, outputs))
    np.testing.assert_array_equal(inputs, before[0])
    np.testing.assert_array_equal(outputs, before[1])
    assert_same_state(first, second)


def test_layout_and_kind_of_numbers_do_not_matter(case: Case) -> None:
    inputs, outputs = case.signals(case.n, 1)
    plain, other = case.make(), case.make()
    plain.update(inputs, outputs)
    other.update(np.asfortranarray(inputs), np.repeat(outputs, 2, axis=0)[::2])
    assert_same_state(plain, other)
    assert_same_state(fed_lists(case), fed(case, 5))


def fed_lists(case: Case) -> RecursiveEstimator:
    estimator = case.make()
    inputs, outputs = case.signals(5, 1)
    estimator.update(inputs.tolist(), outputs.tolist())
    return estimator


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["inputs", "outputs"])
def test_a_sample_that_is_not_finite_changes_no_estimate(case: Case, bad: float, where: str) -> None:
    estimator = fed(case)
    inputs, outputs = (a.copy() for a in case.signals(3, 2))
    (inputs if where == "inputs" else outputs)[0, ...] = bad
    estimate, covariance = estimator.estimate, estimator.covariance
    used, rejected = estimator.n_used, estimator.n_rejected
    error = np.asarray(estimator.update(inputs[0], outputs[0]))
    assert error.shape == outputs[0].shape
    assert np.isnan(error).all()
    np.testing.assert_array_equal(estimator.estimate, estimate)
    np.testing.assert_array_equal(estimator.covariance, covariance)
    assert (estimator.n_used, estimator.n_rejected) == (used, rejected + 1)


def test_goes_on_after_bad_samples(case: Case) -> None:
    inputs, outputs = (a.copy() for a in case.signals(2 * case.n, 1))
    outputs[case.n : case.n + 5] = np.nan
    estimator = case.make()
    estimator.update(inputs, outputs)
    assert estimator.n_rejected >= 5
    assert estimator.n_used > 1.5 * case.n
    assert_sound(estimator)
    before = fed(case)
    assert not np.array_equal(estimator.estimate, before.estimate)


def test_bad_samples_in_a_block_count_as_alone(case: Case) -> None:
    inputs, outputs = (a.copy() for a in case.signals(case.n, 1))
    outputs[case.n // 2] = np.nan
    inputs[case.n // 2 + 9] = np.inf
    block, single = case.make(), case.make()
    errors = block.update(inputs, outputs)
    singles = [np.asarray(single.update(*pair)) for pair in zip(inputs, outputs, strict=True)]
    scale = largest(errors)
    np.testing.assert_allclose(singles, errors, rtol=case.tolerance, atol=case.tolerance * scale)
    assert_same_state(single, block, case.tolerance)


def test_a_copy_goes_its_own_way_and_a_pickle_is_a_copy(case: Case) -> None:
    estimator = fed(case)
    kept, thawed = estimator.copy(), pickle.loads(pickle.dumps(estimator))
    at = estimator.estimate
    more = case.signals(case.n, 3)
    estimator.update(*more)
    np.testing.assert_array_equal(kept.estimate, at)
    for other in (kept, thawed):
        assert other.names == estimator.names
        other.update(*more)
        assert_same_state(other, estimator)


def test_what_is_read_is_a_copy(case: Case) -> None:
    estimator = fed(case)
    estimate, covariance = estimator.estimate, estimator.covariance
    kept = estimate.copy(), covariance.copy()
    estimator.estimate[...] = 7.0
    estimator.covariance[...] = 7.0
    np.testing.assert_array_equal(estimator.estimate, kept[0])
    np.testing.assert_array_equal(estimator.covariance, kept[1])
    estimator.update(*case.signals(case.n, 3))
    np.testing.assert_array_equal(estimate, kept[0])
    np.testing.assert_array_equal(covariance, kept[1])


def test_names_estimate_and_covariance_agree(case: Case) -> None:
    for estimator in (case.make(), fed(case, 3), fed(case)):
        p = len(estimator.names)
        assert len(set(estimator.names)) == p
        assert estimator.estimate.shape == (p,)
        assert estimator.covariance.shape == (p, p)
        assert estimator.estimate.dtype == estimator.covariance.dtype == np.float64
        assert_sound(estimator)


def test_every_sample_is_used_or_rejected(case: Case) -> None:
    estimator = fed(case)
    assert estimator.n_used + estimator.n_rejected == case.n
    assert estimator.n_used > 0


def test_covariance_stays_sound_through_long_silence_and_after(case: Case) -> None:
    estimator = fed(case)
    inputs, outputs = case.silence(case.n_quiet // 4)
    for _ in range(4):
        estimator.update(inputs, outputs)
        assert_sound(estimator)
    estimator.update(*case.signals(case.n, 5))
    assert_sound(estimator)


def test_memory_does_not_grow(case: Case) -> None:
    """Less than a byte for every 32 samples: what is found now and then (a drift that may have begun) has a bound."""
    estimator = fed(case)
    before = len(pickle.dumps(estimator))
    for seed in range(4):
        estimator.update(*case.signals(2 * case.n, seed))
    assert len(pickle.dumps(estimator)) <= before + max(64, case.n // 4)


def test_an_empty_block_changes_nothing(case: Case) -> None:
    estimator, untouched = fed(case), fed(case)
    inputs, outputs = case.signals(2, 1)
    errors = estimator.update(inputs[:0], outputs[:0])
    assert errors.shape == outputs[:0].shape
    assert_same_state(estimator, untouched)


def test_shapes_that_do_not_fit_are_refused_and_change_nothing(case: Case) -> None:
    estimator, untouched = fed(case), fed(case)
    inputs, outputs = case.signals(4, 1)
    wide = np.column_stack([inputs.reshape(4, -1)] * 3)
    for wrong in (
        (inputs[:3], outputs),
        (wide, outputs),
        (wide[0], outputs[0]),
        (inputs, np.column_stack([outputs.reshape(4, -1)] * 3)),
        (np.zeros((2, 2, *inputs.shape[1:], 2)), outputs),
    ):
        with pytest.raises(EstimationError):
            estimator.update(*wrong)
    assert_same_state(estimator, untouched)
