"""Differential evolution: finds the least of many minima, keeps to its budget, hangs on the seed alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ambid.estimation.global_search import BestByDelay, global_search

LOW, HIGH = np.full(5, -5.0), np.full(5, 6.0)


def rastrigin(x: np.ndarray) -> float:
    """Rastrigin's function: 11^5 minima between the bounds, the least (0) at the origin."""
    return float(10.0 * x.size + np.sum(x**2 - 10.0 * np.cos(2.0 * np.pi * x)))


def test_three_tones_are_found_where_local_searches_end_elsewhere() -> None:
    t, rng = np.arange(200), np.random.default_rng(1)
    y = np.sin(0.31 * t) + 0.7 * np.sin(0.47 * t + 1.0) + 0.4 * np.sin(1.1 * t) + 0.1 * rng.standard_normal(200)

    def left(w: np.ndarray) -> float:
        """Sum of squares that the best amplitudes leave."""
        Z = np.hstack([np.stack([np.sin(a * t), np.cos(a * t)], axis=1) for a in w])
        return float(np.sum((y - Z @ np.linalg.lstsq(Z, y, rcond=None)[0]) ** 2))

    low, high = np.full(3, 0.01), np.full(3, 3.0)
    starts = rng.uniform(low, high, (10, 3))
    local = [float(minimize(left, s, bounds=[(0.01, 3.0)] * 3).fun) for s in starts]
    assert min(local) > 4.0
    for seed in range(3):
        found = global_search(left, low, high, seed=seed, evaluations=1500)
        np.testing.assert_allclose(np.sort(found.vector), [0.31, 0.47, 1.1], atol=2e-3)
        assert found.cost == left(found.vector) < 3.0
        assert found.evaluations <= 1500


def test_the_result_hangs_on_the_seed_alone() -> None:
    one, again = (global_search(rastrigin, LOW, HIGH, seed=[3, 1], evaluations=1500) for _ in range(2))
    np.testing.assert_array_equal(one.vector, again.vector)
    np.testing.assert_array_equal(np.array(one.best), np.array(again.best))
    assert one.evaluations == again.evaluations
    other = global_search(rastrigin, LOW, HIGH, seed=[3, 2], evaluations=1500)
    assert np.any(other.vector != one.vector)


def test_where_half_of_the_space_has_no_model_and_where_none_has() -> None:
    found = global_search(lambda x: rastrigin(x) if x[0] > 0.5 else np.nan, LOW, HIGH, seed=1, evaluations=8000)
    assert found.cost == pytest.approx(0.995, abs=1e-3)
    nothing = global_search(lambda x: np.inf, LOW, HIGH, seed=1, evaluations=300)
    assert nothing.cost == np.inf
    assert nothing.evaluations <= 300
    assert np.all((nothing.vector >= LOW) & (nothing.vector <= HIGH))


def test_an_interruption_loses_nothing_and_progress_never_falls() -> None:
    best = BestByDelay()
    seen: list[float] = []
    kept: list[float] = []
    shares: list[float] = []

    def cost(x: np.ndarray) -> float:
        value = rastrigin(x)
        best.note(0, value, x)
        seen.append(value)
        kept.append(rastrigin(best.vectors()[0]))
        return value

    def tick(stage: str, done: float | None = None, /) -> None:
        assert stage == "global search"
        assert done is not None
        shares.append(done)
        if len(shares) == 500:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        global_search(cost, LOW, HIGH, seed=2, evaluations=2000, tick=tick)
    assert np.all(np.diff(shares) >= 0)
    assert shares[-1] == pytest.approx(0.25)
    assert kept == np.minimum.accumulate(seen).tolist()
    assert kept[-1] == rastrigin(best.vectors()[0]) < 40.0


def test_the_best_of_each_delay_is_kept_and_the_best_of_all_comes_first() -> None:
    best = BestByDelay()
    for delay, value, x in ((0, 3.0, 1.0), (2, 1.0, 2.0), (0, 2.0, 3.0), (1, np.inf, 4.0), (2, 5.0, 5.0)):
        best.note(delay, value, np.array([x]))
    np.testing.assert_array_equal(best.vectors(), [[2.0], [3.0]])


def test_bounds_that_make_no_sense_are_refused() -> None:
    for low, high in ((LOW, np.full(5, np.inf)), (HIGH, LOW), (LOW, HIGH[:4])):
        with pytest.raises(ValueError, match="bounds"):
            global_search(rastrigin, low, high, seed=0, evaluations=100)
