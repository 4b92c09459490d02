"""Guided commissioning: it comes to its end on a good bench, and stops with the right reason on others."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ambid.acquisition.device import SelfTest
from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.control.zones import Zone
from ambid.errors import AmbidError, EstimationError, ModelError
from ambid.estimation.estimate import Check
from ambid.estimation.result import Reason, Verdict
from ambid.job import commissioning as room
from ambid.job import commissioning_steps as judge
from ambid.job.commissioning import FILES, REDESIGNED, Declined, check_folder, commission
from ambid.job.commissioning_steps import STEPS, Plan, tracking
from ambid.job.commissioning_steps import record as judged_record
from ambid.job.results import load
from ambid.record import read_record
from ambid.rig import load_rig
from tests.acquisition.test_look import WHOLE
from tests.firmware.conftest import avr_gcc, bench_program, firmware_elf, native_cc
from tests.job.benches import COIL, CURRENT, DUTY, POSITION, Silent, Spoiled, prototype

__all__ = ["avr_gcc", "bench_program", "firmware_elf", "native_cc"]

SHORT = Plan(record_s=4.0, second_s=2.0, hover_s=0.5, rest_s=0.2, track_s=2.0, settle_s=0.5)
TRUTH = {"m": 0.3, "k_x": -6702.0, "k_i": 20.1, "R": 6.0, "L": 0.0803}


def ran(folder, device, *, rig=None, plan=SHORT, **options):
    """What came of it, and what is in the folder; the output is off, nothing is half-written."""
    with device:
        done = commission(device, rig or prototype(), folder, plan=plan, **options)
        assert device.state in ("idle", "fault")
    told = json.loads((folder / "commission.json").read_text(), parse_constant=pytest.fail)
    assert [s["name"] for s in told["steps"]] == [s.name for s in done.steps] == list(STEPS[: len(done.steps)])
    assert told["passed"] == done.passed
    assert told["steps"][-1]["reasons"] == list(done.steps[-1].reasons)
    assert all(s.passed for s in done.steps[:-1])
    assert {p.name for p in folder.iterdir()} <= set(FILES)
    assert load(folder / "commission.json").dumps() == (folder / "commission.json").read_text()
    return done


def stopped_at(name, done, *words):
    """It stopped at this step, and one reason has these words."""
    assert done.steps[-1].name == name
    assert not done.passed
    reasons = done.steps[-1].reasons
    assert any(all(w in r for w in words) for r in reasons), reasons


def files(folder):
    return {p.name for p in folder.iterdir()}


@pytest.fixture(autouse=True)
def plain_report(monkeypatch):
    """A report without its figures, which take seconds; the bench that came to its end has them."""
    monkeypatch.setattr("ambid.job.commissioning.page", lambda found: "<html>2001</html>")


# The way to the end.
@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    begun, said = [], []
    done = ran(folder, SimulatedDevice(prototype()), on_begin=begun.append, on_step=said.append)
    return folder, done, begun, said


def test_a_good_bench_comes_to_its_end(finished):
    folder, done, begun, said = finished
    assert done.passed
    assert begun == [s.name for s in said] == list(STEPS)
    assert files(folder) == set(FILES)


def test_what_it_found_is_the_truth(finished):
    _, done, _, _ = finished
    for p in done.estimate.parameters:
        if p.name in TRUTH:
            assert abs(p.value - TRUTH[p.name]) < 4.0 * p.sd
            assert abs(p.value / TRUTH[p.name] - 1.0) < 0.05


def test_what_it_says_has_digits_and_units_for_people(finished):
    _, done, _, _ = finished
    said = {s.name: s.findings for s in done.steps}
    assert said["self-test"][1] == "supply 5 V, position 921 and current 511.7 counts"
    assert re.fullmatch(r"position at rest 1 mm, noise \d\.\d\d um rms", said["rest"][0])
    assert re.fullmatch(r"current -?[\d.]+ [mu]A, \d+\.\d+ mA rms", said["levitate"][1])
    assert re.fullmatch(r"voltage -?[\d.]+ [mu]?V, \d{3} mV rms", said["levitate"][2])
    m, k_x = said["identify"][:2]
    interval = r" \(95 % interval ± ([\d.]+) %, expected ± ([\d.]+) %\)"
    for text, value in ((m, r"m = (?:29\d|30\d)\.\d+ ± [\d.]+ g"), (k_x, r"k_x = -6\.\d+ ± 0\.0\d+ kN/m")):
        told = re.fullmatch(value + interval, text)
        assert told
        assert 0.7 < float(told[1]) / float(told[2]) < 1.5  # a record of 4 s, designed on a trial of two


def test_a_loop_is_judged_at_the_position_and_named_nowhere_else(finished):
    """Opened at the controller's output its sensitivity is 1.2 dB, at the position 9.5 dB, where zone A ends."""
    _, done, _, _ = finished
    step = next(s for s in done.steps if s.name == "identify")
    zone = Zone.read(done.estimate.sensitivity["x"])
    assert step.numbers["sensitivity_upper_db"] == zone.upper_db > 9.3
    for line in (*step.findings, *step.cautions):
        assert ("ISO 14839-3" in line) == ("sensitivity of the loop" in line or "at the position" in line)
    warned = [c for c in step.cautions if "sensitivity" in c]
    assert bool(warned) == (zone.worst == "B")
    assert all(word in warned[0] for word in (zone.source, zone.words, "estimate.json"))


@pytest.mark.parametrize("of", [SimulatedDevice, EmulatedDevice])
def test_a_loop_with_too_little_margin_is_not_to_be_used(tmp_path, of, request):
    if of is EmulatedDevice:
        request.getfixturevalue("bench_program"), request.getfixturevalue("firmware_elf")
    rig = prototype(("kp = 19415.0", "kp = 15532.0"))
    done = ran(tmp_path, of(rig), rig=rig)
    stopped_at("identify", done, "at the position", "zone D", "ISO 14839-3", "the rotor is set down")
    assert done.verdict.word == "unusable"
    assert Zone.read(done.estimate.sensitivity["x"]).worst == "D"
    assert "better loop" in done.steps[-1].remedy


def judged(peak, sd, measured=None, *, simulated=False, **plan):
    """The step `identify` of an estimate that is sound but for its loop."""
    s = {"peak_db": {"value": peak, "sd": sd}, "frequency_hz": 16.0, "measured_peak_db": None}
    if measured is not None:
        s |= {"measured_peak_db": measured[0], "measured_sd_db": measured[1], "measured_frequency_hz": 16.0}
    estimate = SimpleNamespace(status="converged", parameters=(), checks={}, sensitivity={"x": s}, warnings=())
    return judge.identification(estimate, replace(SHORT, **plan), {}, simulated=simulated)


@pytest.mark.parametrize(
    ("peak", "measured", "passed", "words"),
    [
        ((5.0, 0.1), None, True, None),
        ((5.0, 0.1), (9.4, 0.2), True, "zone A or B"),
        ((5.0, 0.1), (11.0, 0.2), True, "zone B"),
        ((5.0, 0.1), (11.8, 0.2), False, "is not ruled out. Record longer"),
        ((5.0, 0.1), (13.0, 0.2), False, "zone C"),
        ((15.0, 0.1), None, False, "predicted 15.00 ± 0.10 dB"),
        ((15.0, 0.1), (8.0, 0.1), False, "predicted 15.00 ± 0.10 dB"),
    ],
)
def test_the_upper_end_of_the_interval_decides(peak, measured, passed, words):
    step = judged(*peak, measured)
    assert step.passed == passed
    lines = (*step.cautions, *step.reasons)
    assert lines == () if words is None else words in lines[0]


def test_a_better_loop_is_not_offered_where_it_is_on_its_way():
    assert "redesign" in judged(11.0, 0.1).cautions[0]
    assert "redesign" not in judged(11.0, 0.1, redesign=True).cautions[0]


def test_a_better_loop_is_offered_to_firmware_alone():
    (told,) = judged(11.0, 0.1, simulated=True).cautions
    assert "redesign" not in told
    assert told.endswith("zone A. Design a better loop on estimate.json")


def test_a_predicted_peak_where_nothing_was_excited_is_a_caution():
    s = {"peak_db": {"value": 8.0, "sd": 3.0}, "frequency_hz": 900.0, "measured_peak_db": 5.0, "measured_sd_db": 0.1}
    s |= {"measured_frequency_hz": 16.0}
    estimate = SimpleNamespace(status="converged", parameters=(), checks={}, sensitivity={"x": s}, warnings=())
    band = Check(passed=False, detail="the peak of x lies outside the excited band, 1 to 70 Hz")
    step = judge.identification(estimate, SHORT, {}, margins=SimpleNamespace(checks={"band": band}))
    assert step.passed
    assert step.cautions == (f"band: {band.detail}",)


def test_a_loop_that_cannot_be_judged_is_not_passed():
    said = "no sensitivity: the rig's [loop] does not hold the estimated plant"
    estimate = SimpleNamespace(status="converged", parameters=(), checks={}, sensitivity={}, warnings=(said,))
    step = judge.identification(estimate, SHORT, {})
    assert not step.passed
    assert said in step.reasons[0]


def test_what_cannot_be_designed_is_found_by_trials(tmp_path, monkeypatch):
    def nothing(*_args, **_options):
        raise EstimationError("the rig has no limits")

    monkeypatch.setattr(room, "design_experiment", nothing)
    done = ran(tmp_path, SimulatedDevice(prototype()), plan=SHORT)
    excite = next(s for s in done.steps if s.name == "excite")
    assert excite.passed
    assert "no experiment was designed: the rig has no limits" in excite.cautions[0]
    assert "experiment.json" not in files(tmp_path)


@pytest.mark.usefixtures("bench_program", "firmware_elf")
def test_where_no_better_loop_is_found_the_present_one_stays(tmp_path, monkeypatch):
    def nothing(*_args, **_options):
        raise EstimationError("no loop keeps the noise. Raise the limit noise")

    monkeypatch.setattr(room, "design_controller", nothing)
    plan = replace(SHORT, amplitude_v=1.4, redesign=True)
    with EmulatedDevice(prototype()) as device:
        done = commission(device, prototype(), tmp_path, plan=plan)
    assert [s.name for s in done.steps] == list(plan.steps), done.reasons
    assert done.passed, done.reasons
    step = next(s for s in done.steps if s.name == "redesign")
    assert step.cautions == ("the present loop stays: no loop keeps the noise. Raise the limit noise",)
    assert not files(tmp_path) & set(REDESIGNED)


@pytest.mark.parametrize(("cautions", "better"), [(["curvature"], 1.0), (["curvature", "residuals_white"], 0.0)])
def test_curvature_alone_does_not_keep_a_better_loop_from_being_loaded(cautions, better, monkeypatch):
    monkeypatch.setattr(judge, "design_picture", lambda _: None)
    figures = SimpleNamespace(peak=2.0, compliance=1e-4, noise=0.1, settling=0.1)
    loops = SimpleNamespace(worst=figures, figures=figures)
    told = Verdict.of((Reason(check="estimate", text=f"of the plant: {'; '.join(cautions)}"),))
    design = SimpleNamespace(before=loops, after=loops, verdict=told, passed=False)
    estimate = SimpleNamespace(verdict=Verdict.of(tuple(Reason(check=c, text="") for c in cautions)))
    step = judge.redesign(design, estimate)
    assert step.numbers["better"] == better
    assert bool(step.cautions) == (better == 0.0)


def test_a_loop_is_tried_by_the_firmware_alone(tmp_path):
    with SimulatedDevice(prototype()) as device, pytest.raises(AmbidError, match="omit redesign"):
        commission(device, prototype(), tmp_path, plan=replace(SHORT, redesign=True))
    assert not files(tmp_path)


def test_what_a_controller_measured_in_itself_is_said_in_words():
    measured = {"supply_mv": 5006.0, "free_bytes": 206.0, "position": 102.0, "current": 511.0}
    words = "supply 5.006 V, 206 bytes of memory never used, position 102 and current 511 counts"
    device = SimpleNamespace(
        self_test=lambda: SelfTest(failed=(), numbers={**measured, "heat": 3.0}),
        info=SimpleNamespace(kind="serial", port="/dev/ttyACM0", identity={"major": 1, "uid": 7}),
    )
    step = judge.self_test(device)
    assert step.findings == ("serial device at /dev/ttyACM0: major 1", f"{words}, heat 3")
    assert step.numbers["supply_mv"] == 5006.0


def test_what_it_leaves_can_be_read(finished):
    folder, _, _, _ = finished
    rig = load_rig(folder / "rig.toml")
    assert rig.daq == prototype().daq
    assert len(read_record(folder / "record.h5").channels[0].values) == 8000
    assert len(read_record(folder / "second.h5").channels[0].values) == 4000
    assert json.loads((folder / "estimate.json").read_text())["status"] == "converged"
    lines = [json.loads(line) for line in (folder / "track.jsonl").read_text().splitlines()]
    assert lines[0]["schema"] == "ambid.track/1"
    assert lines[-1]["summary"]["samples"] == 4000
    assert json.loads((folder / "commission.json").read_text())["device"]["kind"] == "simulated"


def test_the_report_shows_what_each_step_saw(finished):
    folder, done, _, _ = finished
    text = (folder / "report.html").read_text()
    for k, name in enumerate(STEPS, 1):
        assert f"✓ {k}. {name}" in text
    assert len(done.steps) == len(STEPS)
    seen = {s.name: len(s.pictures) for s in done.steps}
    assert seen == dict.fromkeys(STEPS, 1) | {"self-test": 0, "excite": 2, "record": 2, "validate": 0, "track": 0}
    assert text.count("<svg ") > sum(seen.values()) + 4  # those of the estimate and the track too
    assert text.index("verdict: <") < text.index("1. self-test")
    assert "peak of the sensitivity at the controller" in text
    assert done.verdict.word == json.loads((folder / "commission.json").read_text())["verdict"]["word"]


def test_the_two_records_are_excited_differently(finished):
    folder, _, _, _ = finished
    first, second = (read_record(folder / f).channels[3].values for f in ("record.h5", "second.h5"))
    assert abs(np.corrcoef(first[:4000], second)[0, 1]) < 0.5


# Refused before anything moves.
@pytest.mark.parametrize("name", [*FILES, "record.h5.journal"])
def test_a_folder_of_an_earlier_one_is_refused(tmp_path, name):
    (tmp_path / name).write_text("precious")
    with Spoiled(prototype()) as device:
        with pytest.raises(AmbidError, match=rf"holds {name} of an earlier commissioning"):
            commission(device, prototype(), tmp_path)
        assert device.starts == 0
    assert files(tmp_path) == {name}
    assert (tmp_path / name).read_text() == "precious"


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(AmbidError, match="is no folder"):
        check_folder(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ({"record_s": 0.5}, "the record: a multisine from 2 Hz needs 2 s for 4 periods"),
        ({"second_s": 1.0}, "the second record: "),
        ({"track_s": 1.0}, "tracking: "),
        ({"band_hz": (2.0, 1500.0)}, "a trial of the amplitude: "),
    ],
)
def test_what_cannot_be_played_is_refused(tmp_path, plan, said):
    with Spoiled(prototype()) as device:
        with pytest.raises(AmbidError, match=said):
            commission(device, prototype(), tmp_path, plan=replace(SHORT, **plan))
        assert device.starts == 0
    assert files(tmp_path) == set()


def test_a_rig_without_a_loop_is_refused(tmp_path):
    from ambid.rig import rig_from_text

    rig = rig_from_text(COIL, "coil.toml")
    with SimulatedDevice(rig) as device, pytest.raises(AmbidError, match=r"no \[loop\] with a gain"):
        commission(device, rig, tmp_path)
    assert files(tmp_path) == set()


# Each step for its own reason.
def test_a_self_test_that_fails_stops_it(tmp_path):
    device = Spoiled(prototype())
    device.failed = ("supply voltage outside 4.5 to 5.5 V",)
    stopped_at("self-test", ran(tmp_path, device), "supply voltage")
    assert device.starts == 0


def at_rest(column, change):
    def spoil(values, device):
        if device.starts == 1:
            values[:, column] = change(values[:, column])

    return spoil


def test_a_noisy_sensor_stops_it_at_rest(tmp_path):
    noise = np.random.default_rng(1)
    spoil = at_rest(POSITION, lambda x: 512 + 60 * noise.standard_normal(len(x)))
    device = Spoiled(prototype(), spoil=spoil)
    stopped_at("rest", ran(tmp_path, device), "position sensor's noise", "wiring")
    assert device.starts == 1


def test_current_with_the_output_off_stops_it_at_rest(tmp_path):
    device = Spoiled(prototype(), spoil=at_rest(CURRENT, lambda x: x + 150))
    stopped_at("rest", ran(tmp_path, device), "366 mA", "output off", "channels.current")


def test_a_zero_that_is_a_little_off_is_only_a_caution(tmp_path):
    device = Spoiled(prototype(), spoil=at_rest(CURRENT, lambda x: x + 40))
    with device:
        look = room.make_look(device, prototype(), lambda: False)
        step = judge.rest(look, room.Room.of(prototype()), SHORT, device.info.rate_hz)
    assert step.passed
    assert "with the output off" in step.cautions[0]


@pytest.mark.parametrize(("column", "name"), [(POSITION, "position"), (CURRENT, "current")])
def test_a_dead_sensor_stops_it_when_it_hovers(tmp_path, column, name):
    def dead(values, device):
        if device.lifts:
            values[:, column] = 512

    stopped_at("levitate", ran(tmp_path, Spoiled(prototype(), spoil=dead)), f"{name} does not move", "no sensor there")


def test_a_sensor_that_dies_on_the_way_stops_it_at_the_record(tmp_path):
    def dead(values, device):
        if device.lifts > 1 and device.excited and device._next > 18_000:
            values[:, CURRENT] = 512

    done = ran(tmp_path, Spoiled(prototype(), spoil=dead))
    assert done.steps[-1].name in ("record", "identify")
    assert not done.passed


def test_a_loop_that_is_predicted_unstable_is_refused_with_its_pole_before_anything_moves(tmp_path):
    rig = prototype(("kd = 92.57", "kd = 9.257"))
    with Spoiled(rig) as device:
        with pytest.raises(ModelError, match=r"largest pole 1\.00\d+; it is stable for [\d.]+ to \d+ times its gains"):
            commission(device, rig, tmp_path, plan=SHORT)
        assert device.starts == 0
    assert files(tmp_path) == set()


# The bench does not follow what the rig claims of it.
REVERSED = {
    "position": (
        (("gain   = 2.44140625e-6", "gain = -2.44140625e-6"), ("-1.248779296875e-3", "1.248779296875e-3")),
        ("position falls when the current rises: the rig says it rises", "channels.position.gain"),
    ),
    "current": (
        (("gain   = 2.44140625e-3", "gain = -2.44140625e-3"), ("-1.248779296875 ", "1.248779296875 ")),
        ("the current is reversed", "channels.current.gain"),
    ),
    "voltage": (
        (("gain   = 0.03", "gain = -0.03"), ("offset = -12.0", "offset = 12.0")),
        ("the voltage is reversed", "channels.voltage.gain"),
    ),
    "k_i": (
        (('k_i = { unit = "N/A" }', 'k_i = { value = -20.1, unit = "N/A" }'),),
        ("position rises when the current rises: the rig says it falls", "parameters.k_i"),
    ),
}


def test_one_that_ended_early_has_its_page_with_reason_and_picture(tmp_path, monkeypatch):
    from ambid.job.presentation import page

    monkeypatch.setattr("ambid.job.commissioning.page", page)
    rig = prototype(*REVERSED["position"][0])
    done = ran(tmp_path, SimulatedDevice(rig), rig=rig)
    text = (tmp_path / "report.html").read_text()
    assert "✗ 3. polarity" in text
    assert text.count("<svg ") == 2  # rest, and the pulses
    assert "channels.position.gain" in text[: text.index("<h2>Steps")]  # the verdict says why
    assert text.count("not reached") == len(STEPS) - 3
    assert (done.verdict.word, done.verdict.reasons[0].check) == ("unusable", "polarity")


@pytest.mark.usefixtures("bench_program", "firmware_elf")
@pytest.mark.parametrize("of", [SimulatedDevice, EmulatedDevice])
@pytest.mark.parametrize("what", REVERSED)
def test_a_reversed_sign_is_named_and_never_levitated(tmp_path, of, what):
    changes, words = REVERSED[what]
    rig = prototype(*changes)
    device = of(rig)
    if what == "k_i":  # it is seen in the loop already
        with device, pytest.raises(ModelError, match="stable with the other sign of kp, ki and kd"):
            commission(device, rig, tmp_path, plan=SHORT)
    modes, start = [], device.start
    device.start = lambda mode: (modes.append(mode), start(mode))
    stopped_at("polarity", ran(tmp_path, device, rig=rig, force=True), *words)
    assert set(modes) == {"sample", "drive"}


def test_bad_gains_stop_it_when_it_lifts(tmp_path):
    rig = prototype(("kd = 92.57", "kd = 0.0"))
    done = ran(tmp_path, SimulatedDevice(rig), rig=rig, force=True)
    stopped_at("levitate", done, "safe state during levitation", "out_of_gap, position outside limits", "gains")
    assert files(tmp_path) == {"rig.toml", "commission.json", "report.html"}
    (tmp_path / "rig.toml").unlink()
    with pytest.raises(AmbidError, match=r"commission .* cannot be read: rig\.toml, .* does not lie beside it"):
        load(tmp_path / "commission.json")


def test_a_rotor_that_strays_stops_it(tmp_path):
    def stray(values, device):
        if device.lifts == 1:
            values[:, POSITION] = 512 + 200 * np.sign(np.sin(device.blocks))

    stopped_at("levitate", ran(tmp_path, Spoiled(prototype(), spoil=stray)), "drifts", "badly damped")


def test_a_voltage_that_is_nearly_used_up_stops_it(tmp_path):
    def high(values, device):
        if device.lifts == 1:
            values[:, DUTY] = 770

    stopped_at("levitate", ran(tmp_path, Spoiled(prototype(), spoil=high)), "nothing is left to excite with")


def test_an_amplitude_that_trips_stops_it(tmp_path):
    done = ran(tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=11.0))
    stopped_at("excite", done, "safe state during excitation of 11 V")
    assert json.loads((tmp_path / "commission.json").read_text())["steps"][-1]["numbers"]["used"] is None


def lost_in(lift):
    return lambda device: device.lifts == lift and device.blocks == 150


def test_lost_samples_stop_it_at_the_record(tmp_path):
    plan = replace(SHORT, amplitude_v=1.4)  # hover, one trial: the record is the third time that it levitates
    done = ran(tmp_path, Spoiled(prototype(), lose=lost_in(3)), plan=plan)
    stopped_at("record", done, "20 of 8000 samples were lost during the record")
    assert files(tmp_path) == {"rig.toml", "commission.json", "report.html", "record.h5"}


def test_lost_samples_of_the_second_record_stop_it_too(tmp_path):
    done = ran(tmp_path, Spoiled(prototype(), lose=lost_in(4)), plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("record", done, "20 of 4000 samples were lost during the second record")
    assert files(tmp_path) == {"rig.toml", "commission.json", "report.html", "record.h5", "second.h5"}


def test_a_sensor_at_its_end_stops_it_at_the_record(tmp_path):
    def clip(values, device):
        if device.lifts == 3:
            values[::50, POSITION] = 1023

    done = ran(tmp_path, Spoiled(prototype(), spoil=clip), plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("record", done, "position is at the end of its range")


def test_a_line_that_is_lost_stops_it_with_that_reason_and_keeps_the_record(tmp_path):
    device = Silent(prototype(), after=400 + 250)
    with device:
        done = commission(device, prototype(), tmp_path, plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("record", done, "the line is lost", "record.h5 holds the")
    assert len(read_record(tmp_path / "record.h5").channels[0].values) > 1000


def test_a_fixed_value_that_is_wrong_stops_it(tmp_path):
    rig = prototype(('R   = { value = 6.0, unit = "ohm" }', 'R = { value = 9.0, unit = "ohm", role = "fixed" }'))
    done = ran(tmp_path, SimulatedDevice(rig), rig=rig, plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("identify", done, "contradict the fixed R = 9 ohm", "Check it, or free it")
    assert "estimate.json" in files(tmp_path)


def test_too_little_excitation_stops_it_by_the_width_of_the_intervals(tmp_path):
    done = ran(tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=0.05))
    stopped_at("identify", done, "limit 10 %", "record longer")
    # signal over noise alone is a caution of the record: the intervals decide
    assert any("signal-to-noise" in c for s in done.steps for c in s.cautions)


def test_a_marginal_signal_is_a_caution_where_the_intervals_are_narrow(tmp_path):
    with SimulatedDevice(prototype()) as device:
        done = commission(device, prototype(), tmp_path, plan=replace(SHORT, amplitude_v=0.6))
    snr = [c for s in done.steps if s.name == "record" for c in s.cautions if "signal-to-noise" in c]
    assert snr
    assert done.steps[-1].name == "track"


def test_a_wish_that_is_narrower_than_the_record_allows_stops_it(tmp_path):
    done = ran(tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=1.4, widest=0.001))
    stopped_at("identify", done, "m is known to", "limit 0.1 %")


def test_what_the_identification_refuses_is_its_reason(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise EstimationError("the record says nothing. Take another")

    monkeypatch.setattr("ambid.job.commissioning.identify_axis", refuse)
    done = ran(tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("identify", done, "the record says nothing. Take another")
    assert files(tmp_path) == {"rig.toml", "commission.json", "report.html", "record.h5", "second.h5"}


def change_before(lift, *changes):
    return lambda device, mode: mode == "levitate" and device.lifts == lift and device.become(*changes)


def test_another_bench_in_the_second_record_stops_it_at_validation(tmp_path):
    device = Spoiled(prototype(), before=change_before(4, ("R", 2.0), ("m", 1.3)))
    done = ran(tmp_path, device, plan=replace(SHORT, amplitude_v=1.4))
    stopped_at("validate", done, "innovations")


def test_another_bench_when_it_tracks_stops_it_there(tmp_path):
    device = Spoiled(prototype(), before=change_before(5, ("R", 1.4), ("m", 1.2)))
    done = ran(tmp_path, device, plan=replace(SHORT, amplitude_v=1.4))
    assert done.steps[-1].name == "track"
    assert done.steps[-1].reasons
    assert files(tmp_path) == set(FILES) - {"experiment.json"}


def followed(**changes):
    """What live tracking gave, as far as it is judged."""
    summary = SimpleNamespace(samples=4000, seconds_of_record=2.0, rejected_samples=0, changes=())
    line = SimpleNamespace(error=1.02, state="tracking")
    given = {"overruns": 0, "lines": (line,), "summary": summary, "run": WHOLE} | changes
    track = SimpleNamespace(lines=given["lines"], totals=given["summary"])
    return SimpleNamespace(run=given["run"], overruns=given["overruns"], track=track)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, None),
        ({"lines": (SimpleNamespace(error=1.6, state="tracking"),)}, "the model error is 1.6 at the end, beyond 1.5"),
        ({"lines": (SimpleNamespace(error=float("nan"), state="frozen"),)}, "the model error is nan"),
        ({"lines": ()}, "no line of the track came"),
        ({"overruns": 3}, "3 blocks found the queue full"),
        ({"run": replace(WHOLE, samples=90, lost=10)}, "10 of 100 samples were lost during tracking"),
    ],
    ids=["good", "error", "unknown", "empty", "slow", "lost"],
)
def test_how_tracking_is_judged(changes, said):
    step = tracking(followed(**changes), 1.5)
    assert step.passed == (said is None)
    assert said is None or said in step.reasons[0]


# Ended by people.
def test_an_operator_who_declines_leaves_the_output_off(tmp_path):
    asked = []
    with Spoiled(prototype()) as device:
        with pytest.raises(Declined, match="output stayed off"):
            commission(device, prototype(), tmp_path, plan=SHORT, confirm=lambda name: asked.append(name))
        assert device.starts == 1  # the look at rest, with the output off
        assert device.state == "idle"
    assert asked == ["polarity"]
    told = json.loads((tmp_path / "commission.json").read_text())
    assert [s["name"] for s in told["steps"]] == ["self-test", "rest"]


@pytest.mark.parametrize("name", ["rest", "levitate", "excite", "record", "track"])
def test_an_interruption_is_the_reason_of_the_step_under_way(tmp_path, name, plain_report):
    begun = []
    done = ran(
        tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=1.4), on_begin=begun.append,
        stopped=lambda: begun[-1:] == [name],
    )  # fmt: skip
    stopped_at(name, done, "interrupted")


def test_an_interruption_while_numbers_are_worked_out(tmp_path):
    begun = []
    done = ran(
        tmp_path, SimulatedDevice(prototype()), plan=replace(SHORT, amplitude_v=1.4), on_begin=begun.append,
        stopped=lambda: begun[-1:] == ["identify"],
    )  # fmt: skip
    stopped_at("identify", done, "interrupted while working it out")
    assert files(tmp_path) == {"rig.toml", "commission.json", "report.html", "record.h5", "second.h5"}


def test_a_disk_that_failed_is_the_reason(finished):
    from ambid.acquisition.quality import Quality
    from ambid.acquisition.session import Acquired
    from ambid.errors import DeviceError

    info = SimulatedDevice(prototype()).info
    done = Acquired(
        info=info, run=WHOLE, quality=Quality(info).report(), counters=SimulatedDevice(prototype()).counters(),
        recorded=None, troubles=(DeviceError("the disk is full"),), not_stored=40,
    )  # fmt: skip
    step = judged_record("record", done, Path("a.h5"))
    assert step.reasons == ("40 samples of the record are not stored: the disk is full",)
    slow = judged_record("record", replace(done, not_stored=0), Path("a.h5"))
    assert slow.passed
    assert "the disk is full" in slow.cautions
