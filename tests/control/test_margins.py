"""The margins of a loop: one axis against the prediction of its simulation, rotors against the truth; refusals."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.errors import EstimationError
from ambid.rig.draft import rig_of_preset
from ambid.simulation.margins import loop_margins
from tests.control.test_closed import free_rig, peaks_of, record_of
from tests.rotor_benches import needs_simulator, rig_of


@pytest.fixture(scope="module")
def axis():
    """One levitated axis: its rig, a record, and the margins of its loop."""
    rig = rig_of_preset(ambid.preset("rmit-axis"))
    record = ambid.simulate("rmit-axis", duration=1.0, seed=1)
    return rig, record, ambid.margins(record, rig)


def test_margins_at_the_input_are_those_that_the_simulation_predicts(axis):
    rig, _, found = axis
    of = loop_margins({p.name: p.value for p in rig.parameters}, rig.loop, rig.record.rate_hz)
    at = found.margins["x"].command
    assert at.gain_down == pytest.approx(of.gain[0], rel=0.01)
    assert at.gain_up == pytest.approx(of.gain[1], rel=0.01)
    assert at.phase_deg == pytest.approx(of.phase_deg, abs=0.3)
    assert at.peak_db == pytest.approx(20.0 * np.log10(of.peak[0]), abs=0.02)


def test_sensitivity_at_the_position_signal_is_not_hidden_by_the_current_loop(axis):
    """All that the controller orders passes its output, the current's answer too: seen there the loop looks better."""
    found = axis[2]
    assert found.sensitivity["x"].peak_db.value > found.margins["x"].command.peak_db + 3.0
    assert found.sensitivity["x"].peak_db.value == pytest.approx(found.margins["x"].position.peak_db, abs=0.01)
    assert found.verdict.word == "usable"
    assert found.sensitivity["x"].zone == "A"


def test_at_the_delay_margin_the_loop_is_about_to_swing(axis):
    from ambid.simulation import closed_loop_poles

    rig, _, found = axis
    more = found.margins["x"].command.delay_s * rig.record.rate_hz
    parameters = {p.name: p.value for p in rig.parameters}
    largest = [
        np.abs(closed_loop_poles(parameters, replace(rig.loop, delay=rig.loop.delay + x * more), rig.record.rate_hz)[0])
        for x in (0.97, 1.03)
    ]
    assert largest[0] < 1.0 < largest[1]


def test_margins_come_back_from_their_file(axis, tmp_path):
    found = axis[2]
    found.save(tmp_path / "m.json")
    document = json.loads((tmp_path / "m.json").read_text())
    assert document["schema"] == "ambid.margins/1"
    assert set(document["sensitivity"]["x"]) >= {"peak_db", "frequency_hz", "zone", "measured_peak_db"}
    again = ambid.load(tmp_path / "m.json")
    assert again.sensitivity == found.sensitivity
    np.testing.assert_allclose(again.curves.sensitivity["x"], found.curves.sensitivity["x"])
    assert again.summary() == found.summary()


def test_an_estimate_alone_has_the_margins_of_its_record_without_what_is_measured(axis, tmp_path):
    rig, record, found = axis
    ambid.identify(record, rig).save(tmp_path / "e.json")
    alone = ambid.margins(tmp_path / "e.json", rig)
    assert alone.of == "estimate"
    assert alone.margins == found.margins
    assert alone.sensitivity["x"].measured_peak_db is None
    assert "loop of an estimate" in alone.summary()
    with pytest.raises(EstimationError, match="nothing but the rig"):
        ambid.margins(tmp_path / "e.json", rig, from_s=0.1)


def test_stiffness_and_damping_are_those_of_the_compliance(axis):
    """At low frequency the loop is a spring of its static stiffness; both parts say the compliance together."""
    curves = axis[2].curves
    dynamic = curves.stiffness["x"] + 2j * np.pi * curves.frequency_hz * curves.damping["x"]
    np.testing.assert_allclose(1.0 / np.abs(dynamic), curves.compliance["x"], rtol=1e-12)
    f = curves.frequency_hz
    mass = next(p.value for p in axis[0].parameters if p.name == "m")
    high = f > 4000.0  # above the loop the rotor is a mass
    np.testing.assert_allclose(curves.stiffness["x"][high], -mass * (2.0 * np.pi * f[high]) ** 2, rtol=1e-3)


def test_noise_that_is_predicted_is_that_of_a_simulation(axis):
    """rms of voltage and position in a record without excitation: sensors and process through the loop."""
    rig, _, found = axis
    quiet = ambid.simulate_rig(rig, np.zeros(40_000), rate_hz=20_000.0, seed=3).record
    of = found.room["x"].quantities
    rms = {c.name.split("_")[0]: float(np.std(c.values)) for c in quiet.channels}
    assert found.noise == "rig"
    assert of["voltage"].rms == pytest.approx(rms["voltage"], rel=0.02)
    read = np.hypot(of["position"].rms, rig.noise.position)
    assert read == pytest.approx(rms["position"], rel=0.25)  # its band is narrow: 2 s hold few periods
    assert np.hypot(of["voltage"].sensors, of["voltage"].process) == pytest.approx(of["voltage"].rms)


def test_a_step_of_force_moves_the_rotor_as_far_as_is_predicted(axis):
    """The plant with its loop, stepped sample by sample by its matrices."""
    from ambid.physics.linear_model import discretise, model
    from ambid.simulation.plant import closed_loop_matrix

    rig, _, found = axis
    values = {p.name: p.value for p in rig.parameters}
    z = closed_loop_matrix(values, rig.loop, 20_000.0)
    d, _ = discretise(model("one-axis").matrices(values), 1.0 / 20_000.0)
    x, pushed, far = np.zeros(z.shape[0]), np.zeros(z.shape[0]), []
    pushed[: d.E.shape[0]] = d.E[:, 0]
    for _ in range(4000):
        x = z @ x + pushed
        far.append(d.C[0] @ x[: d.A.shape[0]])
    room = found.room["x"]
    assert room.quantities["position"].step == pytest.approx(np.max(np.abs(far)), rel=0.02)
    at = room.quantities[room.force_limit]
    assert room.force_step * at.step + 3.0 * at.rms == pytest.approx(at.room)


def test_an_open_loop_has_no_margins():
    record = ambid.simulate("thesis", duration=0.3, seed=1)
    with pytest.raises(EstimationError, match="open_loop"):
        ambid.margins(record, rig_of_preset(ambid.preset("thesis")))


def test_without_reference_and_loop_nothing_says_what_the_controller_is(axis):
    rig, record, _ = axis
    with pytest.raises(EstimationError, match="neither a reference"):
        ambid.margins(record, replace(rig, loop=None))


def test_a_loop_that_does_not_hold_the_plant_is_another_one(axis):
    rig, record, _ = axis
    with pytest.raises(EstimationError, match="does not hold the estimated plant"):
        ambid.margins(record, replace(rig, loop=replace(rig.loop, kp=0.1 * rig.loop.kp)))


@needs_simulator
def test_vibration_by_unbalance_and_run_out_is_that_of_the_truth():
    """The loop of the independent simulator at the speed of its record, and what it says of the synchronous motion."""
    from ambid.control.closed import ClosedLoop
    from ambid.control.controller import controller_of_loop
    from ambid.control.margins import synchronous
    from ambid.rotor.balance import Machine
    from ambid.rotor.likelihood import Point
    from tests.control.test_closed import plant_of
    from tests.rotor_benches import truth

    bench = truth.BENCHES["rigid-spin"]
    plant, loop = plant_of(bench), rig_of(bench).loop
    at = Point(theta=plant.theta, delays=plant.delays)
    z = float(rig_of(bench).unbalance[0].z)
    machine = Machine(model=plant.model, at=at, names=(), covariance=np.zeros((0, 0)), beside={"u": (z,)})
    closed = ClosedLoop(
        plant=plant, controller=controller_of_loop(loop, plant.model, bench.rate), frequency_hz=np.array([1.0])
    )
    f = np.array([bench.rpm / 60.0])
    force = bench.unbalance * np.exp(1j * bench.phase_unbalance) * machine.shape("u")[:, None]
    runout = np.zeros((len(plant.model.outputs), 1), dtype=complex)
    for k, role in enumerate(plant.model.outputs):
        if role.endswith("position"):
            runout[k] = bench.runout * np.exp(1.1j) * (1.0 if "x" in role else -1j)
    moved = synchronous(closed, machine, f, force, runout)[0, 4:, 0] + runout[:, 0]
    found = truth.simulate(replace(bench, position_noise=0.0, current_noise=0.0, voltage_noise=0.0, force_noise=0.0,
                                   amplitude=0.0, period=0.5, periods=2), 1)  # fmt: skip
    angle = found["angle"]
    for j, axis in enumerate(truth.AXES):
        seen = 2.0 * np.mean(found["position"][:, j] * np.exp(-1j * angle))
        assert moved[plant.model.outputs.index(f"{axis}_position")] == pytest.approx(seen, abs=2e-3 * abs(seen))


@needs_simulator
def test_margins_of_a_rotor_with_the_estimate_of_another_record(rigid):
    bench, estimate = rigid
    found = ambid.margins(record_of(bench, 2), free_rig(bench), estimate=estimate)
    peaks = [s.peak_db.value for s in found.sensitivity.values()]
    assert peaks == pytest.approx(peaks_of(bench), abs=0.1)
    assert found.verdict.word == "usable"
    assert found.checks["agreement"].values["z"] < 5.0
    stiff = replace(estimate, numbers={**estimate.numbers, "ax.k_i": 1.5 * estimate.numbers["ax.k_i"]})
    wrong = ambid.margins(record_of(bench, 2), free_rig(bench), estimate=stiff)
    assert not wrong.checks["agreement"].passed
    ruled = ambid.margins(record_of(bench, 2), replace(free_rig(bench), loop=rig_of(bench).loop), estimate=estimate)
    assert ruled.controller["source"] == "record"


def test_an_excitation_that_is_logged_shows_controller_and_sensitivity_of_one_axis(axis):
    rig = axis[0]
    record = ambid.simulate(
        "rmit-axis", duration=1.0, periods=5, band=(5.0, 2000.0), excitation="multisine", seed=1, log_excitation=True
    )
    found = ambid.margins(record, replace(rig, loop=None), reference="excitation")
    ruled = axis[2]
    assert found.controller["source"] == "record"
    assert found.sensitivity["x"].peak_db.value == pytest.approx(ruled.sensitivity["x"].peak_db.value, abs=0.1)
    assert found.sensitivity["x"].measured_peak_db == pytest.approx(found.sensitivity["x"].peak_db.value, abs=0.5)
    assert found.checks["agreement"].passed
    assert found.margins["x"].command.gain_up == pytest.approx(ruled.margins["x"].command.gain_up, rel=0.02)


def test_a_reference_without_periods_serves_too(axis):
    from ambid.rig.rig import RigChannel

    estimate, rig = ambid.identify(axis[1], axis[0]), axis[0]
    rig = replace(rig, channels=(*rig.channels, RigChannel(role="reference", column="reference")))
    moved = 2e-6 * np.random.default_rng(1).standard_normal(10_000)
    record = ambid.simulate_rig(rig, np.zeros(10_000), rate_hz=20_000.0, seed=1, setpoint=moved).record
    found = ambid.margins(record, replace(rig, loop=None), estimate=estimate)
    assert found.sensitivity["x"].peak_db.value == pytest.approx(axis[2].sensitivity["x"].peak_db.value, abs=0.1)
    assert found.checks["controller"].values["misfit"] < 1e-6
    assert found.curves.measured["x"].frequency_hz.size > 100


def test_a_noisy_measured_sensitivity_has_no_peak():
    from ambid.control.closed import MeasuredSensitivity

    rng, f = np.random.default_rng(1), np.linspace(1.0, 100.0, 200)
    noisy = MeasuredSensitivity(
        frequency_hz=f, ratio=1.0 + 0.5 * np.abs(rng.standard_normal(200)), sd=np.full(200, 0.5)
    )
    assert noisy.peak is None
    ratio = np.ones(200)
    ratio[50], sd = 2.0, np.full(200, 0.01)
    alone = MeasuredSensitivity(frequency_hz=f, ratio=ratio, sd=sd, phase=np.zeros(200)).peak
    assert alone == pytest.approx((2.0, f[50], 0.02), rel=0.02)


def test_a_peak_in_noise_is_not_taken_for_a_lower_one_beside_it():
    from ambid.control.closed import MeasuredSensitivity

    rng, f = np.random.default_rng(3), np.arange(1.0, 101.0)
    S, noise = 1.0 + 2.0 / (1.0 + ((f - 30.0) / 20.0) ** 2), np.where(f < 60.0, 0.2, 0.04)
    for _ in range(30):
        seen = S * (1.0 + noise * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)))
        found = MeasuredSensitivity(frequency_hz=f, ratio=np.abs(seen), sd=noise * S, phase=np.angle(seen)).peak
        assert found is None


def test_a_measured_peak_is_that_of_many_lines():
    """A peak with 2 % noise on each line: its top is known better than a line, without bias, and its interval covers.

    Three widths over the spacing of the lines: the narrow ones are no parabola within their scatter.
    """
    from ambid.control.closed import MeasuredSensitivity

    rng, f = np.random.default_rng(2), np.arange(2.0, 200.0, 2.0)
    dense = np.linspace(10.0, 100.0, 20_000)
    for damping in (0.08, 0.2, 0.35):

        def exact(f, damping=damping):
            s = 1j * f / 40.0
            return (s**2 + 0.02 * s - 0.1) / (s**2 + 2.0 * damping * s + 1.0)

        S, top, errors = exact(f), float(np.max(np.abs(exact(dense)))), []
        for _ in range(100):
            noise = 0.02 * np.abs(S) * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
            peak = MeasuredSensitivity(
                frequency_hz=f, ratio=np.abs(S + noise), sd=0.02 * np.abs(S), phase=np.angle(S + noise)
            ).peak
            assert peak is not None
            errors.append((peak[0] / top - 1.0, (peak[0] - top) / peak[2]))
        relative, scaled = np.transpose(errors)
        assert np.sqrt(np.mean(relative**2)) < 0.75 * 0.02
        assert abs(np.mean(relative)) < 0.5 * np.std(relative)
        assert np.mean(np.abs(scaled) > 1.96) < 0.12


@pytest.mark.drawn
def test_the_command_writes_text_json_figure_and_page(axis, tmp_path, monkeypatch, capsys):
    from ambid.cli import main
    from ambid.rig import write_rig

    monkeypatch.chdir(tmp_path)
    write_rig(axis[0], "rig.toml")
    ambid.write_record(axis[1], "record.csv")
    words = ["margins", "record.csv", "--rig", "rig.toml", "--json", "m.json", "--plot", "m.png", "--report", "m.html"]
    monkeypatch.setattr("sys.argv", ["ambid", *words, "--strict"])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    said = capsys.readouterr().out
    assert "zone" in said
    assert "least dynamic stiffness" in said
    assert json.loads((tmp_path / "m.json").read_text())["verdict"]["word"] == "usable"
    assert (tmp_path / "m.png").stat().st_size > 10_000
    assert "margins of the loop" in (tmp_path / "m.html").read_text()
