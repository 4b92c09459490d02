"""The same on a cluster: tasks go to workers of Dask distributed, which somebody else may have started anywhere."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from threading import Timer
from typing import Any

from ambid.errors import AmbidError, needs
from ambid.fleet.pool import Done, attempt, drawn, one_thread_each
from ambid.settings.caller import Language, language, setting, speaking

ALLOWED_FAILURES = 2  # workers that a task may have killed before it is held to be poison
_AHEAD = 3  # batches on their way for each worker
_BATCH_S, _BATCH = 1.0, 64  # a batch takes about so long, and has at most so many tasks
_GONE_S = 30.0  # without a worker, after which a cluster on this machine gets new ones
_LOOK_S = 0.2  # how often a wait looks whether it should end


def work_on_cluster(
    job: Callable[[Any], Any],
    tasks: Iterable[Any],
    *,
    scheduler: str | int,
    limit_s: float,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[Done, None, None]:
    """Do each task on a cluster, and yield it as soon as it is done, as `ambid.fleet.pool.work` does.

    A task that is held to have killed its workers is run again alone, when all others are done: it may only have waited
    on them beside the one that did.

    `scheduler`: its address, or the number of workers of a cluster on this machine.
    """
    with needs("Dask distributed", "a cluster", "fleet"):
        distributed: Any = import_module("distributed")
    with _client(distributed, scheduler) as client:
        try:
            yield from _answers(distributed, client, job, iter(tasks), limit_s, stopped)
        except (asyncio.CancelledError, distributed.client.FutureCancelledError, OSError) as failure:
            if client.status == "running":
                raise
            raise AmbidError(f"the scheduler has gone ({failure}). Run again: what is done is not repeated") from None


def _answers(
    distributed: Any, client: Any, job: Any, tasks: Iterator[Any], limit_s: float, stopped: Callable[[], bool]
) -> Iterator[Done]:
    suspects: deque[Any] = deque()
    on_their_way: dict[Any, tuple[list[Any], bool]] = {}  # with whether they are run alone
    mean_s, more = 1.0, True

    def send(some: list[Any], *, alone: bool) -> None:
        future = client.submit(timed, job, some, limit_s, language(), pure=False, retries=0)
        on_their_way[future] = (some, alone)

    last_s = time.monotonic()  # when there was a worker
    n_workers = 0 if client.cluster is None else len(client.cluster.worker_spec)
    while True:
        room = _AHEAD * max(1, len(client.nthreads() or (1,))) - len(on_their_way)
        while more and room > 0:
            some, more = drawn(tasks, max(1, min(_BATCH, int(_BATCH_S / mean_s))))
            if not some:
                break
            send(some, alone=False)
            room -= 1
        if not on_their_way and suspects:
            send([suspects.popleft()], alone=True)
        if stopped() or not (on_their_way or more):
            return
        if not on_their_way:
            time.sleep(_LOOK_S)
            continue
        try:
            ready = distributed.wait(list(on_their_way), timeout=_LOOK_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            if client.nthreads() or client.cluster is None:
                last_s = time.monotonic()
            elif time.monotonic() - last_s > _GONE_S:  # a worker that dies as it starts is not started again
                if client.cluster.workers:
                    client.cluster.scale(0)  # which forgets them, after a while
                else:
                    client.cluster.scale(n_workers)
                    last_s = time.monotonic()
            continue
        for future in ready:
            some, alone = on_their_way.pop(future)
            if future.status == "finished":
                for task, done in zip(some, future.result(), strict=True):
                    mean_s = 0.8 * mean_s + 0.2 * done.seconds
                    yield replace(done, task=task)
                continue
            failure = future.exception()
            if not isinstance(failure, distributed.scheduler.KilledWorker):
                text = f"a defect: {type(failure).__name__}: {' '.join(str(failure).split())}"
                yield from (Done(task=task, failure=text) for task in some)
            elif alone:
                text = f"killed {ALLOWED_FAILURES + 1} workers when run alone, or took longer than {limit_s:g} s"
                yield from (Done(task=task, failure=text) for task in some)
            else:
                suspects.extend(some)


def timed(job: Callable[[Any], Any], some: list[Any], limit_s: float, caller: Language) -> list[Done]:
    """Do tasks in a worker of the cluster; one that takes too long ends the worker; `caller`: who reads messages."""
    from os import _exit

    answers = []
    for task in some:
        watch = Timer(limit_s, _exit, (1,))
        watch.daemon = True
        watch.start()
        try:
            with speaking(caller):
                answers.append(attempt(job, task))
        finally:
            watch.cancel()
    return answers


@contextmanager
def _client(distributed: Any, scheduler: str | int) -> Iterator[Any]:
    """Yield a client of a cluster; one on this machine lives as long as the context, without a dashboard."""
    import dask

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what concerns the user is told in results
    quiet = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.scheduler.worker-saturation": 1.0,  # what waits on the scheduler is not blamed for a death
        "distributed.logging.distributed": "critical",
        "distributed.diagnostics.nvml": False,
        "distributed.worker.profile.enabled": False,  # looks at the stack a hundred times a second
    }
    with dask.config.set(quiet):
        if isinstance(scheduler, str):
            try:
                client = distributed.Client(scheduler, timeout=10)
            except (OSError, ValueError) as failure:
                text = str(failure).splitlines()[0]
                raise AmbidError(
                    f"{setting('scheduler', scheduler)} cannot be reached: {text}. Start it, or correct it"
                ) from None
            with client:
                yield client
            return
        with one_thread_each():
            try:
                cluster = distributed.LocalCluster(
                    n_workers=scheduler, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None,
                    worker_dashboard_address=None, silence_logs=logging.CRITICAL,
                    scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},  # any port
                )  # fmt: skip
            except RuntimeError as failure:  # a worker that ends while it starts
                raise AmbidError(f"the workers did not start ({failure}). Run again") from None
            with cluster, distributed.Client(cluster) as client:
                yield client
