"""A ball that something pushes, on a supply that sags: taken in where the likelihood says so, and only there."""

import numpy as np
import pytest

from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import uncertainty
from ambid.bearing.magnet_problem import FORGETS
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.validation.nonlinear_bearing import white
from tests.bearing.magnet.stops import MASS, RATE, TRUTH, ball_between_stops

TAU, N = 0.02, 5000  # s, samples
KNOWN = {
    "m": Parameter(name="m", unit="kg", role="fixed", value=MASS),
    "c": Parameter(name="c", unit="N s/m", role="fixed", value=0.0),
    "R": Parameter(name="R", unit="ohm"),
}
LAW = MagnetLaw()


def walk(rng, tau, sd):
    """What follows itself for `tau` seconds, of a standard deviation."""
    keep, out = np.exp(-1.0 / tau / RATE), np.zeros(N)
    for k, kick in enumerate(rng.standard_normal(N) * sd * np.sqrt(1.0 - keep**2)):
        out[k] = keep * out[k - 1] + kick
    return out


def ball(seed, force, voltage):
    rng = np.random.default_rng(seed)
    setpoint = np.interp(np.arange(N), np.arange(0, N + 1000, 1000), rng.uniform(1.3e-3, 2.3e-3, N // 1000 + 1))
    return ball_between_stops(setpoint, seed, beside=np.column_stack([walk(rng, 1.0, voltage), walk(rng, TAU, force)]))


def identified(record, **words):
    fit = estimate_bearing([record], KNOWN, laws=[LAW], delay=0.0, white=white, **words)
    spread, values = uncertainty(fit), fit.problem.values(fit.vector)
    sd = np.sqrt(np.diag(spread.covariance(robust=False)))
    z = {n: (values[n] - TRUTH[n]) / s for n, s in zip(spread.names, sd, strict=True) if n != "tau"}
    return fit.problem, values, z


@pytest.fixture(scope="module")
def pushed():
    record = ball(1, 0.02, 0.1)
    return record, *identified(record)


def test_a_force_that_comes_and_goes_is_taken_in_and_moves_no_number(pushed):
    record, problem, values, z = pushed
    assert problem.drift
    assert max(abs(x) for x in z.values()) < 4.0, z
    assert TAU / 3 < values["tau"] < 3 * TAU
    _, _, without = identified(record, extend=())
    assert max(abs(x) for x in without.values()) > 6.0


def test_a_sound_record_gets_no_drift():
    problem, _, z = identified(ball(3, 0.0, 0.0))
    assert not problem.drift
    assert max(abs(x) for x in z.values()) < 4.0, z


def test_a_force_is_forgotten_within_the_record_so_that_the_weight_stays_known(pushed):
    _, problem, *_ = pushed
    assert problem.upper()[[n.name for n in problem.estimated].index("tau")] == np.log(N / RATE / FORGETS)
