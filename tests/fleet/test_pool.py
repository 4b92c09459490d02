"""The pool: each task answered once, whatever becomes of the workers."""

import os
import signal
import time
from functools import partial

import pytest

from ambid.errors import AmbidError
from ambid.fleet.pool import work
from tests.fleet import jobs


def runs(folder, number):
    return len((folder / str(number)).read_text())


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """One of each kind among plain tasks: what came of all, and the folder that counts their runs."""
    folder = tmp_path_factory.mktemp("runs")
    words = {7: "kill", 11: "exit", 13: "hang", 17: "refuse", 19: "defect", 23: "unsendable"}
    tasks = [(str(folder), n, words.get(n, "well")) for n in range(40)]
    return {d.task[1]: d for d in work(jobs.by_word, tasks, workers=2, limit_s=0.8)}, words, folder


def test_all_others_are_done_once(mixed):
    found, words, folder = mixed
    assert sorted(found) == list(range(40))
    for n in set(range(40)) - set(words):
        assert (found[n].value, found[n].failure, runs(folder, n)) == (n, None, 1)


@pytest.mark.parametrize(
    ("number", "reason", "times"),
    [
        (7, "killed its worker by signal 9, twice when run alone", 3),
        (11, "ended its worker with exit code 3, twice when run alone", 3),
        (13, "took longer than the limit of 0.8 s", 1),
        (17, "column 'current' is missing. Add it", 1),
        (19, "a defect: ZeroDivisionError: by zero", 1),
    ],
)
def test_a_failure_is_named_with_its_reason(mixed, number, reason, times):
    found, _, folder = mixed
    assert (found[number].failure, runs(folder, number)) == (reason, times)


def test_what_cannot_be_sent_back_is_told(mixed):
    assert "its result cannot be sent" in mixed[0][23].failure


def test_a_worker_that_others_kill_costs_nothing(tmp_path):
    """Killed twice while they work: all is done, and what they were at is done again."""
    killed, values = [], []
    for done in work(jobs.pid, range(200), workers=2):
        values.append(done.task)
        assert done.failure is None
        if len(values) in (20, 60):
            os.kill(done.value, signal.SIGKILL)
            killed.append(done.value)
    assert sorted(values) == list(range(200))
    assert len(killed) == 2


def test_workers_have_one_thread_of_linear_algebra_each(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    assert [d.value for d in work(jobs.threads, [0], workers=1)] == ["1"]
    assert os.environ["OPENBLAS_NUM_THREADS"] == "7"


def test_it_ends_when_it_is_told_to_with_what_is_done(tmp_path):
    seen = []
    begin = time.monotonic()
    tasks = [(str(tmp_path), n, "slow") for n in range(10_000)]
    for done in work(jobs.by_word, tasks, workers=1, stopped=lambda: len(seen) >= 5):
        seen.append(done.value)  # noqa: PERF401 - looked at meanwhile
    assert 5 <= len(seen) < 1000
    assert len(list(tmp_path.iterdir())) <= len(seen) + 65  # a chunk at most was on its way
    assert time.monotonic() - begin < 30


@pytest.mark.parametrize(
    ("job", "tasks", "why"),
    [
        (lambda x: x, [1], "the job cannot be sent"),
        (partial(jobs.double, y=lambda: 1), [1], "the job cannot be sent"),
        (jobs.double, [lambda: 1], "a task cannot be sent"),
    ],
)
def test_what_cannot_be_sent_is_refused(job, tasks, why):
    with pytest.raises(AmbidError, match=why):
        list(work(job, tasks, workers=1))


def test_nothing_to_do_starts_nothing():
    assert list(work(jobs.double, [])) == []
