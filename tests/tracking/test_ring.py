"""The ring carries blocks between processes: whole, in order, without waiting, and leaves no segment behind."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.blocks import Block
from ambid.tracking.ring import BlockRing
from tests.tracking.damage import blocks
from tests.tracking.damage import signal as noise

NAMES = ("voltage", "current", "position")
X = noise(3000)
ROOT = Path(__file__).parents[3]
# Blocks can be read off their own numbers: sample n of channel c is 3 n + c.
PRODUCER = """
import sys, time
import numpy as np
from ambid.tracking.blocks import Block
from ambid.tracking.ring import BlockRing
with BlockRing.attach(sys.argv[1]) as ring:
    for first in range(0, int(sys.argv[2]), 50):
        values = np.arange(3.0 * first, 3.0 * (first + 50)).reshape(50, 3)
        while not ring.wait_for_room(1.0):
            pass
        ring.put(Block(first=first, time_s=first / 20e3, values=values))
    ring.end()
"""


def ring(**settings):
    return BlockRing.create(**({"rate_hz": 20e3, "channels": NAMES, "slots": 8, "block_samples": 100} | settings))


def exists(name):
    return Path("/dev/shm", name).exists()


def run(code, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip


def test_what_is_put_is_read_in_order():
    with ring() as r:
        before = time.perf_counter()
        for block in blocks(X)[:5]:
            assert r.put(block)
        assert r.filled == 5
        for block in blocks(X)[:5]:
            frame = r.read(0.0)
            assert (frame.block.first, frame.block.time_s) == (block.first, block.time_s)
            np.testing.assert_array_equal(frame.block.values, block.values)
            assert before <= frame.arrived_s <= time.perf_counter()
        assert r.read(0.0) is None
        assert not r.ended
        r.end()
        assert r.ended


def test_a_full_ring_drops_the_newest_counts_and_never_waits():
    with ring() as r:
        kept = [r.put(block) for block in blocks(X)[:12]]
        assert kept == [True] * 8 + [False] * 4
        assert r.overruns == 4
        assert r.read(0.0).block.first == 0
        assert r.put(blocks(X)[20])
        got = [r.read(0.0).block.first for _ in range(8)]
        assert got == [100, 200, 300, 400, 500, 600, 700, 2000]


def test_counters_stay_right_through_many_turns():
    with ring(slots=3) as r:
        for k, block in enumerate(blocks(X, size=7) * 3):
            assert r.put(block)
            if k % 3 == 2:
                assert [r.read(0.0).block.first for _ in range(3)] == [
                    b.first for b in (blocks(X, size=7) * 3)[k - 2 : k + 1]
                ]


def test_a_block_longer_than_a_slot_is_divided_into_consecutive_ones():
    with ring() as r:
        r.put(Block(first=1000, time_s=0.05, values=X[:250]))
        got = [r.read(0.0).block for _ in range(3)]
        assert [b.first for b in got] == [1000, 1100, 1200]
        assert [b.time_s for b in got] == pytest.approx([0.05, 0.055, 0.06], rel=1e-15)
        np.testing.assert_array_equal(np.vstack([b.values for b in got]), X[:250])


@pytest.mark.parametrize(
    "values",
    [X[:5, :2], X[:5].astype(np.float32), np.arange(15).reshape(5, 3), X[:5, 0], X[:0], np.full((5, 3), np.nan)],
    ids=["channels", "float32", "int", "one dimension", "empty", "nan"],
)
def test_damaged_values_are_carried_as_they_are(values):
    with ring() as r:
        r.put(Block(first=0, time_s=0.0, values=values))
        got = r.read(0.0).block.values
        assert got.dtype == values.dtype
        np.testing.assert_array_equal(got, values)


@pytest.mark.parametrize("values", [None, np.array([object()]), np.zeros((2, 2, 2)), np.zeros((100, 40)), "text"])
def test_values_that_fit_no_slot_arrive_as_a_wrong_type(values):
    with ring() as r:
        r.put(Block(first=None, time_s=None, values=values))
        block = r.read(0.0).block
        assert block.values.dtype == object
        assert block.first < -(2**62)
        assert np.isnan(block.time_s)


@pytest.mark.parametrize("where", ["value", "head", "check", "sequence"])
def test_a_torn_frame_is_noticed_and_passed_over(where):
    with ring() as r:
        for block in blocks(X)[:3]:
            r.put(block)
        memory = SharedMemory(name=r.name)
        slot = (memory.size - r._first_slot) // r.slots
        at = r._first_slot + slot + {"value": 500, "head": 20, "check": 9, "sequence": 1}[where]
        memory.buf[at] ^= 0x10
        memory.close()
        assert [r.read(0.0).block.first, r.read(0.0).block.first] == [0, 200]
        assert r.torn == 1


def test_blocks_pass_whole_between_two_processes():
    total = 40_000
    with ring() as r:
        other = run(PRODUCER, r.name, total)
        first = 0
        while not r.ended:
            frame = r.read(10.0)
            assert frame is not None
            assert frame.block.first == first
            np.testing.assert_array_equal(frame.block.values.ravel(), np.arange(3.0 * first, 3.0 * (first + 50)))
            first += 50
        assert (first, r.overruns, r.torn) == (total, 0, 0)
        out, err = other.communicate(timeout=20)
        assert (other.returncode, out, err) == (0, "", "")
        assert exists(r.name)  # the other process did not remove what is not its own
    assert not exists(r.name)


def test_two_in_one_role_are_refused():
    code = """
import sys
from ambid.tracking.ring import BlockRing
from ambid.errors import EstimationError
with BlockRing.attach(sys.argv[1]) as ring:
    try:
        ring.read(0.0)
    except EstimationError as error:
        print(error)
"""
    with ring() as r:
        r.read(0.0)
        out, err = run(code, r.name).communicate(timeout=20)
        assert f"process {os.getpid()} consumes" in out
        assert err == ""


def test_header_tells_what_flows():
    with ring(slots=5) as r, BlockRing.attach(r.name) as other:
        assert (other.rate_hz, other.channels, other.slots, other.block_samples) == (20e3, NAMES, 5, 100)


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="shared memory is no file here")
def test_memory_without_room_is_refused_when_the_ring_is_made_and_leaves_nothing(monkeypatch):
    def full(fd, offset, size):
        raise OSError(errno.ENOSPC, "No space left on device")

    before = set(os.listdir("/dev/shm"))
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(EstimationError, match=r"No space left on device. Make room for it .on Linux in /dev/shm"):
        ring()
    mine = f"ambid-{os.getpid()}-"
    assert not [name for name in set(os.listdir("/dev/shm")) - before if name.startswith(mine)]


def test_something_else_is_not_attached_to():
    with pytest.raises(EstimationError, match="there is no shared memory 'ambid-none'"):
        BlockRing.attach("ambid-none")
    with ring() as r:
        memory = SharedMemory(name=r.name)
        memory.buf[8] += 1
        with pytest.raises(EstimationError, match="version 3"):
            BlockRing.attach(r.name)
        memory.buf[8] -= 1
        memory.buf[33] ^= 1
        with pytest.raises(EstimationError, match="damaged header"):
            BlockRing.attach(r.name)
        memory.buf[0] = 0
        with pytest.raises(EstimationError, match="no ring"):
            BlockRing.attach(r.name)
        memory.close()


@pytest.mark.parametrize("wrong", [{"slots": 0}, {"block_samples": 0}, {"channels": ()}, {"rate_hz": 0.0}])
def test_an_empty_ring_is_refused(wrong):
    with pytest.raises(EstimationError, match="holds nothing"):
        ring(**wrong)


ENDS = {
    "normal": "",
    "exception": "raise ValueError('on purpose')",
    "interrupt": "print('ready', flush=True); time.sleep(60)",
    "not closed": "keep = ring; os._exit  # left to the interpreter",
}


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="looks for segments where Linux keeps them")
@pytest.mark.parametrize("how", ENDS)
def test_no_segment_is_left_and_nothing_is_said(how):
    opened = "ring = BlockRing.create(rate_hz=1.0, channels=['a'])"
    body = f"print(ring.name, flush=True)\n    other = BlockRing.attach(ring.name)\n    {ENDS[how] or 'other.close()'}"
    code = f"import os, time\nfrom ambid.tracking.ring import BlockRing\n{opened}\n"
    code += f"if True:\n    {body}\n" if how == "not closed" else f"with ring:\n    {body}\n"
    process = run(code)
    name = process.stdout.readline().strip()
    if how == "interrupt":
        assert process.stdout.readline().strip() == "ready"
        process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert name
    assert not exists(name)
    assert "leaked" not in err
    assert "resource_tracker" not in err
    assert "BufferError" not in err
    if how in ("normal", "not closed"):
        assert (process.returncode, err) == (0, "")


def test_a_dead_producer_is_followed_by_another():
    with ring() as r:
        run(PRODUCER, r.name, 100).communicate(timeout=20)
        assert [r.read(1.0).block.first for _ in range(2)] == [0, 50]
        assert r.ended
        run(PRODUCER, r.name, 50).communicate(timeout=20)
        assert r.read(1.0).block.first == 0


def test_names_may_be_anything_json_can_hold():
    with ring(channels=("Strom α", "x [mm]")) as r, BlockRing.attach(r.name) as other:
        assert json.dumps(other.channels) == json.dumps(("Strom α", "x [mm]"))
