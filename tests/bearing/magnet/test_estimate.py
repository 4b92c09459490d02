"""A differential bearing moved over 60 % of its gap: every number, every linearisation, and honest deviations."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing import magnet_estimate
from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import criterion, search, uncertainty
from ambid.bearing.magnet_start import balance
from ambid.errors import EstimationError
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.validation.nonlinear_bearing import whiteness
from tests.bearing.magnet.bearings import Motion, as_seen, problem_of, unstable

KNOWN = {
    "m": Parameter(name="m", unit="kg"),
    "R": Parameter(name="R", unit="ohm"),
    "c": Parameter(name="c", unit="N s/m", role="fixed", value=0.0),
    "i0": Parameter(name="i0", unit="A", role="fixed", value=1.0),
}
STRONG = Motion(swing=0.30, swing_hz=2.0, volts=12.0, hold=3)
PAIR = MagnetLaw(pair=True)


@pytest.fixture(scope="module")
def bearing():
    done, truth = unstable(6000, range(2), STRONG)
    fit = estimate_bearing([as_seen(d, str(n)) for n, d in enumerate(done)], KNOWN, laws=[PAIR], extend=())
    return done, truth, fit


def test_disagreement_widens_each_direction_in_which_records_move_the_numbers(bearing):
    known = uncertainty(bearing[2])
    one, other = np.zeros((2, 7))
    one[:2], other[:2] = (3.0, 2.0), (3.0, -1.0)
    plain = known.covariance(robust=True)
    extra = replace(known, disagreement=np.array([one, other])).covariance(robust=True) - plain
    assert np.diag(extra)[:3] == pytest.approx([9.0, 4.0, 0.0])
    assert np.linalg.eigvalsh(extra[:2, :2]).min() > 1.0  # one move alone would leave a combination as it was
    assert not np.any(replace(known, disagreement=np.zeros((3, 7))).covariance(robust=True) - plain)


def test_numbers_are_right_within_one_percent_and_within_their_deviations(bearing):
    done, truth, fit = bearing
    assert all(d.within_limits or d.first_contact is None for d in done)
    assert max(np.abs(d.states[:, 0]).max() for d in done) > 0.6 * truth["s"]
    assert fit.status == "converged"
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    assert known.names == ("k", "s", "L_leak", "m", "R", "x_offset", "v_offset")
    assert known.disagreement.shape == (0, 7)
    for name, sd in zip(known.names, np.sqrt(np.diag(known.information)), strict=True):
        assert abs(values[name] - truth[name]) < 3.7 * sd, name
    for name in ("k", "s", "m", "R"):
        assert values[name] == pytest.approx(truth[name], rel=0.01)
    assert values["L_leak"] == pytest.approx(truth["L_leak"], rel=0.08)  # a thirteenth of the inductance
    assert fit.problem.delays == {20_000.0: 1.0}


def test_saturation_that_a_rig_gives_as_zero_is_not_looked_for(bearing):
    zero = Parameter(name="sigma", unit="1/A^2", role="fixed", value=0.0)
    records = [as_seen(d, str(n)) for n, d in enumerate(bearing[0])]
    fit = estimate_bearing(records, KNOWN | {"sigma": zero}, laws=[PAIR], extend=("saturation",))
    assert not fit.problem.law.saturation
    assert fit.criterion == pytest.approx(bearing[2].criterion, abs=0.05)


def test_a_search_without_a_predictor_is_refused_with_words_also_where_saturation_may_be_found(bearing, monkeypatch):
    def failed(*a, **k):
        return replace(search(*a, **k | {"iterations": 1}), status="failed", at=None)

    monkeypatch.setattr(magnet_estimate, "search", failed)
    monkeypatch.setattr(magnet_estimate, "rescue", lambda fit, *a, **k: fit)
    records = [as_seen(d, str(n)) for n, d in enumerate(bearing[0])]
    with pytest.raises(EstimationError, match="no start value makes a predictor"):
        estimate_bearing(records, KNOWN, laws=[PAIR], extend=("saturation",))


def test_linearised_values_are_right_at_every_operating_point(bearing):
    _, truth, fit = bearing
    x, i = (a.ravel() for a in np.meshgrid(np.linspace(-0.6, 0.6, 7) * truth["s"], np.linspace(-0.7, 0.7, 5)))
    found, _ = PAIR.table(x, i, fit.problem.values(fit.vector))
    exact, _ = PAIR.table(x, i, truth)
    assert found[:, 1:] == pytest.approx(exact[:, 1:], rel=0.01)


def test_a_search_over_a_stretch_first_ends_where_one_over_all_samples_does(bearing, monkeypatch):
    done, _, fit = bearing
    seen = []
    monkeypatch.setattr(magnet_estimate, "_LONGER", 2000)
    monkeypatch.setattr(magnet_estimate, "search", lambda *a, **k: seen.append(search(*a, **k)) or seen[-1])
    again = estimate_bearing([as_seen(d, str(n)) for n, d in enumerate(done)], KNOWN, laws=[PAIR], extend=())
    assert [f.problem.records[0].u.size for f in seen] == [4000, 2000, 6000]
    assert seen[-1].evaluations <= 3
    sd = np.sqrt(np.diag(np.linalg.inv(fit.at.J.T @ fit.at.J)))
    assert again.criterion < fit.criterion + 0.05  # what a search may leave
    assert np.abs((again.vector - fit.vector) / sd).max() < 0.2


def test_nothing_is_left_in_the_innovations(bearing):
    _, _, fit = bearing
    assert min(whiteness(fit, r).p for r in range(2)) > 1e-4


def test_noise_levels_are_found(bearing):
    _, _, fit = bearing
    levels = np.exp(fit.vector[fit.problem.noise_slices[0]])
    assert levels == pytest.approx([1e-7, 2e-3, 1.0, 0.05], rel=0.2)


def test_a_wrong_delay_shows(bearing):
    _, _, fit = bearing
    problem = replace(fit.problem, delays={20_000.0: 2.0})
    wrong = search(problem, fit.vector, iterations=6)
    assert wrong.criterion > fit.criterion + 100
    assert whiteness(wrong, 0).p < 1e-3


def test_the_bias_current_can_be_found_too():
    (done,), truth = unstable(6000, range(3, 4), STRONG)
    wrong = {**truth, "k": 1.1 * truth["k"], "s": 1.05 * truth["s"], "i0": 0.95, "m": 4.3, "L_leak": 3e-3}
    estimated = {"k", "s", "L_leak", "i0", "m", "R", "x_offset", "v_offset"}
    problem = problem_of([as_seen(done)], wrong, PAIR, estimated, [1e-7, 2e-3, 2.0, 0.1, 0.02], 1.0)
    fit = search(problem, problem.start())
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    assert fit.status == "converged"
    assert values["i0"] == pytest.approx(1.0, rel=0.01)
    for name, sd in zip(known.names, np.sqrt(np.diag(known.information)), strict=True):
        assert abs(values[name] - truth[name]) < 4 * sd, name


def test_an_interruption_keeps_the_best_so_far(bearing):
    done, truth, _ = bearing
    wrong = {**truth, "m": 5.0, "k": 1.2 * truth["k"]}
    problem = problem_of([as_seen(done[0])], wrong, PAIR, {"k", "m"}, [1e-7, 2e-3, 2.0, 0.1, 0.02], 1.0)
    calls = []

    def tick(stage, done=None):
        assert stage == "identify"
        calls.append(done)
        if len(calls) == 3:
            raise KeyboardInterrupt

    fit = search(problem, problem.start(), tick=tick)
    assert fit.status == "stalled"
    assert 0.0 <= calls[0] <= calls[1] <= calls[2] < 1.0
    assert fit.at is not None
    assert fit.criterion < criterion(problem, problem.start()) - 100


@pytest.mark.parametrize("gap", ["hyperbolic", "exponential"])
def test_the_balance_gives_the_gap_law_back(bearing, gap):
    seen = as_seen(bearing[0][0])
    law = MagnetLaw(gap=gap)
    numbers = {"k": 2e-4, "s": 2.5e-3, "L_g": 0.04, "zeta": 6.3e-3}
    x = np.repeat(np.linspace(8e-3, 12e-3, 20), 2000)[: seen.u.size * 3]
    pull = -law.table(x, np.ones_like(x), numbers)[0][:, 0]
    i = np.sqrt(0.6 / pull)
    record = type(seen)(
        name="rest", rate_hz=1000.0, u=i, loose=0 * i, y=np.column_stack([x, i]), valid=np.ones((x.size, 2), dtype=bool)
    )
    strength, length = balance([record], law, 0.6)
    first, second = law.names[:2]
    assert (strength, length) == pytest.approx((numbers[first], numbers[second]), rel=0.02)


def test_a_turned_sign_is_refused(bearing):
    seen = as_seen(bearing[0][0])
    with pytest.raises(EstimationError, match="sign"):
        estimate_bearing([seen], KNOWN, laws=[MagnetLaw()], extend=())
