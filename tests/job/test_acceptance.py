"""The acceptance report of a spindle on five axes, from simulated records, and what it says where one is missing."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import ambid
from ambid.control.acceptance import PARTS, dynamic_stiffness
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.limits import vibration_limit
from ambid.errors import EstimationError, RigError
from ambid.estimation.modes import EstimatedNumber
from ambid.job.acceptance_items import Machine, _beside, _critical, _scaled
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.rig.rig import RigMagnet
from ambid.rig.rotor import Operation, operation_of
from ambid.rig.schema import OperationEntry
from ambid.rotor.passage import whirl_of
from ambid.rotor.resonance import Peak, Resonance, Resonances
from ambid.simulation.rotor_bench import RotorBench
from ambid.simulation.variation import Schedule

RPM = math.pi / 30.0
OPERATION = Operation(maximum_speed=30_000.0 * RPM, minimum_speed=25_000.0 * RPM, touch_down=0.2e-3)


@pytest.fixture(scope="module")
def spindle():
    """A record at speed, the machine identified from it, and its acceptance."""
    rig = replace(rig_of_preset(preset("spindle")), operation=OPERATION)
    how = {"duration": 0.5, "periods": 2, "excitation": "zippered", "band": (8.0, 500.0)}
    record = ambid.simulate(rig, seed=3, **how)
    estimate = ambid.identify(record, rig)
    accepted = ambid.accept(record, rig, estimate=estimate)
    return SimpleNamespace(rig=rig, record=record, estimate=estimate, accepted=accepted)


def test_every_part_of_the_report_says_something(spindle):
    assert {x.part for x in spindle.accepted.items} == set(PARTS)
    for x in spindle.accepted.items:
        assert (x.value is None) == (x.outcome == "missing"), x
        assert x.words.endswith("would") or x.outcome != "missing", x


def test_a_radial_clearance_says_nothing_along_the_shaft(spindle):
    along = next(b.name for b in spindle.rig.rotor.bearings if b.axial)
    (item,) = [x for x in spindle.accepted.of("vibration") if x.what.startswith(f"bearing {along},")]
    assert (item.outcome, item.words) == ("missing", "a rig with operation.axial_touch_down would")


def test_sensitivities_are_those_of_margins(spindle):
    items, known = spindle.accepted.of("sensitivity"), spindle.estimate.sensitivity
    assert [x.what.split()[1].rstrip(",") for x in items] == ["ax", "ay", "bx", "by", "az"]
    of_speed = spindle.accepted.margins["record"].sensitivity
    assert of_speed["bx"].peak_db.value == pytest.approx(known["bx"]["peak_db"]["value"], abs=1e-6)
    for item, axis in zip(items, of_speed, strict=True):
        assert item.value == of_speed[axis].rating.value
        assert item.outcome == "passed"
        assert "zone A" in item.words


def test_stiffness_and_damping_are_those_of_the_true_bearings(spindle):
    """Of every axis, at the maximum speed, by the numbers that made the records and the loop of the bench."""
    theta = {p.name: p.value for p in spindle.rig.parameters} | dict(preset("spindle").parameters)
    model, rate, top = spindle.rig.rotor, spindle.rig.rate_hz, OPERATION.maximum_speed
    plant = Plant(model=model, theta=theta, delays=np.ones(5), rate_hz=rate)
    controller = controller_of_loop(spindle.rig.loop, model, rate)
    loop = ClosedLoop(plant=plant, controller=controller, frequency_hz=np.array([top / (2.0 * math.pi)]))
    of_bearings = {x.what: x for x in spindle.accepted.of("bearings")}
    for axis, D in zip(model.axes, dynamic_stiffness(loop)[0], strict=True):
        for what, true in (("stiffness", D.real), ("damping", D.imag / top)):
            x = of_bearings[f"{what} at 30000 1/min, axis {axis}"]
            assert 0.0 < x.sd < 0.05 * abs(x.value)
            assert abs(x.value - true) < 4.0 * x.sd


def test_the_displacement_is_within_the_clearance(spindle):
    for x in (x for x in spindle.accepted.of("vibration") if x.value is not None):
        assert x.limit == pytest.approx(0.4 * 0.2e-3)
        assert not x.confirmed
        assert x.value < 10e-6


def test_the_unbalance_is_that_of_the_bench(spindle):
    static = next(x for x in spindle.accepted.of("unbalance") if x.what == "unbalance, static")
    assert abs(static.value - spindle.rig.unbalance[0].value) < 4.0 * static.sd
    assert static.limit == pytest.approx(6350e-6 * spindle.estimate["m"].value / 30_000.0)


def test_an_excitation_on_the_speed_is_taken_out(spindle):
    """The run at 500 Hz is excited there too; what is left is the unbalance, alike in both axes of a bearing."""
    at = {x.what.split()[2]: x for x in spindle.accepted.of("unbalance") if "vibration" in x.what}
    for one, other in (("ax", "ay"), ("bx", "by")):
        assert abs(at[one].value - at[other].value) < 4.0 * math.hypot(at[one].sd, at[other].sd)


def test_what_no_record_shows_names_the_record_that_would(spindle):
    missing = {x.what: x.words for x in spindle.accepted.items if x.outcome == "missing"}
    assert "run-up or coast-down" in missing["critical speeds"]
    assert "stops" in missing["the clearance itself"]
    assert not spindle.accepted.checks["complete"].passed


def test_it_comes_back_from_its_file(spindle, tmp_path):
    spindle.accepted.save(tmp_path / "a.json")
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["schema"] == "ambid.acceptance/1"
    again = ambid.load(tmp_path / "a.json")
    assert again.items == spindle.accepted.items
    assert again.verdict == spindle.accepted.verdict
    assert again.summary() == spindle.accepted.summary()


def test_its_page_has_every_part_with_its_limit_and_source(spindle, tmp_path):
    spindle.accepted.report(tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    for title in PARTS.values():
        assert title in page
    for word in ("unconfirmed", "ISO 14839-2:2004", "API 617, 9th edition", "SHA-256", "these records cannot show it"):
        assert word in page


def test_one_axis_is_refused():
    rig = rig_of_preset(preset("rmit-axis"))
    with pytest.raises(EstimationError, match="of one axis"):
        ambid.accept(ambid.simulate("rmit-axis", duration=0.2, seed=1), rig)


def mode(speed, factor, sd):
    """A resonance of a run-up, speed in rad/s."""
    number = EstimatedNumber.of
    return Resonance(
        speed=number(speed, 0.1), amplification=number(factor, sd), half_power=True, critically_damped=factor < 2.5,
        frequency=number(speed, 0.1), damping=number(0.5 / factor, 0.01), forward=1.0,
        measured=None, plane="A",
    )  # fmt: skip


def critical(*modes, fastest=2500.0):
    found = Resonances(resonances=modes, speed=np.zeros(0), response=np.zeros((0, 0)), roles=(), misfit=1.0)
    machine = SimpleNamespace(
        resonances=found, speeds=(1800.0, 2000.0), passages={"run": SimpleNamespace(speed=np.array([fastest]))},
        estimate=SimpleNamespace(synchronous={}),
    )  # fmt: skip
    return {x.what: x for x in _critical(machine, None)}


def test_a_well_damped_mode_without_half_power_points_has_no_critical_speed():
    damped = mode(1700.0, 1.2, 0.1)
    damped = replace(damped, half_power=False, speed=replace(damped.speed, identifiable=False))
    items = critical(damped)
    assert not {"critical speed 1", "separation 1"} & set(items)
    assert "too well damped" in items["amplification factor 1"].words


def test_an_amplification_factor_that_may_be_above_the_limit_is_no_critical_damping():
    item = critical(mode(1790.0, 2.45, 0.2))["separation 1"]
    assert item.outcome == "doubt"
    assert "separation 1" not in critical(mode(1790.0, 2.0, 0.1))


def test_a_run_up_to_the_maximum_speed_ends_there():
    assert "critical speeds up to the maximum" not in critical(fastest=1999.0)
    assert critical(fastest=1900.0)["critical speeds up to the maximum"].outcome == "missing"


def test_run_out_is_in_the_spread_of_a_critical_speed():
    moved, near = _beside(mode(1010.0, 4.0, 0.01), [Peak(speed=1000.0, size=1.0, lower=900.0, upper=1140.0)])
    assert moved.speed.sd == pytest.approx(10.0, rel=1e-3)
    assert moved.amplification.sd == pytest.approx(abs(near.amplification - 4.0), rel=0.01)
    assert _beside(mode(1010.0, 4.0, 0.01), [])[0].speed.sd == 0.1


def test_the_scaled_response_is_that_of_a_held_speed_where_a_run_up_passed_too_fast():
    speed, roles = np.linspace(500.0, 2500.0, 201), ("ax_position", "ay_position")
    passed = np.outer(2e-6 + 8e-6 * np.exp(-(((speed - 1000.0) / 100.0) ** 2)), [1.0, -1j])
    run = SimpleNamespace(
        speed=speed, roles=roles, amplitude=passed, planes=(("A", 0, 1),),
        whirl=lambda _: whirl_of(passed, np.full(passed.shape, 1e-8)),
    )  # fmt: skip
    held = SimpleNamespace(roles=roles, speed=np.array([990.0]), response=np.array([[20e-6, -20e-6j]]))
    machine = SimpleNamespace(
        clearance=lambda: 70e-6, speeds=(1900.0, 2100.0), passages={"run": run}, resonances=held, gain_sd=lambda _: 0.0
    )  # fmt: skip
    item = next(_scaled(machine))
    assert item.value == pytest.approx(10.0 * vibration_limit(2100.0), rel=1e-6)
    assert item.outcome == "failed"
    machine.resonances = None
    assert next(_scaled(machine)).outcome == "passed"


def test_a_machine_is_judged_by_its_own_clearances_and_speeds(spindle):
    machine = Machine(spindle.estimate, replace(spindle.rig, limits=None), ())
    assert machine.clearance() == 0.2e-3
    assert machine.clearance(axial=True) is None
    assert [machine.operates_at(n * RPM) for n in (3_000.0, 24_900.0, 30_000.0)] == [False, True, True]


def test_the_synchronous_part_is_taken_out_once(spindle, monkeypatch):
    from ambid.rotor import synchronous

    def never(*_):
        raise AssertionError("the synchronous part is apart already")

    monkeypatch.setattr(synchronous, "separate", never)
    accepted = ambid.accept(spindle.record, spindle.rig)
    for p in spindle.estimate.parameters:
        assert accepted.estimate[p.name].value == pytest.approx(p.value, abs=0.1 * p.sd), p.name


def test_a_dead_sensor_is_refused(spindle):
    dead = tuple(
        replace(c, values=np.zeros(c.values.size)) if c.name == "bx_position" else c for c in spindle.record.channels
    )
    with pytest.raises(EstimationError, match="bx_position is the same in every sample"):
        ambid.accept(replace(spindle.record, channels=dead), spindle.rig, estimate=spindle.estimate)
    with pytest.raises(EstimationError, match="has 1 samples; a rotor needs"):
        ambid.accept(spindle.record, spindle.rig, estimate=spindle.estimate, from_s=0.49991)


def test_a_record_that_turns_is_not_taken_as_at_rest(spindle):
    with pytest.raises(EstimationError, match=r"is given as at rest, and turns \d+ times by its own account"):
        ambid.accept(spindle.record, spindle.rig, estimate=spindle.estimate, speed_rpm=0.0)


def test_a_clearance_beyond_reason_is_refused(spindle):
    wide = OperationEntry(touch_down={"value": 250.0, "unit": "mm"})
    with pytest.raises(RigError, match=r"operation\.touch_down is 250 mm; no touch-down bearing leaves more than 5 mm"):
        operation_of(wide, "rig.toml")
    magnet = RigMagnet(kind="pair", parameters=(Parameter(name="s", unit="m", role="fixed", value=0.1e-3),))
    with pytest.raises(EstimationError, match="200 um, wider than the air gap of the magnets, 100 um"):
        ambid.accept(spindle.record, replace(spindle.rig, magnet=magnet), estimate=spindle.estimate)


def test_a_record_of_another_machine_and_another_speed_is_told(spindle):
    heavier = tuple(replace(p, value=1.4 * p.value) if p.name in ("m", "Id") else p for p in spindle.rig.parameters)
    how = {"duration": 0.5, "periods": 2, "excitation": "zippered", "band": (8.0, 500.0)}
    record = ambid.simulate(replace(spindle.rig, parameters=heavier), seed=3, force=True, **how)
    accepted = ambid.accept(record, spindle.rig, estimate=spindle.estimate, speed_rpm=5000.0)
    assert "agreement" not in spindle.accepted.checks
    assert "the plant is not that of this record" in accepted.checks["agreement"].detail
    assert "not 5000 rpm as given" in accepted.warnings[0]


@pytest.fixture(scope="module")
def run_up(spindle):
    """The acceptance for 15,000 rpm by a run-up to 20,000, and by the rotor moved along its stops."""
    slower = replace(spindle.rig, operation=Operation(maximum_speed=15_000.0 * RPM))
    bench = RotorBench.of(slower, None, None)
    ramp = Schedule.ramp(500.0 * RPM, 20_000.0 * RPM, 0.0, 2.0)
    records = [bench.run_up(ramp, 40_000, seed=5).record, stops(spindle, 0.19e-3)]
    return SimpleNamespace(accepted=ambid.accept(records, slower, estimate=spindle.estimate))


def stops(spindle, clearance):
    """A record at rest in which every axis goes round its clearance, and comes to stand at it."""
    record = spindle.record
    angle = 2.0 * np.pi * np.linspace(0.0, 5.0, record.n_samples)
    way = {"x": np.cos(angle), "y": np.sin(angle), "z": np.sin(angle)}

    def moved(channel):
        if channel.name.endswith("_position"):
            return replace(channel, values=clearance * way[channel.name[1]])
        return replace(channel, values=np.zeros(record.n_samples)) if channel.name.endswith("_reference") else channel

    return replace(record, channels=tuple(moved(c) for c in record.channels if c.name != "angle"))


def test_a_run_up_shows_critical_speeds_and_the_scaled_response(run_up):
    assert [r["kind"] for r in run_up.accepted.records] == ["run-up", "stops"]
    assert run_up.accepted.records[0]["speed"] == pytest.approx(20_000.0 * RPM, rel=1e-3)
    assert not [x for x in run_up.accepted.items if x.outcome == "missing" and x.part in ("critical", "touch_down")]
    scaled = [x for x in run_up.accepted.of("unbalance") if "scaled" in x.what]
    assert {x.outcome for x in scaled} == {"passed"}
    assert scaled[0].limit == pytest.approx(1.5 * 0.2e-3)
    vibration = [x for x in run_up.accepted.of("unbalance") if "vibration" in x.what]
    assert [x.limit for x in vibration] == [pytest.approx(25.4e-6 * math.sqrt(12_000.0 / 15_000.0))] * 4


def test_the_stops_show_the_clearance(run_up):
    clear = [x for x in run_up.accepted.of("touch_down") if x.what.startswith("clearance")]
    assert [x.what for x in clear] == ["clearance, bearing A", "clearance, bearing B", "clearance, bearing T"]
    assert [x.value for x in clear] == [pytest.approx(0.19e-3, rel=5e-3)] * 3


def test_run_ups_alone_say_which_records_are_missing(run_up):
    missing = {x.what: x.words for x in run_up.accepted.items if x.outcome == "missing"}
    assert "excitation logged as reference" in missing["all axes"]
    assert {"force by displacement", "steady operation", "axis ax"} <= set(missing)


def test_a_clearance_that_the_rig_does_not_give_is_that_of_its_limits(run_up):
    assert run_up.accepted.clearance == 0.2e-3
    assert any("loop.limits.position" in w for w in run_up.accepted.warnings)


def test_the_spread_of_a_static_load_is_that_of_its_mean(spindle):
    """The bench carries nothing: what a short record shows is noise, and within it."""
    for x in spindle.accepted.of("capacity"):
        assert x.outcome == "passed"
        assert x.value < 5.0 * x.sd
