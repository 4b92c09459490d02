"""A ball that something pushes, on a supply that sags: taken in where the likelihood says so, and only there."""

import numpy as np
import pytest

import ambid
from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import uncertainty
from ambid.bearing.magnet_problem import FORGETS, touching
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.validation.nonlinear_bearing import white
from tests.bearing.magnet.stops import (
    MASS,
    RATE,
    STOPS,
    TRUTH,
    ball_between_stops,
    exponential,
    hyperbolic,
)

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


def ball(seed, force, voltage, coil=hyperbolic, lies=slice(0)):
    """Resting on the far stop where it `lies`."""
    rng = np.random.default_rng(seed)
    setpoint = np.interp(np.arange(N), np.arange(0, N + 1000, 1000), rng.uniform(1.3e-3, 2.3e-3, N // 1000 + 1))
    setpoint[lies] = 3e-3
    smooth = np.convolve(np.pad(setpoint, (150, 0), mode="edge"), np.ones(151) / 151, "valid")
    beside = np.column_stack([walk(rng, 1.0, voltage), walk(rng, TAU, force)])
    return touching(ball_between_stops(smooth, seed, beside=beside, coil=coil), STOPS)


def identified(*records, **words):
    fit = estimate_bearing(records, KNOWN, laws=[LAW], delay=0.0, white=white, **words)
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


@pytest.mark.parametrize("seed", [2, 1])
def test_a_drift_goes_on_where_a_record_is_cut(seed):
    record = ball(seed, 0.02, 0.1, lies=slice(2000, 3000))
    assert len(record.parts) > 1
    problem, _, z = identified(record)
    assert problem.drift
    assert max(abs(x) for x in z.values()) < 4.0, z


def test_two_records_of_one_ball_have_one_tau_and_walks_of_their_own():
    problem, values, z = identified(ball(2, 0.02, 0.1), ball(4, 0.02, 0.1))
    assert problem.drift
    assert max(abs(x) for x in z.values()) < 4.0, z
    assert TAU / 2 < values["tau"] < 2 * TAU


@pytest.mark.parametrize(("seed", "force", "voltage"), [(2, 0.0, 0.0), (3, 0.02, 0.1), (1, 0.02, 0.1), (2, 0.02, 0.1)])
def test_a_drift_does_not_stand_for_a_law_that_the_rig_has_wrong(seed, force, voltage):
    """With it, or with noise alone, residuals are white, and k_i is up to 7 sd off."""
    record = ball(seed, force, voltage, coil=exponential)
    rig = {
        "schema": "ambid.rig/1", "name": "a ball", "model": "one-axis",
        "channels": {n: {"column": n} for n in ("voltage", "current", "position")},
        "parameters": {n: {"value": p.value, "unit": p.unit, "role": p.role} for n, p in KNOWN.items() if n != "R"},
        "magnet": {"kind": "single", "gap": "hyperbolic"},
    }  # fmt: skip
    rig["channels"]["voltage"]["delay"] = 0
    columns = {"voltage [V]": record.u, "position [m]": record.y[:, 0], "current [A]": record.y[:, 1]}
    found = ambid.identify_nonlinear(columns, rig, rate_hz=RATE)
    assert not found.drift
    assert not found.checks["law"].passed
    assert found.verdict.word != "usable"


def test_the_law_of_a_ball_with_a_drift_is_found_where_it_is_open():
    record = ball(3, 0.02, 0.1, coil=exponential)
    laws = [MagnetLaw(gap=gap) for gap in ("hyperbolic", "exponential")]
    fit = estimate_bearing([record], KNOWN, laws=laws, delay=0.0, white=white)
    assert (fit.problem.law.gap, fit.problem.drift, fit.beaten) == ("exponential", True, 0.0)
