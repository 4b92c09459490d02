"""A simulated rotor as a device: its samples, its safe state, and what is identified from its record."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.acquisition.device import AxesProgram, Program
from ambid.acquisition.devices import open_device
from ambid.acquisition.devices.rotor import RotorDevice
from ambid.errors import AmbidError, DeviceError
from ambid.job.acquiring import acquire
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.simulation.rotor_bench import RotorBench

UTRC, RMIT, SPINDLE = (rig_of_preset(preset(name)) for name in ("utrc", "rmit", "spindle"))


def played(device, sizes, mode="levitate", program=None):
    """Samples in blocks of these sizes."""
    with device:
        device.start(mode)
        device.excite(program)
        return np.vstack([device._made(n).values for n in sizes])


def waves(rig, n, peak):
    x = peak * np.sin(2.0 * np.pi * np.arange(n) / n)
    return AxesProgram(kind="sine", amplitude=peak, wave=np.outer(x, np.ones(len(rig.rotor.axes))))


def test_samples_do_not_depend_on_the_blocks_they_come_in():
    one, two = (played(RotorDevice(UTRC, seed=3), sizes, program=waves(UTRC, 300, 5.0)) for sizes in ((500,), (7, 493)))
    assert np.allclose(one, two, rtol=1e-9, atol=1e-15)  # the angle is summed up in other parts


def test_samples_are_those_of_a_simulated_record():
    bench, program = RotorBench.of(UTRC, None, True), waves(UTRC, 400, 10.0)
    record = bench.simulate(program.wave, seed=5).record
    values = played(RotorDevice(UTRC, seed=5), (400,), program=program)
    assert np.allclose(values, np.column_stack([c.values for c in record.channels]), rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize(("rig", "axes"), [(UTRC, 4), (SPINDLE, 5)])
def test_a_device_names_every_axis(rig, axes):
    roles = [c.role for c in open_device("simulated", rig).info.columns]
    for what in ("voltage", "position", "current", "reference"):
        assert sum(r.endswith(what) for r in roles) == axes
    assert "angle" in roles


def test_a_device_says_whether_its_time_runs_with_the_host_s():
    assert [RotorDevice(UTRC, pace=pace).info.real for pace in ("fastest", "real")] == [False, True]


def test_a_rotor_that_touches_down_ends_the_run_with_its_sample():
    device = RotorDevice(UTRC)
    with device:
        device.start("levitate")
        device.excite(waves(UTRC, 2000, 200.0))
        while device.state != "fault":
            device.read(0.1)
        fault = next(e for e in device.events() if e.kind == "fault")
        assert fault.what in ("out_of_gap", "over_current")
        assert fault.sample is not None
        rest = device._made(4000)  # the output is off: it lies on its stops
        voltage = [k for k, c in enumerate(device.info.columns) if c.role.endswith("voltage")]
        assert not rest.values[:, voltage].any()
        with pytest.raises(DeviceError, match="before clear"):
            device.start("levitate")
        device.clear()
        device.start("levitate")
        assert device.state == "levitating"


def test_a_rig_without_loop_is_not_levitated(tmp_path):
    with pytest.raises(AmbidError, match=r"no \[loop\] with a gain"):
        acquire("simulated", replace(UTRC, loop=None), tmp_path / "a.h5", seconds=1.0)


def test_a_loop_that_is_predicted_unstable_is_refused_or_touches_down(tmp_path):
    weak = replace(UTRC, loop=replace(UTRC.loop, kp=0.3 * UTRC.loop.kp))
    with pytest.raises(AmbidError, match="unstable"):
        acquire("simulated", weak, tmp_path / "a.h5", seconds=1.0)
    done = acquire("simulated", weak, tmp_path / "b.h5", seconds=1.0, settle=0.0, force=True)
    assert done.run.fault.what in ("out_of_gap", "over_current")
    assert done.record.n_samples == done.run.fault.sample


def test_a_rotor_without_speed_has_no_angle(tmp_path):
    done = acquire("simulated", RMIT, tmp_path / "a.h5", seconds=0.5)
    assert "angle" not in done.record.names
    assert done.record.channel("xL_position").values.std() > 0.0


def test_what_a_rotor_does_not_play_is_refused(tmp_path):
    with pytest.raises(AmbidError, match="several records"):
        acquire("simulated", RMIT, tmp_path / "a.h5", excitation="orthogonal")
    with RotorDevice(RMIT) as device:
        device.start("levitate")
        with pytest.raises(DeviceError, match="which axis"):
            device.excite(Program(kind="step"))
        with pytest.raises(DeviceError, match="4 axes, the program 5"):
            device.excite(waves(SPINDLE, 10, 1.0))
    with pytest.raises(DeviceError, match="not a rotor with axes"):
        open_device("simulated", RMIT, bench=SPINDLE)
    with pytest.raises(DeviceError, match="Choose port simulated"):
        open_device("emulated", RMIT)


def test_an_identified_record_of_the_device_holds_the_truth(tmp_path):
    lines = []
    done = acquire(
        "simulated", RMIT, tmp_path / "a.h5", seconds=3.0, excitation="multisine", seed=1, on_note=lines.append
    )
    assert any("dealt out" in x for x in lines)
    assert any("half of what the limits allow" in x for x in lines)
    found, truth = ambid.identify(done.record, RMIT), RotorBench.of(RMIT, None, True).plant.parameters
    assert found.passed
    for p in found.parameters:
        if p.sd:
            assert abs(p.value - truth[p.name]) < 4.0 * p.sd, p.name
