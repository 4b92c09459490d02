"""The grey-box estimator from no start values: simulated truth comes back, delays are found, nonsense is refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ambid.bearing.linear import Signals, carry, greybox
from ambid.bearing.uncertainty import uncertainty
from ambid.errors import EstimationError
from ambid.estimation.likelihood import innovations
from ambid.estimation.predictor import assemble
from ambid.physics.linear_model import Parameter, model
from tests.bearing.benches import parameters, problem_of, run

N = 6000


@cache
def plain(n, seed, fixed=("c",)):
    """A bearing's record and the fit to it, all but `fixed` free and the delay given."""
    bench = run("bearing", n, seed)
    return bench, greybox(bench.model, bench.signals, parameters(bench, fixed=fixed), delay=1)


def judged(fit, bench):
    """Values, relative errors and errors in standard deviations by name."""
    known = uncertainty(fit)
    theta = fit.problem.parameters(fit.vector)
    sd = dict(zip(known.names, known.standard_deviations(robust=False), strict=True))
    error = {k: theta[k] - bench.truth[k] for k in known.names}
    return (
        theta,
        {k: abs(e / (bench.truth[k] or np.inf)) for k, e in error.items()},
        {k: abs(e) / sd[k] for k, e in error.items()},
    )


# every truth inside its 99.9 % interval, and so near that a wrong sign, unit or factor cannot hide
RECOVERED = [
    ("thesis", ("c",), {"m": 0.005, "k_x": 0.05, "k_i": 0.005, "R": 0.01, "L": 0.002}),
    ("bearing", ("c",), {"m": 0.02, "k_x": 0.04, "k_i": 0.02, "R": 0.02, "L": 0.002}),
    ("rmit", ("c",), {"m": 0.02, "k_x": 0.04, "k_i": 0.02, "R": 0.02, "L": 0.003}),
    ("coil", (), {"R": 0.005, "L": 0.005}),
    ("sprung rotor", ("m",), {"k_x": 0.01, "k_i": 0.01, "c": 0.15}),
    ("falling rotor", ("m", "c"), {"k_x": 0.03, "k_i": 0.02}),
]


@pytest.mark.parametrize(("name", "fixed", "within"), RECOVERED, ids=[r[0] for r in RECOVERED])
def test_truth_is_recovered_from_no_start_values(name, fixed, within):
    bench = run(name, N, 11)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=fixed))
    assert fit.status == "converged"
    assert fit.problem.delay_samples(fit.vector) == pytest.approx(bench.delay, abs=0.02)
    _, error, z = judged(fit, bench)
    assert max(z.values()) < 3.3, z
    assert all(error[k] < limit for k, limit in within.items()), error


@pytest.mark.parametrize("delay", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("name", ["thesis", "bearing"])
def test_whole_delays_are_found_and_stay_whole(name, delay):
    # the bearing's loop has a margin of some three samples
    bench = run(name, N, 12, delay=delay)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)))
    assert fit.status == "converged"
    # the score test may keep a fraction by chance, but then with its uncertainty
    sd = uncertainty(fit).delay_sd or 1e-9
    assert abs(fit.problem.delay_samples(fit.vector) - delay) < max(1e-9, 4 * sd if fit.problem.fractional else 0)
    assert max(judged(fit, bench)[2].values()) < 3.5


@pytest.mark.parametrize("delay", [0.5, 1.5, 2.3])
@pytest.mark.parametrize("name", ["thesis", "bearing"])
def test_fractional_delays_are_found(name, delay):
    bench = run(name, N, 13, delay=delay)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)))
    assert fit.status == "converged"
    assert fit.problem.fractional
    assert fit.problem.delay == int(delay)
    assert 0 <= fit.problem.lags_at(fit.vector)[0] < 1
    assert abs(fit.problem.delay_samples(fit.vector) - delay) < 4 * uncertainty(fit).delay_sd
    assert max(judged(fit, bench)[2].values()) < 3.5


@pytest.mark.parametrize("delay", [0.0, 1.0, 1.5])
def test_a_given_delay_is_kept(delay):
    bench = run("bearing", 4000, 14, delay=delay)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=delay)
    assert fit.problem.delay_samples(fit.vector) == delay
    assert not fit.problem.fractional
    assert max(judged(fit, bench)[2].values()) < 3.5


def test_a_wrong_given_delay_spoils_the_likelihood():
    bench, right = plain(4000, 14)
    wrong = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=0)
    assert wrong.criterion > right.criterion + 100


def test_noise_levels_come_back():
    bench = run("bearing", 16_000, 15)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1)
    assert fit.problem.noise == "levels"  # BIC does not buy a free gain where it is not needed
    sl, sc = fit.problem.slices, fit.problem.scales
    numbers = fit.vector[sl["noise"]]
    inner = assemble(fit.problem, fit.vector, with_derivatives=False).innovations.S
    common = np.sqrt(np.trace(np.linalg.solve(inner, fit.covariance)) / 2)
    sensor = np.exp(np.r_[0.0, numbers[2:]]) * sc.output * common
    disturbance = np.exp(numbers[:2]) * sc.disturbance * common
    np.testing.assert_allclose(sensor, bench.sensor, rtol=0.05)
    np.testing.assert_allclose(disturbance, bench.disturbance, rtol=0.25)


def test_offsets_of_the_record_do_not_reach_the_parameters():
    bench = run("bearing", 4000, 16)
    shifted = replace(bench.signals, u=bench.signals.u + 4.0, y=bench.signals.y + np.array([0.01, 0.95]))
    one, other = (greybox(bench.model, s, parameters(bench, fixed=("c",)), delay=1) for s in (bench.signals, shifted))
    sd = np.sqrt(np.diag(uncertainty(one).information)) / one.problem.magnitude
    assert (
        np.max(np.abs(one.problem.magnitude * one.vector[:5] / other.problem.magnitude / other.vector[:5] - 1) / sd)
        < 0.05
    )


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_units_are_nothing_but_units(factor):
    # the same record of a bench `factor` times as large in length: m, k_x, k_i, follow, R and L do not
    bench = run("bearing", 4000, 17)
    y = bench.signals.y * [factor, 1.0]
    one = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1)
    other = greybox(bench.model, replace(bench.signals, y=y), parameters(bench, fixed=("c",)), delay=1)
    a, b = one.problem.parameters(one.vector), other.problem.parameters(other.vector)
    sd = dict(zip(("m", "k_x", "k_i", "R", "L"), uncertainty(one).relative_sd(robust=False), strict=True))
    for name, power in (("m", -2), ("k_x", -2), ("k_i", -1), ("R", 0), ("L", 0)):
        assert abs(b[name] / (a[name] * factor**power) - 1) < 0.1 * sd[name]


def test_fixed_stays_and_a_prior_pulls():
    bench = run("bearing", 2000, 18)
    free = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1)
    theta, _, _ = judged(free, bench)
    ps = [
        replace(p, role="fixed", value=1.03 * bench.truth["m"]) if p.name == "m" else p
        for p in parameters(bench, fixed=("c",))
    ]
    fixed = greybox(bench.model, bench.signals, ps, delay=1)
    assert fixed.problem.parameters(fixed.vector)["m"] == 1.03 * bench.truth["m"]
    assert "m" not in fixed.problem.estimated
    mean = 1.5 * theta["R"]
    ps = [
        replace(p, role="prior", value=mean, sd=1e-4) if p.name == "R" else p for p in parameters(bench, fixed=("c",))
    ]
    pulled = greybox(bench.model, bench.signals, ps, delay=1)
    assert pulled.problem.parameters(pulled.vector)["R"] == pytest.approx(mean, abs=3e-4)
    ps = [replace(p, role="prior", value=mean, sd=1e4) if p.name == "R" else p for p in parameters(bench, fixed=("c",))]
    weak = greybox(bench.model, bench.signals, ps, delay=1)
    known = uncertainty(free)
    sd = known.standard_deviations(robust=False)[known.names.index("R")]
    assert weak.problem.parameters(weak.vector)["R"] == pytest.approx(theta["R"], abs=0.05 * sd)


def test_the_users_start_values_do_no_harm():
    bench, usual = plain(3000, 19)
    good = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",), start=bench.truth), delay=1)
    far = {k: 7.0 * v for k, v in bench.truth.items()}
    bad = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",), start=far), delay=1)
    for other in (good, bad):
        assert other.status == "converged"
        assert other.criterion == pytest.approx(usual.criterion, abs=0.05)


@pytest.mark.parametrize("name", ["k_x", "k_i", "c"])
def test_zero_is_a_value_like_any_other(name):
    # a prior about zero that says nearly nothing, and a start value of zero, end where none ends
    fixed = () if name == "c" else ("c",)
    bench, usual = plain(3000, 19, fixed)
    ps = parameters(bench, fixed=fixed)
    vague = 1e3 * max(abs(bench.truth[name]), 1.0)
    for given in ({"role": "prior", "value": 0.0, "sd": vague}, {"value": 0.0}):
        fit = greybox(bench.model, bench.signals, [replace(p, **given) if p.name == name else p for p in ps], delay=1)
        assert fit.status == "converged"
        assert fit.criterion == pytest.approx(usual.criterion, abs=0.1)
        assert max(judged(fit, bench)[2].values()) < 3.5


def test_equal_records_give_equal_estimates():
    bench = run("bearing", 2000, 20)
    a, b = (greybox(bench.model, bench.signals, parameters(bench, fixed=("c",))) for _ in range(2))
    np.testing.assert_array_equal(a.vector, b.vector)


def test_a_gain_can_be_asked_for():
    bench = run("bearing", 6000, 21)
    gain = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1, noise="gain")
    levels = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1, noise="levels")
    assert gain.problem.noise == "gain"
    assert levels.problem.noise == "levels"
    assert max(judged(gain, bench)[2].values()) < 3.5
    sd = uncertainty(levels).standard_deviations(robust=False) / levels.problem.magnitude
    assert np.max(np.abs(gain.vector[:5] - levels.vector[:5]) / sd) < 1.5


def test_coloured_noise_buys_a_free_gain():
    # position noise that is a random walk: no level of force and voltage can describe it
    bench = run("thesis", 3000, 22)
    walk = np.cumsum(np.random.default_rng(0).standard_normal(3000)) * 3 * bench.sensor[0]
    signals = replace(bench.signals, y=bench.signals.y + np.c_[walk, 0 * walk])
    fit = greybox(bench.model, signals, parameters(bench, fixed=("c",)), delay=0)
    levels = greybox(bench.model, signals, parameters(bench, fixed=("c",)), delay=0, noise="levels")
    assert fit.problem.noise == "gain"
    assert levels.criterion - fit.criterion > 3 * np.log(3000)


@pytest.mark.parametrize(("column", "word"), [("u", "voltage"), ("x", "position"), ("i", "current")])
def test_a_constant_channel_is_refused_by_name(column, word):
    bench = run("bearing", 1000, 23)
    u, y = bench.signals.u.copy(), bench.signals.y.copy()
    if column == "u":
        u[:] = 3.0
    else:
        y[:, "xi".index(column)] = 0.01
    with pytest.raises(EstimationError, match=rf"'{word}' is constant"):
        greybox(bench.model, Signals(u=u, y=y, rate_hz=2e4), parameters(bench, fixed=("c",)))


def test_too_short_a_record_is_refused():
    bench = run("bearing", 100, 23)
    with pytest.raises(EstimationError, match=r"100 samples.*at least"):
        greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)))


def test_nothing_to_estimate_is_refused():
    bench = run("coil", 1000, 23)
    with pytest.raises(EstimationError, match="fixed"):
        greybox(bench.model, bench.signals, parameters(bench, fixed=("R", "L")))


def test_white_noise_in_every_channel_is_not_a_confident_bearing():
    rng = np.random.default_rng(24)
    of = model("one-axis")
    signals = Signals(u=rng.standard_normal((3000, 1)), y=rng.standard_normal((3000, 2)), rate_hz=1e4)
    ps = [
        Parameter(name=p.name, unit=p.unit, **({"role": "fixed", "value": 0.0} if p.name == "c" else {}))
        for p in of.parameters
    ]
    try:
        fit = greybox(of, signals, ps)
    except EstimationError:
        return  # refused: that is an answer too
    assert fit.status != "converged" or not all(uncertainty(fit).identifiable_at(robust=False))


def test_progress_can_interrupt():
    class StopNow(Exception):
        pass

    def tick():
        raise StopNow

    bench = run("bearing", 1000, 25)
    with pytest.raises(StopNow):
        greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), tick=tick)


def test_a_fit_is_carried_into_other_problems_unchanged():
    bench = run("bearing", 1500, 26, delay=1.4)
    fit = greybox(bench.model, bench.signals, parameters(bench, fixed=("c",)), delay=1.4)
    before = innovations(fit.problem, fit.vector)
    scale = np.abs(before).max()
    for changes in (
        {"noise": "gain"},
        {"fractional": True, "lag": 0.0, "skip": max(3, fit.problem.skip)},
        {"fractional": True, "lag": 0.0, "delay": 2, "skip": 4},
    ):
        other = replace(fit.problem, **changes)
        moved = carry(fit, other)
        assert other.parameters(moved) == pytest.approx(fit.problem.parameters(fit.vector), rel=1e-12)
        assert other.delay_samples(moved) == pytest.approx(1.4)
        same = innovations(other, moved)
        late = other.skip - fit.problem.skip
        if not late:
            np.testing.assert_allclose(same, before, rtol=1e-6, atol=1e-7 * scale)
        # a later start forgets its initial state within the predictor's memory
        np.testing.assert_allclose(same[-200:], before[-200:], rtol=1e-4, atol=1e-5 * scale)


def test_problems_say_what_they_hold():
    problem, vector = problem_of(run("bearing", 300, 1), fractional=True)
    assert problem.size == 6 + 1 + 3 + 2 + 3 == vector.size
    assert problem.n_used == 300 - problem.skip
    assert problem.lags == (-1, 0, 1, 2)
    strided, _ = problem_of(run("bearing", 300, 1), noise="gain", stride=4)
    assert strided.lags == (-3, -2, -1, 0)
    assert strided.n_used == len(range(strided.skip, 300, 4))
    with pytest.raises(ValueError, match="stride"):
        replace(strided, noise="levels")
    with pytest.raises(ValueError, match="skip"):
        replace(problem, skip=2)
