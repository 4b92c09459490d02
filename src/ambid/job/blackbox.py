"""The black-box job: one record, inputs and outputs by name, one structure in; one judged fit out.

Read -> cut -> fit -> judge -> BlackBoxFit. The second record, if any, is only judged on.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from ambid.blackbox.data import IOData, Orders, io_data
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.structures import STRUCTURES, Structure, structure
from ambid.errors import EstimationError, nearest
from ambid.estimation.progress import guessed
from ambid.job._progress import Tick, silent
from ambid.job.bench_data import bench_data
from ambid.physics.models import model
from ambid.record import Record, read_record
from ambid.rig import Rig, load_rig
from ambid.signals.conditioning import cut
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit
    from ambid.validate.comparison import Comparison

_ORDERS = 0.95  # of a job's time goes into the choice of orders, where they are chosen
_USUAL_ORDERS = 12  # fits, about half of those that it takes


def fit(
    record: Record | str | Path,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    structure_name: str,
    orders: Orders | None = None,
    criterion: str = "bic",
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    references: Sequence[str] = (),
    open_loop: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    validate: Record | str | Path | None = None,
    validate_from_s: float | None = None,
    validate_to_s: float | None = None,
    rig: Rig | str | Path | None = None,
    tick: Tick | None = None,
) -> BlackBoxFit:
    """Fit a black-box model to one record, and judge it.

    Parameters
    ----------
    record : Record, str or Path
    inputs, outputs : sequence of str
        Channel names; no inputs for a time series.
    structure_name : str
        As in `ambid.blackbox.structures`.
    orders : Mapping[str, int, "auto" or tuple of int], optional
        A tuple has one number for each input. None: all are chosen by `criterion`.
    criterion : str, optional
        For the choice of orders, see `ambid.validate.orders`.
    fixed : Mapping[str, float], optional
        Coefficients that are known, for polynomial structures, by name (``a1``, ``b2``).
    at_rest : bool, optional
        Say that everything was zero before the first sample of the part that is fitted: no offsets and initial states
        are estimated. For polynomial structures; a record that contradicts it is warned of.
    references : sequence of str, optional
        Channels of the loop's outer excitation, for the methods that want it.
    open_loop : bool, optional
        Say that no feedback was at work.
    from_s, to_s : float, optional
        Part of the record to fit, in s.
    rate_hz : float, optional
        Sampling rate for a file without a time column.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps in a file.
    validate : Record, str or Path, optional
        A second record to judge on; may be the first, with another part.
    validate_from_s, validate_to_s : float, optional
        Part of the second record to use, in s; default all of it.
    rig : Rig, str or Path, optional
        Names and calibrates the channels; without `inputs` and `outputs` all of its model are taken.
    tick : callable, optional
        Called with the name of the present stage and, where it is known, the share of the job that is over:
        ``tick(stage, done)``; may raise to interrupt.

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    AmbidError
        If the record, its channels or the orders break a rule.
    EstimationError
        If nothing can be estimated.
    """
    from ambid.estimation.threads import one_thread
    from ambid.validate.blackbox import judge

    say = tick or silent
    of = structure(structure_name)
    _check_criterion(criterion, orders)
    if validate is None and not (validate_from_s is None and validate_to_s is None):
        raise EstimationError(
            "--validate-from and --validate-to cut a second record; none is given. Give --validate, or leave them out"
        )
    bench = rig if isinstance(rig, Rig) or rig is None else load_rig(rig)
    laps, last = dict[str, float](), time.perf_counter()

    def read(source: Record | str | Path, part: tuple[float | None, float | None]) -> IOData:
        return read_data(
            source, inputs, outputs, references, open_loop=open_loop, part=part, rate_hz=rate_hz, gaps=gaps, rig=bench
        )

    _check_use(of, inputs if bench is None else inputs or model(bench.model).inputs, fixed, at_rest=at_rest)
    data = read(record, (from_s, to_s))
    second = None if validate is None else read(validate, (validate_from_s, validate_to_s))
    if second is not None:
        same_bench(data.units, data.dt, second)
    laps["read"], last = time.perf_counter() - last, time.perf_counter()
    with one_thread():
        chosen: dict[str, object] = {}
        if orders is None:
            from ambid.validate.orders import select

            say("orders", 0.0)
            tried = count()
            choice = select(
                of.name, data, criterion=criterion,
                tick=lambda _: say("orders", _ORDERS * guessed(next(tried), _USUAL_ORDERS)),
            )  # fmt: skip
            orders, chosen = choice.orders, {"selection": choice.summary()}
            laps["orders"], last = time.perf_counter() - last, time.perf_counter()
        say("fit", _ORDERS if chosen else None)
        options: dict[str, object] = {"fixed": dict(fixed)} if fixed else {}
        options |= {"at_rest": True} if at_rest else {}
        found = of.estimator(data, orders, **options)
        laps["fit"], last = time.perf_counter() - last, time.perf_counter()
        say("check")
        found = judge(found, data, second=second)
        laps["checks"] = time.perf_counter() - last
    return replace(found, timing_s=laps, details={**found.details, **chosen})


def physics(found: BlackBoxFit, rig: Rig | str | Path) -> PhysicalFit:
    """Carry a fit to the physical parameters of a rig.

    Parameters
    ----------
    found : BlackBoxFit
        With inputs and outputs named by role.
    rig : Rig, str or Path
        Its model, what it fixes and knows, its delay.

    Returns
    -------
    PhysicalFit

    Raises
    ------
    EstimationError
        If the fit cannot carry the model: inputs, outputs, poles or a covariance are missing.
    """
    from ambid.bearing.physical import physical_parameters

    bench = rig if isinstance(rig, Rig) else load_rig(rig)
    plant = model(bench.model)
    return physical_parameters(found, plant, bench.parameters, delay=bench.channel(plant.inputs[0]).delay)


def compare(
    record: Record | str | Path,
    candidates: Sequence[tuple[str, Orders | None]],
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str] = (),
    open_loop: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    validate: Record | str | Path | None = None,
    holdout: float = 0.3,
    tick: Tick | None = None,
) -> Comparison:
    """Fit several structures to one record and compare them on data that none of them has seen.

    Parameters
    ----------
    record : Record, str or Path
    candidates : sequence of (str, Mapping or None)
        Structures with their orders; None chooses.
    inputs, outputs, references : sequence of str
    open_loop : bool, optional
    from_s, to_s : float, optional
        Part of the record to use, in s.
    rate_hz : float, optional
    gaps : {"error", "interpolate", "cut"}, optional
    validate : Record, str or Path, optional
        A second record to judge on; without one the last part of the record is held out.
    holdout : float, optional
        That part, 0 to 1.
    tick : callable, optional

    Returns
    -------
    Comparison

    Raises
    ------
    AmbidError
        If the record, its channels or the orders break a rule.
    """
    from ambid.estimation.threads import one_thread
    from ambid.validate.comparison import compare as compared

    for name, _ in candidates:
        _check_use(structure(name), inputs, None)
    data = read_data(
        record, inputs, outputs, references, open_loop=open_loop, part=(from_s, to_s), rate_hz=rate_hz, gaps=gaps
    )
    second = None
    if validate is not None:
        whole = (None, None)
        second = read_data(
            validate, inputs, outputs, references, open_loop=open_loop, part=whole, rate_hz=rate_hz, gaps=gaps
        )
        same_bench(data.units, data.dt, second)
    with one_thread():
        return compared(data, candidates, holdout=holdout, second=second, tick=tick or silent)


def read_data(
    record: Record | str | Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str] = (),
    *,
    open_loop: bool = False,
    part: tuple[float | None, float | None] = (None, None),
    rate_hz: float | None = None,
    gaps: str | None = None,
    rig: Rig | None = None,
) -> IOData:
    """Read a record, cut it and take inputs and outputs out of it.

    Parameters
    ----------
    record : Record, str or Path
    inputs, outputs, references : sequence of str
        Channel names.
    open_loop : bool, optional
    part : (float or None, float or None), optional
        From and to, in s.
    rate_hz : float, optional
    gaps : {"error", "interpolate", "cut"}, optional
    rig : Rig, optional
        Names inputs and outputs by role and calibrates them; where none are named, all of its model are taken.

    Returns
    -------
    IOData

    Raises
    ------
    AmbidError
        If the file, its columns or the cut break a rule.
    """
    if rig is not None:
        return bench_data(
            record, rig, inputs, outputs, references, open_loop=open_loop, part=part, rate_hz=rate_hz, gaps=gaps
        )
    if not isinstance(record, Record):
        record = read_record(record, rate_hz=rate_hz, gaps=gaps or "error")  # type: ignore[arg-type]
    if part != (None, None):
        record = cut(record, *part)
    return io_data(record, inputs, outputs, references=references, open_loop=open_loop)


def same_bench(units: Mapping[str, str], dt: float, second: IOData) -> None:
    """Refuse a second record whose rate or units are not those of the first.

    `dt`: of the first record.
    """
    if abs(second.dt / dt - 1) > 1e-6:
        raise EstimationError(
            f"the second record is sampled at {1 / second.dt:g} Hz, the first at {1 / dt:g} Hz; they have to agree. "
            "Resample one of them"
        )
    for name in (*second.inputs, *second.outputs):
        one, other = units.get(name, UNKNOWN), second.units[name]
        if one != other and UNKNOWN not in (one, other):
            raise EstimationError(
                f"channel {name!r} is in {other} in the second record, in {one} in the first; they have to agree. "
                "Check that it is the same channel, and its unit"
            )


def _check_criterion(criterion: str, orders: Orders | None) -> None:
    from ambid.validate.orders import Criterion

    known = get_args(Criterion)
    if criterion not in known:
        raise EstimationError(f"criterion {criterion!r} is not one of {', '.join(known)}.{nearest(criterion, known)}")
    if orders is not None and criterion != "bic":
        raise EstimationError(
            f"criterion {criterion} chooses orders, but orders are given. Leave one of them out, or give --orders auto"
        )


def _check_use(
    of: Structure, inputs: Sequence[str], fixed: Mapping[str, float] | None, *, at_rest: bool = False
) -> None:
    if inputs and not of.inputs:
        raise EstimationError(
            f"structure {of.name} is a time series and takes no inputs; it got {', '.join(inputs)}. Leave --input out"
        )
    if not inputs and of.inputs is True and of.kind != "state space":
        raise EstimationError(f"structure {of.name} needs an input. Give --input COLUMN, or use arma")
    if fixed and of.kind != "polynomial":
        raise EstimationError(f"structure {of.name} has no coefficients that can be fixed. Use a polynomial structure")
    if at_rest and not of.prediction_error:
        some = ", ".join(x.name for x in STRUCTURES.values() if x.prediction_error)
        raise EstimationError(
            f"structure {of.name} cannot be told that a record begins at rest; {some} can. Leave --at-rest out"
        )
