"""Blocks whose every value follows from the number of its sample, and files that fail when told to."""

import errno
import os
import threading

import numpy as np

from ambid.acquisition.device import Column, DeviceEvent
from ambid.acquisition.recorder import JournalHeader, JournalReader
from ambid.acquisition.recorder.journal import JournalFile
from ambid.tracking.blocks import Block

RATE = 2000.0
ROWS = 20
COLUMNS = 3


def header(columns=COLUMNS, rate_hz=RATE, **more):
    names = [Column(name=f"c{k}", role="extra", unit="1") for k in range(columns)]
    return JournalHeader(columns=tuple(names), rate_hz=rate_hz, **more)


def values_at(first, n, columns=COLUMNS):
    """Counts, but now and then what only float64 can hold."""
    k = np.arange(first, first + n)[:, None]
    counts = ((k * 37 + np.arange(columns) * 101) % 1024).astype(float)
    return np.where((k // 100) % 3 == 0, np.sin(k + counts) * 1e-3, counts)


def block(number, rows=ROWS, columns=COLUMNS, rate_hz=RATE):
    first = number * rows
    return Block(first=first, time_s=first / rate_hz, values=values_at(first, rows, columns))


def bits(values):
    return np.ascontiguousarray(values, dtype=float).view(np.uint64)


def same_bits(a, b):
    return a.shape == b.shape and bool((bits(a) == bits(b)).all())


def contents(path):
    """Blocks and events of a journal, and what was damaged."""
    with JournalReader.open(path) as reader:
        items = list(reader.items())
        blocks = [i for i in items if isinstance(i, Block)]
        return blocks, [i for i in items if isinstance(i, DeviceEvent)], reader.damage


class FullDisk(JournalFile):
    """Takes so many bytes and no more; a write is cut off in the middle of a frame, as a disk does it."""

    room, error = 0, errno.ENOSPC

    def write(self, data):
        left = max(self.room - self.size, 0)
        super().write(data[:left])
        if left < len(data):
            raise OSError(self.error, os.strerror(self.error))

    def sync(self):
        """Nothing: hundreds of cases are quicker so."""


class FailingSync(JournalFile):
    """Fails at a sync, after which nothing is known of the pages."""

    good, error = 2, errno.EIO

    def sync(self):
        self.good -= 1
        if self.good < 0:
            raise OSError(self.error, os.strerror(self.error))
        super().sync()


class StalledDisk(JournalFile):
    """Writes nothing between `stall` and `resume`."""

    def __init__(self, path):
        super().__init__(path)
        self.free, self.reached = threading.Event(), threading.Event()
        self.free.set()

    def stall(self):
        self.free.clear()

    def write(self, data):
        if not self.free.is_set():
            self.reached.set()
            assert self.free.wait(60), "the test forgot to let the disk go on"
        super().write(data)
