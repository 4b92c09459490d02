"""The nonlinear bearing over 80 % of gap and bias: do deviations of numbers, and bands of curves, hold what they say?

Runs in which the rotor touches a stop are left out: a force acts there that the model does not have (see
`identify.nonlinear_bearing.contact`). 40 runs are asked for what 40 can tell: their 280 intervals of numbers, those of
one run correlated, hold the truth in 0.95 +- 0.02 of all cases if all is right, their curves likewise.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ambid.bearing.magnet_likelihood import search, uncertainty
from ambid.job.nonlinear_bearing import TakenRecord, grown_bearing
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.validation.nonlinear_bearing import whiteness
from tests.bearing.magnet.bearings import Motion, as_seen, moved, problem_of, truth_of
from tests.tiers import runs

RUNS, SAMPLES = runs(40, short=14), 3000
FAR = Motion(swing=0.45, swing_hz=4.0, volts=8.0, hold=3)
LAW = MagnetLaw(pair=True)
ESTIMATED = {"k", "s", "L_leak", "m", "R", "x_offset", "v_offset"}


@cache
def outcomes() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scores of numbers (runs, 7), of curves (runs, 4, points), p of the residual test, reach of position, current."""
    bench, truth = preset("unstable-bearing"), truth_of(preset("unstable-bearing"))
    x, i = (a.ravel() for a in np.meshgrid(np.linspace(-0.6, 0.6, 5) * truth["s"], [-0.6, 0.0, 0.6]))
    exact, _ = LAW.table(x, i, truth)
    rig = rig_of_preset(bench)
    numbers, curves, white, reach, seed = [], [], [], [], 0
    while len(numbers) < RUNS:
        seed += 1
        done = moved(bench, FAR, SAMPLES, seed)
        if done.first_contact is not None:
            continue
        record = as_seen(done)
        problem = problem_of([record], truth, LAW, ESTIMATED, [1e-7, 2e-3, 1.0, 0.05, 0.02], 1.0)
        fit = search(problem, problem.start())
        assert fit.status == "converged"
        known, values = uncertainty(fit), fit.problem.values(fit.vector)
        sds = np.sqrt(np.diag(known.information))
        numbers.append([(values[n] - truth[n]) / sd for n, sd in zip(known.names, sds, strict=True)])
        taken = [TakenRecord(record=record, bench=done.record, remembered={}, warnings=(), start_s=0.0)]
        found = grown_bearing(fit, taken, rig).curves(x, i)
        curves.append(
            [(c.value - exact[:, j]) / c.sd for j, c in enumerate((found.force, found.k_x, found.k_i, found.L))]
        )
        white.append(whiteness(fit, 0).p)
        reach.append((np.abs(done.states[:, 0]).max() / truth["s"], np.abs(done.states[:, 2]).max()))
    return np.array(numbers), np.array(curves), np.array(white), np.array(reach)


def test_the_runs_go_as_far_as_they_claim() -> None:
    reach = outcomes()[3]
    assert np.median(reach[:, 0]) > 0.75
    assert np.median(reach[:, 1]) > 0.8


def test_intervals_of_numbers_hold_the_truth() -> None:
    numbers = outcomes()[0]
    assert RUNS.limit(0.90) < np.mean(np.abs(numbers) < 1.96) < RUNS.limit(0.985)
    assert np.all(np.mean(np.abs(numbers) < 1.96, axis=0) > RUNS.limit(0.80))
    assert np.all(np.abs(numbers.mean(axis=0)) < 4 / np.sqrt(RUNS))
    spread = numbers.std(axis=0)
    assert np.all((spread > RUNS.limit(0.65, centre=1)) & (spread < RUNS.limit(1.4, centre=1)))


def test_bands_of_curves_hold_the_truth() -> None:
    curves = outcomes()[1]
    held = np.mean(np.abs(curves) < 1.96, axis=(0, 2))  # of force, k_x, k_i, L over all points
    assert np.all((held > RUNS.limit(0.86)) & (held < RUNS.limit(0.995)))
    assert RUNS.limit(0.89) < np.mean(np.abs(curves) < 1.96) < RUNS.limit(0.985)


def test_the_residual_test_is_as_often_wrong_as_it_says() -> None:
    white = outcomes()[2]
    assert np.mean(white < 0.05) < RUNS.limit(0.16, centre=0.05)  # 0.05 of 40, and four deviations
    assert np.mean(white < 0.5) > RUNS.limit(0.15, centre=0.5)
