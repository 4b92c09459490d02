"""Forks a recording at full load for each path that it is given; run as a program of its own, so that it imports once.

A line on standard input is the path of a record, a number of blocks and a time. The recording is killed that time after
so many blocks were acknowledged; after it began to make the record if the number is 0, after its start if it is -1.
Standard output gives the number of blocks that were acknowledged until the process was gone.
"""

import os
import signal
import sys
import time

import h5py  # noqa: F401  (loaded once, not in each recording)

from ambid.acquisition.recorder import Recorder
from tests.acquisition.recorder.signals import block, header

AHEAD = 400  # blocks that may wait: the disk is the only thing that holds the load back
BLOCKS = 500  # of a recording that comes to its end


def record(path, blocks, out):
    def told(n):
        os.write(out, b"a %d\n" % n)

    with Recorder(path, header(), sync_s=0.004, write_s=0.001, queue_s=60, on_acknowledged=told) as recorder:
        number = 0
        while blocks != 0 or number < BLOCKS:
            if recorder.blocks - recorder.acknowledged < AHEAD:
                recorder.append(block(number))
                number += 1
            else:
                time.sleep(0.0005)
        os.write(out, b"closing\n")


def killed(path, blocks, delay):
    """Return the number of blocks that were acknowledged."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            record(path, blocks, writing)
        finally:
            os._exit(0)
    os.close(writing)
    acknowledged, waits = 0, blocks >= 0
    with open(reading, encoding="ascii") as told:
        while waits and (line := told.readline()):
            acknowledged = max(acknowledged, int(line[2:]) if line.startswith("a") else 0)
            waits = line != "closing\n" if blocks == 0 else acknowledged < blocks
        time.sleep(delay)
        os.kill(child, signal.SIGKILL)  # ours until it is waited for, even if it has ended
        os.waitpid(child, 0)
        return max(acknowledged, *(int(line[2:]) for line in told if line.startswith("a")), 0)


def main():
    for line in sys.stdin:
        path, blocks, delay = line.rsplit(maxsplit=2)
        os.write(1, b"%d\n" % killed(path, int(blocks), float(delay)))


if __name__ == "__main__":
    main()
