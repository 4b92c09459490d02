"""Replay: records as blocks, numbered by their time column whatever is wrong with it."""

import pickle
import time

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record, read_rows
from ambid.tracking.blocks import Block, Stretch, blocks_of, numbers_from_time, paced
from ambid.tracking.guard import StreamGuard
from tests.tracking.damage import blocks, signal

RATE = 20e3
X = signal(1000, 2)
TIME = 5.0 + np.arange(1000) / RATE


def record(values=X):
    channels = tuple(Channel(name=name, unit="1", values=values[:, k].copy()) for k, name in enumerate(("a", "b")))
    return Record(rate_hz=RATE, channels=channels, start_s=5.0)


def replayed(rows, stamps=TIME, values=X, size=100):
    """Numbers, values and rejections of what a guard gives of these rows of the record, with these stamps."""
    replay = blocks_of(record(values[rows]), size, time_s=np.asarray(stamps)[rows])
    guard = StreamGuard(RATE, 2, watched=[False] * 2)
    out = [passed for block in replay for passed in guard.take(block)] + guard.flush()
    kept = [s for s in out if isinstance(s, Stretch)]
    numbers = np.concatenate([np.arange(s.first, s.first + len(s.values)) for s in kept])
    events = {r.kind: 0 for r in out if not isinstance(r, Stretch)}
    for r in out:
        if not isinstance(r, Stretch):
            events[r.kind] += r.samples
    return numbers, np.vstack([s.values for s in kept]), events, [s.first for s in kept if s.restart]


def test_a_record_comes_whole_again_and_again():
    replay = blocks_of(record(), 300)
    for _ in range(2):
        parts = list(replay)
        assert [(b.first, len(b.values)) for b in parts] == [(0, 300), (300, 300), (600, 300), (900, 100)]
        assert [b.time_s for b in parts] == pytest.approx([5.0, 5.015, 5.03, 5.045], abs=1e-12)
        np.testing.assert_array_equal(np.vstack([b.values for b in parts]), X)


def test_channels_come_in_the_order_that_is_wanted():
    np.testing.assert_array_equal(next(iter(blocks_of(record(), 10, channels=["b", "a"]))).values, X[:10, ::-1])
    with pytest.raises(RecordError, match="no channel 'c'"):
        blocks_of(record(), 10, channels=["c"])


def test_a_replay_can_be_sent_to_another_process():
    copy = pickle.loads(pickle.dumps(blocks_of(record(), 64)))
    np.testing.assert_array_equal(np.vstack([b.values for b in copy]), X)


def test_stamps_that_are_uniform_number_the_samples_in_turn():
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 1000) / RATE
    for stamps in (TIME, TIME * (1 + 1e-4), TIME + jitter):
        np.testing.assert_array_equal(numbers_from_time(stamps, X, RATE)[0], np.arange(1000))


def test_rows_that_are_missing_leave_a_gap():
    rows = np.r_[:250, 400:1000]
    numbers, values, events, restarts = replayed(rows)
    np.testing.assert_array_equal(numbers, rows)
    np.testing.assert_array_equal(values, X[rows])
    assert (events, restarts) == ({"gap": 150}, [0, 400])


def test_rows_that_are_repeated_come_once():
    numbers, values, events, restarts = replayed(np.r_[:500, 430:1000])
    np.testing.assert_array_equal(numbers, np.arange(1000))
    np.testing.assert_array_equal(values, X)
    assert events == {"repeated": 70} or events == {"overlap": 70}
    assert restarts == [0]


def test_rows_in_wrong_order_come_in_order_or_not_at_all():
    rows = np.r_[:500, 600:700, 500:600, 700:1000]
    numbers, values, _, _ = replayed(rows)
    np.testing.assert_array_equal(values, X[numbers])
    np.testing.assert_array_equal(numbers, np.arange(1000))  # one block of rows waits for another


@pytest.mark.parametrize("jump", [-0.01, -3600.0, 1e9, -33.4e-6])
def test_a_clock_that_was_set_loses_nothing(jump):
    stamps = TIME.copy()
    stamps[555:] += jump
    numbers, values, events, restarts = replayed(np.arange(1000), stamps)
    np.testing.assert_array_equal(numbers, np.arange(1000))
    np.testing.assert_array_equal(values, X)
    if abs(jump) * RATE > 1:
        assert (events, restarts) == ({"clock": 0}, [0, 555])


def test_a_missing_stamp_between_its_neighbours_is_known_and_one_at_a_gap_is_not():
    stamps = TIME.copy()
    stamps[[0, 100, 300, 301, 999]] = np.nan
    numbers, _, events, _ = replayed(np.arange(1000), stamps)
    assert events == {"nan": 2}  # both ends: nothing says that they follow
    np.testing.assert_array_equal(numbers, np.arange(1, 999))
    rows = np.r_[:302, 310:1000]
    numbers, values, events, _ = replayed(rows, stamps)
    np.testing.assert_array_equal(numbers, np.r_[1:300, 310:999])
    np.testing.assert_array_equal(values, X[numbers])
    assert events == {"nan": 4, "gap": 8}


def test_missing_values_are_refused_and_counted():
    values = X.copy()
    values[120:125, 1] = np.nan
    numbers, _, events, restarts = replayed(np.arange(1000), TIME, values)
    np.testing.assert_array_equal(numbers, np.r_[:120, 125:1000])
    assert (events, restarts) == ({"nan": 5}, [0, 125])


def test_a_damaged_file_is_replayed(tmp_path):
    lines = [f"{t:.6f},{a:.17g},{b:.17g}" for t, (a, b) in zip(TIME, X, strict=True)]
    lines[50] = f"{TIME[50]:.6f},,1.0"
    lines[700] = f"{TIME[700]:.6f},NaN,1.0"
    del lines[300:400]
    path = tmp_path / "damaged.csv"
    path.write_text("time [s],a [V],b [mA]\n" + "\n".join(lines) + "\n")
    rows = read_rows(path)
    replay = blocks_of(rows.record, 100, time_s=rows.time_s)
    guard = StreamGuard(rows.record.rate_hz, 2)
    out = [passed for block in replay for passed in guard.take(block)] + guard.flush()
    numbers = np.concatenate([np.arange(s.first, s.first + len(s.values)) for s in out if isinstance(s, Stretch)])
    np.testing.assert_array_equal(numbers, np.r_[:50, 51:300, 400:700, 701:1000])
    assert guard.samples == {"nan": 2, "gap": 100}


@pytest.mark.parametrize("stamps", [np.round(TIME, 3), TIME * 3, np.full(1000, np.nan), TIME[::-1].copy()])
def test_stamps_that_number_nothing_are_refused(stamps):
    with pytest.raises(RecordError, match="cannot be numbered"):
        blocks_of(record(), 100, time_s=stamps)


def test_arguments_that_do_not_fit_are_refused():
    with pytest.raises(RecordError, match="at least one"):
        blocks_of(record(), 0)
    with pytest.raises(RecordError, match="999 time stamps do not fit 1000"):
        blocks_of(record(), 10, time_s=TIME[1:])


def test_blocks_are_due_when_their_last_sample_is():
    begin = time.perf_counter()
    stream = blocks(X, size=100)
    del stream[4]
    frames = list(paced(stream, RATE))
    due = np.array([f.arrived_s for f in frames])
    np.testing.assert_allclose(np.diff(due) * RATE, [100, 100, 100, 200, 100, 100, 100, 100], rtol=1e-6)
    assert due[0] - begin >= 100 / RATE
    assert time.perf_counter() >= due[-1]  # none came before it was due


def test_a_far_jump_of_the_numbers_does_not_hold_the_replay_and_a_stop_ends_it():
    stream = [
        *blocks(X)[:2],
        Block(first=10**12, time_s=0.0, values=X[:10]),
        Block(first=None, time_s=None, values=None),
    ]
    asked = []
    for _ in paced(stream, RATE, stopped=lambda: asked.append(1) or len(asked) > 2):
        pass
    assert len(asked) == 3
