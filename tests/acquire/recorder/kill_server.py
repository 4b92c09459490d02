"""Forks a recording at full load for each path that it is given; run as a program of its own, so that it imports once.

A line on standard input is the path of a record, the seconds until it is closed, and those until it is killed; on
standard output come ``a N`` for N acknowledged blocks, and ``end`` when the process is gone.
"""

import os
import signal
import sys
import time

import h5py  # noqa: F401  (loaded once, not in each recording)

from ambid.acquire.recorder import Recorder
from tests.acquire.recorder.signals import block, header

AHEAD = 400  # blocks that may wait: the disk is the only thing that holds the load back


def record(path, seconds):
    def told(n):
        os.write(1, b"a %d\n" % n)

    with Recorder(path, header(), sync_s=0.004, write_s=0.001, queue_s=60, on_acknowledged=told) as recorder:
        until, number = time.monotonic() + seconds, 0
        while time.monotonic() < until:
            if recorder.blocks - recorder.acknowledged < AHEAD:
                recorder.append(block(number))
                number += 1
            else:
                time.sleep(0.0005)


def main():
    for line in sys.stdin:
        path, seconds, delay = line.rsplit(maxsplit=2)
        child = os.fork()
        if child == 0:
            try:
                record(path, float(seconds))
            finally:
                os._exit(0)
        time.sleep(float(delay))
        os.kill(child, signal.SIGKILL)  # ours until it is waited for, even if it has ended
        os.waitpid(child, 0)
        os.write(1, b"end\n")


if __name__ == "__main__":
    main()
