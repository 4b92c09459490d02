"""A run of a device: exactly what was wanted is passed on, whatever happens, and the output is off after it."""

import pytest

from ambid.acquisition.device import DeviceEvent, Program
from ambid.acquisition.protocol import table
from ambid.acquisition.session import Course, run
from ambid.acquisition.settings import fault_words
from ambid.errors import DeviceError
from tests.acquisition.scripted import Listener, ScriptedDevice

SQUARE = Program(kind="step", amplitude=1.0, hold=5, length=2)


def ran(device, *, taps=None, stopped=lambda: False, on_event=None, **course):
    course = {"mode": "levitate", "seconds": 0.025} | course
    taps = [Listener()] if taps is None else taps
    report = run(device, Course(**course), taps=taps, stopped=stopped, on_event=on_event)
    return report, taps[0] if taps else None


def test_exactly_the_wanted_samples_are_passed_on():
    device = ScriptedDevice()
    report, heard = ran(device, seconds=0.025)
    assert heard.numbers == list(range(25))
    assert (report.samples, report.wanted, report.lost, report.first, report.after) == (25, 25, 0, 0, 25)
    assert report.complete
    assert report.fault is None
    assert not report.interrupted
    assert device.state == "idle"


def test_every_tap_hears_the_same():
    taps = [Listener(), Listener()]
    ran(ScriptedDevice(), taps=taps)
    assert taps[0].numbers == taps[1].numbers == list(range(25))


def test_what_settles_is_not_passed_on_and_the_excitation_begins_after_it():
    device = ScriptedDevice()
    report, heard = ran(device, settle_s=0.02, program=SQUARE)
    assert device.told[:2] == ["start levitate", "excite at 20"]
    assert heard.numbers == list(range(30, 55))  # and the bench is given one period, 10 ticks, to settle to it
    assert all(f.block.values[:, 1].all() for f in heard.frames)
    assert [f.block.time_s for f in heard.frames] == [n / 1000.0 for n in heard.firsts]
    assert (report.first, report.after, report.samples) == (30, 55, 25)


def test_samples_that_were_under_way_when_the_excitation_was_ordered_are_not_passed_on():
    device = ScriptedDevice(excited_late=17)  # in the middle of a block
    report, heard = ran(device, settle_s=0.02, program=SQUARE)
    assert heard.numbers == list(range(47, 72))
    assert heard.firsts[0] == 47
    assert heard.frames[0].block.time_s == pytest.approx(0.047)
    assert report.complete


def test_an_excitation_of_many_seconds_is_not_waited_for_longer_than_one():
    slow = Program(kind="step", amplitude=1.0, hold=5000, length=2)
    _, heard = ran(ScriptedDevice(blocks=200), program=slow)
    assert heard.numbers[0] == 1000


def test_an_excitation_that_never_shows_is_an_error():
    device = ScriptedDevice(blocks=2000, excited_late=10**9)
    with pytest.raises(DeviceError, match="excitation was started but is not visible in 10 s"):
        ran(device, program=SQUARE)
    assert device.state == "idle"


def test_without_an_excitation_none_is_asked_for():
    device = ScriptedDevice()
    ran(device, settle_s=0.02)
    assert device.told == ["start levitate", "stop"]


def test_settling_over_a_gap_counts_samples_and_not_blocks():
    report, heard = ran(ScriptedDevice(gaps={1: 30}), settle_s=0.03)
    assert heard.numbers[0] == 50  # the block that came at 40 made the 30 full
    assert report.complete
    assert report.lost == 0  # the gap was while it settled


def test_a_gap_is_counted_and_its_samples_are_not_waited_for():
    report, heard = ran(ScriptedDevice(gaps={1: 7}), seconds=0.03)
    assert heard.numbers == [*range(10), *range(17, 30)]
    assert (report.samples, report.lost, report.wanted) == (23, 7, 30)
    assert not report.complete


def test_a_gap_over_the_end_is_no_part_of_the_record():
    report, heard = ran(ScriptedDevice(gaps={2: 40}), seconds=0.025)
    assert heard.numbers == list(range(20))
    assert (report.samples, report.lost, report.complete) == (20, 0, False)


def test_a_fault_ends_the_run_and_what_was_before_it_is_passed_on():
    report, heard = ran(ScriptedDevice(fault_at=13), seconds=0.05)
    assert heard.numbers == list(range(13))
    assert report.fault is not None
    assert (report.fault.what, report.fault.sample) == ("over_current", 13)
    assert not report.complete


def test_blocks_that_wait_when_a_fault_is_told_are_passed_on_up_to_it():
    # The event overtakes the samples: it is told with the first block, and concerns the fourth.
    report, heard = ran(ScriptedDevice(fault_at=34, fault_told_at=0), seconds=0.05)
    assert heard.numbers == list(range(34))
    assert report.fault is not None


def test_a_fault_at_the_edge_of_a_block_passes_the_block_before_it():
    _, heard = ran(ScriptedDevice(fault_at=20), seconds=0.05)
    assert heard.numbers == list(range(20))


def test_a_fault_while_it_settles_passes_nothing_on_and_excites_nothing():
    device = ScriptedDevice(fault_at=5)
    report, heard = ran(device, settle_s=0.03, program=SQUARE)
    assert heard.numbers == []
    assert report.fault is not None
    assert (report.samples, report.lost, report.first == report.after) == (0, 0, True)
    assert device.told == ["start levitate", "stop"]


def test_a_fault_whose_sample_is_not_known_ends_the_run_at_once():
    class Lost(ScriptedDevice):
        def made(self):
            frame = super().made()
            if self.block == 3:
                self.news.append(DeviceEvent(kind="fault", sample=None, what="interlock"))
            return frame

    report, heard = ran(Lost(), seconds=0.08)
    assert heard.numbers == list(range(20))
    assert report.fault is not None


def test_an_interruption_ends_it_in_order():
    heard = Listener()
    device = ScriptedDevice()
    report, _ = ran(device, taps=[heard], stopped=lambda: len(heard.frames) == 2, seconds=1.0)
    assert report.interrupted
    assert heard.numbers == list(range(20))
    assert device.state == "idle"


def test_an_interruption_while_it_settles_excites_nothing():
    device = ScriptedDevice()
    report, heard = ran(device, settle_s=0.05, program=SQUARE, stopped=lambda: device.block == 2)
    assert report.interrupted
    assert heard.numbers == []
    assert device.told == ["start levitate", "stop"]


def test_a_device_that_has_no_more_ends_the_run():
    report, heard = ran(ScriptedDevice(blocks=2), seconds=1.0)
    assert heard.numbers == list(range(20))
    assert (report.complete, report.interrupted, report.fault) == (False, False, None)


def test_silence_is_an_error_and_the_device_is_stopped():
    device = ScriptedDevice(silent_from=2)
    heard = Listener()
    with pytest.raises(DeviceError, match=r"script: no sample came for 5 s.*1000 per second.*cable"):
        ran(device, taps=[heard], seconds=1.0)
    assert heard.numbers == list(range(20))
    assert device.told[-1] == "stop"


def test_a_lost_line_is_told_as_such_although_it_cannot_be_stopped_any_more():
    device = ScriptedDevice(pulled_at=2)
    heard = Listener()
    with pytest.raises(DeviceError, match="the line is lost"):
        ran(device, taps=[heard], seconds=1.0)
    assert heard.numbers == list(range(20))
    assert "stop" in device.told


def test_a_tap_that_breaks_still_leaves_the_device_stopped():
    device = ScriptedDevice()
    with pytest.raises(RuntimeError, match="the tap broke"):
        ran(device, taps=[Listener(at=2)], seconds=1.0)
    assert device.told[-1] == "stop"
    assert device.state == "idle"


def test_a_stop_before_the_start_leaves_the_output_off():
    device = ScriptedDevice()
    report, _ = ran(device, stopped=lambda: True, settle_s=0.02, program=SQUARE)
    assert report.interrupted
    assert device.told == ["stop"]


def test_a_refused_start_leaves_the_device_stopped():
    class Refuses(ScriptedDevice):
        def start(self, mode):
            raise DeviceError("script refuses")

    device = Refuses()
    with pytest.raises(DeviceError, match="refuses"):
        ran(device)
    assert device.told == ["stop"]


def test_what_an_earlier_run_left_unread_is_not_of_this_one():
    device = ScriptedDevice(after_stop=2)
    ran(device, seconds=0.02, mode="drive")
    report, heard = ran(device, seconds=0.02, mode="drive", program=SQUARE)
    assert heard.numbers == list(range(50, 70))  # 20 to 39 were on their way when the first one was stopped
    assert all(f.block.values[:, 1].all() for f in heard.frames)
    assert report.complete


def test_nor_where_nothing_is_excited():
    device = ScriptedDevice(after_stop=2)
    ran(device, seconds=0.02, mode="sample")
    _, heard = ran(device, seconds=0.02, mode="sample")
    assert heard.numbers == list(range(40, 60))


def test_events_are_told_as_they_come_and_kept():
    told = []
    report, _ = ran(ScriptedDevice(fault_at=13), seconds=0.05, on_event=told.append)
    assert [e.kind for e in told] == ["fault"]
    assert report.events == tuple(told)


@pytest.mark.parametrize("cause", [e.name for e in table().enums["cause"] if e.name != "none"])
def test_each_cause_of_a_fault_is_said_with_a_remedy(cause):
    text = fault_words(DeviceEvent(kind="fault", sample=7, what=cause))
    assert text.startswith(f"{cause}, ")
    assert " at sample 7. " in text
    assert not text.endswith("Remove the cause")
