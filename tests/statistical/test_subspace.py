"""Standard deviations of subspace estimates are what estimates scatter by, in open and closed loop."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.model import StateSpaceModel, pole_covariance, response_covariance
from ambid.blackbox.subspace import n4sid, pbsid
from tests.blackbox.subspace.systems import COLOURED, UNSTABLE, record
from tests.tiers import runs as number

OMEGA = np.array([1.0, 20.0, 50.0, 150.0, 280.0])


def real_numbers(fit, truth: StateSpaceModel) -> tuple[np.ndarray, np.ndarray]:
    """Errors and standard deviations of poles (matched) and frequency response, real and imaginary parts."""
    poles, true = fit.model.poles(), truth.poles()
    true = true[true.imag >= 0]
    at = [int(np.argmin(np.abs(poles - p))) for p in true]
    error = [(poles[at] - true).real, (poles[at] - true).imag]
    spread = pole_covariance(fit.model, fit.covariance)[at]
    sd = [np.sqrt(spread[:, 0, 0]), np.sqrt(spread[:, 1, 1])]
    keep = [np.ones(true.size, bool), true.imag > 0]
    difference = (fit.model.frequency_response(OMEGA) - truth.frequency_response(OMEGA))[:, 0, 0]
    of = response_covariance(fit.model, fit.covariance, OMEGA)[:, 0, 0]
    error += [difference.real, difference.imag]
    sd += [np.sqrt(of[:, 0, 0]), np.sqrt(of[:, 1, 1])]
    keep += [np.ones(OMEGA.size, bool)] * 2
    chosen = np.concatenate(keep)
    return np.concatenate(error)[chosen], np.concatenate(sd)[chosen]


@pytest.mark.parametrize(
    ("estimator", "plant", "hold", "bias", "runs"),
    [
        (n4sid, COLOURED, None, 0.8, number(100, short=25)),
        (pbsid, COLOURED, None, 0.6, number(50, short=25)),
        (pbsid, UNSTABLE, 1.2, 0.6, number(50, short=50)),
    ],
    ids=["n4sid", "pbsid", "pbsid in a loop"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(estimator, plant, hold, bias, runs):
    errors, sds = [], []
    for seed in range(runs):
        fit = estimator(record(plant, 2500, 5000 + seed, hold=hold), {"n": plant.order})
        error, sd = real_numbers(fit, plant)
        errors.append(error)
        sds.append(sd)
    e, s = np.array(errors), np.array(sds)
    inside = np.mean(np.abs(e) < 1.96 * s, axis=0)
    # one number's share scatters by 0.02 in 100 runs, the mean over all by less
    assert np.all(inside > 0.95 - 0.95 / np.sqrt(runs))
    assert runs.limit(0.90) < np.mean(inside) < runs.limit(0.985)
    assert np.all(np.abs(np.mean(e, axis=0)) < runs.limit(bias, centre=0) * np.std(e, axis=0))
    ratio = np.median(s, axis=0) / np.std(e, axis=0)  # the median: single short records have long tails
    assert runs.limit(0.85, centre=1) < np.median(ratio) < runs.limit(1.25, centre=1)


def test_order_is_found_in_most_records():
    right = sum(pbsid(record(UNSTABLE, 2500, 9000 + seed, hold=1.2), {}).orders["n"] == 2 for seed in range(30))
    assert right >= 27
