"""The jobs of black-box and nonlinear models: records, channels by name, one structure in; one judged fit out.

Read -> cut -> fit -> judge. The second record, if any, is only judged on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ambid.blackbox.structures import STRUCTURES, Structure, structure
from ambid.errors import EstimationError, nearest
from ambid.estimation.progress import Tick, guessed, part_of, silent
from ambid.job.data import Channels, Clock, check_same_bench, known_rig
from ambid.nonlinear.structures import NonlinearStructure, nonlinear_structure
from ambid.physics.models import model
from ambid.record import Record
from ambid.rig import Rig

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit
    from ambid.blackbox.data import IOData, Orders
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit, Settings
    from ambid.validate.comparison import Comparison

    Method = Callable[[Sequence[IOData], IOData | None, Clock], BlackBoxFit | NonlinearFit]

_ORDERS = 0.95  # of a job's time goes into the choice of orders, where they are chosen
_USUAL_ORDERS = 12  # fits, about half of those that it takes
_SEARCH = 0.95  # of a nonlinear job's time, by experience; the rest are the checks


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
    of, say = structure(structure_name), tick or silent
    channels = Channels(
        inputs=inputs, outputs=outputs, references=references, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps,
        rig=None if rig is None else known_rig(rig),
    )  # fmt: skip
    bench = channels.rig
    _check_criterion(criterion, orders)
    _check_use(of, inputs if bench is None else inputs or model(bench.model).inputs, fixed, at_rest=at_rest)
    options: dict[str, Any] = {"fixed": dict(fixed)} if fixed else {}
    options |= {"at_rest": True} if at_rest else {}

    def estimated(data: Sequence[IOData], second: IOData | None, clock: Clock) -> BlackBoxFit:
        from ambid.validate.blackbox import judge

        chosen: dict[str, object] = {}
        wanted = orders
        if wanted is None:
            wanted, chosen = _choose_orders(of, data[0], criterion, say)
            clock.lap("orders")
        say("fit", _ORDERS if chosen else None)
        found = of.estimator(data[0], wanted, **options)
        clock.lap("fit")
        say("check")
        found = judge(found, data[0], second=second)
        return replace(found, details={**found.details, **chosen})

    parts = (from_s, to_s), (validate_from_s, validate_to_s)
    found: Any = _run(estimated, [record], validate, channels, parts, silent)
    return found  # type: ignore[no-any-return]


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
    rate_hz, gaps, rig : optional
        As `fit`.
    validate : Record, str or Path, optional
        A further record to judge on; may be one of the first, with another part.
    validate_from_s, validate_to_s : float, optional
        Part of it to use, in s; default all of it.
    seed : int, optional
        Of everything random, 0 or more: equal seeds give equal results.
    tick : callable, optional
        As `fit`. A KeyboardInterrupt that it raises during the search ends that with the best model so far, status
        ``stalled``; in the stages ``read`` and ``check`` it ends the job.

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
    say, of, wanted = tick or silent, nonlinear_structure(structure_name), settings or {}
    _check_settings(of, records, wanted, seed)
    channels = Channels(
        inputs=inputs, outputs=outputs, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps,
        rig=None if rig is None else known_rig(rig),
    )  # fmt: skip

    def estimated(data: Sequence[IOData], second: IOData | None, clock: Clock) -> NonlinearFit:
        from ambid.validate.nonlinear import judge

        found = of.estimator(data, wanted, seed=seed, tick=part_of(say, 0.0, _SEARCH))
        clock.lap("fit")
        say("check", _SEARCH)
        judged_fit = judge(found, data, second=second)
        say("check", 1.0)
        return replace(judged_fit, details={**judged_fit.details, "fit_timing_s": dict(judged_fit.timing_s)})

    parts = (from_s, to_s), (validate_from_s, validate_to_s)
    found: Any = _run(estimated, records, validate, channels, parts, say)
    return found  # type: ignore[no-any-return]


def _run(
    method: Method,
    records: Sequence[Record | str | Path],
    validate: Record | str | Path | None,
    channels: Channels,
    parts: tuple[tuple[float | None, float | None], tuple[float | None, float | None]],
    say: Tick,
) -> BlackBoxFit | NonlinearFit:
    """Read the records, let the method estimate and judge, and keep the times."""
    from ambid.estimation.linear import one_thread

    if validate is None and parts[1] != (None, None):
        raise EstimationError(
            "--validate-from and --validate-to cut a second record; none is given. Give --validate, or leave them out"
        )
    clock, data = Clock(), list[Any]()
    for record in records:
        say("read")
        data.append(channels.read(record, parts[0]))
    second = None if validate is None else channels.read(validate, parts[1])
    for other in data[1:] if second is None else (*data[1:], second):
        check_same_bench(data[0].units, data[0].dt, other)
    clock.lap("read")
    with one_thread():
        found = method(data, second, clock)
        clock.lap("checks")
    return replace(found, timing_s=clock.laps)


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

    bench = known_rig(rig)
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
    open_loop, from_s, to_s, rate_hz, gaps, tick : optional
        As `fit`.
    validate : Record, str or Path, optional
        A second record to judge on; without one the last part of the record is held out.
    holdout : float, optional
        That part, 0 to 1.

    Returns
    -------
    Comparison

    Raises
    ------
    AmbidError
        If the record, its channels or the orders break a rule.
    """
    from ambid.estimation.linear import one_thread
    from ambid.validate.comparison import compare as compare_fits

    for name, _ in candidates:
        _check_use(structure(name), inputs, None)
    channels = Channels(
        inputs=inputs, outputs=outputs, references=references, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps
    )
    data = channels.read(record, (from_s, to_s))
    second = None if validate is None else channels.read(validate)
    if second is not None:
        check_same_bench(data.units, data.dt, second)
    with one_thread():
        return compare_fits(data, candidates, holdout=holdout, second=second, tick=tick or silent)


def _choose_orders(of: Structure, data: IOData, criterion: str, say: Tick) -> tuple[Any, dict[str, object]]:
    from ambid.validate.orders import select

    say("orders", 0.0)
    tried = count()

    def tick(_: object) -> None:
        say("orders", _ORDERS * guessed(next(tried), _USUAL_ORDERS))

    choice = select(of.name, data, criterion=criterion, tick=tick)
    return choice.orders, {"selection": choice.summary()}


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


def _check_settings(of: NonlinearStructure, records: Sequence[object], settings: Settings, seed: int) -> None:
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
