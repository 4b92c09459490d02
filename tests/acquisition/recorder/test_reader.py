"""Damage of every kind: what is whole comes back bit by bit, what is not is counted."""

import errno
import os

import numpy as np
import pytest

from ambid.acquisition.device import DeviceEvent
from ambid.acquisition.recorder import JournalReader, Recorder
from ambid.acquisition.recorder import journal as layout
from ambid.acquisition.recorder import recorder as recorder_module
from ambid.acquisition.recorder.journal import HEADER, Head, frame_bytes, json_bytes, preamble
from ambid.errors import DeviceError
from ambid.tracking.blocks import Block
from tests.acquisition.recorder.signals import ROWS, block, contents, header, same_bits, values_at

BLOCKS = 40


def journal_bytes(folder, blocks=BLOCKS, events=(), name="source.h5"):
    with Recorder(folder / name, header()) as recorder:
        for k in range(blocks):
            recorder.append(block(k))
            if k in events:
                recorder.event(DeviceEvent(kind="note", what=f"after {k}"))
        recorder.flush()
        return recorder.journal.read_bytes()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return journal_bytes(tmp_path_factory.mktemp("journal"), events=(10, 20))


def places(data):
    """Where each frame begins, and its head."""
    found, at = [], layout.PREAMBLE_SIZE
    while at < len(data):
        head = layout.head_of(data[at : at + layout.HEAD_SIZE])
        found.append((at, head))
        at += head.size
    return found


def read(path, data):
    path.write_bytes(data)
    blocks, events, damage = contents(path)
    assert all(same_bits(b.values, values_at(b.first, ROWS)) for b in blocks)
    return blocks, events, damage


def test_a_sound_journal_has_no_damage(tmp_path, data):
    blocks, events, damage = read(tmp_path / "a.journal", data)
    assert [b.first for b in blocks] == [k * ROWS for k in range(BLOCKS)]
    assert [b.time_s for b in blocks] == [k * ROWS / 2000 for k in range(BLOCKS)]
    assert [e.what for e in events] == ["after 10", "after 20"]
    assert (damage.blocks, damage.frames, damage.places, damage.tail_bytes, damage.repeated) == (0, 0, 0, 0, 0)
    assert damage.discarded_bytes == 0


def test_wrong_bytes_cost_the_frames_that_they_are_in_and_no_other(tmp_path, data):
    rng = np.random.default_rng(2)
    starts = places(data)
    inside = [(at, head) for at, head in starts if head.kind != HEADER][:-1]
    for case in range(300):
        wrong = bytearray(data)
        hit = sorted(set(rng.integers(0, len(inside), rng.integers(1, 6)).tolist()))
        for k in hit:
            at, head = inside[k]
            for _ in range(int(rng.integers(1, 5))):
                wrong[at + int(rng.integers(0, head.size))] ^= int(rng.integers(1, 256))
        hit = [
            k for k in hit if wrong[inside[k][0] :][: inside[k][1].size] != data[inside[k][0] :][: inside[k][1].size]
        ]
        blocks, events, damage = read(tmp_path / "a.journal", bytes(wrong))
        lost = [inside[k][1] for k in hit]
        lost_blocks = sum(head.kind == layout.BLOCK for head in lost)
        assert damage.frames == len(lost), case
        assert damage.blocks == lost_blocks == BLOCKS - len(blocks), case
        assert len(events) == 2 - (len(lost) - lost_blocks), case
        assert damage.discarded_bytes == sum(head.size for head in lost), case
        assert damage.tail_bytes == 0


def test_bytes_that_are_missing_or_inserted_cost_one_place(tmp_path, data):
    at, head = places(data)[15]
    middle = at + 30
    for wrong in (
        data[:middle] + data[middle + 9 :],
        data[:middle] + layout.SYNC + b"more" + data[middle:],
        data[: at + layout.HEAD_SIZE + 3] + data[at + layout.HEAD_SIZE + 4 :],
    ):
        _, _, damage = read(tmp_path / "a.journal", wrong)
        assert (damage.frames, damage.blocks, damage.places) == (1, 1, 1)
        assert damage.discarded_bytes == head.size + len(wrong) - len(data)
    _, _, damage = read(tmp_path / "a.journal", data[:at] + b"between" + layout.SYNC + data[at:])
    assert (damage.frames, damage.places, damage.discarded_bytes) == (0, 1, 15)


def test_frames_that_are_gone_or_come_twice_are_counted(tmp_path, data):
    found = places(data)
    first, last = found[15][0], found[18][0]
    _, _, damage = read(tmp_path / "a.journal", data[:first] + data[last:])
    assert (damage.frames, damage.blocks, damage.places) == (3, 3, 0)
    blocks, _, damage = read(tmp_path / "a.journal", data[:last] + data[first:])
    assert (damage.frames, damage.repeated, len(blocks)) == (0, 3, BLOCKS)


def test_a_frame_of_another_journal_is_no_part_of_this_one(tmp_path, data):
    other = journal_bytes(tmp_path, blocks=60, name="other.h5")
    blocks, _, damage = read(tmp_path / "a.journal", data + other[layout.PREAMBLE_SIZE :])
    assert len(blocks) == BLOCKS
    assert damage.tail_bytes == len(other) - layout.PREAMBLE_SIZE


def test_the_header_comes_again_so_that_damage_at_the_beginning_costs_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "_HEADER_EVERY", 100)
    with Recorder(tmp_path / "source.h5", header(), write_s=1e-3) as recorder:
        for k in range(BLOCKS):
            recorder.append(block(k))
            recorder.flush()
        data = recorder.journal.read_bytes()
    _, _, damage = read(tmp_path / "a.journal", data)
    assert (damage.frames, damage.places) == (0, 0)
    again = [at for at, head in places(data) if head.kind == HEADER]
    assert len(again) > 3
    end = places(data)[0][1].size
    for wrong in (bytes(end) + data[end:], os.urandom(end) + data[end:]):
        blocks, _, damage = read(tmp_path / "a.journal", wrong)
        assert len(blocks) == BLOCKS
        assert (damage.blocks, damage.frames) == (0, 1)


def test_a_disk_with_a_bad_sector_costs_what_was_in_it(tmp_path):
    data = journal_bytes(tmp_path, blocks=200)

    def failing(at, n):
        if at < 12288 and at + n > 8192:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return data[at : at + n]

    reader = JournalReader(failing, len(data), tmp_path / "bad.journal")
    found = [item for item in reader.items() if isinstance(item, Block)]
    touched = [1 for at, head in places(data) if at < 12288 and at + head.size > 8192]
    assert len(found) == 200 - len(touched)
    assert reader.damage.blocks == len(touched)
    assert all(same_bits(b.values, values_at(b.first, ROWS)) for b in found)


def test_garbage_full_of_sync_words_is_passed_over(tmp_path, data):
    blocks, _, damage = read(tmp_path / "a.journal", data + layout.SYNC * 20_000)
    assert len(blocks) == BLOCKS
    assert damage.tail_bytes == 160_000


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"time [s],x [m]\n0,1\n", "is not a journal"),
        (os.urandom(5000), "is not a journal"),
        (preamble(), "no intact header"),
        (preamble() + bytes(4096), "no intact header"),
    ],
)
def test_what_is_no_journal_is_refused(tmp_path, content, says):
    (tmp_path / "a.journal").write_bytes(content)
    with pytest.raises(DeviceError, match=says):
        JournalReader.open(tmp_path / "a.journal")


def test_another_version_and_another_schema_are_refused(tmp_path):
    from zlib import crc32

    text = b"AMBIDJNL" + (9).to_bytes(4, "little")
    (tmp_path / "a.journal").write_bytes(text + crc32(text).to_bytes(4, "little"))
    with pytest.raises(DeviceError, match="version 9"):
        JournalReader.open(tmp_path / "a.journal")
    payload = json_bytes({"schema": "ambid.journal/7"})
    head = Head(kind=HEADER, journal=1, frame=0, block=0, length=len(payload))
    (tmp_path / "a.journal").write_bytes(preamble() + frame_bytes(head, payload))
    with pytest.raises(DeviceError, match=r"ambid\.journal/7"):
        JournalReader.open(tmp_path / "a.journal")


def test_a_folder_or_nothing_is_refused(tmp_path):
    with pytest.raises(DeviceError, match="folder"):
        JournalReader.open(tmp_path)
    with pytest.raises(DeviceError, match="No such file"):
        JournalReader.open(tmp_path / "none.journal")
