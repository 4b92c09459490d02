"""Checks of an estimate: what passes, what is named, and what the words say."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.uncertainty import uncertainty
from ambid.estimation.likelihood import innovations, search, sparse_gain
from ambid.physics.linear_model import model
from ambid.record import Channel, Record
from ambid.validation.physical import (
    agreement,
    implausible,
    innovation_checks,
    innovation_products,
    lowest_power_hz,
    physical_checks,
)
from ambid.validation.residuals import ResidualTest, white_check
from tests.bearing.benches import BEARING, problem_of, run
from tests.validation.wrong import WithoutMotionalVoltage

AXIS = ("m", "k_x", "k_i", "R", "L")


def fitted(seed=51, n=4000, name="bearing", change=lambda p: p, **bench):
    names = AXIS if name in ("bearing", "thesis", "rmit") else tuple(p.name for p in model("coil").parameters)
    problem, vector = problem_of(run(name, n, seed, **bench), estimated=names)
    return search(change(problem), vector)


def record_of(fit):
    p = fit.problem
    roles = [*zip(p.model.inputs, p.u.T, strict=True), *zip(p.model.outputs, p.y.T, strict=True)]
    units = {"voltage": "V", "current": "A", "position": "m"}
    return Record(rate_hz=p.rate_hz, channels=tuple(Channel(name=r, unit=units[r], values=v) for r, v in roles))


def all_checks(fit):
    moved = agreement(fit)
    known = replace(uncertainty(fit), disagreement=moved.disagreement())
    checks = innovation_checks(fit, innovation_products(fit, innovations(fit.problem, fit.vector)), known, moved)
    robust = not all(c.passed for c in checks.values())
    return {**checks, **physical_checks(fit, known, record_of(fit), robust=robust)}


@pytest.mark.parametrize("name", ["bearing", "thesis", "rmit", "coil"])
def test_the_right_model_passes_every_check(name):
    checks = all_checks(fitted(name=name, n=12_000))
    assert {"residuals_white", "residuals_uncorrelated", "identifiable", "plausible", "within_limits"} <= set(checks)
    assert not {k: c.detail for k, c in checks.items() if not c.passed}
    assert all("\n" not in c.detail and c.detail for c in checks.values())


def test_a_wrong_model_fails_by_name():
    checks = all_checks(fitted(change=lambda p: replace(p, delay=0)))
    assert not checks["residuals_uncorrelated"].passed
    assert "residuals are correlated with past inputs" in checks["residuals_uncorrelated"].detail


def test_refits_agree_on_the_right_model_and_say_how_well():
    largest = []
    for seed in range(8):
        found = agreement(fitted(60 + seed, n=3000))
        assert found.passed
        assert found.disagreement().shape == (5,)
        assert found.shift.shape == found.sd.shape == (2, 5)
        largest.append(found.largest)
    # a refit uses a part of the same data: it moves by less than its own standard deviation, but it does move
    assert 0.1 < np.mean(largest) < 2.5


def test_refits_disagree_where_the_delay_is_ignored():
    found = agreement(fitted(delay=3.0, change=lambda p: replace(p, delay=0)))
    assert not found.passed
    assert found.largest > 4
    moved = found.disagreement()
    row = np.argmax(np.max(np.abs(found.shift / found.sd), axis=1))
    np.testing.assert_array_equal(moved, found.shift[row])


def test_without_the_motional_voltage_some_check_fails():
    checks = all_checks(fitted(change=lambda p: replace(p, model=WithoutMotionalVoltage())))
    assert not all(checks[k].passed for k in ("residuals_white", "residuals_uncorrelated", "estimates_agree"))


def test_agreement_of_a_plant_whose_states_are_never_corrected():
    bench = run("thesis", 3000, 3)
    problem, vector = problem_of(bench, estimated=AXIS, noise="given", gain=np.zeros((3, 2)))
    found = agreement(search(problem, vector))
    assert found.shift.shape[0] == 2
    assert found.passed


def test_what_the_record_does_not_show_is_named_with_an_experiment():
    fit = fitted(n=250)
    known = uncertainty(fit)
    blurred = replace(known, information=known.information * 400)
    checks = physical_checks(fit, blurred, record_of(fit), robust=False)
    unseen = [k for k, seen in zip(known.names, blurred.identifiable_at(robust=False), strict=True) if not seen]
    assert unseen
    assert not checks["identifiable"].passed
    assert all(k in checks["identifiable"].detail for k in unseen)
    assert any(word in checks["identifiable"].detail for word in ("excite", "Weigh", "steps"))


def test_a_clipped_channel_is_named():
    fit = fitted()
    u = np.clip(fit.problem.u, -5.0, 5.0)
    clipped = record_of(replace(fit, problem=replace(fit.problem, u=u)))
    check = physical_checks(fit, uncertainty(fit), clipped, robust=False)["within_limits"]
    assert not check.passed
    assert "voltage" in check.detail
    assert check.values["voltage_fraction"] == pytest.approx(np.mean(np.abs(fit.problem.u) >= 5.0), rel=0.3)


def test_physics_forbids_what_it_forbids():
    of, sd = model("one-axis"), dict.fromkeys(BEARING, 0.01)
    assert implausible(of, BEARING, sd) == []
    for name in ("m", "R", "L"):
        wrong = implausible(of, {**BEARING, name: -0.1}, sd)
        assert len(wrong) == 1
        assert wrong[0].startswith(f"{name} = -0.1")
    assert "impossible" in implausible(of, {**BEARING, "L": 1e-9}, {**sd, "L": 1e-10})[0]
    assert implausible(of, {**BEARING, "L": 1e-9}, sd) == []  # which the record does not show
    assert implausible(of, {**BEARING, "c": -0.02}, sd) == []  # within 3.3 sd of none
    assert "generate energy" in implausible(of, {**BEARING, "c": -0.05}, sd)[0]
    # a spring may have either sign, and so may the force
    assert implausible(of, {**BEARING, "k_x": 1.0, "k_i": -5.0}, sd) == []


def test_words_of_a_residual_check():
    good = ResidualTest(p=0.4, statistic=10.0, degrees=11, largest=0.012, largest_lag=3)
    bad = replace(good, p=1e-9)
    assert white_check(good).passed
    assert white_check(good).detail == "residuals are white (largest autocorrelation 0.012 at lag 3, p = 0.4)"
    assert not white_check(bad).passed
    assert white_check(bad).detail.startswith("residuals are not white (")
    assert white_check(replace(good, p=0.0)).detail.endswith("p < 1e-16)")
    assert white_check(bad).values["degrees_of_freedom"] == 11
    assert replace(good, p=1e-3).passed
    assert not replace(good, p=0.99e-3).passed


@pytest.mark.parametrize("low", [2.0, 17.0, 120.0])
def test_lowest_power_is_found(low):
    t = np.arange(8000) / 1000.0
    u = np.sin(2 * np.pi * low * t) + np.sin(2 * np.pi * 300 * t + 1)
    assert lowest_power_hz(u[:, None] + 7.0, 1000.0) == pytest.approx(low, abs=0.13)


def test_agreement_does_without_a_refit_whose_gain_is_not_found(monkeypatch):
    def none(fit, stride):
        if stride == 4:
            raise np.linalg.LinAlgError("the Riccati equation has no stabilising solution")
        return sparse_gain(fit, stride)

    monkeypatch.setattr("ambid.validation.physical.sparse_gain", none)
    assert agreement(fitted(60, n=3000)).strides == (2,)
