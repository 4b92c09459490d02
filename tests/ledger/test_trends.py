"""Trends of one parameter: slow wander is none, a drift under it is found with an honest interval."""

import numpy as np
import pytest

from ambid.ledger.history import History, Series
from ambid.ledger.trends import MONTH_S, trend_of
from tests.tiers import runs

DAY, SD = 86400.0, 0.003


def wander(rng: np.random.Generator, n: int, follow: float = 0.9) -> np.ndarray:
    e = rng.standard_normal(n)
    e[1:] *= np.sqrt(1.0 - follow**2)
    for k in range(1, n):
        e[k] += follow * e[k - 1]
    return e


def trend(relative: np.ndarray, every_s: float = 3 * DAY):
    n = relative.size
    s = Series(
        name="k_i", unit="N/A", taken_at=every_s * np.arange(n), value=80.0 * (1.0 + relative),
        sd=np.full(n, 80.0 * SD), identifiable=np.ones(n, dtype=bool), estimate=np.arange(n), role="free",
    )  # fmt: skip
    (found,) = trend_of(History(bearing="A", plant="", ledger="", estimates=(), series={"k_i": s}), s, ())
    return found


@pytest.mark.parametrize("white", [0.0, 1.0], ids=["wander alone", "wander and noise"])
@pytest.mark.parametrize("n", [366, 60])
def test_slow_wander_is_no_trend(n, white):
    """At most 5 in 300; before, 30 in 300 of those with noise were told."""
    trials = runs(300, short=30)
    told = 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        told += trend(SD * (wander(rng, n) + white * rng.standard_normal(n))).kind != "none"
    assert told <= max(5 * trials / 300, 1)


@pytest.mark.parametrize("wandering", [0.0, 1.0], ids=["noise", "wander and noise"])
def test_a_drift_of_three_percent_a_year_is_found_with_an_interval_that_holds_it(wandering):
    trials, n = runs(400, short=30), 366
    months = 3 * DAY * np.arange(n) / MONTH_S
    z = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        found = trend(SD * (wandering * wander(rng, n) + rng.standard_normal(n)) - 0.0025 * months)
        assert found.kind == "drift"
        z.append((found.per_month + 0.0025) / found.per_month_sd)
    assert abs(np.mean(z)) < 0.1 + 3.0 / np.sqrt(trials)
    assert trials.limit(0.7, 1.0) < np.std(z) < trials.limit(1.3, 1.0)
