"""The plant file that is written for a rig is the bench that the rig names, and the emulated bench takes it."""

import dataclasses
import subprocess

import numpy as np
import pytest

from ambid.acquisition.devices.benches import plant_text
from ambid.acquisition.scales import scale_of
from ambid.errors import DeviceError, RigError
from ambid.physics.loop import Limits
from ambid.physics.nonlinear import PowerStage
from ambid.physics.presets import preset, preset_names
from ambid.record.calibration import Calibration
from ambid.rig.load import load_rig
from tests.firmware.conftest import BENCH

RIG = BENCH.parents[1] / "src" / "ambid" / "data" / "prototype.toml"


@pytest.fixture
def rig():
    return load_rig(RIG)


@pytest.fixture
def written(rig):
    def write(of=None, **options):
        rows = [line.split() for line in plant_text(of or rig, **options).splitlines() if not line.startswith("#")]
        return {row[0]: row[1] for row in rows if len(row) == 2}, [row for row in rows if len(row) == 3]

    return write


def calibrated(rig, role, calibration):
    channels = [dataclasses.replace(c, calibration=calibration) if c.role == role else c for c in rig.channels]
    return dataclasses.replace(rig, channels=tuple(channels))


@pytest.mark.parametrize("name", preset_names(rotors=False))
def test_the_emulated_bench_takes_every_preset(bench_program, rig, tmp_path, name):
    path = tmp_path / "bench.plant"
    path.write_text(plant_text(rig, bench=preset(name)))
    words = [str(bench_program), "--plant", str(path), "--firmware", str(path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert "not an ELF file" in done.stderr  # and no word about the plant, which is read before


def test_a_linear_bench_has_its_parameters_and_stops(written):
    b = preset("thesis")
    values, _ = written(bench=b)
    assert {k: float(values[k]) for k in b.parameters} == dict(b.parameters)
    assert (values["kind"], float(values["stop_low"]), float(values["stop_high"])) == ("linear", -0.01, 0.01)
    assert float(values["start_position"]) == 0.0  # a stable one lies where it rests


def test_a_magnet_has_its_co_energy(written):
    b = preset("levitated-ball")
    values, _ = written(bench=b)
    assert float(values["k"]) == b.plant.magnet.coenergy.k_b
    assert (float(values["gravity"]), float(values["leakage"])) == (9.81, 0.104)
    assert float(values["start_position"]) == 0.020  # its weight takes it to the lower end
    pair = preset("unstable-bearing")
    values, _ = written(bench=pair)
    assert (float(values["gap"]), float(values["bias"])) == (0.432e-3, 1.0)
    assert float(values["k"]) == pair.plant.magnet.coenergy.k_a
    assert float(values["start_position"]) == -0.2e-3


def test_the_power_stage_gives_what_the_calibration_says(written, rig):
    values, _ = written()
    assert (float(values["low_voltage"]), float(values["high_voltage"])) == (-12.0, 12.0)
    assert (values["off"], values["current"], values["pwm"]) == ("diodes", "both-ways", "switched")
    single = Calibration(unit_in="1", unit_out="V", gain=12.0 / 800)
    values, _ = written(calibrated(rig, "voltage", single))
    assert (float(values["low_voltage"]), float(values["high_voltage"])) == (0.0, pytest.approx(12.0))
    assert (values["off"], values["current"], values["pwm"]) == ("short", "one-way", "switched")


@pytest.mark.parametrize("role", ["position", "current"])
def test_a_count_is_read_in_the_middle_of_its_step(written, rig, role):
    values, _ = written()
    scale = scale_of(rig, role)
    for count in (0, 1, 512, 1023):
        volts = float(values[f"{role}_gain"]) * float(scale.to_si(count)) + float(values[f"{role}_offset"])
        assert volts / 5.0 * 1024.0 == pytest.approx(count + 0.5, abs=1e-9)


def test_a_table_goes_over_point_by_point(written, rig):
    table = Calibration(
        unit_in="1",
        unit_out="m",
        raw=np.array([0.0, 400.0, 1023.0]),
        out=np.array([-2e-3, -1e-3, 1e-3]),
        extrapolate=True,
    )
    values, points = written(calibrated(rig, "position", table))
    assert "position_gain" not in values
    assert [row[0] for row in points] == ["position_point"] * len(points)
    assert [float(row[1]) for row in points] == pytest.approx([0.5 / 204.8, 400.5 / 204.8, 1023.5 / 204.8])
    assert [float(row[2]) for row in points] == [-2e-3, -1e-3, 1e-3]


def test_the_instruments_rise_whatever_the_rig_claims_unless_the_bench_has_its_own(written, rig):
    falls = Calibration(unit_in="1", unit_out="m", gain=-2e-6, offset=1.023e-3)
    claimed, _ = written(calibrated(rig, "position", falls))
    assert float(claimed["position_gain"]) == pytest.approx(5.0 / 1024.0 / 2e-6)
    plant = preset("prototype").parameters
    known = tuple(dataclasses.replace(p, value=plant[p.name]) for p in rig.parameters)
    own = calibrated(dataclasses.replace(rig, parameters=known), "position", falls)
    really, _ = written(bench=own)
    assert float(really["position_gain"]) == pytest.approx(-5.0 / 1024.0 / 2e-6)


def test_noise_is_the_bench_s_own(written):
    b = preset("unstable-bearing")
    loud, _ = written(bench=b)
    assert float(loud["position_noise"]) == b.noise.position
    assert float(loud["force_noise"]) == b.noise.force


def test_what_the_emulated_bench_cannot_be_is_refused(written, rig):
    b = preset("unstable-bearing")
    with pytest.raises(DeviceError, match="stops inside its air gap"):
        written(bench=dataclasses.replace(b, limits=Limits(position=(-1e-3, 1e-3))))
    with pytest.raises(RigError, match="has no calibration"):
        written(calibrated(rig, "position", None))
    bent = Calibration(unit_in="1", unit_out="V", raw=np.array([0.0, 400.0, 800.0]), out=np.array([-12.0, 1.0, 12.0]))
    with pytest.raises(DeviceError, match="power stage is a straight line"):
        written(calibrated(rig, "voltage", bent))


@pytest.mark.parametrize("change", [{"stage": PowerStage(v_drop=0.5)}, {"eddy_pole": 900.0}])
def test_what_the_emulated_bench_does_not_know_is_refused(written, change):
    b = preset("prototype")
    other = dataclasses.replace(b, plant=dataclasses.replace(b.plant, **change))
    with pytest.raises(DeviceError, match="has neither"):
        written(bench=other)
