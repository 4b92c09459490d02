"""A recording from beginning to end, and what is refused."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ambid.acquisition.device import Column, DeviceEvent, DeviceInfo
from ambid.acquisition.recorder import (
    JournalHeader,
    JournalReader,
    Recorder,
    convert,
    journal_path,
    read_acquisition,
)
from ambid.acquisition.recorder import recorder as recorder_module
from ambid.errors import DeviceError
from ambid.record import read_record
from ambid.tracking.blocks import Block
from tests.acquisition.recorder.signals import COLUMNS, RATE, ROWS, block, contents, header, same_bits, values_at

ROOT = Path(__file__).resolve().parents[3]


def recorded(path, numbers=range(10), **more):
    with Recorder(path, header(), **more) as recorder:
        for k in numbers:
            assert recorder.append(block(k))
    return recorder


def refused_at_the_end(path, error, match=None, numbers=range(10), before_close=lambda: None, **more):
    """Record, and fail in the end; the journal is what is left."""
    recorder = Recorder(path, header(), **more)

    def run():
        with recorder:
            for k in numbers:
                recorder.append(block(k))
            before_close()

    with pytest.raises(error, match=match):
        run()
    return recorder


def columns_of(path, gaps="error"):
    record = read_record(path, gaps=gaps)
    return np.column_stack([c.values for c in record.channels])


@pytest.mark.parametrize("name", ["run.h5", "run.hdf5", "run.csv", "run.csv.gz"])
def test_what_is_appended_is_in_the_record_bit_by_bit(tmp_path, name):
    recorder = recorded(tmp_path / name)
    assert same_bits(columns_of(tmp_path / name), values_at(0, 10 * ROWS))
    record = read_record(tmp_path / name)
    assert record.rate_hz == RATE
    assert record.names == ("c0", "c1", "c2")
    assert [p.name for p in tmp_path.iterdir()] == [name]  # neither journal nor anything half written
    assert recorder.acknowledged == recorder.blocks == 10
    assert recorder.result.survey.samples == 10 * ROWS
    assert recorder.result.survey.damage.closed
    assert not recorder.result.keep_journal


def test_all_is_acknowledged_while_it_is_recorded(tmp_path):
    told = []
    with Recorder(tmp_path / "run.h5", header(), on_acknowledged=told.append, sync_s=0.01) as recorder:
        for k in range(30):
            recorder.append(block(k))
        assert recorder.flush()
        assert recorder.acknowledged == 30
        data = journal_path(tmp_path / "run.h5").read_bytes()
    assert told == sorted(set(told))
    assert told[-1] == 30
    (tmp_path / "copy.journal").write_bytes(data)  # as it was on the disk when all was acknowledged
    blocks, _, damage = contents(tmp_path / "copy.journal")
    assert [b.first for b in blocks] == [k * ROWS for k in range(30)]
    assert (damage.frames, damage.tail_bytes, damage.closed) == (0, 0, False)


def test_header_and_events_are_beside_the_record(tmp_path):
    columns = (Column(name="x", role="position", unit="m", span=(-1e-3, 1e-3)),)
    info = DeviceInfo(kind="simulated", port="one-axis", rate_hz=RATE, columns=columns, identity={"board": 1})
    with Recorder(tmp_path / "run.h5", JournalHeader.of(info, "schema = 1\n")) as recorder:
        recorder.append(Block(first=0, time_s=0.0, values=np.full((ROWS, 1), 1e-4)))
        recorder.event(DeviceEvent(kind="fault", sample=12, what="over_current"))
        recorder.event(DeviceEvent(kind="excitation", what="prbs", sample=13))
    found, events = read_acquisition(tmp_path / "run.h5")
    assert found.columns == columns
    assert found.rig == "schema = 1\n"
    assert found.device == {"kind": "simulated", "port": "one-axis", "identity": {"board": 1}}
    assert [(e.kind, e.what, e.sample) for e in events] == [("fault", "over_current", 12), ("excitation", "prbs", 13)]
    record = read_record(tmp_path / "run.h5")
    assert record.channel("x").unit == "m"
    assert record.provenance["rig_sha256"] == found.rig_sha256
    assert record.history[0].name == "acquire"
    assert record.history[0].settings["events"] == 2
    json.dumps(found.as_json())
    with pytest.raises(DeviceError, match="no acquisition"):
        read_acquisition(tmp_path / "none.h5")


def test_a_recording_ended_by_an_error_is_still_a_record(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    recorder = refused_at_the_end(tmp_path / "run.h5", KeyboardInterrupt, before_close=interrupted)
    assert same_bits(columns_of(tmp_path / "run.h5"), values_at(0, 10 * ROWS))
    assert not recorder.journal.exists()


def test_nothing_recorded_leaves_nothing(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        assert recorder.append(Block(first=0, time_s=0.0, values=np.empty((0, COLUMNS))))
    assert recorder.result is None
    assert list(tmp_path.iterdir()) == []


def test_a_second_close_does_nothing(tmp_path):
    recorder = recorded(tmp_path / "run.h5")
    (tmp_path / "run.h5").unlink()
    assert recorder.close() is recorder.result
    assert not (tmp_path / "run.h5").exists()
    assert recorder.append(block(10)) is False
    assert recorder.lost_samples == ROWS


def test_a_second_recorder_is_refused(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        recorder.append(block(0))
        with (
            pytest.raises(DeviceError, match=r"already exists.*ambid recover"),
            Recorder(tmp_path / "run.h5", header()),
        ):
            pass
        with pytest.raises(DeviceError, match="is being written"):
            JournalReader.open(recorder.journal)
    assert same_bits(columns_of(tmp_path / "run.h5"), values_at(0, ROWS))


def test_the_lock_holds_against_another_process(tmp_path):
    journal = str(tmp_path / "run.h5.journal")
    code = f"from ambid.acquisition.recorder import JournalReader\nJournalReader.open({journal!r})"
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        recorder.append(block(0))
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "is being written" in done.stderr


FORKED = """
import os, sys
from ambid.acquisition.recorder import Recorder
from tests.acquisition.recorder.signals import block, header
recorder = Recorder(sys.argv[1], header())
recorder.__enter__()
recorder.append(block(0))
recorder.flush()
if os.fork() == 0:
    sys.stdin.read()
os._exit(0)
"""


def test_a_process_that_was_forked_off_does_not_hold_the_journal_of_a_dead_recorder(tmp_path):
    code = [sys.executable, "-c", FORKED, str(tmp_path / "run.h5")]
    with subprocess.Popen(
        code, stdin=subprocess.PIPE, cwd=ROOT
    ) as parent:  # on leaving, the child's input is closed: it ends
        assert parent.wait(60) == 0
        assert len(contents(tmp_path / "run.h5.journal")[0]) == 1


@pytest.mark.parametrize("name", ["run.mat", "run", "missing/run.h5"])
def test_a_record_that_could_not_be_written_is_refused_before(tmp_path, name):
    with pytest.raises(DeviceError), Recorder(tmp_path / name, header()):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_record_that_exists_is_refused_without_force(tmp_path):
    (tmp_path / "run.h5").write_text("precious")
    with pytest.raises(DeviceError, match="already exists"), Recorder(tmp_path / "run.h5", header()):
        pass
    assert (tmp_path / "run.h5").read_text() == "precious"
    recorded(tmp_path / "run.h5", force=True)
    assert same_bits(columns_of(tmp_path / "run.h5"), values_at(0, 10 * ROWS))


def test_a_record_that_comes_into_being_meanwhile_is_not_replaced(tmp_path):
    path = tmp_path / "run.h5"
    recorder = refused_at_the_end(path, DeviceError, "already exists", before_close=lambda: path.write_text("precious"))
    assert path.read_text() == "precious"
    assert len(contents(recorder.journal)[0]) == 10
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.h5", "run.h5.journal"]


def test_nor_is_one_that_comes_into_being_while_the_record_is_made(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    monkeypatch.setattr(convert, "_sync_file", lambda beside: path.write_text("precious"))
    recorder = refused_at_the_end(path, DeviceError, "came into being")
    assert path.read_text() == "precious"
    assert len(contents(recorder.journal)[0]) == 10
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.h5", "run.h5.journal"]


def test_columns_that_csv_cannot_hold_are_refused_before(tmp_path):
    columns = (Column(name="a,b", role="extra", unit="1"),)
    with (
        pytest.raises(DeviceError, match="cannot be a CSV column"),
        Recorder(tmp_path / "run.csv", JournalHeader(columns=columns, rate_hz=1.0)),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("columns", "rate"),
    [([], 1.0), ([("a", "1"), ("a", "1")], 1.0), ([("a", "mA")], 1.0), ([("a", "volts")], 1.0), ([("a", "V")], 0.0)],
)
def test_a_header_that_describes_no_record_is_refused(columns, rate):
    made = tuple(Column(name=name, role="extra", unit=unit) for name, unit in columns)
    with pytest.raises(DeviceError):
        JournalHeader(columns=made, rate_hz=rate)


def test_a_block_of_other_columns_is_refused(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        with pytest.raises(DeviceError, match="shape"):
            recorder.append(Block(first=0, time_s=0.0, values=np.zeros((ROWS, COLUMNS + 1))))
        recorder.append(block(0))
    assert recorder.result.survey.blocks == 1


@pytest.mark.parametrize("first", [1.5, float("nan"), 2**63])
def test_a_block_of_no_number_is_refused(tmp_path, first):
    with Recorder(tmp_path / "run.h5", header()) as recorder, pytest.raises(DeviceError, match="numbers of samples"):
        recorder.append(Block(first=first, time_s=0.0, values=values_at(0, ROWS)))


def test_a_disk_without_room_is_refused_before(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "free_bytes", lambda folder: 100 << 20)
    with pytest.raises(DeviceError, match=r"100|105 MB left"), Recorder(tmp_path / "run.h5", header(), seconds=36000):
        pass
    assert list(tmp_path.iterdir()) == []
    recorded(tmp_path / "run.h5", seconds=60)


def test_numbers_that_go_back_are_stored_and_told(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        for k in (0, 1, 2, 1, 2, 3):
            recorder.append(block(k))
    assert [(e.kind, e.sample) for e in recorder.result.survey.events] == [("note", ROWS)]
    assert recorder.result.survey.misplaced == 2 * ROWS
    assert same_bits(columns_of(tmp_path / "run.h5"), values_at(0, 4 * ROWS))
    assert len(contents(recorder.journal)[0]) == 6  # kept: it holds more than the record


@pytest.mark.parametrize("at", ["_sync_file", "_put_in_place", "_rows", "survey"])
def test_ctrl_c_while_the_record_is_made_leaves_the_journal(tmp_path, monkeypatch, at):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(convert, at, interrupted)
    recorder = refused_at_the_end(tmp_path / "run.h5", KeyboardInterrupt)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5.journal"]
    blocks, _, damage = contents(recorder.journal)
    assert len(blocks) == 10
    assert damage.closed


@pytest.mark.parametrize("name", ["run.h5", "run.csv", "run.csv.gz"])
def test_a_record_that_does_not_read_back_leaves_the_journal(tmp_path, monkeypatch, name):
    def wrong(path):
        data = bytearray(path.read_bytes())
        for at in range(len(data) // 2, len(data), 50):
            data[at] ^= 0x11
        path.write_bytes(bytes(data))

    monkeypatch.setattr(convert, "_sync_file", wrong)
    match = r"read back.*kept; then: ambid recover"
    recorder = refused_at_the_end(tmp_path / name, DeviceError, match, numbers=range(50))
    assert [p.name for p in tmp_path.iterdir()] == [f"{name}.journal"]
    assert len(contents(recorder.journal)[0]) == 50


def test_a_callback_that_fails_does_not_stop_the_recording(tmp_path):
    def fails(_):
        raise ValueError("mine")

    recorder = refused_at_the_end(tmp_path / "run.h5", ValueError, "mine", on_acknowledged=fails)
    assert same_bits(columns_of(tmp_path / "run.h5"), values_at(0, 10 * ROWS))
    assert recorder.acknowledged == 10
