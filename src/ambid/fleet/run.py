"""A job on many records: each once, whatever happens to the workers; what a ledger knows is not done again."""

from __future__ import annotations

import hashlib
import inspect
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, CircumstanceError, choices, counted
from ambid.estimation.progress import Tick, silent
from ambid.estimation.result import Result
from ambid.fleet.pace import Pace, in_order
from ambid.fleet.pool import LIMIT_S, Done, cores, work
from ambid.fleet.sources import Item, Rigs, fit_for_ledger, items, started_in, undated
from ambid.job.results import result_of
from ambid.ledger.entry import Entry, entry_of, installed, key_of, moment, rig_sha_of, settings_text, sha_of
from ambid.ledger.leases import Leases
from ambid.ledger.store import Failure, FleetRow, FleetRun, Ledger, open_ledger
from ambid.record import Source
from ambid.rig import Rig, default_rig
from ambid.settings.caller import check_positive, check_whole, setting
from ambid.settings.jobs import JOBS as SETTINGS_OF

if TYPE_CHECKING:
    import pandas

JOBS = ("identify", "identify_nonlinear", "fit", "frf", "info", "margins", "validate")
"""Jobs by name: functions of `ambid` that take one record."""

_OWN = ("record", "records", "rig", "tick", "units")  # arguments that are no settings
_ASKED, _ASKED_S = 200, 0.25  # keys that a ledger is asked for at once, and for how long they are looked up
_PORTION_S = 2.0  # work that is taken in hand together, where several runs share a list
_PROBED = 10  # rigs with which it is asked what a job says to its settings
_LOOK_S = 0.5  # how often it is looked what other runs have done
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
    key: str = ""


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
        if not item.remote and isinstance(item.source, (str, Path)) and not Path(item.source).is_file():
            raise CircumstanceError(f"record {item.name} is gone since the fleet began. Put it back, and run again")
        when = item.when() if self.stored else None
        with item.here(task.sha) as record:
            if self.stored and when is None and item.remote:  # what lies here was looked at before
                said = started_in(record)
                if said == "" and isinstance(self.job, str):
                    raise CircumstanceError(undated([item], 1))
                when = moment(said, f"the time in {item.name}") if said else None
            result = self.of(record, item.rig)
        values, units = numbers_of(result)
        entry = self._entry(result, task, when) if self.stored else None
        return _Found(judged=_judged(result), values=values, units=units, entry=entry)

    def _entry(self, result: Any, task: _Task, when: float | None) -> Entry:
        from ambid.job.presentation import document

        if not isinstance(result, Result):
            raise CircumstanceError(f"{self.name} gives no result that a ledger keeps. Run it without one")
        try:
            return entry_of(
                result, bearing=task.item.bearing, taken_at=when, sha=task.sha, rig=task.item.rig, settings=self.said,
                job=self.name, document=document(result) if isinstance(self.job, str) else "",
            )  # fmt: skip
        except AmbidError as refusal:  # of bearing or time: the record was done
            raise CircumstanceError(str(refusal)) from None

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
    return replace(result, said=settings_text(result.name, **values))


def check_settings(job: Job, settings: Mapping[str, Any], rigs: Sequence[Rig]) -> None:
    """Refuse settings that no record can make good: by their ranges, and by what the job says, whatever the rig, to a
    record that is not there.
    """
    if not settings or not isinstance(job, str):
        return
    declared = SETTINGS_OF["identify" if job == "identify_nonlinear" else job]
    declared.check(settings.items())
    for name in (s.name for s in declared.settings if s.kind == "path"):
        if name in settings and not Path(str(settings[name])).is_file():
            raise AmbidError(f"{name} {settings[name]} does not exist. Check the path")
    absent, refusals = Path(__file__).with_name("no record.h5"), list[AmbidError]()
    for rig in rigs[:_PROBED] or [default_rig()]:
        try:
            JobOf(job=job, settings=settings, said="").of(absent, rig)
        except AmbidError as refusal:
            if str(absent) not in str(refusal):
                refusals.append(refusal)
                continue
        except Exception:  # a defect is told of each record
            pass
        return
    raise refusals[0]


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

    def __init__(self, job: JobOf, fleet: Sequence[Item], ledger: Ledger | None, *, again: bool, workers: int) -> None:
        self.job, self.fleet, self.ledger, self.workers = job, fleet, ledger, workers
        self.rows: dict[int, FleetRow] = {}
        self.units: dict[str, str] = {}
        self.counts = Counter[str]()
        self.pace = Pace([item.size for item in fleet], workers)
        self._leases = None if ledger is None else Leases(ledger)
        self._again = again
        self._failed = {} if ledger is None else ledger.failures()  # before this run
        self._first: dict[str, int] = {}  # of each key, the record that is done for it
        self._same: dict[int, list[tuple[int, Item]]] = {}  # and others of the same contents
        self._elsewhere: dict[str, _Task] = {}  # what other runs have in hand, by key
        self._look_at = 0.0  # when it is looked what became of that
        self._reached = 0
        self._rigs = {id(i.rig): rig_sha_of(i.rig) for i in {id(i.rig): i for i in fleet}.values()} if ledger else {}
        self._entries: list[Entry] = []
        self._failures: list[Failure] = []
        self._fruitless: list[str] = []  # keys of what failed by circumstances
        self._stored = self._begin = time.monotonic()

    def tasks(self) -> Iterator[_Task | None]:
        """Yield what is not known yet and nobody else has in hand; None: others still have some that may come back."""
        if self.ledger is None:
            yield from (_Task(at=at, item=item) for at, item in enumerate(self.fleet))
            return
        coming = self._unknown(self.ledger)
        while some := list(islice(coming, self._portion())):
            yield from self._taken(some)
            self._adopt()
        while self._elsewhere:
            if time.monotonic() < self._look_at:
                yield None
                continue
            self._adopt()
            yield from self._taken([*self._elsewhere.values()])

    def _portion(self) -> int:
        """Return how many records are taken in hand together: about two seconds' work, fewer towards the end."""
        wanted = self.workers * int(_PORTION_S / max(self.pace.mean_s, 1e-3))
        return max(self.workers, min(wanted, (len(self.fleet) - self._reached) // 8, _ASKED))

    def _unknown(self, ledger: Ledger) -> Iterator[_Task]:
        """Yield the records of which the ledger knows nothing, the first of each contents."""
        coming, more = iter(enumerate(self.fleet)), True
        while more:
            some, end = list[_Task](), time.monotonic() + _ASKED_S
            while more and len(some) < _ASKED and time.monotonic() < end:
                at, item = next(coming, (0, None))
                more = item is not None
                task = self._keyed(at, item) if item is not None else None
                if task is not None:
                    some.append(task)
            for task in self._told(ledger, some, {} if self._again else self._failed):
                self._reached = task.at
                yield task

    def _told(self, ledger: Ledger, some: Sequence[_Task], failed: Mapping[str, Failure]) -> list[_Task]:
        """Put down the records whose result the ledger has, or which are among the failed ones; return the others."""
        known, left = ledger.documents(task.key for task in some), list[_Task]()
        for task in some:
            if task.key in known:
                self.put(task.at, task.item, "known", **self.kept(*known[task.key]))
            elif task.key in failed:
                self.put(task.at, task.item, "failed", reason=failed[task.key].reason)
            else:
                left.append(task)
                continue
            self._like(task.at)
        return left

    def _keyed(self, at: int, item: Item) -> _Task | None:
        """Return a record with its key; None where it cannot be read, or another one holds the same."""
        try:
            sha, rig_sha = item.digest(), self._rigs[id(item.rig)]
        except AmbidError as refusal:
            self.put(at, item, "failed", reason=str(refusal))
            return None
        key = key_of(sha, rig_sha, self.job.said)
        first = self._first.setdefault(key, at)
        if first != at:
            self._same.setdefault(first, []).append((at, item))
            self._like(first)
            return None
        return _Task(at=at, item=item, sha=sha, rig_sha=rig_sha, key=key)

    def _taken(self, some: Sequence[_Task]) -> list[_Task]:
        """Return those that are this run's now, and nobody has done meanwhile; keep the others in mind."""
        if not some:
            return []
        assert self._leases is not None
        mine = self._leases.take({task.key: task.item.name for task in some})
        for task in some:
            if task.key in mine:
                self._elsewhere.pop(task.key, None)
            else:
                self._elsewhere[task.key] = task
        return self._open([task for task in some if task.key in mine])

    def _adopt(self) -> None:
        """Put down what other runs have done meanwhile of what they had in hand."""
        if self._elsewhere and time.monotonic() >= self._look_at:
            self._look_at = time.monotonic() + _LOOK_S
            left = self._open([*self._elsewhere.values()])
            self._elsewhere = {task.key: task for task in left}

    def _open(self, some: Sequence[_Task]) -> list[_Task]:
        """Return the records that no run has brought to an end, and put down the others."""
        if not some:
            return []
        assert self.ledger is not None
        assert self._leases is not None
        now = self.ledger.failures(task.key for task in some)
        left = self._told(self.ledger, some, {k: f for k, f in now.items() if f != self._failed.get(k)})
        self._leases.release({task.key for task in some} - {task.key for task in left})
        return left

    def alive(self) -> None:
        """Say that this run is at work; called often."""
        if self._leases is not None:
            self._leases.beat()

    def end(self) -> None:
        """Store what has come, and give back what has not."""
        try:
            self.store()
        finally:
            if self._leases is not None:
                self._leases.close()

    def kept(self, status: str, verdict: str, failed: str, text: str) -> dict[str, Any]:
        """Return the fields of a row whose result the ledger keeps."""
        values, units = numbers_of(result_of(text, Path(self.job.name))) if text else ({}, {})
        self.units |= units
        checks = tuple(filter(None, failed.split(",")))
        return {"status": status, "verdict": verdict, "checks": checks, "values": values}

    def put(self, at: int, item: Item, state: Any, **more: Any) -> None:
        """Put down what is known of a record."""
        self.counts[state] += 1
        self.pace.over(item.size)
        self.rows[at] = FleetRow(
            record=item.name, bearing=item.bearing, rig=item.rig.name, taken_at=item.taken_at, state=state,
            **{"values": {}, **more},
        )  # fmt: skip

    def tell(self, n: int, say: Tick) -> None:
        """Tell how it goes, after so many answers."""
        failed, others = self.counts["failed"], 0 if self._leases is None else self._leases.others
        rate = n / max(time.monotonic() - self._begin, 1e-9)
        beside = f", {counted(others, 'other run')} beside" if others else ""
        left, share = self.pace.said(1 + others)
        say(f"{rate:.3g} records/s{f', {failed} failed' if failed else ''}{beside}{left}", share)

    def take(self, done: Done) -> None:
        """Take the answer to a record."""
        task: _Task = done.task
        self.pace.take(task.item.size, done.seconds, first=done.first)
        if done.failure is None:
            outcome: _Found = done.value
            self.units |= outcome.units
            values = {sys.intern(name): x for name, x in outcome.values.items()}
            self.put(task.at, task.item, "done", values=values, seconds=done.seconds, **outcome.judged)
            if outcome.entry is not None:
                self._entries.append(outcome.entry)
        else:
            self.put(task.at, task.item, "failed", reason=done.failure, seconds=done.seconds)
            if task.sha and done.lasting:
                self._failures.append(
                    Failure(
                        bearing=task.item.bearing, record=task.item.name, sha=task.sha, rig_sha=task.rig_sha,
                        settings=self.job.said, version=installed("ambid"), reason=done.failure,
                    )
                )  # fmt: skip
            else:
                self._fruitless.append(task.key)
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
        """Store what has come since the last time, and give it back."""
        if self.ledger is not None and self._leases is not None:
            self.ledger.add(self._entries)
            there = self.ledger.documents(f.key for f in self._failures)  # by a run that took a lease over
            failures = [f for f in self._failures if f.key not in there]
            if failures:
                self.ledger.fail(failures)
            self._leases.release([e.key for e in self._entries] + [f.key for f in self._failures] + self._fruitless)
        self._entries, self._failures, self._fruitless, self._stored = [], [], [], time.monotonic()


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
    check_settings(job, settings or {}, [*{id(item.rig): item.rig for item in fleet}.values()])
    if ledger is not None:
        fleet = fit_for_ledger(fleet, strict=isinstance(job, str))
    n_workers = local or workers or cores()
    store = None if ledger is None else open_ledger(ledger)
    try:
        order = in_order([item.size for item in fleet])
        run = _Run(job_made, [fleet[k] for k in order], store, again=again, workers=n_workers)

        def wished() -> bool:
            run.alive()
            return stopped()

        if scheduler is None:
            answers = work(job_made, run.tasks(), workers=workers, limit_s=limit_s, stopped=wished)
        else:
            from ambid.fleet.cluster import work_on_cluster

            answers = work_on_cluster(
                job_made, run.tasks(), scheduler=local or scheduler, limit_s=limit_s, stopped=wished
            )
        try:
            for n, done in enumerate(answers, 1):
                run.take(done)
                run.tell(n, say)
        finally:
            answers.close()
            run.end()
    finally:
        if store is not None:
            store.close()
    return FleetRun(
        job=job_made.name, settings=job_made.said, ledger=None if store is None else store.shown,
        workers=n_workers, seconds=time.monotonic() - begin, records=len(fleet), units=run.units,
        rows=tuple(run.rows[at] for at in sorted(run.rows, key=order.__getitem__)),
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
