"""The time left of a job: right at an even pace, in time right after a change, never jumping; shown on a terminal."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

import numpy as np
import pytest

from ambid.cli.terminal import TimeLeft, in_words


def course(shares, *, step=0.1, end=None):
    """Time left at each step of a job whose share over time is given, as (time, time left)."""
    told, found = TimeLeft(0.0), []
    for t in np.arange(0.0, end, step):
        told.take(shares(t), t)
        left = told.left(t)
        if left is not None:
            found.append((t, left))
    return np.array(found)


def test_an_even_pace_is_told_exactly() -> None:
    t, left = course(lambda t: t / 20.0, end=20.0).T
    assert t[0] < 1.0
    np.testing.assert_allclose(left, 20.0 - t, atol=0.2)


def test_after_a_change_of_pace_it_is_right_again_and_does_not_jump() -> None:
    """Half of the work takes 5 s, the other half 20 s."""
    t, left = course(lambda t: t / 10 if t < 5 else 0.5 + (t - 5) / 40, end=25.0).T
    late = t > 12.0
    np.testing.assert_allclose(left[late], 25.0 - t[late], atol=0.2 * 13.0)
    assert np.max(np.diff(left)) < 1.5  # in a tenth of a second, though expectation rises from 5 s to 20 s
    assert left[-1] < 1.5


def test_uneven_words_give_an_even_countdown() -> None:
    """A word each second or so, of what was done meanwhile."""
    told, shown = TimeLeft(0.0), []
    words = iter(np.cumsum(np.random.default_rng(1).uniform(0.2, 1.8, 40)))
    due = next(words)
    for t in np.arange(0.0, 25.0, 0.1):
        if t >= due:
            told.take(due / 30.0, t)
            due = next(words)
        if t > 5.0:
            shown.append((t, told.left(t)))
    t, left = np.array(shown).T
    np.testing.assert_allclose(left, 30.0 - t, atol=2.5)
    assert np.max(np.diff(left)) < 0.3


def test_without_news_it_runs_down_to_half_and_waits() -> None:
    told = TimeLeft(0.0)
    assert told.share is None
    told.take(0.0, 0.0)
    assert told.left(5.0) is None
    told.take(0.5, 5.0)
    for t in np.arange(5.0, 60.0, 0.1):
        left = told.left(t)
    assert left == pytest.approx(2.5, abs=0.2)
    told.take(0.3, 60.0)  # what is over stays so
    assert told.share == 0.5


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
