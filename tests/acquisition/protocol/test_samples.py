"""Frames of samples to arrays: values, numbers over 16 bits, gaps and what is dropped, against a truth known sample by
sample."""

import struct

import numpy as np
import pytest

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import pack
from ambid.acquisition.protocol.samples import SampleCounters, SampleDecoder, columns_of
from ambid.errors import DeviceError
from tests.acquisition.protocol.vectors import sample

MASK = 0b1011  # position, current, duty


def payloads(ticks):
    """Samples whose values tell the whole number of their tick."""
    return [struct.pack("<BHBHHH", 1, t & 0xFFFF, 3, t & 0xFFFF, t >> 16 & 0xFFFF, t >> 32) for t in ticks]


def whole(samples):
    return (samples.values @ [1.0, 65536.0, 2.0**32]).astype(np.int64)


def fed(decoder, ticks, source, *, biggest=400, times=None):
    """Feed in pieces of random size; return all numbers given out, checked against the values of their samples."""
    frames, given, gaps, at = payloads(ticks), [], [], 0
    while at < len(frames):
        end = min(at + int(source.integers(1, biggest)), len(frames))
        out = [decoder.decode(frames[at:end], None if times is None else times[end - 1])]
        if end == len(frames):
            out.append(decoder.finish())
        for samples in out:
            np.testing.assert_array_equal(samples.ticks, whole(samples))
            given += samples.ticks.tolist()
            gaps += samples.gaps
        at = end
    return given, gaps


def brute_force_gaps(ticks, first=0):
    expected, found = first, []
    for tick in ticks:
        if tick != expected:
            found.append((expected, tick - expected))
        expected = tick + 1
    return found


def random_ticks(source, runs, longest_gap):
    """Numbers of the samples that came: runs of random length, between them gaps, many short and some long."""
    ticks, at = [], 0
    for _ in range(runs):
        gap = int(longest_gap ** source.random()) if source.random() < 0.9 else 0
        at += gap
        length = int(300 ** source.random())
        ticks += range(at, at + length)
        at += length
    return ticks


@pytest.mark.parametrize("seed", range(30))
def test_every_sample_gets_its_number_and_every_gap_is_counted(seed):
    source = np.random.default_rng(seed)
    ticks = random_ticks(source, runs=100, longest_gap=32_000)
    decoder = SampleDecoder(MASK)
    given, gaps = fed(decoder, ticks, source)
    truth = brute_force_gaps(ticks)
    assert given == ticks
    assert gaps == truth
    assert decoder.counters == SampleCounters(
        samples=len(ticks), lost=ticks[-1] + 1 - len(ticks), gaps=len(truth), damaged=0, misnumbered=0, repeated=0
    )


@pytest.mark.parametrize("seed", range(12))
def test_long_gaps_are_counted_by_the_hosts_clock(seed):
    """Gaps of up to ten minutes, a clock that is wrong by up to 0.5 %, and a host that sleeps while samples wait."""
    source = np.random.default_rng(seed)
    rate, drift = 2000.0, 1 + source.uniform(-5e-3, 5e-3)
    starts = np.cumsum(np.r_[0, 3000 + (1_200_000 ** source.random(30)).astype(int)])
    ticks = [int(s + k) for s in starts for k in range(500)]
    taken = np.array(ticks) / rate * drift
    times = np.maximum.accumulate(taken + source.exponential(2e-3, len(ticks)))
    for begin in np.arange(5.0, times[-1], 20.0) + source.uniform(0, 9):  # of each 20 s the host sleeps for 10
        times = np.where((times >= begin) & (times < begin + 10.0), begin + 10.0, times)
    decoder = SampleDecoder(MASK, rate_hz=rate)
    given, gaps = fed(decoder, ticks, source, biggest=40, times=times)
    assert given == ticks
    assert gaps == brute_force_gaps(ticks)
    assert max(count for _, count in gaps) > 65536


def test_a_host_that_slept_does_not_take_its_full_buffer_for_a_gap():
    """All 45 s of samples arrive together after it: nothing is lost, the number of the next one is contiguous."""
    decoder = SampleDecoder(MASK, rate_hz=2000.0)
    first = decoder.decode(payloads(range(100)), 0.05)
    late = decoder.decode(payloads(range(100, 90_100)), 45.05)
    after = decoder.decode(payloads(range(90_101, 90_200)), 45.1)
    assert len(first) == 100
    assert late.ticks[-1] == 90_099
    assert after.ticks[0] == 90_101
    assert decoder.counters.lost == 1


def test_a_buffer_that_ran_over_while_the_host_slept():
    decoder = SampleDecoder(MASK, rate_hz=2000.0)
    decoder.decode(payloads(range(100)), 0.05)
    rest = decoder.decode(payloads([*range(100, 400), *range(80_000, 80_100)]), 40.05)
    assert rest.ticks[-1] == 80_099
    assert rest.gaps == ((400, 79_600),)


def test_without_times_a_long_gap_is_short_by_a_multiple_of_65536():
    decoder = SampleDecoder(MASK)
    decoder.decode(payloads(range(10)))
    assert decoder.decode(payloads(range(100_000, 100_010))).ticks[0] == 100_000 - 65_536
    assert decoder.counters.lost == 100_000 - 65_536 - 10


def test_a_number_that_is_not_gone_on_from_is_dropped_and_counted():
    """As from a damaged frame whose check value is right by chance; also where it is the last one of a call."""
    ticks = [0, 1, 2, 3, 30_000, 5, 6, 7]
    for cut in range(len(ticks)):
        decoder = SampleDecoder(MASK)
        found = [decoder.decode(payloads(p)) for p in (ticks[:cut], ticks[cut:])] + [decoder.finish()]
        assert [t for s in found for t in s.ticks.tolist()] == [0, 1, 2, 3, 5, 6, 7]
        assert [g for s in found for g in s.gaps] == [(4, 1)]
        assert decoder.counters == SampleCounters(samples=7, lost=1, gaps=1, misnumbered=1)


def test_a_jump_is_held_until_the_next_sample_speaks_for_it():
    decoder = SampleDecoder(MASK)
    assert len(decoder.decode(payloads([0, 1, 9]))) == 2
    after = decoder.decode(payloads([10]))
    assert after.ticks.tolist() == [9, 10]
    assert after.gaps == ((2, 7),)
    assert len(decoder.decode(payloads([12]))) == 0
    assert decoder.finish().ticks.tolist() == [12]


def test_a_sample_that_comes_twice_is_dropped_and_counted():
    decoder = SampleDecoder(MASK)
    found = decoder.decode(payloads([0, 1, 1, 2, 2]))
    assert found.ticks.tolist() == [0, 1, 2]
    assert decoder.counters == SampleCounters(samples=3, repeated=2)


def test_what_is_lost_at_either_end_is_counted():
    decoder = SampleDecoder(MASK)
    decoder.decode(payloads([3, 4]))
    assert decoder.finish(ticks=10).gaps == ((5, 5),)
    assert decoder.counters == SampleCounters(samples=2, lost=8, gaps=2)
    assert decoder.finish(ticks=10).gaps == ()
    assert decoder.finish(ticks=7).gaps == ()


def test_a_new_start_and_a_stream_joined_on_its_way():
    decoder = SampleDecoder(MASK)
    decoder.decode(payloads(range(5)))
    decoder.restart()
    assert decoder.decode(payloads(range(3))).ticks.tolist() == [0, 1, 2]
    decoder.restart(None)
    assert decoder.next_tick is None
    assert decoder.decode(payloads([700, 701])).ticks.tolist() == [700, 701]
    decoder.decode(payloads([900]))
    decoder.restart(70_000)
    assert decoder.decode(payloads([70_000])).ticks.tolist() == [70_000]
    assert decoder.next_tick == 70_001
    assert decoder.counters == SampleCounters(samples=11, misnumbered=1)


def test_values_states_and_causes():
    decoder = SampleDecoder(0b111111)
    names = [c.name for c in columns_of(0b111111)]
    assert names == ["analog_0", "analog_1", "analog_2", "duty", "excitation", "setpoint"]
    found = decoder.decode([pack(sample(0, [1, 2, 3, 4, 65536 - 5, 65535], state=4, cause=8))])
    np.testing.assert_array_equal(found.values, [[1, 2, 3, 4, -5, 65535]])
    assert found.values.dtype == np.float64
    assert found.values.flags.c_contiguous
    assert (found.states[0], found.causes[0]) == (table().value("state", "fault"), table().value("cause", "watchdog"))


def test_a_sample_of_another_stream_or_of_no_state_is_damaged():
    decoder = SampleDecoder(MASK)
    bad = [sample(0, [1, 2]), sample(0, [1, 2, 3, 4]), sample(0, [1, 2, 3], state=5), sample(0, [1, 2, 3], cause=9)]
    found = decoder.decode([pack(m) for m in bad] + payloads([0]))
    assert found.ticks.tolist() == [0]
    assert decoder.counters == SampleCounters(samples=1, damaged=4)


def test_no_columns_and_no_samples():
    decoder = SampleDecoder(0)
    assert decoder.decode([]).values.shape == (0, 0)
    assert decoder.decode([pack(sample(0, []))]).values.shape == (1, 0)
    assert SampleDecoder(MASK).decode([]).runs() == []


def test_runs_are_the_pieces_without_a_gap():
    found = SampleDecoder(MASK).decode(payloads([0, 1, 5, 6, 7, 9, 10]))
    assert [found.ticks[run].tolist() for run in found.runs()] == [[0, 1], [5, 6, 7], [9, 10]]


def test_an_unknown_bit_of_the_stream_is_refused():
    with pytest.raises(DeviceError, match="stream mask 0x40"):
        SampleDecoder(0x40)
