"""The time left of a job, shown on a terminal."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

import numpy as np
import pytest

from ambid.cli.terminal import in_words


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "nearly done"), (12.3, "about 12 s left"), (99.0, "about 99 s left"), (200.0, "about 3 min left")],
)
def test_words(seconds, words) -> None:
    assert in_words(seconds) == words


SLOWLY = """
import sys, time
from ambid.nonlinear.lagged_problem import LaggedProblem as Problem
quick = Problem.cost
def cost(*words):
    time.sleep(0.2)
    return quick(*words)
Problem.cost = cost
from ambid.cli import run
sys.exit(run(sys.argv[1:]))
"""


def test_a_fit_of_some_seconds_shows_on_a_terminal_how_long_it_still_takes(tmp_path) -> None:
    rng = np.random.default_rng(3)
    u, y, e = rng.uniform(-1, 1, 400), np.zeros(400), 0.05 * rng.standard_normal(400)
    for t in range(2, 400):
        y[t] = 0.6 * y[t - 1] + 0.9 * u[t - 2] + 0.3 * u[t - 1] ** 2 + e[t] + 0.5 * e[t - 1]
    table = np.column_stack([np.arange(400) / 100, u, y])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="")
    words = [sys.executable, "-c", SLOWLY, "fit", "r.csv", "--structure", "narmax", "--input", "u", "--output", "y"]
    ours, theirs = pty.openpty()
    job = subprocess.Popen(
        words,
        cwd=tmp_path,
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=theirs,
        env={**os.environ, "COLUMNS": "100", "TERM": "xterm"},
    )
    os.close(theirs)
    said = b""
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not piece:
            break
        said += piece
    out, _ = job.communicate()
    os.close(ours)
    assert job.returncode == 0
    assert b"r.csv: narmax" in out
    shown = re.findall(r"(\d+) %, (?:about (\d+) s left|nearly done)", said.decode(errors="replace"))
    shares, left = [int(s) for s, _ in shown], [int(x or 0) for _, x in shown]
    assert shares == sorted(shares)
    assert shares[-1] > shares[0]
    assert len(set(left)) >= 3, shown
    assert left[-1] < max(left), shown
