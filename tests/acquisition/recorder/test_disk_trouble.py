"""The disk is full, fails, stalls, or the file is taken away: told at once, and nothing acknowledged is lost."""

import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.recorder import JournalHeader, Recorder, journal_path
from ambid.acquisition.recorder import journal as disk
from ambid.acquisition.recorder import recorder as recorder_module
from ambid.acquisition.recorder.journal import HEAD_SIZE, OVERHEAD, PREAMBLE_SIZE, json_bytes
from ambid.errors import DeviceError
from ambid.record import read_record
from ambid.tracking.blocks import Block
from tests.acquisition.recorder.signals import (
    COLUMNS,
    ROWS,
    FailingSync,
    FullDisk,
    StalledDisk,
    block,
    contents,
    header,
    same_bits,
    values_at,
)

BLOCKS = 4
SMALL = JournalHeader(columns=header(1).columns, rate_hz=1000.0)
HEADER_END = PREAMBLE_SIZE + OVERHEAD + len(json_bytes(SMALL.as_json()))

ROOT = Path(__file__).resolve().parents[3]


def small(number):
    return Block(first=number * 2, time_s=number * 2e-3, values=np.array([[float(number)], [-1.0]]))


def full_disk(room, error=errno.ENOSPC):
    return type("Full", (FullDisk,), {"room": room, "error": error})


def filled(path, room, error=errno.ENOSPC):
    """Record onto a disk that takes so many bytes; return what was told, and what had been acknowledged by then."""
    told, acknowledged = [], []
    with Recorder(
        path, SMALL, write_s=1e-4, sync_s=1e-4, open_file=full_disk(room, error),
        on_trouble=told.append, on_acknowledged=acknowledged.append,
    ) as recorder:  # fmt: skip
        for k in range(BLOCKS):
            recorder.append(small(k))
            recorder.flush()
    return recorder, told, acknowledged


def test_a_disk_that_is_full_at_any_byte_costs_nothing_acknowledged(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda fd: None)  # what is full is not the disk of this machine
    monkeypatch.setattr(disk, "_DATA_SYNC", lambda fd: None)
    frame = OVERHEAD + 4
    for room in range(HEADER_END, HEADER_END + BLOCKS * frame + 1):
        path = tmp_path / f"{room}.h5"
        recorder, told, acknowledged = filled(path, room)
        whole = (room - HEADER_END) // frame
        assert (acknowledged or [0])[-1] == recorder.acknowledged == whole, room
        assert [type(t) for t in told] == [DeviceError], room  # by the closing frame at the latest
        assert "the disk is full" in str(told[0])
        assert recorder.failed is told[0]
        assert recorder.lost_samples == 2 * (BLOCKS - whole)
        blocks, _, damage = contents(recorder.journal) if whole else ([], [], None)
        assert [b.first for b in blocks] == [2 * k for k in range(whole)]
        assert all(same_bits(b.values, small(k).values) for k, b in enumerate(blocks))
        assert damage is None or damage.frames == 0


def test_a_disk_that_is_full_from_the_start_leaves_no_journal(tmp_path):
    for room in range(0, HEADER_END, 9):
        with pytest.raises(DeviceError, match="disk is full"):
            filled(tmp_path / "run.h5", room)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "says"), [(errno.EDQUOT, "quota"), (errno.EFBIG, "largest size"), (errno.EIO, "the disk failed")]
)
def test_what_is_wrong_with_the_disk_is_said(tmp_path, error, says):
    recorder, told, _ = filled(tmp_path / "run.h5", HEADER_END + 2 * (OVERHEAD + 4) + HEAD_SIZE, error)
    assert says in str(told[0])
    assert str(recorder.journal) in str(told[0])
    assert recorder.acknowledged == 2
    assert recorder.journal.exists()  # after a disk has failed, what was read back from it proves little


def test_a_sync_that_fails_acknowledges_nothing_more(tmp_path):
    told, acknowledged = [], []
    disk = type("Disk", (FailingSync,), {"good": 3})
    with Recorder(
        tmp_path / "run.h5", header(), open_file=disk, on_trouble=told.append, on_acknowledged=acknowledged.append
    ) as recorder:
        for k in range(10):
            recorder.append(block(k))
            recorder.flush()
    assert acknowledged == [1, 2]
    assert recorder.acknowledged == 2
    assert "cannot be brought to the disk: the disk failed" in str(told[0])
    assert len(told) == 1
    assert recorder.append(block(11)) is False
    assert recorder.lost_samples >= 7 * ROWS
    assert len(contents(recorder.journal)[0]) >= 2


LIMITED = """
import resource, sys
import h5py
from ambid.acquisition.recorder import Recorder
from tests.acquisition.recorder.signals import block, header
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))  # libraries are loaded by now
told = []
recorder = Recorder(sys.argv[1], header(), write_s=1e-3, sync_s=1e-3, on_trouble=lambda e: told.append(str(e)))
try:
    with recorder:
        k = 0
        while not told:
            recorder.append(block(k))
            recorder.flush()
            k += 1
except Exception as failure:
    told.append(str(failure))
print(recorder.acknowledged, recorder.blocks, *told, sep="\\n")
"""


def test_a_limit_of_the_system_on_the_size_of_files(tmp_path):
    path, limit = tmp_path / "run.h5", 9000
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path), str(limit)], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    acknowledged, blocks, *told = done.stdout.splitlines()
    assert int(acknowledged) == int(blocks) - 1 > 3  # the one block that did not fit
    assert "largest size" in told[0]
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != limit
    found, _, damage = contents(journal_path(path))
    assert damage.tail_bytes > 0
    assert len(found) == int(acknowledged)
    assert all(same_bits(b.values, values_at(b.first, ROWS)) for b in found)


@pytest.mark.parametrize("kill_it", ["unlink", "rename"])
def test_a_journal_that_is_taken_away_is_told_and_still_becomes_a_record(tmp_path, kill_it):
    told = []
    with Recorder(tmp_path / "run.h5", header(), on_trouble=told.append, sync_s=0.01) as recorder:
        recorder.append(block(0))
        assert recorder.flush()
        if kill_it == "unlink":
            recorder.journal.unlink()
        else:
            recorder.journal.rename(tmp_path / "elsewhere")
        recorder.append(block(1))
        assert recorder.flush(10) is (kill_it == "rename")  # what a kill would take with it is not acknowledged
        assert ("removed" if kill_it == "unlink" else "moved") in str(told[0])
        recorder.append(block(2))
    assert len(told) == 1
    record = read_record(tmp_path / "run.h5")
    assert same_bits(np.column_stack([c.values for c in record.channels]), values_at(0, 3 * ROWS))
    left = {"unlink": ["run.h5"], "rename": ["elsewhere", "run.h5"]}
    assert sorted(p.name for p in tmp_path.iterdir()) == left[kill_it]


def test_another_file_in_its_place_is_left_alone(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        recorder.append(block(0))
        recorder.journal.unlink()
        recorder.journal.write_text("somebody's")
    assert recorder.journal.read_text() == "somebody's"
    assert recorder.result.survey.blocks == 1


@pytest.mark.skipif(os.getuid() == 0, reason="a superuser may write everywhere")
def test_a_folder_that_may_not_be_written_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(DeviceError, match="may not be written"), Recorder(tmp_path / "run.h5", header()):
            pass
    finally:
        tmp_path.chmod(0o700)


def test_a_folder_that_may_not_be_made_use_of_is_refused(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refused)
        with pytest.raises(DeviceError, match="may only be read"), Recorder(tmp_path / "run.h5", header()):
            pass


def test_a_folder_that_becomes_read_only_is_told_while_recording(tmp_path, monkeypatch):
    told = []
    with Recorder(tmp_path / "run.h5", header(), on_trouble=told.append, sync_s=0.01) as recorder:
        recorder.append(block(0))
        assert recorder.flush()
        with monkeypatch.context() as patch:
            patch.setattr(os, "access", lambda *_: False)
            recorder.append(block(1))
            assert recorder.flush()
    assert len(told) == 1
    assert "may not be written any more" in str(told[0])
    assert recorder.result.survey.blocks == 2


def test_a_disk_that_is_nearly_full_is_told_once(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(recorder_module, "_LOOK_S", 0.0)
    with Recorder(tmp_path / "run.h5", header(), on_trouble=told.append) as recorder:
        monkeypatch.setattr(recorder_module, "free_bytes", lambda folder: 1 << 20)
        for k in range(5):
            recorder.append(block(k))
            assert recorder.flush()
    assert len(told) == 1
    assert "nearly full: 1 MB left" in str(told[0])
    assert recorder.failed is None


def test_a_stalled_disk_is_counted_told_at_once_and_marked(tmp_path):
    disks, troubles = [], []

    def disk(path):
        disks.append(StalledDisk(path))
        return disks[0]

    room = 10  # blocks
    with Recorder(
        tmp_path / "run.h5",
        header(),
        queue_s=room * ROWS / 2000,
        on_trouble=troubles.append,
        open_file=disk,
    ) as recorder:
        recorder.append(block(0))
        assert recorder.flush()
        disks[0].stall()
        taken = [recorder.append(block(k)) for k in range(1, 31)]
        assert disks[0].reached.wait(60)
        assert taken == [True] * room + [False] * (30 - room)
        assert recorder.lost_samples == (30 - room) * ROWS
        assert len(troubles) == 1  # while the disk still stands; once, not for each block
        assert f"too slow: samples are lost from number {(room + 1) * ROWS} on" in str(troubles[0])
        disks[0].free.set()
        assert recorder.flush()
        assert recorder.append(block(31))
        data = recorder.journal.read_bytes() if recorder.flush() else b""
    (tmp_path / "copy.journal").write_bytes(data)
    _, events, _ = contents(tmp_path / "copy.journal")
    assert [(e.kind, e.sample, e.count) for e in events] == [("lost", (room + 1) * ROWS, (30 - room) * ROWS)]
    assert recorder.result.survey.gap_samples == (30 - room) * ROWS
    with pytest.raises(Exception, match="gaps"):
        read_record(tmp_path / "run.h5")
    kept = read_record(tmp_path / "run.h5", gaps="cut")
    assert kept.n_samples == (room + 1) * ROWS
    assert same_bits(np.column_stack([c.values for c in kept.channels]), values_at(0, (room + 1) * ROWS))
    assert kept.history[1].settings == {"lost_samples": (30 - room) * ROWS, "places": 1}
    assert len(kept.channels) == COLUMNS


def test_what_was_lost_at_the_end_is_marked_too(tmp_path):
    disks = []

    def disk(path):
        disks.append(StalledDisk(path))
        return disks[0]

    with Recorder(tmp_path / "run.h5", header(), queue_s=ROWS / 2000, open_file=disk) as recorder:
        disks[0].stall()
        recorder.append(block(0))
        assert disks[0].reached.wait(60)
        assert recorder.append(block(1)) is False
        disks[0].free.set()
    (event,) = recorder.result.survey.events
    assert (event.kind, event.sample, event.count) == ("lost", ROWS, ROWS)
