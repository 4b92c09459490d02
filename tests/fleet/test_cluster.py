"""Dask's cluster on this machine: what happens to its workers is mended, or told in a line."""

import subprocess
import sys
import time
from contextlib import suppress

import pytest

pytest.importorskip("distributed", reason="Dask's distributed is not installed")
psutil = pytest.importorskip("psutil")  # which distributed needs

PARENT = """
import os
import signal
import distributed
from ambid.fleet import cluster
from ambid.fleet.cluster import _answers, _client
cluster._GONE_S = 2.0
from tests.fleet.jobs import double
async def fails():
    raise RuntimeError("killed as it started")
if __name__ == "__main__":
    with _client(distributed, 1) as client:
        if {gone}:
            for nanny in client.cluster.workers.values():
                nanny.instantiate = fails
                os.kill(nanny.pid, signal.SIGKILL)
        print(sorted(d.value for d in _answers(distributed, client, double, iter(range(5)), 10.0, lambda: False)))
"""


def run_parent(*, gone):
    return subprocess.Popen(
        [sys.executable, "-c", PARENT.format(gone=gone)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_workers_that_are_gone_for_good_are_replaced():
    out, said = run_parent(gone=True).communicate(timeout=120)
    assert out.strip() == "[0, 2, 4, 6, 8]", said


def test_workers_that_do_not_start_are_told():
    begun = run_parent(gone=False)
    end = time.monotonic() + 60
    while begun.poll() is None and time.monotonic() < end:
        with suppress(psutil.Error):
            for child in psutil.Process(begun.pid).children():
                if "spawn_main" in " ".join(child.cmdline()):
                    child.kill()
        time.sleep(0.05)
    assert (
        begun.communicate(timeout=10)[1]
        .splitlines()[-1]
        .startswith("ambid.errors.AmbidError: the workers did not start (")
    )
