"""Whatever happens to a stream, what the guard gives is the original, in order, once; and it goes on."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.blocks import Block, Rejection, Stretch
from ambid.tracking.guard import StreamGuard
from tests.tracking import damage
from tests.tracking.damage import RATE, blocks, signal

X = signal(6000)


def fed(stream, **settings):
    """Every stretch and rejection of a stream, the guard, and after which block each came."""
    guard = StreamGuard(RATE, 3, **({"limits": 1e3, "watched": [False] * 3} | settings))
    out = [(k, passed) for k, block in enumerate(stream) for passed in guard.take(block)]
    out += [(len(stream), passed) for passed in guard.flush()]
    return guard, out


def stretches(out):
    return [passed for _, passed in out if isinstance(passed, Stretch)]


def rejections(out):
    return [passed for _, passed in out if isinstance(passed, Rejection)]


def numbers(out):
    return np.concatenate([[], *(np.arange(s.first, s.first + len(s.values)) for s in stretches(out))]).astype(int)


def check_original(out, values, guard):
    """The property that must hold whatever happened."""
    end = None
    for s in stretches(out):
        np.testing.assert_array_equal(s.values, values[s.first : s.first + len(s.values)])
        assert s.values.dtype == np.float64
        assert len(s.values)
        if end is None:
            assert s.restart
        else:
            assert s.first >= end
            assert s.restart or s.first == end
        end = s.first + len(s.values)
    assert guard.n_given == sum(len(s.values) for s in stretches(out))
    assert guard.n_received == guard.n_given + guard.n_rejected
    assert guard.n_waiting == 0
    assert guard.n_rejected + guard.n_missing == sum(r.samples for r in rejections(out))
    assert all("\n" not in r.why and r.why for r in rejections(out))


def test_a_sound_stream_passes_whole():
    stream = blocks(X)
    guard, out = fed(stream)
    check_original(out, X, guard)
    assert [s.restart for s in stretches(out)] == [True] + [False] * (len(stream) - 1)
    assert numbers(out).tolist() == list(range(6000))
    assert rejections(out) == []
    assert all(passed.first + 100 <= 100 * (k + 1) for k, passed in out[2:])  # nothing waits once it has begun


@pytest.mark.parametrize("kind", damage.ALL, ids=lambda kind: kind.__name__)
def test_one_damage_is_met_and_the_stream_goes_on_with_the_next_sound_block(kind):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stream = blocks(X)
        kind(stream, 20, rng)
        guard, out = fed(stream)
        check_original(out, X, guard)
        lost = 6000 - numbers(out).size
        assert lost <= 100  # a damaged block costs itself at most
        assert numbers(out)[-3000:].tolist() == list(range(3000, 6000))


@pytest.mark.parametrize("reorder", [0, 1, 3])
def test_no_mixture_of_damages_corrupts_what_is_given(reorder):
    for seed in range(100):
        rng = np.random.default_rng([reorder, seed])
        stream = blocks(X, size=int(rng.integers(3, 150)))
        for _ in range(rng.integers(1, 12)):
            kind = damage.ALL[rng.integers(len(damage.ALL))]
            before = list(stream)
            try:
                kind(stream, int(rng.integers(0, max(len(stream) - 30, 1))), rng)
            except (TypeError, AttributeError, IndexError, ValueError):
                stream = before  # it met a block that another damage has made unfit for it
        guard, out = fed(stream, reorder=reorder)
        check_original(out, X, guard)
        tail = stream[-10].first
        assert np.array_equal(numbers(out)[numbers(out) >= tail], np.arange(tail, 6000)), seed


def shifted(stream, k, *, number=0, time_s=0.0):
    """The stream with the counter and the clock set off from block k on."""
    return stream[:k] + [replace(b, first=b.first + number, time_s=b.time_s + time_s) for b in stream[k:]]


def kinds(out):
    return [(r.kind, r.samples) for r in rejections(out)]


def test_each_damage_has_its_name_and_its_number_of_samples():
    stream = blocks(X)
    nan = X.copy()
    nan[1010:1030, 1] = np.nan
    cases = {
        "gap": (stream[:10] + stream[12:], [("gap", 200)]),
        "repeated": (stream[:11] + stream[10:], [("repeated", 100)]),
        "late": (stream[:10] + stream[11:14] + [stream[10]] + stream[14:], [("gap", 100), ("repeated", 100)]),
        "nan": (blocks(nan), [("nan", 20)]),
        "clock": (shifted(stream[:11], 10, time_s=1.0) + stream[11:], [("clock", 100)]),
        "number": (shifted(stream[:11], 10, number=700) + stream[11:], [("number", 100), ("gap", 100)]),
        "jump": (shifted(stream, 10, time_s=-1.0), [("clock", 0)]),
        "empty": ([*stream[:10], Block(first=1000, time_s=0.05, values=X[:0]), *stream[10:]], [("empty", 0)]),
    }
    for name, (damaged, expected) in cases.items():
        _, out = fed(damaged)
        assert kinds(out) == expected, name
        first = {"nan": 1010, "number": 1700}.get(name, 1000)
        assert rejections(out)[0].t == first / RATE, name


def test_neighbours_in_wrong_order_are_put_right():
    stream = blocks(X)
    stream[10], stream[11] = stream[11], stream[10]
    _, out = fed(stream)
    assert rejections(out) == []
    assert numbers(out).size == 6000
    assert sum(s.restart for s in stretches(out)) == 1


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_a_gap_delays_by_the_depth_of_the_buffer_and_no_more(depth):
    stream = blocks(X)
    del stream[10]
    _, out = fed(stream, reorder=depth)
    came = next(k for k, passed in out if isinstance(passed, Stretch) and passed.first == 1100)
    assert came == 10 + depth
    assert sum(s.restart for s in stretches(out)) == 2


@pytest.mark.parametrize("jump", [1e-3, -1e-3, 0.3, -3600.0, 1e9])
def test_a_clock_that_jumps_costs_no_sample_but_the_memory_of_the_signals(jump):
    guard, out = fed(shifted(blocks(X), 20, time_s=jump))
    check_original(out, X, guard)
    assert numbers(out).size == 6000
    assert [s.first for s in stretches(out) if s.restart] == [0, 2000]
    assert kinds(out) == [("clock", 0)]
    assert ("forward" if jump > 0 else "back") in rejections(out)[0].why


def test_drift_and_jitter_of_a_clock_are_no_damage():
    values = signal(400_000, 1)
    rng = np.random.default_rng(3)
    stream = [
        replace(b, time_s=b.time_s * (1 - 8e-5) + rng.uniform(-0.3, 0.3) / RATE) for b in blocks(values, size=100)
    ]
    guard = StreamGuard(RATE, 1)
    out = [passed for b in stream for passed in guard.take(b)] + guard.flush()
    assert not [r for r in out if isinstance(r, Rejection)]
    assert guard.n_given == 400_000
    assert guard.drift == pytest.approx(-8e-5, abs=3e-6)


def test_a_counter_set_back_under_a_running_clock_costs_one_block():
    stream = blocks(X)
    stream = stream[:30] + [replace(b, first=b.first - 3000) for b in stream[30:]]
    guard, out = fed(stream)
    assert kinds(out) == [("repeated", 100), ("number", 0)]
    assert guard.n_given == 5900
    # The samples after it go on under the next numbers: what was lost has none.
    np.testing.assert_array_equal(np.vstack([s.values for s in stretches(out)]), np.delete(X, np.s_[3000:3100], axis=0))
    assert numbers(out).tolist() == list(range(5900))
    assert [s.first for s in stretches(out) if s.restart] == [0, 3000]


def test_an_acquisition_that_begins_anew_is_followed_when_patience_is_over():
    stream = [*blocks(X[:3000]), *(Block(first=b.first, time_s=b.time_s, values=b.values) for b in blocks(-X))]
    guard, out = fed(stream, patience_s=0.05)
    assert guard.samples["repeated"] == 900
    assert guard.n_given == 3000 + 5100
    after = [s for s in stretches(out) if s.first >= 3000]
    assert after[0].restart
    np.testing.assert_array_equal(np.vstack([s.values for s in after]), -X[900:])
    assert numbers(out).tolist() == list(range(8100))


def test_a_long_repetition_is_never_given_twice_while_patience_lasts():
    stream = blocks(X)
    guard, out = fed(stream[:40] + stream[5:40] + stream[40:])
    check_original(out, X, guard)
    assert numbers(out).size == 6000


def test_a_first_block_that_is_wrong_numbers_nothing():
    stream = blocks(X)
    for wrong in ({"first": 2**40}, {"time_s": 77.0}, {"time_s": np.nan}, {"first": -5}):
        guard, out = fed([replace(stream[0], **wrong), *stream[1:]])
        check_original(out, X, guard)
        assert numbers(out).tolist() == list(range(100, 6000))
    assert numbers(fed(stream[:1])[1]).tolist() == list(range(100))  # but one that nothing contradicts is given


def test_an_overlap_with_other_values_is_refused_and_starts_the_memory_anew():
    stream = blocks(X)
    both = np.vstack([X[950:1000] + 1.0, X[1000:1100]])
    stream[10] = Block(first=950, time_s=950 / RATE, values=both)
    guard, out = fed(stream)
    check_original(out, X, guard)
    assert kinds(out) == [("contradiction", 150)]
    assert [s.first for s in stretches(out) if s.restart] == [0, 1100]


def test_blocks_are_neither_changed_nor_kept():
    buffer = np.empty((100, 3))
    guard = StreamGuard(RATE, 3, watched=[False] * 3)
    kept = []
    for block in blocks(X):
        buffer[:] = block.values
        kept += guard.take(replace(block, values=buffer))
        np.testing.assert_array_equal(buffer, block.values)
        buffer[:] = np.nan  # an acquisition uses its buffer again
    kept += guard.flush()
    np.testing.assert_array_equal(np.vstack([s.values for s in kept]), X)


def test_memory_stays_bounded_whatever_comes():
    guard = StreamGuard(RATE, 3)
    rng = np.random.default_rng(0)
    for _ in range(3000):
        guard.take(Block(first=int(rng.integers(0, 2**40)), time_s=float(rng.uniform(0, 1e6)), values=X[:50]))
        assert guard.n_waiting <= 2
        assert len(guard._order._refused) <= 8


@pytest.mark.parametrize("wrong", [{"reorder": -1}, {"patience_s": 0.0}, {"watched": [True]}])
def test_settings_that_make_no_guard_are_refused(wrong):
    with pytest.raises(EstimationError, match=r"Correct it"):
        StreamGuard(RATE, 3, **wrong)
    with pytest.raises(EstimationError, match="rate"):
        StreamGuard(0.0, 3)
