"""The power is cut: what was brought to the disk is there, behind it anything may be."""

import os

import numpy as np
import pytest

from ambid.acquisition.recorder import JournalReader, Recorder, journal_path, recorded_from
from ambid.acquisition.recorder.journal import JournalFile
from ambid.record.hdf5_format import read_hdf5
from ambid.tracking.blocks import Block
from tests.acquisition.recorder.signals import ROWS, block, contents, header, same_bits, values_at
from tests.tiers import ALL

CASES = 200 if ALL else 40
BLOCKS = 60


class NotedDisk(JournalFile):
    """Notes how much of it had been brought to the disk at each sync."""

    def __init__(self, path):
        super().__init__(path)
        self.synced = []

    def sync(self):
        super().sync()
        self.synced.append(self.size)


@pytest.fixture(scope="module")
def journal(tmp_path_factory):
    """Bytes of a journal; for each sync its bytes on the disk and the blocks that were acknowledged then."""
    path, disks, acknowledged = tmp_path_factory.mktemp("journal") / "run.h5", [], []

    def disk(at):
        disks.append(NotedDisk(at))
        return disks[0]

    with Recorder(path, header(), open_file=disk, on_acknowledged=acknowledged.append) as recorder:
        for k in range(BLOCKS):
            recorder.append(block(k))
            if k % 3 == 2:
                assert recorder.flush()
        data = journal_path(path).read_bytes()
    synced = disks[0].synced[1 : len(acknowledged) + 1]  # the first one is that of the header
    assert acknowledged[-1] == BLOCKS
    assert synced[-1] == len(data)
    return data, list(zip(synced, acknowledged, strict=True))


def tail_after_a_cut(rng, data, size, other):
    """What may lie behind the last byte that was brought to the disk."""
    written = data[size : size + int(rng.integers(0, 12000))]
    kind = rng.integers(0, 6)
    if kind == 0:
        return written[: int(rng.integers(0, len(written) + 1))]
    if kind == 1:
        return bytes(len(written))
    if kind == 2:
        return rng.bytes(len(written))
    if kind == 3:  # sectors come to the disk in any order
        kept = [written[k : k + 512] if rng.random() < 0.5 else bytes(512) for k in range(0, len(written), 512)]
        return b"".join(kept)
    if kind == 4:  # the file system gives a piece of another file: an older journal
        return other[int(rng.integers(0, 200)) :]
    at = int(rng.integers(0, len(written) + 1))
    return written[:at] + rng.bytes(300) + bytes(700)


def test_nothing_acknowledged_is_lost_by_a_power_cut(tmp_path, journal, monkeypatch):
    data, syncs = journal
    monkeypatch.setattr(os, "fsync", lambda fd: None)  # of the records that are made: no cut follows them
    rng = np.random.default_rng(6)
    with Recorder(tmp_path / "other.h5", header()) as other_recorder:
        for k in range(80):
            first = block(k).first
            other_recorder.append(Block(first=first, time_s=0.0, values=values_at(first, ROWS) + 1.0))
        assert other_recorder.flush()
        other = other_recorder.journal.read_bytes()
    tails = 0
    for case in range(CASES):
        size, acknowledged = syncs[int(rng.integers(0, len(syncs)))]
        path = tmp_path / f"{case}.h5.journal"
        path.write_bytes(data[:size] + tail_after_a_cut(rng, data, size, other))
        with JournalReader.open(path) as reader:
            made = recorded_from(reader, tmp_path / f"{case}.h5")
        found = made.survey
        assert found.blocks >= acknowledged, case
        tails += found.damage.tail_bytes > 0
        record = read_hdf5(tmp_path / f"{case}.h5")  # with its rows of NaN, if later blocks came through

        first = np.column_stack([c.values for c in record.channels])[: acknowledged * ROWS]
        assert same_bits(first, values_at(0, acknowledged * ROWS)), case
        assert all(same_bits(b.values, values_at(b.first, ROWS)) for b in contents(path)[0]), case
    assert tails > CASES / 4  # there was something to be passed over


def test_a_journal_cut_anywhere_gives_what_is_whole(tmp_path, journal):
    data, syncs = journal
    ends = dict(syncs)
    path = tmp_path / "cut.h5.journal"
    beginning = syncs[0][0]
    for size in range(beginning, beginning + 1500, 7):
        path.write_bytes(data[:size])
        blocks, _, damage = contents(path)
        assert len(blocks) >= max(n for end, n in ends.items() if end <= size)
        assert damage.frames == 0
        assert [b.first for b in blocks] == [k * ROWS for k in range(len(blocks))]
