"""The jobs of black-box and nonlinear models: records, channels by name, one structure in; one fit with its checks out.

Read -> cut -> fit -> validate. The second record, if any, is only validated on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ambid.blackbox.data import candidates_of, fixed_of, orders_of, settings_of
from ambid.blackbox.fit import RESPONSE_STRUCTURES, STRUCTURES, Structure
from ambid.blackbox.fit import structure as structure_named
from ambid.errors import EstimationError, nearest
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, guessed, part_of, silent
from ambid.job.data import Channels, Clock, Names, RigSource, Source, check_same_bench, known_rig, sources_of
from ambid.nonlinear.fit import NONLINEAR_STRUCTURES, nonlinear_structure
from ambid.physics.linear_model import model
from ambid.record import GapPolicy, Record, read_record
from ambid.rig import default_rig
from ambid.settings.caller import refuse_given, setting
from ambid.settings.calls import of_job

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit
    from ambid.blackbox.data import IOData, Orders
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit, Settings
    from ambid.validation.agreement import Agreement
    from ambid.validation.comparison import Comparison

_ORDERS = 0.95  # of a job's time goes into the choice of orders, where they are chosen
_USUAL_ORDERS = 12  # fits, about half of those that it takes
_SEARCH = 0.95  # of a nonlinear job's time, by experience; the rest are the checks


@of_job("fit")
def fit(
    records: Source | Sequence[Source],
    structure: str,
    orders: Orders | Settings | Sequence[int] | int | str | None = "auto",
    *,
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    reference: Names | None = None,
    settings: object = None,
    seed: int | None = None,
    criterion: str = "bic",
    fix: Mapping[str, float] | Sequence[str] | str | None = None,
    rig: RigSource | None = None,
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
        Names of channels; no input for a time series. With a rig its roles or columns, by default all of its model;
        so too of a record whose channels are called voltage, current and position.
        References are the loop's outer excitation, for methods that use it.
    orders : str, Mapping[str, int, "auto" or tuple of int], int or sequence of int, optional
        Orders of a linear structure: ``"na=2,nb=2,nk=1"`` as in the command, by name, with a tuple where inputs
        differ, or ``[2, 2, 1]`` in their order (na, nb, nc, nd, nf, nk, without those it does not have).
        "auto": all are chosen by `criterion`. Of a nonlinear structure its settings, as ``ambid
        models`` lists them (``"ny=2,degree=3"``); the method chooses those left out.
    settings : optional
        Former name of the orders of a nonlinear structure; refused.
    seed : int, optional
        Seed of all randomness in a nonlinear structure, 0 or more; equal seeds give equal results.
    criterion : str, optional
        Criterion that chooses orders, see `ambid.validation.orders`.
    fix : Mapping[str, float] or sequence of str, optional
        Known coefficients of polynomial structures, by name (``{"a1": -1.5}`` or ``["a1=-1.5"]``).
    rig : Rig, path, dict or TOML text, optional
        Names and calibrates the channels.
    open_loop : bool, optional
        Declare the record open loop.
    at_rest : bool, optional
        All signals are zero before the first sample: no offsets and initial states are estimated. For polynomial
        structures; a warning tells if the record contradicts it.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`, of every record.
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
    sources, structure = sources_of(records), str(structure).lower()
    if not (channels.inputs or channels.outputs or channels.references or channels.rig):
        sources, channels = _by_role(sources, structure, channels)
    if settings is not None:
        raise EstimationError("settings of a nonlinear structure are its orders now. Give them as orders")
    nonlinear, fixed = structure in NONLINEAR_STRUCTURES, fixed_of(fix)
    placed: Any = _by_place(structure, orders)
    wanted: Any = settings_of(placed) if nonlinear else orders_of(placed)
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


def _by_role(sources: list[Source], structure: str, channels: Channels) -> tuple[list[Source], Channels]:
    """Read records whose inputs and outputs are not named: those of a rig without knowledge, if they are there."""
    how: Any = {"rate_hz": channels.rate_hz, "gaps": channels.gaps or "error", "layout": channels.layout}
    read: list[Source] = [read_record(x, units=channels.units, **how) for x in sources]
    rig, names = default_rig(), read[0].names if read and isinstance(read[0], Record) else ()
    known = {c.role for c in rig.channels} <= {*names}
    if names and not known and structure in {*STRUCTURES, *NONLINEAR_STRUCTURES}:
        raise EstimationError(
            f"no input and no output were named; the record has {', '.join(names)}. Give "
            f"{setting('output', 'COLUMN')}, and {setting('input', 'COLUMN')} unless it is a time series"
        )
    timed = structure in STRUCTURES and not structure_named(structure).inputs
    return read, replace(channels, units=None, rate_hz=None, rig=rig if known and not timed else None)


def _by_place(structure: str, orders: Any) -> Any:
    """Return orders by name that were given by their places."""
    if isinstance(orders, bool) or not isinstance(orders, (int, list, tuple)) or structure not in STRUCTURES:
        return orders
    names, values = STRUCTURES[structure].orders, [orders] if isinstance(orders, int) else list(orders)
    if len(names) != len(values):
        raise EstimationError(
            f"{setting('orders')} is {orders!r}; {structure} has {', '.join(names)}, in this order. Give each"
        )
    return dict(zip(names, values, strict=True))


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


def physics(found: BlackBoxFit, rig: RigSource) -> PhysicalFit:
    """Carry a fit to the physical parameters of a rig.

    Parameters
    ----------
    found : BlackBoxFit
        With inputs and outputs named by role.
    rig : Rig, path, dict or TOML text
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
    from ambid.estimation.calibration import left_out

    bench = known_rig(rig)
    if bench.rotor is not None:
        raise EstimationError(
            f"{setting('rig')} of a rotor on many axes is for 'ambid identify'; a fit does not lead to its "
            f"parameters. Omit {setting('rig')}, "
            f"and name columns by {setting('input')} and {setting('output')}"
        )
    plant = model(bench.model)
    try:
        fit = physical_parameters(found, plant, bench.parameters, delay=bench.channel(plant.inputs[0]).delay)
    except EstimationError as refusal:  # for a reason that the record may give
        reasons = [r.text for r in found.reasons if r.cause]
        raise EstimationError(". Further: ".join([*reasons, str(refusal)])) from None
    return replace(fit, warnings=(*fit.warnings, *left_out(bench)))


@of_job("compare")
def compare(
    record: Any,
    candidates: Any = (),
    *,
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    reference: Names | None = None,
    rig: RigSource | None = None,
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
) -> Comparison | Agreement:
    """Fit several structures to one record and compare them on data that none of them has seen; or compare estimates.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays; estimate
        Or the first of several estimates or fits of one kind, or of their files; or all of them, in a list or by name
        in a dict. They are tested for whether they are of one machine; nothing else is then to be given.
    candidates : sequence of str or (str, orders); estimate
        Structures with their orders: ``"arx:na=2,nb=2,nk=1"``, ``"n4sid"`` (orders are chosen), or a name beside
        orders as `fit` takes them. Or the second estimate, or a list of further ones.
    input, output, reference, rig, open_loop, from_s, to_s, rate_hz, gaps, units, layout, tick : optional
        As `fit`.
    validate : as `record`, optional
        A second record to validate on; without one the last part of the record is held out.
    holdout : float, optional
        Size of that part relative to the record, 0 to 1.

    Returns
    -------
    Comparison, or of estimates Agreement

    Raises
    ------
    AmbidError
        If the record, its channels or the orders break a rule.
    EstimationError
        If two records are given.

    Examples
    --------
    >>> import ambid
    >>> a, b = (ambid.identify(ambid.simulate("thesis", duration=0.5, seed=s)) for s in (1, 2))
    >>> ambid.compare(a, b).checks["one_machine"].passed
    True
    """
    from ambid.validation.comparison import compare as compare_fits

    results = _results(record, candidates)
    if isinstance(candidates, Record):
        raise EstimationError(
            "two records are given; records are compared by their estimates. Give ambid.compare(one, other) what "
            "ambid.identify returns of each"
        )
    if results is not None:
        from ambid.validation.agreement import agreement

        return agreement(results)
    candidates = [candidates] if isinstance(candidates, str) else candidates
    candidates = [x if isinstance(x, str) else (x[0], _by_place(*x)) for x in candidates]
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


def _results(first: Any, second: Any) -> dict[str, Any] | None:
    """Return results that are to be compared, by name; None where `first` is a record."""
    from ambid.estimation.estimate import Parametric
    from ambid.job.results import load_result

    def is_one(x: Any) -> bool:
        return isinstance(x, Parametric) or (isinstance(x, str | Path) and Path(x).suffix.lower() == ".json")

    given = first if isinstance(first, Mapping | list | tuple) else (first,)
    named = (
        given.items() if isinstance(given, Mapping) else enumerate([*given, *([second] if is_one(second) else second)])
    )
    entries = list(named)
    results = [is_one(x) for _, x in entries]
    if not any(results):
        return None
    if not all(results):
        raise EstimationError("a record is judged by one estimate, and estimates are compared among themselves. Use "
                              "ambid.validate(estimate, record)")  # fmt: skip
    files = [Path(x) for _, x in entries if isinstance(x, str | Path)]
    alike = len({x.stem for x in files}) < len(files)
    named_by = {n if isinstance(n, str) else _name(n, x, whole=alike): x for n, x in entries}
    if len(named_by) < 2:
        raise EstimationError("one estimate is given; comparing takes two or more. Give another")
    loaded = {name: load_result(x) if isinstance(x, str | Path) else x for name, x in named_by.items()}
    for name, x in loaded.items():
        if not isinstance(x, Parametric):
            raise EstimationError(f"{name} has no parameters to compare. Give estimates, or fits")
    return loaded


def _name(n: int, x: Any, *, whole: bool) -> str:
    """Name a result by its file, as a whole where others are called alike, or by a letter."""
    return chr(ord("A") + n) if not isinstance(x, str | Path) else str(x) if whole else Path(x).stem


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
