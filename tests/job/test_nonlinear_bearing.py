"""The job of the nonlinear bearing: records and rig in, curves with bands out."""

from dataclasses import replace

import numpy as np
import pytest

import ambid as package
from ambid.errors import EstimationError
from ambid.job.identification import identify_nonlinear
from ambid.job.nonlinear_bearing import Reading, take_record
from ambid.physics.coenergy_law import law_numbers
from ambid.physics.linear_model import Parameter
from ambid.physics.loop import Limits
from ambid.physics.presets import preset
from ambid.rig import load_rig, rig_of_preset
from ambid.simulation import simulate
from ambid.simulation.rig_bench import plant_of_rig

RIG = """schema = "ambid.rig/1"
name = "ball under one magnet"
model = "one-axis"
[channels.voltage]
column = "voltage"
[channels.current]
column = "current"
[channels.position]
column = "position"
[parameters]
m = {{ value = 60, unit = "g", role = "{role}" }}
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "ball.toml"
    path.write_text(RIG.format(role="fixed"), encoding="utf-8")
    return load_rig(path)


@pytest.fixture(scope="module")
def balls():
    """Two records of a levitated ball at 8 to 12 mm."""
    bench, done = preset("levitated-ball"), []
    for seed in (1, 2):
        n = 5000
        rng = np.random.default_rng(seed)
        setpoint = np.repeat(rng.uniform(8e-3, 12e-3, 10), n // 10)
        kick = np.repeat(rng.choice([-0.5, 0.5], n // 10), 10)
        done.append(
            simulate(
                bench.plant, kick, rate_hz=bench.rate_hz, seed=seed, loop=bench.loop, limits=bench.limits,
                noise=bench.noise, operating_point=bench.operating_point, setpoint=setpoint,
            ).record
        )  # fmt: skip
    return done


@pytest.fixture(scope="module")
def estimate(balls, rig):
    return identify_nonlinear(balls, rig)


def test_the_law_is_chosen_and_right(estimate):
    truth = law_numbers(preset("levitated-ball").plant.magnet.coenergy)
    assert estimate.status == "converged"
    assert estimate.law.gap == "hyperbolic"
    assert not estimate.law.saturation
    for name in ("k", "L_leak"):
        p = estimate.parameter(name)
        assert abs(p.value - truth[name]) < 4 * p.sd
        assert p.value == pytest.approx(truth[name], rel=0.03)
    assert abs(estimate.parameter("s").value) < 3e-4
    assert estimate.parameter("m").role == "fixed"
    assert estimate.checks["carries_its_weight"].passed


def test_curves_have_bands_that_hold_the_truth(estimate):
    magnet = preset("levitated-ball").plant.magnet.coenergy
    x, i = np.array([8e-3, 10e-3, 12e-3]), np.array([0.76, 0.95, 1.14])
    found = estimate.curves(x, i)
    for curve, exact in (
        (found.k_i, magnet.force_per_current), (found.k_x, magnet.displacement_coefficient),
        (found.L, lambda x, i: magnet.inductance(x)), (found.force, magnet.force),
    ):  # fmt: skip
        truth = np.array([exact(a, b) for a, b in zip(x, i, strict=True)])
        assert np.all(np.abs(curve.value - truth) < 4 * curve.sd)
        assert curve.value == pytest.approx(truth, rel=0.02)
        assert np.all((curve.low < curve.value) & (curve.value < curve.high))
    assert found.inside.all()


def test_extrapolation_is_flagged(estimate):
    assert not estimate.curves([2e-3, 10e-3], [0.95, 3.0]).inside.any()


def test_bands_are_those_of_the_delta_method(estimate):
    # by finite differences of the whole curve in every estimated number
    x, i = np.array([9e-3]), np.array([0.9])
    names, values = estimate.covariance_names, estimate.values
    slopes = []
    for name in names:
        h = 1e-5 * (abs(values[name]) or 1e-3)
        up, down = ({**values, name: values[name] + d} for d in (h, -h))
        slopes.append((estimate.law.table(x, i, up)[0] - estimate.law.table(x, i, down)[0])[0] / (2 * h))
    variance = np.einsum("jc,jk,kc->c", np.array(slopes), estimate.covariance, np.array(slopes))
    found = estimate.curves(x, i)
    sds = [found.force.sd[0], found.k_x.sd[0], found.k_i.sd[0], found.L.sd[0]]
    assert np.sqrt(variance) == pytest.approx(sds, rel=1e-4)


def test_an_interruption_ends_all_stages_and_keeps_the_best(balls, rig):
    stages = []

    def tick(stage, done=None):
        stages.append(stage)
        if stage == "identify" and stages.count(stage) == 4:
            raise KeyboardInterrupt

    found = identify_nonlinear(balls[:1], rig, tick=tick)
    assert found.status == "stalled"
    assert stages.count("identify") == 4
    assert any("did not converge" in w for w in found.warnings)


def test_what_is_asked_wrongly_is_refused(balls, rig):
    with pytest.raises(EstimationError, match="no record with a moving rotor"):
        identify_nonlinear([], rig, held=balls)


def test_a_rotor_at_its_stops_and_a_command_beyond_the_supply_are_told(balls, rig):
    x, u = balls[0]["position"], balls[0]["voltage"]
    free = take_record(balls[0], replace(rig, limits=Limits(position=(0.0, float(x.max()) + 1e-3))), Reading())
    assert free.warnings == ()
    assert free.record.knock is None
    taken = take_record(balls[0], replace(rig, limits=Limits(position=(0.0, float(np.quantile(x, 0.5))))), Reading())
    assert "is treated as unknown" in taken.warnings[0]
    assert "rests on a stop" in taken.warnings[1]
    assert np.count_nonzero(taken.record.cut) == taken.record.u.size - taken.record.kept.shape[0] > 0
    with pytest.raises(EstimationError, match="nowhere free for 100 samples"):
        take_record(balls[0], replace(rig, limits=Limits(position=(0.0, float(x.min())))), Reading())
    high = float(np.quantile(u, 0.9))
    taken = take_record(balls[0], replace(rig, limits=Limits(voltage=(0.0, high))), Reading())
    assert taken.record.u.max() == high
    assert taken.record.u.size == u.size  # none thrown away
    assert "replaced by the limit" in taken.warnings[0]


def test_one_signal_in_two_channels_is_refused_and_a_held_rotor_that_moves_is_told(balls, rig):
    from ambid.job.nonlinear_bearing import Reading, bearing_rig, check_together, take_record

    bench = bearing_rig(rig)
    free = take_record(balls[0], bench, Reading())
    twice = replace(free.record, y=np.column_stack([1e-4 * free.record.y[:, 1] + 0.01, free.record.y[:, 1]]))
    with pytest.raises(EstimationError, match="position and current are the same signal up to scale and offset"):
        check_together([replace(free, record=twice)], None)
    rocking = take_record(balls[1], bench, Reading(), held=True)
    (moving, told) = check_together([free, rocking], None)
    assert not moving.warnings
    assert "declared held, but its position scatters by" in told.warnings[-1]


def test_a_failed_search_is_refused_in_words(balls, rig, monkeypatch):
    from types import SimpleNamespace

    monkeypatch.setattr(
        "ambid.bearing.magnet_estimate.estimate_bearing", lambda *_, **__: SimpleNamespace(status="failed")
    )
    with pytest.raises(EstimationError, match="the search ended without a stable predictor"):
        identify_nonlinear(balls, rig)


FREE = ("g",)  # numbers of the magnet that stay known


def ball(*, leak=None, **numbers):
    """A rig of the levitated ball whose law has these numbers, and one that knows nothing of it but gravity."""
    rig = rig_of_preset(preset("levitated-ball"))
    given = tuple(
        replace(p, value=leak) if p.name == "L_leak" and leak is not None else p for p in rig.magnet.parameters
    )
    more = tuple(Parameter(name=n, unit="1/A^2", value=x, role="fixed") for n, x in numbers.items())
    known = tuple(p for p in rig.magnet.parameters if p.name in FREE)
    true = replace(rig, magnet=replace(rig.magnet, saturation="sigma" in numbers, parameters=(*given, *more)))
    return true, replace(rig, magnet=replace(rig.magnet, parameters=known))


def test_a_leakage_that_is_none_is_judged_by_what_it_moves():
    """No record shows nothing to a part of itself; of L, k_x and k_i it moves a few per cent at most."""
    true, told = ball(leak=0.0)
    for seed in (1, 2, 3):
        found = identify_nonlinear(package.simulate(true, duration=3.0, seed=seed, nonlinear=True), told)
        leak = found.parameter("L_leak")
        assert abs(leak.value) < 4.0 * leak.sd
        assert leak.sd > 0.25 * leak.value
        assert leak.identifiable
        assert found.verdict.word == "usable"


@pytest.fixture(scope="module")
def contradicting():
    """Estimates from two records each, at two gaps, by a law without the saturation that the bench has."""
    true, told = ball(sigma=0.3)
    told = replace(told, magnet=replace(told.magnet, saturation=False))
    found = []
    for seed in range(3):
        places = enumerate((0.008, 0.012))
        records = [
            package.simulate(true, duration=3.0, seed=10 * seed + j, nonlinear=True, position=x) for j, x in places
        ]
        found.append(identify_nonlinear(records, told))
    return true, found


@pytest.mark.parametrize("seed", range(3))
def test_saturation_is_found_in_one_record_at_one_gap(seed):
    """Without it the residuals are white in two of these records, and k_i, which the weight then fixes to a part in ten
    thousand, is six per cent off. The first 4000 samples do not show it."""
    true, told = ball(sigma=0.3)
    found = identify_nonlinear(package.simulate(true, duration=3.0, seed=seed, nonlinear=True, position=0.01), told)
    law = plant_of_rig(true).magnet
    assert found.law.saturation
    assert not found.law.rise
    x = found.operating_point["position"]
    i = law.holding_current(x, 0.06 * 9.81)
    at = found.curves(x, i)
    for curve, truth in ((at.k_x, law.displacement_coefficient(x, i)), (at.k_i, law.force_per_current(x, i))):
        assert abs(curve.value[0] - truth) < 3.5 * curve.sd[0]


def test_records_that_contradict_each_other_are_told_and_their_intervals_hold_the_truth(contradicting):
    """Two places fix two numbers of any law by the weight alone, a hundred times more sharply than the motion does: the
    residuals are white, and k_x is five per cent off."""
    true, found = contradicting
    law = plant_of_rig(true).magnet
    for estimate in found:
        assert "records_agree" in {r.check for r in estimate.verdict.reasons}
        x = estimate.operating_point["position"]
        i = law.holding_current(x, 0.06 * 9.81)
        at = estimate.curves(x, i)
        for curve, truth in ((at.k_x, law.displacement_coefficient(x, i)), (at.k_i, law.force_per_current(x, i))):
            assert abs(curve.value[0] - truth) < 3.0 * curve.sd[0]


def test_sound_records_agree(estimate):
    assert estimate.checks["records_agree"].passed
    assert estimate.covariance_method == "information"


def test_facts_of_a_record_are_compared_with_the_estimate():
    """An offset of the voltage lets the means contradict R, unless the rig says that there is one, or the estimate
    does, and it is of a stage's size.
    """
    _, told = ball()
    record = package.simulate("levitated-ball", duration=1.0, seed=2, nonlinear=True)
    far = 0.05 * float(record["voltage"].values.mean())
    moved, farther = (
        replace(
            record,
            channels=tuple(replace(c, values=c.values + x) if c.name == "voltage" else c for c in record.channels),
        )
        for x in (far, 4.0 * far)
    )
    sound, explained, contradicted = (identify_nonlinear(x, told) for x in (record, moved, farther))
    check = explained.checks["ohm"]
    assert (check.passed, explained.verdict.word) == (True, "usable")
    assert explained["R"].sd > 0.9 * abs(check.size)
    assert abs(explained["v_offset"].value + far) < 2.0 * explained["v_offset"].sd
    assert any("only known together" in w for w in explained.warnings)
    assert {"ohm", "belonging", "sampling", "log_runs", "position_size"} <= sound.checks.keys()
    assert sound.verdict.word == "usable"
    check = contradicted.checks["ohm"]
    assert (check.passed, check.cause) == (False, "ohm")
    assert contradicted["R"].sd > 0.9 * abs(check.size)
    given = Parameter(name="v_offset", unit="V", value=far, role="prior", sd=0.1 * far)
    rig = replace(told, magnet=replace(told.magnet, parameters=(*told.magnet.parameters, given)))
    assert identify_nonlinear(moved, rig).checks.get("ohm") is None


def test_facts_are_those_of_the_voltage_that_counts():
    """A command beyond the limit never came to the coil: its mean tells nothing of R."""
    _, told = ball()
    record = package.simulate("levitated-ball", duration=1.0, seed=2, nonlinear=True)
    x = record["voltage"].values
    high = float(np.quantile(x, 0.99))
    channels = (
        replace(c, values=np.where(x >= high, 10.0 * x, x)) if c.name == "voltage" else c for c in record.channels
    )
    limits = Limits(voltage=(float(x.min()) - 1.0, high))
    found = identify_nonlinear(replace(record, channels=tuple(channels)), replace(told, limits=limits))
    assert any("beyond loop.limits.voltage" in w for w in found.warnings)
    assert found.checks["ohm"].passed
    assert found.checks["ohm"].values["value"] == pytest.approx(found["R"].value, rel=0.02)
