"""A pool of processes that a killed worker does not end: every task is answered once, and a poisonous one is named.

A worker gets its tasks in small chunks and answers each as soon as it is done, so that the one that it died of is
known: the first without an answer. The others of its chunk go to other workers; the suspect waits until nothing else
is left, and is run again alone.
"""

from __future__ import annotations

import copyreg
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import count
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import MappingProxyType
from typing import Any

from ambid.compiled import THREADS
from ambid.errors import AmbidError, CircumstanceError
from ambid.settings.caller import Language, language, speaking
from ambid.tracking.engine import ignoring_interrupts

LIMIT_S = 600.0
_ALONE = 2  # times that a suspect kills a worker when it is run alone, until it is held to be poison
_CHUNK_S, _CHUNK = 0.02, 64  # a chunk takes about so long, and has at most so many tasks
_LOOK_S = 0.2  # how often a wait looks whether it should end
_PATIENCE_S = 2.0  # for a worker that was told to end
_STILLBORN = 3  # workers in a row that died before they began


_ATTEMPTS = count()  # of this process
_END = object()


def _read_only(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(mapping)


copyreg.pickle(MappingProxyType, lambda x: (_read_only, (dict(x),)))  # so that records, rigs and results can be sent


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """A task with its value, or with why there is none."""

    task: Any
    value: Any = None
    failure: str | None = None
    seconds: float = 0.0
    lasting: bool = True  # whether another run would fail likewise
    first: bool = False  # of its process: it also loads what all need


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def attempt(job: Callable[[Any], Any], task: Any) -> Done:
    """Do a task here, and keep why it cannot be done."""
    begin, value, failure, lasting = time.perf_counter(), None, None, True
    try:
        value = job(task)
    except AmbidError as refusal:
        failure, lasting = str(refusal), not isinstance(refusal, CircumstanceError)
    except MemoryError:
        failure, lasting = "out of memory", False
    except Exception as defect:
        failure = f"a defect: {type(defect).__name__}: {' '.join(str(defect).split())}"
    return Done(
        task=None, value=value, failure=failure, seconds=time.perf_counter() - begin, lasting=lasting,
        first=next(_ATTEMPTS) == 0,
    )  # fmt: skip


def work(
    job: Callable[[Any], Any],
    tasks: Iterable[Any],
    *,
    workers: int | None = None,
    limit_s: float = LIMIT_S,
    stopped: Callable[[], bool] = lambda: False,
) -> Generator[Done, None, None]:
    """Do each task in one of several processes, and yield it as soon as it is done, in no certain order.

    `job`: can be pickled, as must be tasks and values; `tasks`: None among them: nothing at present; `workers`:
    processes, by default as many as there are processors; `limit_s`: after which a task is given up and its worker
    killed; `stopped`: asked now and then; true ends the work after what is done already.
    """
    try:
        packed = pickle.dumps(job)
    except Exception as failure:
        raise AmbidError(
            f"the job cannot be sent to another process ({failure}). Use a function of a module, no lambda"
        ) from None
    pool = _Pool(packed, iter(tasks), workers or cores(), limit_s)
    try:
        yield from pool.answers(stopped)
    finally:
        pool.end()


def drawn(tasks: Iterator[Any], most: int) -> tuple[list[Any], bool]:
    """Return tasks as far as there are some at present, and whether more may come."""
    some: list[Any] = []
    while len(some) < most:
        task = next(tasks, _END)
        if task is None or task is _END:
            return some, task is None
        some.append(task)
    return some, True


@dataclass(slots=True, kw_only=True, eq=False)
class _Worker:
    """A process and what it was given that it has not answered; the first of these is what it is at."""

    process: BaseProcess
    line: Connection
    ready: bool = False
    given: deque[tuple[int, Any]] = field(default_factory=deque)
    since: float = 0.0  # when it began what it is at

    def kill(self) -> int:
        """End it whatever it does, and return its exit code."""
        self.process.kill()
        return self.gone()

    def gone(self) -> int:
        """Wait for its end."""
        self.process.join()
        self.line.close()
        return self.process.exitcode or 0


class _Pool:
    """The workers, and the tasks that are on their way."""

    def __init__(self, job: bytes, tasks: Iterator[Any], size: int, limit_s: float) -> None:
        self._job, self._size, self._limit_s = job, size, limit_s
        self._tasks, self._numbers = tasks, count()
        self._waiting: deque[tuple[int, Any]] = deque()
        self._suspects: deque[tuple[int, Any]] = deque()
        self._deaths: dict[int, int] = {}  # of suspects that were run alone
        self._workers: list[_Worker] = []
        self._mean_s, self._stillborn = 1.0, 0
        self._more = True  # whether tasks may still come

    def answers(self, stopped: Callable[[], bool]) -> Iterator[Done]:
        """Yield every task when it is done."""
        while True:
            ending = stopped()
            if not ending:
                self._give()
            busy = [w for w in self._workers if w.given or not w.ready]
            if not busy and (ending or not self._more):
                return
            if not busy:
                time.sleep(_LOOK_S)
                continue
            for line in wait([w.line for w in busy], 0.0 if ending else self._patience(busy)):
                yield from self._hear(next(w for w in busy if w.line is line))
            if ending:
                return
            yield from self._overdue()

    def end(self) -> None:
        """End all workers: idle ones leave by themselves."""
        for worker in self._workers:
            if worker.given or not worker.ready:
                worker.process.kill()
            worker.line.close()
        for worker in self._workers:
            worker.process.join(_PATIENCE_S)
            worker.kill()

    def _give(self) -> None:
        """Give idle workers something to do, and start those that are missing; suspects come last, one at a time."""
        for worker in [w for w in self._workers if w.ready and not w.given]:
            self._send(worker, self._next(max(1, min(_CHUNK, int(_CHUNK_S / self._mean_s)))))
        coming = sum(not w.ready for w in self._workers)
        while len(self._workers) < self._size and not (coming and self._stillborn):
            self._waiting.extend(self._draw(coming + 1 - len(self._waiting)))
            if len(self._waiting) <= coming:
                break
            self._start()
            coming += 1
        if self._suspects and not any(w.given for w in self._workers):
            idle = next((w for w in self._workers if w.ready), None)
            if idle is not None:
                self._send(idle, [self._suspects.popleft()])
            elif not self._workers:
                self._start()

    def _next(self, most: int) -> list[tuple[int, Any]]:
        """Take tasks from what waits, then from what comes."""
        tasks = [self._waiting.popleft() for _ in range(min(most, len(self._waiting)))]
        return tasks or self._draw(most)

    def _draw(self, most: int) -> list[tuple[int, Any]]:
        """Take tasks from what comes, as far as there are some at present."""
        some, self._more = drawn(self._tasks, most) if self._more else ([], False)
        return [(next(self._numbers), task) for task in some]

    def _start(self) -> None:
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._job, language()), daemon=True)
        with ignoring_interrupts(), one_thread_each():
            process.start()
        theirs.close()
        self._workers.append(_Worker(process=process, line=ours))

    def _send(self, worker: _Worker, chunk: list[tuple[int, Any]]) -> None:
        if not chunk:
            return
        worker.given.extend(chunk)
        worker.since = time.monotonic()
        try:
            packed = pickle.dumps(chunk)
        except Exception as failure:
            raise AmbidError(f"a task cannot be sent to another process ({failure}). Give files, or records") from None
        with suppress(OSError):  # it died meanwhile: that is heard at once
            worker.line.send_bytes(packed)

    def _hear(self, worker: _Worker) -> Iterator[Done]:
        """Take all that a worker has said."""
        try:
            while worker.line.poll():
                message = worker.line.recv()
                if isinstance(message, str):
                    raise AmbidError(message)
                if message is None:
                    worker.ready, self._stillborn = True, 0
                    continue
                _, task = worker.given.popleft()
                worker.since = time.monotonic()
                self._mean_s = 0.8 * self._mean_s + 0.2 * message.seconds
                yield replace(message, task=task)
        except (EOFError, OSError):
            self._workers.remove(worker)
            yield from self._bury(worker, _cause(worker.gone()))

    def _bury(self, worker: _Worker, cause: str) -> Iterator[Done]:
        """Hand on the tasks of a dead worker; it died of the first."""
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= _STILLBORN:
                raise AmbidError(
                    f"workers do not begin: each {cause}. Call from a script whose work stands under if __name__ =="
                    " '__main__', and look whether there is memory"
                )
        if not worker.given:
            return
        number, task = worker.given.popleft()
        self._waiting.extendleft(reversed(worker.given))
        if number not in self._deaths:
            self._deaths[number] = 0
        else:
            self._deaths[number] += 1
            if self._deaths[number] >= _ALONE:
                del self._deaths[number]
                yield Done(task=task, failure=f"{cause}, twice when run alone")
                return
        self._suspects.append((number, task))

    def _patience(self, busy: list[_Worker]) -> float:
        due = min((w.since for w in busy if w.given), default=float("inf")) + self._limit_s - time.monotonic()
        return min(max(due, 0.0), _LOOK_S)

    def _overdue(self) -> Iterator[Done]:
        """Give up what takes too long."""
        now = time.monotonic()
        for worker in [w for w in self._workers if w.given and now - w.since > self._limit_s and not w.line.poll()]:
            self._workers.remove(worker)
            worker.kill()
            number, task = worker.given.popleft()
            self._waiting.extendleft(reversed(worker.given))
            self._deaths.pop(number, None)
            yield Done(task=task, failure=f"took longer than the limit of {self._limit_s:g} s", seconds=self._limit_s)


def _cause(code: int) -> str:
    return f"killed its worker by signal {-code}" if code < 0 else f"ended its worker with exit code {code}"


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let processes that are started meanwhile keep linear algebra to one thread: there are as many as processors."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(line: Connection, packed: bytes, caller: Language) -> None:
    """Do tasks in a process of its own, until nobody wants more; interrupts are the business of whoever started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    try:
        job = pickle.loads(packed)
    except Exception as failure:
        line.send(f"the job cannot be used in another process ({failure}). Put it into a module that can be imported")
        return
    with suppress(EOFError, OSError), speaking(caller):
        line.send(None)
        while True:
            for _, task in pickle.loads(line.recv_bytes()):
                _answer(line, attempt(job, task))


def _answer(line: Connection, done: Done) -> None:
    try:
        packed = pickle.dumps(done)
    except Exception as failure:
        packed = pickle.dumps(Done(task=None, failure=f"a defect: its result cannot be sent ({failure})"))
    line.send_bytes(packed)


def _leave_with_parent() -> None:
    """End this process when its parent has ended, however that was."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
