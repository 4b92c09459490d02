"""Facts of a record without a fit, and what they say of an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.bearing.linear import greybox
from ambid.bearing.uncertainty import uncertainty
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.job.data import load_bench, signals_of
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import default_rig, rig_of_preset
from ambid.validation.facts import agreements, belonging, between_samples, facts, informed, mean_resistance, one_sided

RATE = 1000.0


def record(voltage, current, position):
    columns = {"voltage": (voltage, "V"), "current": (current, "A"), "position": (position, "m")}
    channels = tuple(
        Channel(name=k, values=np.asarray(x, float), unit=u, source_unit=u) for k, (x, u) in columns.items()
    )
    return Record(channels=channels, rate_hz=RATE, start_s=0.0, provenance={}, history=())


def carried(seed=1, n=4000, offset=0.0):
    """A current of one sign through 4 ohm, and a position that it moves."""
    rng = np.random.default_rng(seed)
    i = 1.0 + 0.1 * np.convolve(rng.standard_normal(n + 40), np.hanning(41), mode="valid")[:n] / 4
    x = np.cumsum(np.cumsum(i - i.mean())) * 1e-6
    x = x - np.polyval(np.polyfit(np.arange(n), x, 3), np.arange(n)) + 1e-7 * rng.standard_normal(n)
    return record(4.0 * i + offset + 0.01 * rng.standard_normal(n), i, x)


def test_means_of_a_current_with_one_sign_give_the_resistance():
    value, sd = mean_resistance(carried())
    assert abs(value - 4.0) < 2 * sd < 0.15
    assert mean_resistance(carried(offset=0.4))[0] == pytest.approx(4.4, abs=0.02)


def test_a_fixed_resistance_that_the_means_contradict_is_named():
    """However far it is, and first; beside an offset that makes the means it stands, as the record shows it."""
    ball, bench = ambid.simulate("levitated-ball", duration=2.0, seed=1), preset("levitated-ball")
    rig = rig_of_preset(bench)
    wrong = [replace(p, role="fixed", value=2.52) if p.name == "R" else p for p in rig.parameters]
    reasons = ambid.identify(ball, replace(rig, parameters=tuple(wrong))).verdict.reasons
    assert (reasons[0].check, reasons[0].cause, reasons[0].alternatives) == ("ohm", "fixed_value", ("ohm",))

    known = {k: sd for k, sd in SD.items() if k != "R"}
    theta = {**THETA, "R": 2.4}
    for step, passed in ((1.6, False), (0.01, True)):
        freed = {"R": ((step / 0.01) ** 2, np.array([0.0, step]))}
        assert agreements(carried(), default_rig(), theta, known, known, freed)["ohm"].passed is passed
    assert not agreements(carried(), default_rig(), theta, known, known)["ohm"].passed


def test_belonging_of_a_short_record_is_not_tested():
    short = carried(n=239)
    assert belonging(short).passed
    assert belonging(short).p is None
    assert "not tested" in belonging(short).detail
    assert belonging(carried(n=240)).p is not None


def test_means_of_opposite_signs_are_contradicted_before_any_fit():
    way = carried()
    back = replace(
        way, channels=tuple(replace(c, values=c.values * (-1.0) ** (c.name == "current")) for c in way.channels)
    )
    check = facts(back)["ohm"]
    assert facts(way)["ohm"].passed
    assert not check.passed
    assert check.cause == "ohm"
    assert "reversed" in check.detail


def test_what_the_means_contradict_is_told_also_where_the_record_is_refused():
    """A current that is reversed, or reads -8 A at rest beside a voltage in parts of the supply's."""
    ball = ambid.simulate("levitated-ball", duration=3.0, seed=1)
    columns = {c.name: c.values.copy() for c in ball.channels}
    units = {c.name: c.unit for c in ball.channels}
    with pytest.raises(EstimationError, match=r"^mean voltage over mean current is -4\.\d+ .*'current' is reversed"):
        ambid.identify(columns | {"current": -columns["current"]}, rate_hz=ball.rate_hz, units=units)
    shifted = columns | {"current": columns["current"] - 8.0, "voltage": columns["voltage"] / 12.0}
    estimate = ambid.identify(shifted, rate_hz=ball.rate_hz, units=units)
    assert not estimate.checks["ohm"].passed
    assert estimate.verdict.word != "usable"


def test_a_current_of_both_signs_gives_none():
    x = carried()
    both = record(x["voltage"].values, x["current"].values - 1.0, x["position"].values)
    assert mean_resistance(both) is None
    assert not one_sided(both["current"].values)
    assert one_sided(-x["current"].values)


def test_offset_is_within_the_stated_deviation():
    i = carried()["current"].values
    near = record(4.0 * i + 0.005 * 4.8, i, i)
    value, sd = mean_resistance(near)
    assert abs(value - 4.0) < 1.5 * sd


THETA = {"m": 0.1, "k_x": -50.0, "k_i": 2.0, "R": 4.0, "L": 0.04, "c": 0.0}
SD = {"R": 0.01, "L": 1e-4, "k_i": 0.01}


@pytest.mark.parametrize(("r", "passed"), [(4.0, True), (4.05, True), (4.4, False), (3.6, False)])
def test_a_resistance_that_the_means_contradict_is_named(r, passed):
    check = agreements(carried(), default_rig(), {**THETA, "R": r}, SD, SD)["ohm"]
    assert check.passed is passed
    assert check.cause == ("" if passed else "ohm")
    if not passed:
        assert check.size == pytest.approx(4.0 - r, abs=0.05)
        assert "offset" in check.detail


def test_what_the_flux_took_up_is_no_part_of_the_resistance():
    """A current that rises by half within 25 time constants of its coil, beside a position that sinks."""
    i = carried()["current"].values + np.linspace(-0.25, 0.25, 4000)
    x = 1e-3 * np.linspace(0.0, 1.0, 4000)
    v = 4.0 * i + 0.6 * np.gradient(i) * RATE - 20.0 * np.gradient(x) * RATE
    assert mean_resistance(record(v, i, x))[0] == pytest.approx(4.1, abs=0.02)
    theta = {**THETA, "L": 0.6, "k_i": -20.0}
    check = agreements(record(v, i, x), default_rig(), theta, SD, SD)["ohm"]
    assert check.values["value"] == pytest.approx(4.0, abs=0.02)


def test_a_current_of_another_run_does_not_belong():
    own, other = carried(1), carried(2)
    x = own["position"].values + 1e-8 * own["voltage"].values
    check = belonging(record(own["voltage"].values, other["current"].values, x))
    assert not check.passed
    assert "relates the current to" in check.detail


def test_positions_of_another_run_do_not_belong():
    own, other = carried(1), carried(2)
    assert belonging(own).passed
    mixed = record(own["voltage"].values, own["current"].values, other["position"].values)
    assert not belonging(mixed).passed
    assert facts(mixed)["belonging"].cause == "belonging"
    assert not agreements(mixed, default_rig(), THETA, {**SD, "k_i": 1.0}, SD)["belonging"].passed


def test_belonging_is_seldom_denied_and_never_where_the_force_shows():
    chances = [belonging(carried(seed)).passed for seed in range(20)]
    assert all(chances)
    mixed = record(carried(1)["voltage"].values, carried(1)["current"].values, carried(2)["position"].values)
    assert agreements(mixed, default_rig(), THETA, SD, SD)["belonging"].passed


def test_a_coil_that_the_fit_shows_relates_its_current_and_voltage():
    """In a short log whose noise hides both from each other; a position of another run stays alone."""
    own, rng = carried(1, 500), np.random.default_rng(1)
    v, i = (own[name].values + rng.standard_normal(500) for name in ("voltage", "current"))
    noisy = record(v, i, carried(2, 500)["position"].values)
    theta, unsure = {**THETA, "L": 0.04}, {**SD, "k_i": 1.0, "L": 0.1}
    assert "relates the position" not in belonging(noisy).detail
    assert not agreements(noisy, default_rig(), theta, unsure, SD)["belonging"].passed
    told = agreements(noisy, default_rig(), theta, {**unsure, "L": 1e-3}, SD)["belonging"]
    assert not told.passed
    assert "relates the position to" in told.detail


def test_slow_signals_of_two_runs_are_related_by_chance_only():
    """Random walks always look alike; whitened, at most a few of a hundred pairs do."""
    rng = np.random.default_rng(5)
    walks = np.cumsum(rng.standard_normal((100, 2, 2000)), axis=2)
    related = [belonging(record(w[0], w[0], w[1])).passed for w in walks]
    assert sum(related) <= 3


@pytest.mark.parametrize(
    ("inductance", "cause", "grave"), [(0.04, "", False), (6e-3, "sampling", False), (1e-3, "sampling", True)]
)
def test_a_coil_faster_than_the_sampling_is_named(inductance, cause, grave):
    check = agreements(carried(), default_rig(), {**THETA, "L": inductance}, {**SD, "L": 1e-5}, SD)["sampling"]
    assert (check.cause, check.grave) == (cause, grave)


def test_of_an_inductance_that_is_not_seen_a_bound_is_told():
    check = agreements(carried(), default_rig(), {**THETA, "L": 1e-14}, {**SD, "L": 1e-6}, SD)["sampling"]
    assert check.grave
    assert "less than 0.1 samples" in check.detail
    assert "50000 Hz" in check.detail


def test_voltage_that_changes_between_samples_is_seen():
    """A coil under a voltage that is held, logged at each sample, and at each tenth."""
    rng, n = np.random.default_rng(3), 20_000
    v, i = rng.standard_normal(n), np.zeros(n)
    for k in range(n - 1):
        i[k + 1] = 0.95 * i[k] + 0.05 * v[k]
    i += 1e-4 * rng.standard_normal(n)
    assert not between_samples(record(v, i, i**2))
    assert between_samples(record(v[::10], i[::10], i[::10] ** 2))
    slow = np.convolve(v, np.hanning(60), mode="same")
    assert not between_samples(record(slow, i, i**2))


@pytest.mark.parametrize("cause", ["sampling", "line"])
def test_of_a_log_that_does_not_hold_what_the_coil_got_the_coil_is_not_known(cause):
    bench = load_bench(ambid.simulate("thesis", duration=0.3, seed=1), default_rig())
    fit = greybox(default_rig().plant, signals_of(bench, default_rig().plant), default_rig().parameters)
    theta, spread = fit.problem.parameters(fit.vector), uncertainty(fit)
    named = Check(passed=False, detail="", cause="fixed_value", alternatives=(cause,))
    checks = {"causes": named, "ohm": facts(bench)["ohm"]}
    _, wider, _ = informed(fit, default_rig(), bench, checks, spread, robust=False)
    for name, before, after in zip(
        spread.names, spread.standard_deviations(robust=False), wider.standard_deviations(robust=False), strict=True
    ):
        unknown = cause == "sampling" and name in ("R", "L")
        assert after == pytest.approx(np.hypot(before, theta[name] if unknown else 0.0))


def test_a_log_that_stood_still_is_named_and_coarse_steps_are_not():
    x = carried()
    frozen = {c.name: c.values.copy() for c in x.channels}
    for values in frozen.values():
        values[1000:1012] = values[1000]
    check = facts(record(**frozen))["log_runs"]
    assert (check.passed, check.cause, check.values["longest"]) == (False, "stuck", 12.0)
    assert "1 s" in check.detail
    coarse = record(*(np.round(c.values / np.std(c.values) / 3) for c in x.channels))
    assert facts(coarse)["log_runs"].passed


def test_a_position_of_metres_is_grave():
    x = carried()
    far = record(x["voltage"].values, x["current"].values, x["position"].values + 18.5)
    assert facts(far)["position_size"].cause == "unit"


def test_two_contradicting_facts_are_do_not_use():
    estimate = ambid.identify(ambid.simulate("thesis", duration=0.5, seed=1))
    ohm = replace(estimate.checks["residuals_white"], passed=False, cause="ohm")
    one = replace(estimate, checks={**estimate.checks, "ohm": ohm})
    assert one.verdict.word == "caution"
    both = replace(one, checks={**one.checks, "gravity_balance": replace(ohm, cause="weight")})
    assert both.verdict.word == "unusable"
    assert {r.cause for r in both.verdict.reasons} == {"ohm", "weight"}


def test_causes_go_through_the_file(tmp_path):
    estimate = ambid.identify(ambid.simulate("thesis", duration=0.5, seed=1))
    line = replace(
        estimate.checks["causes"], passed=False, cause="line", size=50.0, alternatives=("slow_force",), grave=True
    )
    named = replace(estimate, checks={**estimate.checks, "causes": line})
    named.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.checks["causes"] == line
    reason = again.verdict.reasons[0]
    assert (reason.cause, reason.size, reason.alternatives, reason.grave) == ("line", 50.0, ("slow_force",), True)


def test_a_weight_that_one_magnet_carries_moves_an_estimate_and_its_intervals(tmp_path):
    """Of a record that hardly shows k_i the weight does, by the current's scale and no longer by the position's."""
    record = ambid.simulate("levitated-ball", duration=2.0, seed=1)
    columns = {c.name: c.values.copy() for c in record.channels}
    rng = np.random.default_rng(1)
    columns["position"] += 3e-5 * rng.standard_normal(columns["position"].size)
    units = {c.name: c.unit for c in record.channels}
    text = """schema = "ambid.rig/1"
model = "one-axis"
channels.voltage.column = "voltage"
channels.current.column = "current"
channels.position.column = "position"
parameters.m = {{ value = {m}, unit = "kg", role = "fixed" }}
parameters.c = {{ value = 0.0, unit = "N s/m", role = "fixed" }}
"""
    m = ambid.preset("levitated-ball").parameters["m"]
    made = {}
    for name, more in (("alone", ""), ("weighed", 'magnet.kind = "single"')):
        (tmp_path / f"{name}.toml").write_text(text.format(m=m) + more)
        made[name] = ambid.identify(columns, tmp_path / f"{name}.toml", rate_hz=record.rate_hz, units=units)
    expected = -2.0 * 9.81 / columns["current"].mean() * m
    alone, weighed = made["alone"]["k_i"], made["weighed"]["k_i"]
    assert weighed.sd < 0.02 * abs(expected) < alone.sd
    assert abs(weighed.value - expected) < 2.0 * weighed.sd
    assert abs(weighed.value - expected) < abs(alone.value - expected)
    assert "uses it" in made["weighed"].checks["gravity_balance"].detail
    assert made["alone"].calibration["position"]["k_i"] == pytest.approx(1.0, abs=0.2)
    assert abs(made["weighed"].calibration["position"]["k_i"]) < 0.3
    assert made["weighed"].calibration["current"]["k_i"] == pytest.approx(-1.0, abs=0.3)
