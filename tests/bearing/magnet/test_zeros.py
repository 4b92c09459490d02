"""Records of one ball whose position is counted from different zeros: each has its own where the likelihood says so."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import bearing_moves, criterion, linearise
from ambid.physics.sensor_errors import SensorError
from ambid.validation.nonlinear_bearing import replay, white
from tests.bearing.magnet.stops import RATE, ball_between_stops
from tests.bearing.magnet.test_drift import KNOWN, LAW, identified

ZERO, N = 0.15e-3, 3000  # m, samples
NEAR, FAR = 1.2e-3, 1.8e-3  # about which the records move
RIG = """schema = "ambid.rig/1"
name = "ball"
model = "one-axis"
[channels.voltage]
delay = 0
[channels.current]
[channels.position]
[parameters]
m = { value = 50, unit = "g", role = "fixed" }
c = { value = 0, unit = "N s/m", role = "fixed" }
[magnet]
kind = "single"
gap = "hyperbolic"
"""


def ball(seed, place):
    swing = 0.2e-3 * np.sin(2 * np.pi * 3.0 * np.arange(N) / RATE)
    return ball_between_stops(place + swing, seed)


def shifted(record, by):
    return replace(record, y=record.y + np.array([by, 0.0]))


@pytest.fixture(scope="module", params=[1, 2])
def moved(request):
    near, far = ball(request.param, NEAR), ball(request.param + 10, FAR)
    return far, identified(near, shifted(far, ZERO))


def test_a_zero_that_moved_between_records_is_found_and_taken_out(moved):
    far, (problem, _, z) = moved
    assert problem.records[0].zero is None
    assert problem.records[1].zero == pytest.approx(ZERO, abs=0.1 * ZERO)
    assert np.allclose(problem.records[1].y[:, 0] + problem.records[1].zero, far.y[:, 0] + ZERO)
    assert max(map(abs, z.values())) < 4.0


def test_the_slope_of_the_criterion_along_a_zero_is_exact(moved):
    problem = moved[1][0]
    vector = problem.start()
    vector[problem.zero(1)] = 0.1
    at, step = linearise(problem, vector), 1e-5
    up, down = vector.copy(), vector.copy()
    up[-1] += step
    down[-1] -= step
    slope = (criterion(problem, up) - criterion(problem, down)) / (2 * step)
    assert 2.0 * (at.J.T @ at.r)[-1] == pytest.approx(slope, rel=1e-5)


def test_records_from_one_zero_keep_it_and_say_what_another_would_move():
    fit = estimate_bearing((ball(1, NEAR), ball(11, FAR)), KNOWN, laws=[LAW], delay=0.0, white=white)
    assert all(r.zero is None for r in fit.problem.records)
    error, apart = SensorError(kind="zero", channel="position"), FAR - NEAR
    by = bearing_moves(fit, [error])[:, 0]
    far = shifted(ball(11, FAR), 1e-3 * apart)  # a thousandth of the way between them
    again = estimate_bearing((ball(1, NEAR), far), KNOWN, laws=[LAW], delay=0.0, white=white, extend=())
    values, others = (f.problem.values(f.vector) for f in (fit, again))
    k = [n.name for n in fit.problem.estimated].index("k")
    assert 1e-3 * by[k] == pytest.approx(others["k"] - values["k"], rel=0.1)


def test_own_records_and_a_second_one_are_predicted_from_their_own_zeros():
    records = [ball(1, NEAR), shifted(ball(11, FAR), ZERO), shifted(ball(12, FAR), -ZERO)]
    columns = [{"voltage": r.u, "position": r.y[:, 0], "current": r.y[:, 1]} for r in records]
    found = ambid.identify_nonlinear(
        columns[:2], RIG, validate=columns[2], rate_hz=RATE, units={"voltage": "V", "position": "m", "current": "A"}
    )
    assert found.extended == ("zeros",)
    assert found.verdict.word == "usable"
    assert found.validation["passed"]
    for name, taken in zip(found.noise, found.used, strict=True):
        run = replay(found, taken.record, noise_of=name)
        assert np.allclose(np.nanmean((run.innovations / run.sd) ** 2, axis=0), 1.0, atol=0.2)
