"""A job on many records: each once, whatever happens to the workers; what a ledger knows is not done again."""

from __future__ import annotations

import hashlib
import inspect
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, choices
from ambid.estimation.progress import Tick, silent
from ambid.estimation.result import Result
from ambid.fleet.pool import LIMIT_S, Done, cores, work
from ambid.fleet.sources import Item, Rigs, items
from ambid.job.results import result_of
from ambid.ledger.entry import Entry, entry_of, key_of, rig_sha_of, settings_text, sha_of
from ambid.ledger.store import Failure, FleetRow, FleetRun, Ledger, open_ledger
from ambid.record import Source
from ambid.settings.caller import check_positive, check_whole, setting

if TYPE_CHECKING:
    import pandas

JOBS = ("identify", "identify_nonlinear", "fit", "frf", "info", "margins", "validate")
"""Jobs by name: functions of `ambid` that take one record."""

_OWN = ("record", "records", "rig", "tick", "units")  # arguments that are no settings
_ASKED = 200  # keys that a ledger is asked for at once
_STORE_S = 0.25  # results of so long are stored together
_MOST = 500
_WORKERS = 1024  # at most

Job = str | Callable[..., Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    """A record on its way."""

    at: int
    item: Item
    sha: str = ""
    rig_sha: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """What a worker tells of a record."""

    judged: Mapping[str, Any]  # fields of its row
    values: Mapping[str, tuple[float | None, float | None]]
    units: Mapping[str, str]
    entry: Entry | None  # for the ledger


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOf:
    """A job with its settings, as processes hand it on."""

    job: Job
    settings: Mapping[str, Any]
    said: str  # the same as text
    stored: bool = False  # whether a ledger wants what it gives

    @property
    def name(self) -> str:
        """What the ledger calls it."""
        return self.job if isinstance(self.job, str) else f"{self.job.__module__}.{self.job.__qualname__}"

    def __call__(self, task: _Task) -> _Found:
        """Do one record."""
        item = task.item
        with item.here(task.sha) as record:
            result = self.of(record, item.rig)
        entry = None
        if self.stored:
            from ambid.job.presentation import document

            if not isinstance(result, Result):
                raise AmbidError(f"{self.name} gives no result that a ledger keeps. Run it without one")
            entry = entry_of(
                result, bearing=item.bearing, taken_at=item.when(), sha=task.sha, rig=item.rig, settings=self.said,
                job=self.name, document=document(result) if isinstance(self.job, str) else "",
            )  # fmt: skip
        values, units = numbers_of(result)
        return _Found(judged=_judged(result), values=values, units=units, entry=entry)

    def of(self, record: Any, rig: Any) -> Any:
        """Return what the job gives."""
        function = function_of(self.job)
        if not isinstance(self.job, str):
            return function(record, rig, **self.settings)
        first = next(n for n in inspect.signature(function).parameters if n.startswith("record"))
        return function(**{first: record}, rig=rig, **self.settings)


def function_of(job: Job) -> Callable[..., Any]:
    """Return the function of a job."""
    if not isinstance(job, str):
        return job
    if job not in JOBS:
        raise AmbidError(f"{setting('job', job)} is unknown; jobs are {choices(job, JOBS)} Correct it")
    function: Callable[..., Any] = getattr(import_module("ambid.job"), job)
    return function


def job_of(job: Job, settings: Mapping[str, Any], *, stored: bool = False) -> JobOf:
    """Return a job with its settings; those that it does not take are refused."""
    function = function_of(job)
    if isinstance(job, str):
        parameters = inspect.signature(function).parameters
        takes = [name for name in parameters if name not in _OWN]
        for name in settings:
            if name not in takes:
                raise AmbidError(f"{job} takes no {name!r}; it takes {choices(name, takes)} Correct it")
        lacks = [n for n in takes if n not in settings and parameters[n].default is inspect.Parameter.empty]
        if lacks:
            raise AmbidError(f"{job} needs {lacks[0]}. Give {setting('set', f'{lacks[0]}=…')}")
    values = {n: f"{x} {sha_of(Path(x))}" if isinstance(x, (str, Path)) and Path(x).is_file() else x
            for n, x in settings.items()}  # fmt: skip
    if not isinstance(job, str):  # another function under the same name is another job; what it calls is not seen
        with suppress(OSError, TypeError):
            values["its code"] = hashlib.sha256(inspect.getsource(job).encode()).hexdigest()[:16]
    result = JobOf(job=job, settings=dict(settings), said="", stored=stored)
    return JobOf(job=job, settings=dict(settings), said=settings_text(result.name, **values), stored=stored)


def numbers_of(result: Any) -> tuple[dict[str, tuple[float | None, float | None]], dict[str, str]]:
    """Return value and standard deviation by name, None where they are not to be seen, and the units."""
    if isinstance(result, Mapping):
        return {str(n): (float(x), None) for n, x in result.items()}, {}
    values: dict[str, tuple[float | None, float | None]] = {}
    units: dict[str, str] = {}
    for p in (*getattr(result, "parameters", ()), *getattr(result, "mode_parameters", ())):
        if p.role != "fixed":
            values[p.name] = (p.value, p.sd) if p.identifiable else (None, None)
            units[p.name] = p.unit
    for axis, s in (getattr(result, "sensitivity", None) or {}).items() if not values else ():
        values[f"{axis}.sensitivity"], units[f"{axis}.sensitivity"] = (s.peak_db.value, s.peak_db.sd), "dB"
    for output, numbers in (getattr(result, "fit", None) or {}).items() if not values else ():
        for kind in ("one_step", "simulation"):
            share = getattr(numbers, kind, None)
            if share is not None:
                values[f"{output}.{kind}"], units[f"{output}.{kind}"] = (float(share), None), "1"
    return values, units


def _judged(result: Any) -> dict[str, Any]:
    if not isinstance(result, Result):
        return {}
    checks = tuple(dict.fromkeys(r.check for r in result.reasons))
    return {"status": str(getattr(result, "status", "")), "verdict": result.verdict.word, "checks": checks}


class _Run:
    """A fleet at work: rows that are there, and what is to be stored."""

    def __init__(self, job: JobOf, fleet: Sequence[Item], ledger: Ledger | None, *, again: bool) -> None:
        self.job, self.fleet, self.ledger = job, fleet, ledger
        self.rows: dict[int, FleetRow] = {}
        self.units: dict[str, str] = {}
        self.counts = Counter[str]()
        self._failed = {} if ledger is None or again else ledger.failures()
        self._first: dict[str, int] = {}  # of each key, the record that is done for it
        self._same: dict[int, list[tuple[int, Item]]] = {}  # and others of the same contents
        self._rigs = {id(i.rig): rig_sha_of(i.rig) for i in {id(i.rig): i for i in fleet}.values()} if ledger else {}
        self._entries: list[Entry] = []
        self._failures: list[Failure] = []
        self._stored = time.monotonic()

    def tasks(self) -> Iterator[_Task]:
        """Yield what is not known yet."""
        coming = iter(enumerate(self.fleet))
        while some := list(islice(coming, _ASKED)):
            if self.ledger is None:
                yield from (_Task(at=at, item=item) for at, item in some)
                continue
            keyed = {}
            for at, item in some:
                try:
                    task = _Task(at=at, item=item, sha=item.digest(), rig_sha=self._rigs[id(item.rig)])
                except AmbidError as refusal:
                    self.put(at, item, "failed", reason=str(refusal))
                    continue
                keyed[at] = (key_of(task.sha, task.rig_sha, self.job.said), task)
            done = self.ledger.documents(key for key, _ in keyed.values())
            for at, (key, task) in keyed.items():
                if key in done:
                    self.put(at, task.item, "known", **self.kept(*done[key]))
                elif key in self._first:
                    self._same.setdefault(self._first[key], []).append((at, task.item))
                    self._like(self._first[key])
                elif key in self._failed:
                    self.put(at, task.item, "failed", reason=self._failed[key].reason)
                else:
                    self._first[key] = at
                    yield task

    def kept(self, status: str, verdict: str, failed: str, text: str) -> dict[str, Any]:
        """Return the fields of a row whose result the ledger keeps."""
        values, units = numbers_of(result_of(text, Path(self.job.name))) if text else ({}, {})
        self.units |= units
        checks = tuple(filter(None, failed.split(",")))
        return {"status": status, "verdict": verdict, "checks": checks, "values": values}

    def put(self, at: int, item: Item, state: Any, **more: Any) -> None:
        """Put down what is known of a record."""
        self.counts[state] += 1
        self.rows[at] = FleetRow(
            record=item.name, bearing=item.bearing, rig=item.rig.name, taken_at=item.taken_at, state=state,
            **{"values": {}, **more},
        )  # fmt: skip

    def said(self, rate: float) -> str:
        """Say how it goes."""
        failed = self.counts["failed"]
        return f"{rate:.3g} records/s" + (f", {failed} failed" if failed else "")

    def take(self, done: Done) -> None:
        """Take the answer to a record."""
        task: _Task = done.task
        if done.failure is None:
            outcome: _Found = done.value
            self.units |= outcome.units
            values = {sys.intern(name): x for name, x in outcome.values.items()}
            self.put(task.at, task.item, "done", values=values, seconds=done.seconds, **outcome.judged)
            if outcome.entry is not None:
                self._entries.append(outcome.entry)
        else:
            self.put(task.at, task.item, "failed", reason=done.failure, seconds=done.seconds)
            if task.sha:
                self._failures.append(
                    Failure(
                        bearing=task.item.bearing, record=task.item.name, sha=task.sha, rig_sha=task.rig_sha,
                        settings=self.job.said, version=version("ambid"), reason=done.failure,
                    )
                )  # fmt: skip
        self._like(task.at)
        if time.monotonic() - self._stored > _STORE_S or len(self._entries) >= _MOST:
            self.store()

    def _like(self, first: int) -> None:
        """Put down what is known of the records that hold the same as one that has its row."""
        row = self.rows.get(first)
        if row is None:
            return
        for at, item in self._same.pop(first, []):
            same = {x: getattr(row, x) for x in ("status", "verdict", "checks", "values")}
            reason = row.reason.replace(row.record, item.name)  # which may name its file
            self.put(at, item, "known" if row.state == "done" else row.state, reason=reason, **same)

    def store(self) -> None:
        """Store what has come since the last time."""
        if self.ledger is not None:
            self.ledger.add(self._entries)
            if self._failures:
                self.ledger.fail(self._failures)
        self._entries, self._failures, self._stored = [], [], time.monotonic()


def run_fleet(
    records: Source | Sequence[Source],
    rigs: Rigs = None,
    *,
    job: Job = "identify",
    settings: Mapping[str, Any] | None = None,
    ledger: str | Path | None = None,
    workers: int | None = None,
    limit_s: float = LIMIT_S,
    again: bool = False,
    taken_at: str | None = None,
    scheduler: str | None = None,
    stopped: Callable[[], bool] = lambda: False,
    tick: Tick | None = None,
) -> FleetRun:
    """Do a job on many records, as `fleet` does; `again`: also those that failed before; `stopped`: ends it early."""
    check_positive({"limit_s": limit_s})
    if workers is not None:
        check_whole({"workers": workers}, 1, _WORKERS)
    local = _local(scheduler)
    job_made = job_of(job, settings or {}, stored=ledger is not None)
    fleet, begin, say = items(records, rigs, taken_at), time.monotonic(), tick or silent
    store = None if ledger is None else open_ledger(ledger)
    try:
        run = _Run(job_made, fleet, store, again=again)
        if scheduler is None:
            answers = work(job_made, run.tasks(), workers=workers, limit_s=limit_s, stopped=stopped)
        else:
            from ambid.fleet.cluster import work_on_cluster

            answers = work_on_cluster(
                job_made, run.tasks(), scheduler=local or scheduler, limit_s=limit_s, stopped=stopped
            )
        try:
            for n, done in enumerate(answers, 1):
                run.take(done)
                say(run.said(n / max(time.monotonic() - begin, 1e-9)), len(run.rows) / len(fleet))
        finally:
            answers.close()
            run.store()
    finally:
        if store is not None:
            store.close()
    return FleetRun(
        job=job_made.name, settings=job_made.said, ledger=None if store is None else store.shown,
        workers=local or workers or cores(), seconds=time.monotonic() - begin, records=len(fleet), units=run.units,
        rows=tuple(run.rows[at] for at in sorted(run.rows)),
    )  # fmt: skip


def _local(scheduler: str | None) -> int | None:
    """Return the number of workers where a cluster on this machine is named, as ``local:N``."""
    where, _, number = (scheduler or "").partition(":")
    if where != "local":
        return None
    if not (number.isdecimal() and 1 <= int(number) <= _WORKERS):
        raise AmbidError(
            f"{setting('scheduler', scheduler)}: local:N has a number of workers, 1 to {_WORKERS}. Correct it"
        )
    return int(number)


def fleet(
    records: Source | Sequence[Source],
    rigs: Rigs = None,
    *,
    job: Job = "identify",
    ledger: str | Path | None = None,
    taken_at: str | None = None,
    workers: int | None = None,
    limit_s: float = LIMIT_S,
    scheduler: str | None = None,
    tick: Tick | None = None,
    **settings: Any,
) -> pandas.DataFrame:
    """Do a job on many records, each once, in processes of their own.

    A record that ends its worker, or takes too long, is told as failed; all others are done.

    Parameters
    ----------
    records : str, Path, Record, DataFrame, or sequence of these
        Files, URLs or patterns such as ``"records/{bearing}/*.h5"``, where a word in braces stands for a part of one
        name; or records in memory.
    rigs : Rig, str, Path or sequence, optional
        One for all, or one for each of `records`; a name with words of the pattern, ``"rigs/{bearing}.toml"``; or a
        table ``.csv`` with columns pattern, rig and perhaps bearing, taken_at.
    job : str or callable, optional
        A function of `ambid` that takes one record, such as ``"fit"``; or a function of a module, called with record,
        rig and settings, that gives a `Result` or numbers by name.
    ledger : str or Path, optional
        File or URL of a ledger: what stands there is not done again.
    taken_at : str, optional
        When records were taken that neither say so themselves nor by name or table; ``"file"``: time of the file.
    workers : int, optional
        Processes; default one for each processor.
    limit_s : float, optional
        Longest time for one record, s.
    scheduler : str, optional
        Cluster of Dask: ``local:2`` for one of two workers on this machine, or a scheduler's address, ``tcp://…``.
    tick : callable, optional
        Called with the progress.
    **settings
        Of the job, under its own names.

    Returns
    -------
    pandas.DataFrame
        A row for each record: state, verdict, reason of a failure, values with standard deviations.

    Raises
    ------
    AmbidError
        If records, rigs or settings break a rule: before anything is done.

    Examples
    --------
    >>> import ambid
    >>> records = [ambid.simulate("thesis", duration=0.1, seed=k) for k in range(2)]
    >>> table = ambid.fleet(records, workers=1)  # in a script: under if __name__ == "__main__"
    >>> list(table["state"]), table["m"].round(3).tolist()
    (['done', 'done'], [0.1, 0.1])
    """
    return run_fleet(
        records, rigs, job=job, settings=settings, ledger=ledger, taken_at=taken_at, workers=workers, limit_s=limit_s,
        scheduler=scheduler, tick=tick,
    ).to_dataframe()  # fmt: skip
