"""Bad luck of a recorder, through its public interface: what it finds at its end is told with where the samples are."""

import os

import pytest

from ambid.acquisition.recorder import JournalReader, Recorder
from ambid.acquisition.session import Course, run
from ambid.errors import DeviceError
from tests.acquisition.recorder.signals import block, header
from tests.acquisition.scripted import ScriptedDevice

BLOCKS = 3000


@pytest.fixture
def recorder(tmp_path):
    """A recorder that has brought blocks to the disk."""
    recorder = Recorder(tmp_path / "a.h5", header(), write_s=1e-3)
    recorder.__enter__()
    for k in range(BLOCKS):
        recorder.append(block(k))
        if k % 100 == 0:
            recorder.flush()
    recorder.flush()
    return recorder


def test_a_record_that_came_into_being_meanwhile_is_kept_and_so_are_the_samples(recorder):
    recorder.path.write_text("mine", encoding="utf-8")
    with pytest.raises(DeviceError, match=r"already exists.*What was recorded is in .*a\.h5\.journal: ambid recover"):
        recorder.close()
    assert recorder.path.read_text(encoding="utf-8") == "mine"
    with JournalReader.open(recorder.journal) as journal:
        assert len(list(journal.items())) == BLOCKS


def test_a_journal_that_somebody_cuts_off_meanwhile_hangs_nothing(recorder):
    os.truncate(recorder.journal, 20_000)
    recorder.append(block(BLOCKS))
    made = recorder.close()
    assert made is not None
    assert 0 < made.survey.blocks < BLOCKS


def test_a_damaged_header_costs_nothing_and_all_headers_damaged_are_not_called_an_empty_journal(recorder, tmp_path):
    data = bytearray(recorder.journal.read_bytes())
    recorder.close()
    assert data.count(b"ambid.journal/1") > 1
    data[100] ^= 1
    damaged = tmp_path / "b.h5.journal"
    damaged.write_bytes(data)
    with JournalReader.open(damaged) as journal:
        assert len(list(journal.items())) == BLOCKS
    damaged.write_bytes(data.replace(b"ambid.journal/1", b"ambid.journal/X"))
    with pytest.raises(DeviceError, match=rf"holds {BLOCKS} sound blocks.*Keep it"):
        JournalReader.open(damaged)


def test_numbers_that_come_again_make_up_for_none_that_are_lost():
    device = ScriptedDevice(gaps={1: 10, 2: -5})
    report = run(device, Course(mode="levitate", seconds=0.045), taps=[])
    assert (report.samples, report.lost) == (40, 10)
