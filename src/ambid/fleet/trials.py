"""Monte Carlo over a rig: records of many seeds, simulated and given to a job, beside the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ambid.errors import AmbidError
from ambid.estimation.progress import Tick, silent
from ambid.estimation.result import Result
from ambid.fleet.pool import LIMIT_S, work
from ambid.fleet.run import Job, JobOf, check_settings, job_of, numbers_of
from ambid.job.data import RigSource
from ambid.job.simulation import bench_of_source, simulate
from ambid.ledger.entry import settings_text
from ambid.physics.presets import Preset
from ambid.rig import Rig, rig_of_preset
from ambid.settings.caller import check_whole
from ambid.simulation.rotor_bench import RotorBench
from ambid.validation.coverage import Coverage, Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """A seed on its way to a trial, in a worker."""

    rig: Rig  # with the truth
    known: Rig  # without it
    job: JobOf
    simulated: Mapping[str, Any]

    def __call__(self, seed: int) -> Trial:
        record = simulate(self.rig, seed=seed, **self.simulated)
        result = self.job.of(record, self.known)
        values, _ = numbers_of(result)
        verdict = result.verdict.word if isinstance(result, Result) else "usable"
        return Trial(seed=seed, verdict=verdict, values=values)


def monte_carlo(
    rig: RigSource,
    *,
    runs: int = 100,
    seed: int = 1,
    job: Job = "identify",
    simulated: Mapping[str, Any] | None = None,
    workers: int | None = None,
    limit_s: float = LIMIT_S,
    stopped: Callable[[], bool] = lambda: False,
    tick: Tick | None = None,
    **settings: Any,
) -> Coverage:
    """Simulate many records of a rig, do a job on each, and compare with the truth.

    The job gets the rig without the values of parameters that are free: they have to be found.

    Parameters
    ----------
    rig : Rig, path, dict or TOML text
        A rig or its file, or the name of a preset; each of its parameters has a value.
    runs : int, optional
        Number of records.
    seed : int, optional
        Of the first; the others follow.
    job : str or callable, optional
        As in `ambid.fleet`; its numbers are compared with the parameters of the same name.
    simulated : Mapping, optional
        Arguments of `ambid.simulate`, such as ``{"duration": 0.5}``.
    workers : int, optional
        Processes; default one for each processor.
    limit_s : float, optional
        Longest time for one run, s.
    stopped : callable, optional
        Asked now and then; true ends the work, and keeps what is done.
    tick : callable, optional
        Called with the progress.
    **settings
        Of the job, under its own names.

    Returns
    -------
    Coverage
        Bias, spread and coverage of each parameter.

    Raises
    ------
    AmbidError
        If a parameter of the rig has no value, settings break a rule, or the job gives none of the parameters.

    Examples
    --------
    >>> from ambid.fleet import monte_carlo
    >>> found = monte_carlo("thesis", runs=2, simulated={"duration": 0.1}, workers=1)  # in a script: under __main__
    >>> found.counts["usable"], [row.name for row in found.rows]
    (2, ['k_x', 'k_i', 'R', 'L'])
    """
    check_whole({"runs": runs}, 1, 1_000_000)
    check_whole({"seed": seed}, 0)
    source = bench_of_source(str(rig) if isinstance(rig, Path) else rig)
    truth = rig_of_preset(source) if isinstance(source, Preset) else source
    if truth.rotor is not None:  # whose drawing gives numbers of the rigid motion
        drawn = RotorBench.of(truth, None, None).plant.parameters
        truth = replace(truth, parameters=tuple(replace(p, value=drawn.get(p.name, p.value)) for p in truth.parameters))
    lacks = [p.name for p in truth.parameters if p.value is None]
    if lacks:
        raise AmbidError(f"rig {truth.name!r} has no value of {lacks[0]}, and a simulation needs it. Give it")
    places = () if truth.rotor is None else truth.rotor.places
    known = replace(
        truth,
        parameters=tuple(
            replace(p, value=None) if p.role == "free" and p.name not in places else p for p in truth.parameters
        ),
    )
    check_settings(job, settings, [known])
    made, given = job_of(job, settings), dict(simulated or {})
    begin, say, trials = time.monotonic(), tick or silent, list[Trial]()
    answers = work(
        _Run(rig=truth, known=known, job=made, simulated=given), range(seed, seed + runs), workers=workers,
        limit_s=limit_s, stopped=stopped,
    )  # fmt: skip
    try:
        for n, done in enumerate(answers, 1):
            failed = done.failure is not None
            trials.append(Trial(seed=done.task, reason=done.failure or "", values={}) if failed else done.value)
            say(f"{n / max(time.monotonic() - begin, 1e-9):.3g} runs/s", n / runs)
    finally:
        answers.close()
    values = {p.name: float(p.value) for p in truth.parameters if p.value is not None and p.role != "fixed"}
    seen = {name for t in trials for name in t.values}
    if not seen & set(values) and any(not t.reason for t in trials):
        gives = f"gives {', '.join(sorted(seen)[:5])}: none is" if seen else "gives no number that is"
        raise AmbidError(f"{made.name} {gives} a parameter of the rig. Choose another job")
    return Coverage(
        rig=source.name, job=made.name,
        settings=settings_text(made.name, runs=runs, seed=seed, **given, **settings),
        truth={n: x for n, x in values.items() if n in seen or not seen},
        units={p.name: p.unit for p in truth.parameters}, trials=tuple(sorted(trials, key=lambda t: t.seed)),
        asked=runs, seconds=time.monotonic() - begin,
    )  # fmt: skip
