"""The nonlinear job: records of one bench, inputs and outputs by name, one structure in; one judged fit out.

Read -> cut -> fit -> judge -> NonlinearFit. The second record, if any, is only judged on.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, nearest
from ambid.estimation.progress import part_of
from ambid.job._progress import Tick, silent
from ambid.job.blackbox import read_data, same_bench
from ambid.nonlinear.fit import NonlinearFit, Settings
from ambid.nonlinear.structures import NonlinearStructure, nonlinear_structure
from ambid.record import Record
from ambid.rig import Rig, load_rig

OWN_STAGES = ("read", "check")
"""Stages outside the search: an exception from `tick` there ends the job; elsewhere the best so far is kept."""

_SEARCH = 0.95  # of the job's time, by experience; the rest are the checks


def fit_nonlinear(
    records: Sequence[Record | str | Path],
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    structure_name: str,
    settings: Settings | None = None,
    open_loop: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    validate: Record | str | Path | None = None,
    validate_from_s: float | None = None,
    validate_to_s: float | None = None,
    rig: Rig | str | Path | None = None,
    seed: int = 0,
    tick: Tick | None = None,
) -> NonlinearFit:
    """Fit one nonlinear model to one or several records, and judge it.

    Parameters
    ----------
    records : sequence of Record, str or Path
        Of one bench: same channels, same rate.
    inputs, outputs : sequence of str
        Channel names.
    structure_name : str
        As in `ambid.nonlinear.structures`.
    settings : Mapping, optional
        As the register describes them; what is left out the method chooses.
    open_loop : bool, optional
        Say that no feedback was at work in any of them.
    from_s, to_s : float, optional
        Part of every record to fit, in s.
    rate_hz : float, optional
        Sampling rate for files without a time column.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps in a file.
    validate : Record, str or Path, optional
        A further record to judge on; may be one of the first, with another part.
    validate_from_s, validate_to_s : float, optional
        Part of it to use, in s; default all of it.
    rig : Rig, str or Path, optional
        Names and calibrates the channels; without `inputs` and `outputs` all of its model are taken.
    seed : int, optional
        Of everything random, 0 or more: equal seeds give equal results.
    tick : callable, optional
        Called with the name of the present stage and, where it is known, the share of the job that is over, 0 to 1
        (else None): ``tick(stage, done)``. A KeyboardInterrupt that it raises during the search ends that with
        the best model so far, status ``stalled``.

    Returns
    -------
    NonlinearFit

    Raises
    ------
    AmbidError
        If a record, its channels or the settings break a rule.
    EstimationError
        If nothing can be estimated.
    """
    from ambid.estimation.threads import one_thread
    from ambid.validate.nonlinear import judge

    say = tick or silent
    of = nonlinear_structure(structure_name)
    _check(of, records, settings or {}, seed)
    if validate is None and not (validate_from_s is None and validate_to_s is None):
        raise EstimationError(
            "--validate-from and --validate-to cut a second record; none is given. Give --validate, or leave them out"
        )
    bench = rig if isinstance(rig, Rig) or rig is None else load_rig(rig)
    laps, last = dict[str, float](), time.perf_counter()

    def read(source: Record | str | Path, part: tuple[float | None, float | None]) -> IOData:
        say("read")
        return read_data(source, inputs, outputs, open_loop=open_loop, part=part, rate_hz=rate_hz, gaps=gaps, rig=bench)

    data = [read(x, (from_s, to_s)) for x in records]
    second = None if validate is None else read(validate, (validate_from_s, validate_to_s))
    for other in data[1:] if second is None else (*data[1:], second):
        same_bench(data[0].units, data[0].dt, other)
    laps["read"], last = time.perf_counter() - last, time.perf_counter()
    with one_thread():
        found = of.estimator(data, settings or {}, seed=seed, tick=part_of(say, 0.0, _SEARCH))
        laps["fit"], last = time.perf_counter() - last, time.perf_counter()
        say("check", _SEARCH)
        found = judge(found, data, second=second)
        say("check", 1.0)
        laps["checks"] = time.perf_counter() - last
    return replace(found, timing_s=laps, details={**found.details, "fit_timing_s": dict(found.timing_s)})


def _check(of: NonlinearStructure, records: Sequence[object], settings: Settings, seed: int) -> None:
    if not records:
        raise EstimationError("there is no record to fit. Give one at least")
    if seed < 0:
        raise EstimationError(f"the seed is {seed}; it is 0 or more. Give another one")
    for name in settings:
        if name not in of.settings:
            known = ", ".join(of.settings)
            raise EstimationError(
                f"structure {of.name} has no setting {name!r}; it has: {known}.{nearest(name, list(of.settings))}"
            )
