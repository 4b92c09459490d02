"""Noisy records of a ball at one operating point, where the search from the linear estimate ends nowhere."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing import magnet_rescue as rescue
from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import uncertainty
from ambid.bearing.magnet_rescue import bearing_cost, failure, global_problems
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.simulation import simulate
from tests.bearing.magnet.bearings import LARGE, as_seen, truth_of, unstable

BENCH = preset("levitated-ball")
TRUTH = truth_of(BENCH)
LAW = MagnetLaw()


def fixed(name, unit):
    return Parameter(name=name, unit=unit, role="fixed", value=TRUTH[name])


KNOWN = {"m": fixed("m", "kg"), "R": Parameter(name="R", unit="ohm"), "c": fixed("c", "N s/m")}


def ball(n, seed, *, swing, louder):
    """A ball about 10 mm, small voltage steps, sensors so many times as noisy as usual."""
    rng = np.random.default_rng(seed)
    setpoint = 0.010 + swing * np.sin(2 * np.pi * (0.7 * np.arange(n) / BENCH.rate_hz + rng.random()))
    kick = np.repeat(rng.choice([-0.3, 0.3], n // 20 + 1), 20)[:n]
    seen = as_seen(
        simulate(
            BENCH.plant, kick, rate_hz=BENCH.rate_hz, seed=seed, loop=BENCH.loop, noise=BENCH.noise,
            operating_point=BENCH.operating_point, setpoint=setpoint, substeps=2,
        )
    )  # fmt: skip
    added = louder * np.array([2e-6, 1e-3]) * np.random.default_rng(0).standard_normal(seen.y.shape)
    return replace(seen, y=seen.y + added)


def shifts(fit):
    """Errors of the estimated numbers in standard deviations."""
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    sd = np.sqrt(np.diag(known.information))
    return {n: abs(values[n] - TRUTH[n]) / s for n, s in zip(known.names, sd, strict=True)}


@pytest.fixture(scope="module")
def noisy():
    return ball(1500, 2, swing=0.0, louder=30.0)


@pytest.fixture(scope="module")
def before(noisy):
    return estimate_bearing([noisy], KNOWN, laws=[LAW], extend=(), evaluations=0)


def test_a_better_minimum_is_found_where_no_search_converges(noisy, before):
    assert before.status == "stalled"
    assert failure(before) == "no search converged"
    fit = estimate_bearing([noisy], KNOWN, laws=[LAW], extend=())
    assert fit.global_search is not None
    told = fit.global_search
    assert told["taken"]
    assert not told["interrupted"]
    assert 100 < told["evaluations"] <= 800
    assert fit.criterion < before.criterion - 100.0
    assert told["criterion_after"] < told["criterion_before"]
    # the search hardly ends in such noise: where it does, its deviations hold (in a stalled one R was 3.5 of them off)
    assert fit.status == "stalled" or max(shifts(fit).values()) < 3.5
    error = [abs(f.problem.values(f.vector)["R"] / TRUTH["R"] - 1.0) for f in (before, fit)]
    assert error[1] < 0.5 < 1.0 < error[0]


def test_what_is_hardly_better_is_not_taken():
    # the delay is 1; in such noise other delays do as well, with other numbers
    record = ball(1500, 3, swing=0.0, louder=30.0)
    fit = estimate_bearing([record], KNOWN, laws=[LAW], extend=())
    assert fit.global_search is not None
    assert not fit.global_search["taken"]
    assert fit.problem.delays == {2000.0: 1.0}


def test_a_sign_that_is_lost_in_the_noise_does_not_end_the_estimate():
    known = {**KNOWN, "R": fixed("R", "ohm")}
    fit = estimate_bearing(
        [ball(2000, 1, swing=2e-3, louder=400.0)], known, laws=[LAW], extend=(), delay=1.0, evaluations=0
    )
    assert fit.status == "converged"
    assert max(shifts(fit).values()) < 3.5
    assert fit.problem.values(fit.vector)["k"] == pytest.approx(TRUTH["k"], rel=0.1)


def test_it_is_not_called_where_the_ordinary_start_works(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a global search where none is needed")

    monkeypatch.setattr(rescue, "bearing_cost", refuse)
    one = estimate_bearing([ball(1500, 1, swing=0.0, louder=1.0)], KNOWN, laws=[LAW], extend=())
    done, _ = unstable(1500, range(1), LARGE)
    pair = {
        "m": Parameter(name="m", unit="kg"),
        "R": Parameter(name="R", unit="ohm"),
        "c": fixed("c", "N s/m"),
        "i0": Parameter(name="i0", unit="A", role="fixed", value=1.0),
    }
    two = estimate_bearing([as_seen(done[0])], pair, laws=[MagnetLaw(pair=True)], extend=())
    for fit in (one, two):
        assert fit.status == "converged"
        assert fit.global_search is None


def test_equal_seeds_give_equal_places(before):
    found = [global_problems(bearing_cost(before, search_delay=True), seed=seed, evaluations=60) for seed in (0, 0, 1)]
    one, again, other = ([p.start() for p in places] for places in found)
    assert len(one) > 1
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one[0], other[0])


def test_an_interruption_keeps_the_best_so_far(noisy, before):
    seen = []

    def tick(stage, done=None, /):
        seen.append(stage)
        if seen.count("global search") > 200:
            raise KeyboardInterrupt

    fit = estimate_bearing([noisy], KNOWN, laws=[LAW], extend=(), tick=tick)
    assert fit.global_search is not None
    assert fit.status == "stalled"
    assert fit.global_search["interrupted"]
    assert fit.global_search["evaluations"] == 200
    assert fit.criterion <= before.criterion


def test_an_interruption_before_it_leaves_it_out(noisy):
    def tick(stage, done=None, /):
        raise KeyboardInterrupt

    fit = estimate_bearing([noisy], KNOWN, laws=[LAW], extend=(), tick=tick)
    assert fit.status == "stalled"
    assert fit.global_search is None
