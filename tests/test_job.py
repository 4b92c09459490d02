"""The main job as a script calls it: record and rig in, checked estimate out."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import AmbidError, EstimationError
from ambid.job import identify, load_bench, signals_of
from ambid.physics.linear_model import Parameter, model
from ambid.physics.presets import preset
from ambid.record import Channel, Record, write_record
from ambid.rig import default_rig
from ambid.signals import multisine
from ambid.simulation import simulate_preset

AXIS = ("m", "k_x", "k_i", "R", "L")
BEARING = preset("unstable-bearing")


def record(name="unstable-bearing", n=4000, seed=1, rms=5.0, **settings):
    p = preset(name)
    u = multisine(n, p.rate_hz, amplitude=rms, band=(5.0, 0.1 * p.rate_hz), seed=seed, amplitude_is="rms")
    return simulate_preset(p, u, seed=seed, **settings).record


def with_parameter(rig, **changes):
    return replace(rig, parameters=tuple(changes.get(p.name, p) for p in rig.parameters))


@pytest.fixture(scope="module")
def estimate():
    return identify(record())


def test_nothing_but_a_record_is_needed(estimate):
    assert estimate.passed
    assert not estimate.warnings
    for name in AXIS:
        p = estimate.parameter(name)
        assert p.role == "free"
        assert p.identifiable
        assert abs(p.value - BEARING.parameters[name]) < 3.3 * p.sd
        assert p.ci95[0] < p.value < p.ci95[1]
    assert estimate.delay["voltage"].how == "estimated"
    assert estimate.delay["voltage"].samples + estimate.delay["voltage"].fraction == pytest.approx(1.0, abs=0.05)
    assert estimate.covariance_method == "information"


def test_noise_is_told_in_si_units():
    found = identify(record(n=16_000, seed=2)).noise
    # held over a sample: the rms that the preset was made with
    assert found.form == "levels"
    assert found.sensor_sd["position"] == pytest.approx(BEARING.noise.position, rel=0.1)
    assert found.sensor_sd["current"] == pytest.approx(BEARING.noise.current, rel=0.1)
    force, voltage = BEARING.noise.held_rms(BEARING.rate_hz)
    assert found.disturbance_sd["force"] == pytest.approx(force, rel=0.3)
    assert found.disturbance_sd["voltage"] == pytest.approx(voltage, rel=0.5)


def test_a_file_and_its_values_give_the_same(estimate, tmp_path):
    path = tmp_path / "bench.csv"
    write_record(record(), path)
    found = identify(path)
    assert found.record["file"] == "bench.csv"
    assert found.record["sha256"]
    for p in estimate.parameters:
        assert found.parameter(p.name).value == pytest.approx(p.value, abs=0.01 * p.sd + 1e-12)


def test_a_part_of_the_record_can_be_taken():
    found = identify(record(), from_s=0.05, to_s=0.15)
    assert found.record["samples"] == pytest.approx(2000, abs=1)
    assert any("cut" in step for step in found.record["history"])
    with pytest.raises(AmbidError):
        identify(record(), from_s=5.0)


def test_the_nonlinear_bearing_gives_its_linearisation():
    # small motion about the middle of the gap: what is found is the linear plant at the operating point
    found = identify(record(n=8000, seed=3, nonlinear=True))
    for name in AXIS:
        p = found.parameter(name)
        assert abs(p.value - BEARING.parameters[name]) < 4 * p.sd + 0.01 * abs(p.value)


def test_gravity_and_a_gap_are_only_an_operating_point():
    ball = preset("levitated-ball")
    rec = record("levitated-ball", n=20_000, seed=4, rms=0.5, nonlinear=True)
    rig = with_parameter(default_rig(), m=Parameter(name="m", unit="kg", role="fixed", value=ball.parameters["m"]))
    found = identify(rec, rig)
    assert found.operating_point["position"] == pytest.approx(0.010, rel=0.05)
    assert found.operating_point["current"] == pytest.approx(0.95, rel=0.05)
    for name in ("k_x", "k_i", "R", "L"):
        p = found.parameter(name)
        assert abs(p.value - ball.parameters[name]) < 4 * p.sd + 0.03 * abs(p.value), name
    # gravity balance: k_i/m = -2 g/i0
    assert found.values["k_i"] / found.values["m"] == pytest.approx(-2 * 9.81 / 0.95, rel=0.1)


def test_fixed_and_prior_parameters(estimate):
    m = BEARING.parameters["m"]
    fixed = identify(record(), with_parameter(default_rig(), m=Parameter(name="m", unit="kg", role="fixed", value=m)))
    assert fixed.parameter("m").value == m
    assert fixed.parameter("m").sd == 0
    assert fixed.parameter("m").identifiable
    assert "m" not in fixed.covariance_names
    sd = estimate.parameter("m").sd
    # a prior as good as the data halves the variance, and says that half came from the data
    prior = Parameter(name="m", unit="kg", role="prior", value=estimate.values["m"] + sd, sd=sd)
    both = identify(record(), with_parameter(default_rig(), m=prior)).parameter("m")
    assert both.value == pytest.approx(estimate.values["m"] + 0.5 * sd, abs=0.08 * sd)
    assert both.sd == pytest.approx(sd / np.sqrt(2), rel=0.05)
    assert both.data_share == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("off", [-14, 14])
def test_a_prior_against_the_data_does_not_pass_unnoticed(estimate, off):
    # ten standard deviations of the data away, and held as tightly as they hold: one of the two is wrong
    free = estimate.parameter("R")
    prior = Parameter(name="R", unit="ohm", role="prior", value=free.value + off * free.sd, sd=free.sd)
    found = identify(record(), with_parameter(default_rig(), R=prior))
    assert not found.passed


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_given_delay_is_taken(delay):
    rig = default_rig()
    rig = replace(rig, channels=tuple(replace(c, delay=delay) if c.role == "voltage" else c for c in rig.channels))
    found = identify(record(), rig)
    assert (found.delay["voltage"].samples, found.delay["voltage"].how) == (delay, "given")
    assert found.passed == (delay == 1)
    if delay != 1:
        assert found.covariance_method == "robust"
        assert found.warnings


def test_a_second_record_is_judged_with_it():
    found = identify(record(), validate=record(seed=5))
    assert found.validation["passed"]
    assert set(found.validation["fit"]) == {"position", "current"}


@pytest.mark.parametrize("name", ["coil", "rotor"])
def test_other_models(name):
    p, rec = BEARING.parameters, record(n=8000)
    plant = model(name)
    rig = default_rig(name)
    if name == "rotor":
        rig = with_parameter(rig, m=Parameter(name="m", unit="kg", role="fixed", value=p["m"]))
        found = identify(
            Record(rate_hz=rec.rate_hz, channels=tuple(c for c in rec.channels if c.name != "voltage")), rig
        )
        for k in ("k_x", "k_i"):
            q = found.parameter(k)
            # sensor noise on the current is noise on the input here: it may cost a little
            assert abs(q.value - p[k]) < 4 * q.sd + 0.02 * abs(p[k])
    else:
        # a rotor that moves induces a voltage that the coil alone does not know
        found = identify(rec, rig)
        assert not found.passed
    assert found.model == plant.name


def test_ratios_to_the_mass_are_said_to_be_ratios():
    rec = record(n=4000)
    found = identify(Record(rate_hz=rec.rate_hz, channels=rec.channels[1:]), default_rig("rotor"))
    assert not found.passed
    assert not any(found.parameter(k).identifiable for k in ("m", "k_x", "k_i"))
    assert "ratios of m, k_x and k_i" in found.checks["identifiable"].detail
    assert any("ratios of m, k_x and k_i" in w for w in found.warnings)


def test_equal_records_give_equal_estimates(estimate):
    again = identify(record())
    assert again.values == estimate.values
    np.testing.assert_array_equal(again.covariance, estimate.covariance)


def renamed(rec, **roles):
    units = {"voltage": "V", "current": "A", "position": "m"}
    return replace(
        rec, channels=tuple(Channel(name=to, unit=units[to], values=rec[source]) for to, source in roles.items())
    )


def damaged(kind):
    if kind == "voltage is the current":  # short: a hopeless record is searched globally
        return renamed(record(n=1500), voltage="current", current="voltage", position="position")
    rec = record()
    if kind == "position upside down in the second half":
        x = rec["position"].values.copy()
        x[2000:] *= -1
        return replace(rec, channels=(*rec.channels[:2], Channel(name="position", unit="m", values=x)))
    if kind == "stuck for a while":
        x = rec["position"].values.copy()
        x[1000:1800] = x[1000]
        return replace(rec, channels=(*rec.channels[:2], Channel(name="position", unit="m", values=x)))
    raise AssertionError(kind)


@pytest.mark.parametrize(
    "kind", ["voltage is the current", "position upside down in the second half", "stuck for a while"]
)
def test_a_damaged_record_is_refused_or_fails_a_check(kind):
    try:
        found = identify(damaged(kind))
    except EstimationError as refused:
        assert "\n" not in str(refused)  # noqa: PT017  either answer is right
        return
    assert not found.passed
    assert found.warnings


def test_a_sensor_turned_round_turns_the_signs_that_hang_on_it(estimate):
    rec = record()
    turned = replace(rec, channels=(*rec.channels[:2], Channel(name="position", unit="m", values=-rec["position"])))
    other = identify(turned)
    for name, sign in (("m", 1), ("k_x", 1), ("k_i", -1), ("R", 1), ("L", 1)):
        p = estimate.parameter(name)
        assert other.values[name] == pytest.approx(sign * p.value, abs=0.05 * p.sd)


def test_stages_are_told_and_may_be_interrupted():
    stages = []
    identify(record(n=2000), tick=stages.append)
    assert set(stages) >= {"identify", "check"}

    class StopNow(Exception):
        pass

    def stop(stage):
        raise StopNow(stage)

    with pytest.raises(StopNow):
        identify(record(n=2000), tick=stop)


def test_times_are_told(estimate):
    assert set(estimate.timing_s) >= {"read", "fit", "checks"}
    assert all(t >= 0 for t in estimate.timing_s.values())


def test_load_cuts_and_signals_take_their_order_from_the_model():
    rec = load_bench(record(), default_rig(), from_s=0.01)
    s = signals_of(rec, model("one-axis"))
    assert s.u.shape == (rec.n_samples, 1)
    np.testing.assert_array_equal(s.y[:, 0], rec["position"])
    np.testing.assert_array_equal(s.y[:, 1], rec["current"])
