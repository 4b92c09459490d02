"""What stands between command and force, and between two magnets: found where it is there, flagged where it is not."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.magnet_estimate import estimate_bearing
from ambid.bearing.magnet_likelihood import criterion, search, uncertainty
from ambid.estimation.uncertainty import WEAK
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import Parameter
from ambid.physics.nonlinear import PowerStage
from ambid.physics.presets import preset
from ambid.validation.nonlinear_bearing import whiteness
from tests.bearing.magnet.bearings import Motion, as_seen, moved, numbers_of, problem_of, truth_of

KNOWN = {
    "m": Parameter(name="m", unit="kg"),
    "R": Parameter(name="R", unit="ohm"),
    "c": Parameter(name="c", unit="N s/m", role="fixed", value=0.0),
    "i0": Parameter(name="i0", unit="A", role="fixed", value=1.0),
}
STRONG = Motion(swing=0.30, swing_hz=2.0, volts=12.0, hold=3)
WEAK_MOTION = Motion(swing=0.01, swing_hz=5.0, volts=1.0, hold=10)
EQUAL, UNEQUAL = MagnetLaw(pair=True), MagnetLaw(pair=True, asymmetric=True)
NOISE = [1e-7, 2e-3, 1.0, 0.05, 0.02, 0.01]
BARS = {"k": 0.01, "s": 0.005, "m": 0.01, "R": 0.01, "L_leak": 0.1}


def bench(*, k_asym=0.0, i0_asym=0.0, **plant):
    b = preset("unstable-bearing")
    values = numbers_of(b) | {"k_asym": k_asym, "i0_asym": i0_asym}
    return replace(b, plant=replace(b.plant, magnet=LawMagnet(law=UNEQUAL, values=values), **plant))


def truth(b):
    numbers = {"a": min(b.plant.eddy_pole, 1e5), "v_drop": b.plant.stage.v_drop, "i_drop": b.plant.stage.i_drop}
    return {**truth_of(b), **numbers}


def seen(b, n, motion=STRONG, seed=0):
    done = moved(b, motion, n, seed)
    assert done.first_contact is None
    return as_seen(done)


def right(fit, exact, bars):
    """Every number within four deviations, those with a bar within it."""
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    assert fit.status == "converged"
    for name, sd in zip(known.names, np.sqrt(np.diag(known.information)), strict=True):
        assert abs(values[name] - exact[name]) < 4 * sd, name
        assert sd > 0
    for name, bar in bars.items():
        assert values[name] == pytest.approx(exact[name], rel=bar), name
    return known


@pytest.fixture(scope="module")
def unequal():
    b = bench(k_asym=0.08, i0_asym=0.04)
    return b, seen(b, 5000)


def test_unequal_magnets_are_found_without_being_asked_for(unequal):
    b, record = unequal
    fit = estimate_bearing([record], KNOWN, laws=[EQUAL])
    assert fit.problem.law == UNEQUAL
    right(fit, truth(b), {**BARS, "k_asym": 0.1, "i0_asym": 0.03})
    assert whiteness(fit, 0).p > 1e-3


def test_an_equal_law_on_unequal_magnets_shows(unequal):
    b, record = unequal
    problem = problem_of(
        [record], {**truth(b), "k_asym": 0.0, "i0_asym": 0.0}, EQUAL, {"k", "s", "m", "R", "x_offset", "v_offset"},
        NOISE, 1.0,
    )  # fmt: skip
    assert whiteness(search(problem, problem.start(), iterations=40), 0).p < 1e-6


def test_equal_magnets_stay_equal():
    record = seen(bench(), 4000)
    fit = estimate_bearing([record], KNOWN, laws=[EQUAL], delay=1.0)
    assert fit.problem.law == EQUAL


def test_a_small_motion_does_not_show_a_difference_and_says_so():
    b = bench(k_asym=0.08, i0_asym=0.04)
    record, known = seen(b, 3000, WEAK_MOTION), {**KNOWN, "k_asym": Parameter(name="k_asym", unit="1")}
    fit = estimate_bearing([record], known, laws=[EQUAL], extend=(), delay=1.0)
    found = uncertainty(fit)
    sd = np.sqrt(np.diag(found.information))[found.names.index("k_asym")]
    number = next(n for n in fit.problem.numbers if n.name == "k_asym")
    assert sd > WEAK * max(number.magnitude, abs(fit.problem.values(fit.vector)["k_asym"]))


def test_an_eddy_pole_is_found():
    b = bench(eddy_pole=3000.0)
    fit = estimate_bearing([seen(b, 4000)], KNOWN, laws=[EQUAL], extend=(), eddy=True, delay=1.0)
    right(fit, truth(b), {**BARS, "a": 0.03})
    assert whiteness(fit, 0).p > 1e-3


def test_an_eddy_pole_that_is_left_out_shows_in_past_voltages_alone():
    record = seen(bench(eddy_pole=3000.0), 4000)
    fit = estimate_bearing([record], KNOWN, laws=[EQUAL], extend=(), delay=1.0)
    assert abs(fit.problem.values(fit.vector)["m"] / 4.0 - 1.0) > 0.03  # it would be believed
    test = whiteness(fit, 0)
    assert test.p < 1e-6
    assert test.own.p > 1e-6


def test_a_pole_that_is_not_there_goes_to_its_bound_and_is_not_identifiable():
    record, b = seen(bench(), 2500), bench()
    problem = problem_of(
        [record], {**truth(b), "a": 2e4}, EQUAL, {"k", "s", "m", "R", "a", "L_leak"}, NOISE, 1.0, eddy=True
    )
    fit = search(problem, problem.start())
    known, values = uncertainty(fit), fit.problem.values(fit.vector)
    assert fit.status == "converged"
    assert np.sqrt(known.information[known.names.index("a"), known.names.index("a")]) > WEAK * values["a"]
    assert values["m"] == pytest.approx(4.0, rel=0.02)


@pytest.fixture(scope="module")
def lossy():
    """A stage that drops and ends at its supply, below what the controller asks for in a third of all samples."""
    b = bench(stage=PowerStage(limits=(-14.0, 14.0), v_drop=0.8, i_drop=0.05))
    record = seen(b, 5000)
    assert np.mean(np.abs(record.u) > 14.0) > 0.2
    return b, replace(record, u=np.clip(record.u, -14.0, 14.0))


def test_drop_and_limits_of_the_stage_are_identified(lossy):
    b, record = lossy
    known = {**KNOWN, "v_drop": Parameter(name="v_drop", unit="V")}
    fit = estimate_bearing([record], known, laws=[EQUAL], extend=(), delay=1.0)
    found = right(fit, truth(b), {**BARS, "v_drop": 0.01})
    assert "i_drop" in found.names  # a width that is wrong makes the drop wrong: both are free
    assert whiteness(fit, 0).p > 1e-3


def test_a_drop_that_is_left_out_shows(lossy):
    _, record = lossy
    fit = estimate_bearing([record], KNOWN, laws=[EQUAL], extend=(), delay=1.0)
    assert whiteness(fit, 0).p < 1e-6
    assert fit.problem.values(fit.vector)["R"] > 1.8  # it is taken for a resistance


def test_a_drop_that_changes_its_sign_within_a_sample_is_integrated_through_it():
    b = bench(stage=PowerStage(v_drop=4.0, i_drop=0.01))
    record, free = seen(b, 1500), {"k", "s", "m", "R", "v_drop", "i_drop"}
    problem = problem_of([record], truth(b), EQUAL, free, NOISE, 1.0)
    finer = replace(problem, substeps=8)
    # steps of a whole sample would be wrong by hundreds
    assert criterion(problem, problem.start()) == pytest.approx(criterion(finer, finer.start()), abs=3.0)
