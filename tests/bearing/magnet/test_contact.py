"""A rotor that touches a stop, or lies on it: no number may follow from the force that acts there."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import search, uncertainty
from ambid.bearing.magnet_problem import touching, weight_carried
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.validation.nonlinear_bearing import whiteness
from tests.bearing.magnet.bearings import problem_of
from tests.bearing.magnet.stops import NOISE, RATE, STOPS, TRUTH, ball_between_stops, lying

FREE = {"k", "s", "L_leak", "R", "v_offset"}
LAW = MagnetLaw()


def fitted(records):
    problem = problem_of(records, TRUTH, LAW, FREE, NOISE, 0.0)
    return search(problem, problem.start())


def right(fit):
    """Every number within four deviations, the force law and R within 0.3 %."""
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    assert fit.status == "converged"
    for name, sd in zip(known.names, np.sqrt(np.diag(known.information)), strict=True):
        assert abs(values[name] - TRUTH[name]) < 4 * sd, name
    for name in ("k", "R", "L_leak"):
        assert values[name] == pytest.approx(TRUTH[name], rel=3e-3), name


@pytest.fixture(scope="module")
def rests():
    return [lying(seed, name=f"{seed}.csv") for seed in (1, 2)]


def test_a_touch_is_a_force_that_is_not_known():
    sway = 1.8e-3 + 1e-3 * np.sin(2 * np.pi * 6 * np.arange(3000) / RATE)
    record = ball_between_stops(sway, 3, bounce=0.9)
    aware = touching(record, STOPS)
    assert record.knock is None
    assert 20 < np.count_nonzero(aware.knock) < 300
    assert touching(record, (-np.inf, np.inf)) is record
    blind = fitted([replace(aware, knock=None)])  # what is cut out is so in both: only then the criteria compare
    fit = fitted([aware])
    assert whiteness(blind, 0).p < 1e-3
    assert blind.criterion > fit.criterion + 500
    assert whiteness(fit, 0).p > 1e-3
    right(fit)


def test_stretches_in_which_it_lies_on_a_stop_are_cut_and_the_predictor_begins_anew(rests):
    aware = [touching(r, STOPS) for r in rests]
    for record in aware:
        assert 0.2 < np.mean(record.cut) < 0.4
        known = record.y[~record.cut & (record.knock == 0.0), 0]
        assert np.all(np.abs(known - STOPS[1]) > 3e-6)
        assert len(record.parts) == 2
    fit = fitted(aware)
    assert all(whiteness(fit, r).p > 1e-3 for r in (0, 1))
    right(fit)
    blind = fitted(rests)
    assert blind.status == "failed" or whiteness(blind, 0).p < 1e-3
    assert uncertainty(blind).information[0, 0] > 25 * uncertainty(fit).information[0, 0]


def test_a_long_record_with_touches_is_identified_from_its_beginning_on():
    record = touching(lying(4, 4500), STOPS)
    first = record.first(2500)
    assert first.kept.shape[0] == 2500
    assert {x.shape[0] for x in (first.u, first.loose, first.y, first.valid, first.knock, first.cut)} == {first.u.size}
    known = {n: Parameter(name=n, unit="1", role="fixed", value=TRUTH[n]) for n in ("m", "c")}  # m in kg, c in N s/m
    known["R"] = Parameter(name="R", unit="ohm")
    # more samples than those on which laws are compared
    right(estimate_bearing([touching(lying(5, 6000), STOPS)], known, laws=[LAW], delay=0.0, extend=()))


def test_the_impulse_of_the_force_is_that_of_the_weight_and_the_momentum(rests):
    thrown = touching(rests[0], STOPS)
    for record in (thrown, replace(thrown, cut=np.arange(thrown.u.size) > 500)):
        assert weight_carried(LAW, TRUTH, record) == pytest.approx(1.0, abs=0.01)
        assert weight_carried(LAW, {**TRUTH, "k": 1.2 * TRUTH["k"]}, record) == pytest.approx(1.2, abs=0.02)
    assert type(weight_carried(LAW, TRUTH, thrown)) is float  # a file takes no number of NumPy's
    # at the means of position and current the force is another, as it is not linear
    x, i = thrown.kept.mean(axis=0)
    assert abs(LAW.table(np.array([x]), np.array([i]), TRUTH)[0][0, 0] / 0.4905 + 1.0) > 0.02
    assert weight_carried(LAW, TRUTH, replace(thrown, cut=np.arange(thrown.u.size) > 30)) is None
