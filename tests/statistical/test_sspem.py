"""State spaces by prediction error: intervals hold as often as they say, and nothing scatters less than they do."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.state_space_search import sspem
from ambid.blackbox.subspace import pbsid
from tests.blackbox.subspace.systems import COLOURED, UNSTABLE, modal, record
from tests.statistical.test_subspace import real_numbers
from tests.tiers import runs

RUNS = runs(50, short=16)


@pytest.mark.parametrize(
    ("plant", "hold", "n"),
    [(COLOURED, None, 3000), (UNSTABLE, 1.2, 3000), (modal(4, 2, 2, 1), None, 700)],
    ids=["open loop", "unstable in a loop", "2 x 2"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(plant, hold, n):
    errors, sds, first = [], [], []
    for seed in range(RUNS):
        data = record(plant, n, 7000 + seed, hold=hold, open_loop=False)
        fit = sspem(data, {"n": plant.order})
        assert fit.status == "converged"
        error, sd = real_numbers(fit, plant)
        errors.append(error)
        sds.append(sd)
        if seed < 30:
            first.append(real_numbers(pbsid(data, {"n": plant.order}), plant)[0])
    e, s = np.array(errors), np.array(sds)
    inside = np.mean(np.abs(e) < 1.96 * s, axis=0)
    # 50 runs: one number's share scatters by 0.03; the mean over all by less
    assert np.all(inside > RUNS.limit(0.82))
    assert RUNS.limit(0.90) < np.mean(inside) < RUNS.limit(0.985)
    assert np.all(np.abs(np.mean(e, axis=0)) < RUNS.limit(0.35, centre=0) * np.std(e, axis=0))
    # quantiles: near an unstable pole the response at low frequency has long tails
    ratio = np.quantile(np.abs(e), 0.683, axis=0) / np.median(s, axis=0)
    assert np.all((ratio > RUNS.limit(0.72, centre=1)) & (ratio < RUNS.limit(1.35, centre=1)))
    # the maximum of the likelihood is not beaten by the estimate it starts from
    assert np.mean(np.log(np.median(np.abs(first), axis=0) / np.median(np.abs(e[:30]), axis=0))) > -0.05
