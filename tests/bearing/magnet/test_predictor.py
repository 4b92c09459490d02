"""The extended Kalman predictor: exact sensitivities, innovations as predicted, linear theory in the small."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.magnet_likelihood import criterion, linearise, prior_rows, promise, run
from ambid.bearing.magnet_problem import BearingRecord
from ambid.physics.coenergy_law import MagnetLaw
from tests.bearing.magnet.bearings import as_seen, problem_of, unstable

NOISE = [1e-7, 2e-3, 1.0, 0.05, 0.02, 0.01]
PAIR = {"k", "s", "L_leak", "i0", "m", "R", "c", "x_offset", "i_offset", "v_offset", "g"}


@pytest.fixture(scope="module")
def bench():
    (done,), truth = unstable(3000, range(1))
    return as_seen(done), truth


def gradient_agrees(problem, vector):
    """Every derivative of the criterion against central differences."""
    at = linearise(problem, vector)
    assert at is not None
    assert at.criterion == pytest.approx(criterion(problem, vector), rel=1e-12)
    exact = 2 * at.J.T @ at.r
    step = 1e-6
    for j in range(problem.size):
        up, down = vector.copy(), vector.copy()
        up[j] += step
        down[j] -= step
        slope = (criterion(problem, up) - criterion(problem, down)) / (2 * step)
        assert exact[j] == pytest.approx(slope, rel=2e-4, abs=2e-5 * np.linalg.norm(at.J[:, j]) ** 1 + 0.02), j


@pytest.mark.parametrize("kind", ["pair", "saturated", "unequal", "drift", "eddy", "delay", "stage"])
def test_sensitivities_of_mean_and_covariance_are_exact(bench, kind):
    record, truth = bench
    record = replace(record, u=record.u[:400], loose=record.loose[:400], y=record.y[:400], valid=record.valid[:400])
    law, estimated = MagnetLaw(pair=True), set(PAIR)
    settings = {}
    truth = {**truth, "c": 5.0, "g": 0.3}
    if kind == "saturated":
        law = MagnetLaw(pair=True, saturation=True, rise=True)
        truth |= {"sigma": 0.2, "L_rise": 1e-3, "i_knee": 0.3}
        estimated = {"sigma", "L_rise", "i_knee", "k", "L_leak", "m"}
    if kind == "unequal":
        law = MagnetLaw(pair=True, saturation=True, asymmetric=True)
        truth |= {"sigma": 0.2, "k_asym": 0.1, "i0_asym": 0.05}
        estimated = {"k", "s", "k_asym", "i0_asym", "sigma", "i0", "m", "x_offset"}
    if kind == "stage":
        truth |= {"v_drop": 0.7, "i_drop": 0.2}
        estimated = {"v_drop", "i_drop", "R", "k", "L_leak", "v_offset"}
        settings = {"free_delay": frozenset([record.rate_hz])}
        record = replace(record, knock=np.where(np.arange(400) // 20 == 5, 3.0, 0.0))
    if kind == "drift":
        settings, estimated = {"drift": True}, {"k", "s", "m", "R", "c", "tau"}
    if kind == "eddy":
        truth["a"] = 3e4
        settings, estimated = {"eddy": True, "drift": True}, {"a", "k", "s", "m", "c", "tau"}
    if kind == "delay":
        settings, estimated = {"free_delay": frozenset([record.rate_hz])}, {"k", "L_leak"}
    problem = problem_of([record], truth, law, estimated, NOISE, 0.6 if kind in ("delay", "stage") else 1.0, **settings)
    vector = problem.start() + 1e-3 * np.random.default_rng(3).standard_normal(problem.size)
    gradient_agrees(problem, vector)


def test_the_score_of_a_whole_delay_is_that_of_a_free_one_on_either_side(bench):
    record, truth = bench
    record = replace(record.first(600), valid=record.valid[:600])
    problem = problem_of([record], truth, MagnetLaw(pair=True), PAIR - {"c"}, NOISE, 1.0)
    free = replace(problem, free_delay=frozenset([record.rate_hz]))
    at, place = linearise(problem, problem.start()), len(free.estimated)
    for side, shift in enumerate((0.0, -1e-9)):
        vector = free.start()
        vector[place] += shift
        beside = linearise(free, vector)
        assert at.J_delay[:, side] @ at.r == pytest.approx(beside.J[:, place] @ beside.r, rel=1e-6)
        assert promise(at, delay=side) == pytest.approx(promise(beside), rel=1e-6)


def test_sensitivities_of_one_magnet_with_an_exponential_gap():
    rng, n = np.random.default_rng(2), 300
    truth = {"L_g": 0.04, "zeta": 6.3e-3, "sigma": 0.1, "L_leak": 0.05, "L_rise": 0.06, "i_knee": 0.28, "i0": 0.0,
             "m": 0.06, "R": 4.2, "c": 0.1, "g": 9.81, "a": 900.0, "x_offset": 0.0, "i_offset": 0.0,
             "v_offset": 0.1, "v_drop": 0.3, "i_drop": 0.6, "tau": 1.0, "k_asym": 0.0, "i0_asym": 0.0}  # fmt: skip
    x = 10e-3 + 1e-3 * np.sin(np.arange(n) / 30) + 2e-5 * rng.standard_normal(n)
    i = 0.96 + 0.1 * np.cos(np.arange(n) / 30) + 5e-3 * rng.standard_normal(n)
    valid = np.ones((n, 2), dtype=bool)
    valid[100:120, 0] = False  # a sensor that is lost for a while
    loose = np.zeros(n)
    loose[200:220] = 1.0  # a stage that was switched off
    moving = BearingRecord(
        name="moving", rate_hz=1000.0, u=4.2 * i, loose=loose, y=np.column_stack([x, i]), valid=valid
    )
    held = replace(moving, name="held", rate_hz=200.0, held=True, u=moving.u + rng.standard_normal(n))
    law = MagnetLaw(gap="exponential", saturation=True, rise=True)
    estimated = {
        "L_g",
        "zeta",
        "sigma",
        "L_leak",
        "L_rise",
        "i_knee",
        "m",
        "R",
        "c",
        "a",
        "v_offset",
        "v_drop",
        "i_drop",
    }
    problem = problem_of(
        [moving, held], truth, law, estimated, [2e-5, 5e-3, 0.05, 0.1, 0.01, 0.01], 1.45,
        eddy=True, free_delay=frozenset([1000.0, 200.0]),
    )  # fmt: skip
    gradient_agrees(problem, problem.start())


def test_innovations_are_as_large_as_predicted_and_white_at_the_truth(bench):
    record, truth = bench
    problem = problem_of([record], truth, MagnetLaw(pair=True), PAIR - {"c"}, NOISE, 1.0)
    found = run(problem, problem.start(), 0)
    white = (found.e / np.sqrt(found.s))[200:]
    n = len(white)
    assert np.abs(record.y[:, 0]).max() > 0.45 * truth["s"]  # far from the centre
    assert np.mean(white**2, axis=0) == pytest.approx([1.0, 1.0], abs=4 * np.sqrt(2 / n))
    for lag in (1, 2, 5):
        correlation = white[lag:].T @ white[:-lag] / n
        assert np.abs(correlation).max() < 4.5 / np.sqrt(n)


def test_a_closed_gap_is_no_predictor(bench):
    record, truth = bench
    problem = problem_of([record], {**truth, "s": 1e-4}, MagnetLaw(pair=True), PAIR - {"c"}, NOISE, 1.0)
    assert criterion(problem, problem.start()) == np.inf
    assert linearise(problem, problem.start()) is None


def test_priors_pull_with_their_own_weight(bench):
    record, truth = bench
    problem = problem_of([record], truth, MagnetLaw(pair=True), PAIR - {"c"}, NOISE, 1.0)
    numbers = tuple(replace(n, prior_sd=0.1, value=1.5) if n.name == "R" else n for n in problem.numbers)
    with_prior = replace(problem, numbers=numbers)
    place = [n.name for n in with_prior.estimated].index("R")
    vector = with_prior.start()
    vector[place] = np.log(1.6)
    r, J = prior_rows(with_prior, vector)
    row = int(np.argmax(np.abs(J[:, place])))
    assert r[row] == pytest.approx(15.0 * np.log(1.6 / 1.5))
    assert J[row, place] == pytest.approx(15.0)
    vector[place] = np.log(1.5e-6)  # one in SI, (0 - 1.5) / 0.1, would pull no further from here on
    assert prior_rows(with_prior, vector)[0][row] == pytest.approx(-15.0 * np.log(1e6))
