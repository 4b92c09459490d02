"""Many runs of the recursive prediction error method: no bias, intervals that cover, with and without forgetting."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive.polynomial import RecursivePolynomial
from tests.blackbox.polynomial.systems import SYSTEMS, unstable_loop
from tests.tiers import runs as number

N_RUNS = number(200, short=50)
N_SAMPLES, N_FIRST = 3000, 600


def checked(error: np.ndarray, sd: np.ndarray) -> None:
    """Coverage, and bias and spread as far as 200 runs tell them."""
    inside = np.mean(np.abs(error) < 1.959964 * sd, axis=0)
    assert np.all((inside >= N_RUNS.limit(0.895)) & (inside <= N_RUNS.limit(0.985))), inside
    assert N_RUNS.limit(0.92) <= np.mean(inside) <= N_RUNS.limit(0.98)
    bias = np.mean(error, axis=0) / np.std(error, axis=0, ddof=1)
    assert np.all(np.abs(bias) < N_RUNS.limit(0.25, centre=0)), bias  # 3.5 / sqrt(200)
    ratio = np.std(error, axis=0, ddof=1) / np.sqrt(np.mean(sd**2, axis=0))
    assert np.all((ratio > N_RUNS.limit(0.85, centre=1)) & (ratio < N_RUNS.limit(1.2, centre=1))), ratio


@pytest.fixture(scope="module", params=["armax", "oe", "bj"])
def runs(request):
    system, found = SYSTEMS[request.param], {"nothing": [], "fit": [], "forgetting": []}
    for seed in range(N_RUNS):
        data = system.data(seed, N_SAMPLES, offset=10.0)
        u, y, fit = data.u, data.y[:, 0], system.fit(data.part(0, N_FIRST))
        nothing = RecursivePolynomial(system.structure, system.orders, burn_in=N_FIRST, open_loop=True)
        nothing.update(u, y)
        later = [RecursivePolynomial.from_fit(fit, forgetting=x, open_loop=True) for x in (1.0, 0.995)]
        for r in later:
            r.update(u[N_FIRST:], y[N_FIRST:])
        for name, r in zip(found, (nothing, *later), strict=True):
            found[name].append((r.estimate - system.truth[fit.sd > 0], r.sd))
    return {name: np.array(x) for name, x in found.items()}


@pytest.mark.parametrize("how", ["nothing", "fit", "forgetting"])
def test_intervals_cover_and_there_is_no_bias(runs, how: str) -> None:
    checked(runs[how][:, 0], runs[how][:, 1])


def test_armax_is_consistent_under_feedback() -> None:
    found = []
    for seed in range(N_RUNS):
        data, a, c = unstable_loop(N_SAMPLES, seed)
        r = RecursivePolynomial("armax", {"na": 2, "nb": 1, "nc": 2, "nk": 1}, burn_in=500)
        r.update(data.u, data.y)
        found.append((r.estimate - np.concatenate([a[1:], [0.5], c[1:]]), r.sd))
    error, sd = np.array(found).transpose(1, 0, 2)
    checked(error, sd)
