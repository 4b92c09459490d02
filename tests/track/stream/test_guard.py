"""Whatever happens to a stream, what the guard gives is the original, in order, once; and it goes on."""

import numpy as np
import pytest

from ambid.track.stream.guard import StreamGuard
from ambid.track.stream.outcome import Rejection, Stretch
from tests.track.stream import damage
from tests.track.stream.damage import RATE, blocks, signal

X = signal(6000)


def fed(stream, **settings):
    """Every stretch and rejection of a stream, the guard, and after which block each came."""
    guard = StreamGuard(RATE, 3, **({"limits": 1e3, "stuck": None} | settings))
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
    for seed in range(40):
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
    for seed in range(150):
        rng = np.random.default_rng([reorder, seed])
        stream = blocks(X, size=int(rng.integers(1, 150)))
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
