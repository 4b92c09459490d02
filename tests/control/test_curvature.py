"""The magnet's curvature in linear estimates: what the check expects is what estimates are off by."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.control.closed import Plant
from ambid.control.curvature import judge_shift
from ambid.control.drawn import laws_of
from ambid.control.experiment import MOST, reached
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset

SEEDS = range(4)


@pytest.fixture(scope="module")
def experiment():
    return ambid.design_experiment("prototype", seconds=4.0, lines=40, use=0.63)


@pytest.fixture(scope="module")
def bent(experiment):
    """Estimates of records of the nonlinear bench."""
    return [identified(experiment, seed, nonlinear=True) for seed in SEEDS]


def identified(experiment, seed, *, nonlinear):
    rig = rig_of_preset(preset("prototype"))  # by role; of the preset itself a record has counts
    return ambid.identify(ambid.simulate(rig, duration=4.0, seed=seed, nonlinear=nonlinear, excitation=experiment), rig)


def test_the_shift_expected_is_the_shift_seen(bent):
    rig = rig_of_preset(preset("prototype"))
    of = Plant(model=rig.plant, theta=bent[0].values, delays=np.zeros(1), rate_hz=2000.0)
    law = laws_of(of, rig, {})[0][""]
    truth = dict(zip(("k_x", "k_i", "L"), law.numbers(*law.rest), strict=True))
    expected = np.array([[x.checks["curvature"].values[n] for n in truth] for x in bent])
    # the stated sd holds the shift too, in quadrature
    seen = np.array([[(x[n].value - truth[n]) / x[n].sd for n in truth] for x in bent]) * np.sqrt(1.0 + expected**2)
    assert expected[:, 2].mean() > 3.0  # of L
    # sd of a mean of four is a half; 4 of those
    assert np.all(np.abs((seen - expected).mean(axis=0)) < 2.0)


def test_a_curved_record_is_used_with_caution_and_told_what_to_do(bent):
    for estimate in bent:
        reason = next(r for r in estimate.verdict.reasons if r.check == "curvature")
        assert estimate.verdict.word == "caution"
        assert "L by +" in reason.text
        assert "ambid.identify_nonlinear" in reason.text
        assert reason.cause == "curvature"


def test_a_small_shift_is_held_by_the_intervals_and_is_no_caution():
    """A shift of about 2 sd of L, 0.1 % of it, is nothing to a user; the interval reaches to the operating point."""
    wave = ambid.design_experiment("prototype", seconds=4.0, lines=40, use=0.42)
    rig = rig_of_preset(preset("prototype"))
    runs, held, far = 12, 0, 0
    for seed in range(runs):
        found = identified(wave, seed, nonlinear=True)
        check = found.checks["curvature"]
        of = Plant(model=rig.plant, theta=found.values, delays=np.zeros(1), rate_hz=2000.0)
        law = laws_of(of, rig, {})[0][""]
        truth = dict(zip(("k_x", "k_i", "L"), law.numbers(*law.rest), strict=True))
        low, high = found["L"].ci95
        held += low <= truth["L"] <= high
        if MOST < abs(check.values["L"]) <= 3.0:
            far += 1
            assert check.passed, check.detail
            assert "the intervals hold it" in check.detail
            assert found.verdict.word == "usable"
            assert reached(wave, found).passed  # the shift that its interval holds is no noise
    assert far >= runs // 4  # else nothing was tested
    assert held >= 9  # of 12 at 95 %: fewer by chance in 2 of 10,000


def test_what_an_interval_cannot_bear_is_a_caution():
    theta = {"L": 0.08, "k_x": -6700.0}
    for shift, size, passed in (
        ({"L": 1.4, "k_x": 0.1}, {"L": 1e-3, "k_x": 1.0}, True),  # no number moves far, however wide it is
        ({"L": 1.9, "k_x": 0.1}, {"L": 4e-5, "k_x": 1.0}, True),  # 0.05 %
        ({"L": 1.9, "k_x": 0.1}, {"L": 4e-3, "k_x": 1.0}, False),  # 5 %
        ({"L": 3.5, "k_x": 0.1}, {"L": 4e-5, "k_x": 1.0}, False),  # what is of higher degree moves it too
    ):
        assert judge_shift(shift, size, theta, in_interval=True)[0] == passed, (shift, size)
        assert not (
            abs(shift["L"]) > MOST and judge_shift(shift, size, theta, in_interval=False)[0]
        )  # a design can be smaller


def test_a_linear_bench_is_not_cautioned_for_the_magnet_of_its_rig(experiment):
    check = identified(experiment, 1, nonlinear=False).checks["curvature"]
    assert check.passed, check.detail
    assert abs(check.values["part"]) < 5.0 * check.values["part_sd"]


def test_small_motion_is_not_cautioned():
    rig = rig_of_preset(preset("prototype"))
    record = ambid.simulate(rig, duration=2.0, seed=1, nonlinear=True, amplitude=3.0)
    check = ambid.identify(record, rig).checks["curvature"]
    assert check.passed
    assert max(abs(check.values[n]) for n in ("k_x", "k_i", "L")) < 0.3


def test_a_design_says_what_its_record_will_be_off_by(experiment, bent):
    check = experiment.checks["curvature"]
    for name in ("k_x", "k_i", "L"):
        expected = experiment.expected[name].shift
        mean = np.mean([x.checks["curvature"].values[name] / x.checks["curvature"].values["part"] for x in bent])
        assert abs(expected - mean) < max(0.3, 0.15 * abs(expected))
        assert check.values[name] == expected
    assert not check.passed
    assert experiment.verdict.word == "caution"


def test_a_design_of_little_motion_is_not_cautioned():
    found = ambid.design_experiment("prototype", seconds=1.0, lines=20, use=0.1)
    assert found.checks["curvature"].passed


def test_a_record_away_from_the_rest_of_the_rig_is_judged_where_it_is():
    rig = rig_of_preset(preset("levitated-ball"))
    open_zero = [replace(c, offset_sd=0.5) if c.role == "current" else c for c in rig.channels]
    rig = replace(rig, channels=tuple(open_zero))  # the weight says nothing then
    wave = ambid.design_experiment("levitated-ball", seconds=2.0, lines=10, use=0.1)
    record = ambid.simulate("levitated-ball", duration=2.0, nonlinear=True, position=0.012, excitation=wave)
    found = ambid.identify(record, rig)
    of = Plant(model=rig.plant, theta=found.values, delays=np.zeros(1), rate_hz=2000.0)
    law, check = laws_of(of, rig, found.operating_point)[0][""], found.checks["curvature"]
    assert law.rest[0] == pytest.approx(0.012, abs=1e-4)
    truth = dict(zip(("k_x", "k_i", "L"), law.numbers(*law.rest), strict=True))
    own = {n: found[n].sd / np.hypot(1.0, check.values[n]) for n in truth}  # without the shift
    seen = {n: (found[n].value - x) / own[n] for n, x in truth.items()}
    assert seen["k_i"] > 4.0
    assert all(abs(check.values[n] - x) < 3.0 for n, x in seen.items()), (seen, check.values)
    moved = laws_of(of, rig, {"position": 0.0, "current": 0.0})[0][""]  # of a record of deviations
    assert moved.rest == pytest.approx((0.01, 0.95))


def told_less(rig, *, parameters=(), magnet=(), **other):
    """A rig without some values of [parameters], and some numbers of [magnet]; others are given, fixed."""
    numbers = tuple(
        replace(p, value=other.get(p.name, p.value), role="fixed")
        for p in rig.magnet.parameters
        if p.name not in magnet
    )
    return replace(
        rig,
        parameters=tuple(replace(p, value=None) if p.name in parameters else p for p in rig.parameters),
        magnet=replace(rig.magnet, parameters=numbers),
    )


@pytest.fixture(scope="module")
def swinging():
    """A record of a ball under one magnet that moves far."""
    wave = ambid.design_experiment("levitated-ball", seconds=4.0, lines=20, use=0.8)
    return ambid.simulate("levitated-ball", duration=4.0, seed=3, nonlinear=True, excitation=wave)


@pytest.mark.parametrize("magnet", [(), ("k", "s", "L_leak")])
def test_one_magnet_is_one_whatever_the_rig_leaves_out(swinging, magnet):
    """The estimate says what the rig does not: R, which a plant needs, and the numbers of the law."""
    rig = told_less(rig_of_preset(preset("levitated-ball")), parameters=("R",), magnet=magnet)
    found = ambid.identify(swinging, rig)
    assert found.checks["curvature"].cause == "curvature"
    assert abs(found.checks["curvature"].values["k_x"]) > 3.0
    for name, true in (("k_x", -117.72), ("k_i", -1.23916)):
        assert found[name].ci95[0] < true < found[name].ci95[1]


def test_the_law_of_one_magnet_follows_from_its_numbers_at_rest():
    rig = rig_of_preset(preset("levitated-ball"))
    theta = {p.name: p.value for p in rig.parameters}
    of = Plant(model=rig.plant, theta=theta, delays=np.zeros(1), rate_hz=1000.0)
    known, made = (
        laws_of(of, r, rig.operating_point)[0][""] for r in (rig, told_less(rig, magnet=("k", "s", "L_leak")))
    )
    for x in (0.009, 0.012):
        assert made.numbers(x, 0.9) == pytest.approx(known.numbers(x, 0.9), rel=1e-9)
    bent = replace(rig.magnet, gap="exponential", parameters=())
    law = laws_of(of, replace(rig, magnet=bent), rig.operating_point)[0][""]
    assert law.numbers(*law.rest) == pytest.approx([theta["k_x"], theta["k_i"], theta["L"]], rel=1e-9)


def test_a_rig_whose_magnet_contradicts_its_numbers_is_told():
    """k_x is k i^2/d^3 of the gap d, where i is measured: 11 % by a gap that is 4 % too small."""
    rig = rig_of_preset(preset("levitated-ball"))
    wrong = told_less(rig, s=-0.00038)
    record = ambid.simulate("levitated-ball", duration=1.0, seed=1)
    for given, passed in ((told_less(rig), True), (wrong, False)):
        check = ambid.identify(record, given).checks["magnet_agrees"]
        assert check.passed == passed
        assert check.values["k_x"] == pytest.approx(0.0 if passed else -0.11, abs=0.04)
    check = ambid.design_experiment(wrong, seconds=1.0, lines=10, use=0.1).checks["magnet_agrees"]
    assert not check.passed
    assert "k_x" in check.detail
    start = replace(wrong, magnet=replace(
        wrong.magnet, parameters=tuple(replace(p, role="free") for p in wrong.magnet.parameters)))  # fmt: skip
    assert ambid.identify(record, start).checks["magnet_agrees"].passed  # nobody said that it is right
