"""Many runs of the eight polynomial structures: no bias, intervals that cover, spread as stated.

Each of the 120 runs has a twin with the noise turned round. What is linear in the noise cancels in their mean, so the
bias is seen below the 0.09 standard deviations by which the mean of 120 runs scatters of itself.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.blackbox.polynomial.systems import SYSTEMS
from tests.tiers import runs as number

N_RUNS = number(120, short=40)
MIRRORED = number(120, short=120)  # of noise alone: turned round it gives the same estimate, and nothing cancels
N_SAMPLES = 2000


@pytest.fixture(scope="module", params=list(SYSTEMS))
def runs(request):
    system, values, sds = SYSTEMS[request.param], [], []
    n = MIRRORED if request.param == "arma" else N_RUNS
    for seed in range(n):
        for sign in (1.0, -1.0):
            fit = system.fit(system.data(seed, N_SAMPLES, sign=sign, offset=10.0, excitation=1000 + seed))
            assert fit.status == "converged", (request.param, seed)
            values.append(fit.model.theta[fit.sd > 0])
            sds.append(fit.sd[fit.sd > 0])
    truth = system.truth[fit.sd > 0]
    shape = (n, 2, truth.size)
    return np.reshape(values, shape) - truth, np.reshape(sds, shape), n


def test_no_bias(runs):
    error, _, n = runs
    bias = np.mean(error, axis=(0, 1)) / np.std(error[:, 0], axis=0, ddof=1)
    assert np.all(np.abs(bias) < n.limit(0.15, centre=0)), bias


def test_intervals_cover(runs):
    error, sd, n = runs
    inside = np.mean(np.abs(error) < 1.959964 * sd, axis=0)
    # 120 runs know a share to 0.02
    assert np.all((inside[0] >= n.limit(0.885)) & (inside[0] <= n.limit(0.993))), inside
    assert n.limit(0.915) <= np.mean(inside) <= n.limit(0.98)


def test_spread_is_as_stated(runs):
    error, sd, n = runs
    ratio = np.std(error[:, 0], axis=0, ddof=1) / np.sqrt(np.mean(sd[:, 0] ** 2, axis=0))
    assert np.all((ratio > n.limit(0.82, centre=1)) & (ratio < n.limit(1.22, centre=1))), (
        ratio
    )  # 120 runs know it to 6.5 %
    assert n.limit(0.89, centre=1) < np.mean(ratio) < n.limit(1.13, centre=1)
