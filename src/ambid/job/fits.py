"""The jobs of black-box and nonlinear models: records, channels by name, one structure in; one fit with its checks out.

Read -> cut -> fit -> validate. The second record, if any, is only validated on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ambid.blackbox.data import Candidate, candidates_of, fixed_of, orders_of, settings_of
from ambid.blackbox.fit import RESPONSE_STRUCTURES, STRUCTURES, Structure
from ambid.blackbox.fit import structure as structure_named
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, guessed, part_of, silent
from ambid.job.data import Channels, Clock, Names, Source, check_same_bench, known_rig, sources_of
from ambid.nonlinear.fit import NONLINEAR_STRUCTURES, nonlinear_structure
from ambid.physics.linear_model import model
from ambid.record import GapPolicy
from ambid.rig import Rig
from ambid.settings.caller import refuse_given, setting

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit
    from ambid.blackbox.data import IOData, Orders
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit, Settings
    from ambid.validation.comparison import Comparison

_ORDERS = 0.95  # of a job's time goes into the choice of orders, where they are chosen
_USUAL_ORDERS = 12  # fits, about half of those that it takes
_SEARCH = 0.95  # of a nonlinear job's time, by experience; the rest are the checks


def fit(
    records: Source | Sequence[Source],
    *,
    structure: str,
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    reference: Names | None = None,
    orders: Orders | Settings | str | None = "auto",
    settings: object = None,
    seed: int | None = None,
    criterion: str = "bic",
    fix: Mapping[str, float] | Sequence[str] | str | None = None,
    rig: Rig | str | Path | None = None,
    open_loop: bool = False,
    at_rest: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    validate: Source | None = None,
    tick: Tick | None = None,
) -> BlackBoxFit | NonlinearFit:
    """Fit a black-box model to one record, or a nonlinear one to one or several, and check it.

    Parameters
    ----------
    records : file, Record, DataFrame, Dataset or dict of arrays, or sequence of these
        Several: for nonlinear structures, of one bench, with the same channels and rate.
    structure : str
        As in `ambid.blackbox.fit` or `ambid.nonlinear.fit`.
    input, output, reference : str or sequence of str, optional
        Names of channels; no input for a time series. With a rig its roles or columns, by default all of its model.
        References are the loop's outer excitation, for methods that use it.
    orders : str or Mapping[str, int, "auto" or tuple of int], optional
        Orders of a linear structure: ``"na=2,nb=2,nk=1"`` as in the command, or by name, with a tuple where inputs
        differ. "auto": all are chosen by `criterion`. Of a nonlinear structure its settings, as ``ambid models`` lists
        them (``"ny=2,degree=3"``); the method chooses those left out.
    settings : optional
        Former name of the orders of a nonlinear structure; refused.
    seed : int, optional
        Seed of all randomness in a nonlinear structure, 0 or more; equal seeds give equal results.
    criterion : str, optional
        Criterion that chooses orders, see `ambid.validation.orders`.
    fix : Mapping[str, float] or sequence of str, optional
        Known coefficients of polynomial structures, by name (``{"a1": -1.5}`` or ``["a1=-1.5"]``).
    rig : Rig, str or Path, optional
        Names and calibrates the channels.
    open_loop : bool, optional
        Declare the record open loop.
    at_rest : bool, optional
        All signals are zero before the first sample: no offsets and initial states are estimated. For polynomial
        structures; a warning tells if the record contradicts it.
    from_s, to_s : float, optional
        Part of every record to fit, in s.
    rate_hz : float, optional
        Sampling rate of records without time, Hz.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about missing values.
    units : Mapping of str to str, optional
        Unit by column, for tables in memory.
    layout : Mapping of str to str, optional
        What files leave open, as `ambid.record.read_record` takes it.
    validate : as `records`, optional
        A further record to validate on, all of it; `ambid.validate` takes a part.
    tick : callable, optional
        Called with the name of the present stage and, where it is known, the share of the job that is over:
        ``tick(stage, done)``; may raise to interrupt. A KeyboardInterrupt during the search of a nonlinear structure
        ends that with the best model so far, status ``stalled``.

    Returns
    -------
    BlackBoxFit or NonlinearFit

    Raises
    ------
    AmbidError
        If a record, its channels, orders or settings break a rule.
    EstimationError
        If nothing can be estimated.
    """
    say, channels = tick or silent, Channels.of(
        input=input, output=output, reference=reference, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps, units=units,
        rig=rig, layout=layout,
    )  # fmt: skip
    sources = sources_of(records)
    if settings is not None:
        raise EstimationError("settings of a nonlinear structure are its orders now. Give them as orders")
    nonlinear, fixed = structure in NONLINEAR_STRUCTURES, fixed_of(fix)
    wanted: Any = settings_of(orders) if nonlinear else orders_of(orders)
    if nonlinear:
        linear_only = {"fix": fixed, "reference": channels.references, "at_rest": at_rest,
                       "criterion": criterion != "bic"}  # fmt: skip
        refuse_given(linear_only, f"{{}} is for linear structures; {structure} does not use it. Omit it")
        _check_settings(structure, sources, wanted, seed or 0)
    else:
        _check_linear(structure, sources, {"seed": seed is not None})
        _check_criterion(criterion, wanted)
        taken = channels.inputs if channels.rig is None else channels.inputs or channels.rig.plant.inputs
        _check_use(structure_named(structure), taken, fixed, at_rest=at_rest)
    clock, data = Clock(), list[Any]()
    for record in sources:
        (say if nonlinear else silent)("read")
        data.append(channels.read(record, (from_s, to_s)))
    second = None if validate is None else channels.read(validate, (None, None))
    for other in data[1:] if second is None else (*data[1:], second):
        check_same_bench(data[0].units, data[0].dt, other)
    clock.lap("read")
    options: dict[str, Any] = {"fixed": fixed} if fixed else {}
    options |= {"at_rest": True} if at_rest else {}
    with one_thread():
        found: Any = (
            _estimate_nonlinear(structure, data, second, wanted, seed or 0, clock, say)
            if nonlinear
            else _estimate_linear(structure_named(structure), data[0], second, wanted, criterion, options, clock, say)
        )
        clock.lap("checks")
    return replace(found, timing_s=clock.laps, used=(data, second))  # type: ignore[no-any-return]


def _estimate_linear(
    of: Structure,
    data: IOData,
    second: IOData | None,
    orders: Orders | None,
    criterion: str,
    options: Mapping[str, Any],
    clock: Clock,
    say: Tick,
) -> BlackBoxFit:
    from ambid.validation.fits import judge

    chosen: dict[str, object] = {}
    if orders is None:
        orders, chosen = _choose_orders(of, data, criterion, say)
        clock.lap("orders")
    say("fit", _ORDERS if chosen else None)
    found: BlackBoxFit = of.estimator(data, orders, **options)
    clock.lap("fit")
    say("check")
    found = judge(found, data, second=second)
    return replace(found, details={**found.details, **chosen})


def _estimate_nonlinear(
    name: str,
    data: Sequence[IOData],
    second: IOData | None,
    settings: Settings,
    seed: int,
    clock: Clock,
    say: Tick,
) -> NonlinearFit:
    from ambid.validation.fits import judge

    more = {"linear": _physical_weights} if name == "nn" else {}
    found = nonlinear_structure(name).estimator(data, settings, seed=seed, tick=part_of(say, 0.0, _SEARCH), **more)
    clock.lap("fit")
    say("check", _SEARCH)
    checked = judge(found, data, second=second)
    say("check", 1.0)
    return replace(checked, details={**checked.details, "fit_timing_s": dict(checked.timing_s)})


def _physical_weights(data: IOData, delay: int) -> Mapping[str, float] | None:
    """Return A, B (thesis eq. 4.8) and the predictor gain by the names of their entries, SI, as `identify` finds them;
    None if it does not.
    """
    import numpy as np

    from ambid.bearing.linear import greybox
    from ambid.bearing.multistart import Signals
    from ambid.estimation.predictor import assemble
    from ambid.physics.linear_model import OneAxis, Parameter

    plant, units = OneAxis(), [data.units[x] for x in data.outputs]
    places = [units.index("m"), units.index("A")]
    known = [
        Parameter(name=p.name, unit=p.unit, role="fixed", value=0.0) if p.name == "c"
        else Parameter(name=p.name, unit=p.unit) for p in plant.parameters
    ]  # fmt: skip
    try:
        signals = Signals(u=data.u, y=data.y[:, places], rate_hz=1.0 / data.dt)
        found = greybox(plant, signals, known, delay=float(delay), evaluations=0)
    except (EstimationError, np.linalg.LinAlgError):
        return None
    predictor, scales = assemble(found.problem, found.vector, with_derivatives=False), found.problem.scales
    if predictor is None:
        return None
    K = predictor.gain[:3] * scales.state[:3, None] / scales.output
    space = plant.matrices(found.problem.parameters(found.vector))
    A = {f"a{r + 1}{c + 1}": float(space.A[r, c]) for r, c in ((1, 0), (1, 2), (2, 1), (2, 2))}
    gain = {f"k{r + 1}{c + 1}": float(K[r, k]) for r in range(3) for k, c in enumerate(places)}
    return {**A, "b3": float(space.B[2, 0]), **gain}


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
    if bench.rotor is not None:
        raise EstimationError(
            f"{setting('rig')} of a rotor on many axes is for 'ambid identify'; a fit does not lead to its "
            f"parameters. Omit {setting('rig')}, "
            f"and name columns by {setting('input')} and {setting('output')}"
        )
    plant = model(bench.model)
    return physical_parameters(found, plant, bench.parameters, delay=bench.channel(plant.inputs[0]).delay)


def compare(
    record: Source,
    candidates: Sequence[Candidate],
    *,
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    reference: Names | None = None,
    rig: Rig | str | Path | None = None,
    open_loop: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    validate: Source | None = None,
    holdout: float = 0.3,
    tick: Tick | None = None,
) -> Comparison:
    """Fit several structures to one record and compare them on data that none of them has seen.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
    candidates : sequence of str or (str, orders)
        Structures with their orders: ``"arx:na=2,nb=2,nk=1"``, ``"n4sid"`` (orders are chosen), or a name beside
        orders as `fit` takes them.
    input, output, reference, rig, open_loop, from_s, to_s, rate_hz, gaps, units, layout, tick : optional
        As `fit`.
    validate : as `record`, optional
        A second record to validate on; without one the last part of the record is held out.
    holdout : float, optional
        Size of that part relative to the record, 0 to 1.

    Returns
    -------
    Comparison

    Raises
    ------
    AmbidError
        If the record, its channels or the orders break a rule.
    """
    from ambid.validation.comparison import compare as compare_fits

    wanted, channels = candidates_of(candidates), Channels.of(
        input=input, output=output, reference=reference, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps, units=units,
        rig=rig, layout=layout,
    )  # fmt: skip
    for name, _ in wanted:
        _check_use(structure_named(name), channels.inputs, None)
    data = channels.read(record, (from_s, to_s))
    second = None if validate is None else channels.read(validate)
    if second is not None:
        check_same_bench(data.units, data.dt, second)
    with one_thread():
        return compare_fits(data, wanted, holdout=holdout, second=second, tick=tick or silent)


def _choose_orders(of: Structure, data: IOData, criterion: str, say: Tick) -> tuple[Any, dict[str, object]]:
    from ambid.validation.orders import select

    say("orders", 0.0)
    tried = count()

    def tick(_: object) -> None:
        say("orders", _ORDERS * guessed(next(tried), _USUAL_ORDERS))

    choice = select(of.name, data, criterion=criterion, tick=tick)
    return choice.orders, {"selection": choice.summary()}


def _check_criterion(criterion: str, orders: Orders | None) -> None:
    from ambid.validation.orders import Criterion

    known = get_args(Criterion)
    if criterion not in known:
        raise EstimationError(f"criterion {criterion!r} is not one of {', '.join(known)}.{nearest(criterion, known)}")
    if orders is not None and criterion != "bic":
        raise EstimationError(
            f"criterion {criterion} chooses orders, but orders are given. Omit one, or give {setting('orders', 'auto')}"
        )


def _check_use(
    of: Structure, inputs: Sequence[str], fixed: Mapping[str, float] | None, *, at_rest: bool = False
) -> None:
    if inputs and not of.inputs:
        raise EstimationError(
            f"structure {of.name} is a time series and takes no inputs; it got {', '.join(inputs)}. Omit "
            f"{setting('input')}"
        )
    if not inputs and of.inputs is True and of.kind != "state space":
        raise EstimationError(f"structure {of.name} needs an input. Give {setting('input', 'COLUMN')}, or use arma")
    if fixed and of.kind != "polynomial":
        raise EstimationError(f"structure {of.name} has no coefficients that can be fixed. Use a polynomial structure")
    if at_rest and not of.prediction_error:
        some = ", ".join(x.name for x in STRUCTURES.values() if x.prediction_error)
        raise EstimationError(f"structure {of.name} cannot start at rest; {some} can. Omit {setting('at_rest')}")


def _check_linear(name: str, records: Sequence[object], given: Mapping[str, object]) -> None:
    """Refuse a structure that is none, and what a linear one has no use for."""
    if name in RESPONSE_STRUCTURES:
        structure_named(name)  # says where those are fitted
    every = [*STRUCTURES, *NONLINEAR_STRUCTURES]
    if name not in STRUCTURES:
        raise EstimationError(f"structure {name!r} is unknown; known: {', '.join(every)}.{nearest(name, every)}")
    if len(records) > 1:
        several = ", ".join(NONLINEAR_STRUCTURES)
        raise EstimationError(f"structure {name} takes one record; {several} take several. Give one")
    refuse_given(given, f"{{}} is for nonlinear structures; {name} has {setting('orders')}. Omit it")


def _check_settings(name: str, records: Sequence[object], settings: Settings, seed: int) -> None:
    known = list(nonlinear_structure(name).settings)
    if not records:
        raise EstimationError("no record was given. Give at least one")
    if seed < 0:
        raise EstimationError(f"seed {seed} is negative; a seed is 0 or more. Give another one")
    for x in settings:
        if x not in known:
            raise EstimationError(
                f"structure {name} has no setting {x!r}; it has: {', '.join(known)}.{nearest(x, known)}"
            )
