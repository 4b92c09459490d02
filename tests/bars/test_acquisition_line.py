"""Nothing is lost on the way from the converter to the record, at the rate that is promised and at the highest one."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.devices.emulated import EmulatedDevice
from ambid.acquisition.program import program
from ambid.acquisition.scales import SHORTEST_PERIOD
from ambid.acquisition.session import Course, acquire
from ambid.record import read_record
from tests.bars.rates import COUNTED, run, stream_of

SECONDS, RATE = 20.0, 2000.0


def test_three_inputs_without_a_loss(rig, tmp_path):
    """2 kHz, three inputs and the pulse width, 1 Mbaud, excited, through driver, session and recorder."""
    rig = replace(rig, daq=replace(rig.daq, third="third"))
    wave = program("multisine", amplitude_v=3.0, band=(2.0, 66.0), rate_hz=RATE, seconds=SECONDS)
    with EmulatedDevice(rig, seed=1) as device:
        course = Course(mode="levitate", seconds=SECONDS, settle_s=1.0, program=wave)
        done = acquire(device, rig, tmp_path / "three.h5", course)
    c = done.counters
    assert done.run.complete
    assert done.run.samples == SECONDS * RATE
    assert (done.run.lost, c.lost, c.damaged, c.discarded_bytes, c.overruns) == (0, 0, 0, 0, 0)
    counted = {name: c.controller[name] for name in COUNTED}
    assert counted.pop("overruns") <= 0.001 * done.run.samples  # pulse widths that a command made act a period later
    assert not any(counted.values())
    assert done.troubles == ()
    record = read_record(tmp_path / "three.h5")
    columns = {channel.name: channel.values for channel in record.channels}
    assert set(columns) >= {"position", "current", "third", "duty"}
    assert {len(v) for v in columns.values()} == {SECONDS * RATE}
    assert np.ptp(columns["position"]) > 10  # counts: it is the excited rotor


@pytest.mark.parametrize("mode", ["sample", "levitate"])
@pytest.mark.parametrize("inputs", [2, 3])
def test_the_highest_rate_that_is_taken_is_kept(mode, inputs, rig, tmp_path):
    """The fastest ticks that the controller agrees to, with 200 commands a second beside the pings: no loss."""
    carried = stream_of(*[f"analog_{k}" for k in range(inputs)], "duty")
    for period in range(SHORTEST_PERIOD, 11):
        found = run(rig, tmp_path / f"{period}", seconds=2.0, stream=carried, period=period, mode=mode, commands=200)
        if found is not None:
            break
    assert found is not None, "not even 2 kHz is taken"
    assert found.kept, str(found)  # in full: an object is cut short
    if mode == "levitate":
        assert found.clean, str(found)


def test_what_is_faster_than_the_controller_says_is_refused(rig, tmp_path):
    fast = SHORTEST_PERIOD - 1
    assert run(rig, tmp_path, seconds=0.1, stream=stream_of("analog_0"), period=fast, mode="sample") is None
