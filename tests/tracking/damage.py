"""A known stream and everything that can happen to its blocks."""

from dataclasses import replace

import numpy as np

from ambid.tracking.blocks import Block

RATE = 20_000.0


def signal(n, n_channels=3, seed=0):
    """Noise: every value says which sample it is."""
    return np.random.default_rng(seed).standard_normal((n, n_channels))


def blocks(values, size=100, rate=RATE, start=0):
    return [Block(first=start + k, time_s=k / rate, values=values[k : k + size]) for k in range(0, len(values), size)]


def drop(stream, k, rng):
    del stream[k]


def repeat(stream, k, rng):
    run = stream[k : k + rng.integers(1, 6)]
    at = k + len(run) + rng.integers(0, 4)
    stream[at:at] = run


def overlap(stream, k, rng):
    a, b = stream[k], stream[k + 1]
    sound = a.first + len(a.values) == b.first and all(
        v.dtype == np.float64 and v.ndim == 2 for v in (a.values, b.values)
    )
    if sound and a.values.shape[1] == b.values.shape[1]:
        m = int(rng.integers(1, len(a.values) + 1))
        time_s = b.time_s - m / RATE
        stream[k + 1] = Block(first=b.first - m, time_s=time_s, values=np.vstack([a.values[-m:], b.values]))


def swap(stream, k, rng):
    stream[k], stream[k + 1] = stream[k + 1], stream[k]


def late(stream, k, rng):
    stream.insert(k + rng.integers(2, 6), stream.pop(k))


def _with_cells(stream, k, rng, bad):
    values = np.array(stream[k].values)
    if values.dtype == np.float64 and values.ndim == 2 and values.size:
        first = rng.integers(0, len(values))
        values[first : first + rng.integers(1, 40), rng.integers(0, values.shape[1])] = bad
        stream[k] = replace(stream[k], values=values)


def nans(stream, k, rng):
    _with_cells(stream, k, rng, rng.choice([np.nan, np.inf, -np.inf]))


def absurd(stream, k, rng):
    _with_cells(stream, k, rng, rng.choice([1e9, -3e200, 1.7e308]))


def stamp(stream, k, rng):
    off = rng.choice([rng.uniform(1e-3, 1e4), -rng.uniform(1e-3, 1e4), np.nan, np.inf])
    stream[k] = replace(stream[k], time_s=stream[k].time_s + off)


def clock_jump(stream, k, rng):
    off = rng.choice([-1, 1]) * rng.uniform(1e-3, 1e3)
    stream[k:] = [replace(b, time_s=b.time_s + off) for b in stream[k:]]


def number(stream, k, rng):
    # No size comes often: two blocks that are wrong alike are a counter that jumped, which is another matter.
    off = int(rng.choice([-1, 1]) * rng.integers(1, rng.choice([100, 5000, 2**31, 2**40])))
    stream[k] = replace(stream[k], first=stream[k].first + off)


def no_number(stream, k, rng):
    stream[k] = replace(stream[k], first=rng.choice(np.array([None, "7", 0.5, 2**70], dtype=object)))


def channels(stream, k, rng):
    stream[k] = replace(stream[k], values=np.array(stream[k].values)[..., : rng.integers(1, 3)])


def kind(stream, k, rng):
    wrong = rng.integers(0, 4)
    values = stream[k].values
    stream[k] = replace(
        stream[k],
        values=[values.astype(np.float32), (1000 * np.nan_to_num(values)).astype(np.int32), None, values.ravel()][wrong]
        if isinstance(values, np.ndarray)
        and values.dtype == np.float64
        and np.abs(np.nan_to_num(values)).max(initial=0) < 1e3
        else None,
    )


def empty(stream, k, rng):
    stream.insert(k, replace(stream[k], values=np.empty((0, 3))))


ALL = (
    drop, repeat, overlap, swap, late, nans, absurd, stamp, clock_jump, number, no_number, channels, kind, empty
)  # fmt: skip
