"""From a rig file to a rig, checked against the model and itself, in SI, and a record through its eyes: columns become
roles, calibrated, in the units of the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from ambid.errors import ModelError, RecordError, RigError, UnitError, choices
from ambid.physics.law import StateLaw
from ambid.physics.law_magnet import BEARING_NUMBERS, NOT_NEGATIVE
from ambid.physics.linear_model import LinearModel, Parameter, ParameterSpec, model
from ambid.physics.loop import UNLIMITED, Interval, Limits, Loop, Noise
from ambid.physics.rotor_model import RotorModel
from ambid.record import NAMED, Channel, GapPolicy, Record, Source, Step, format_of, read_record
from ambid.record.calibration import Calibration
from ambid.rig.calibration import calibration_of, channel_sd_of, plane_sd_of
from ambid.rig.rig import (
    DAQ_RATE_HZ,
    Daq,
    RecordSettings,
    Rig,
    RigChannel,
    RigMagnet,
    optional_roles,
    role_units,
)
from ambid.rig.rotor import modes_of, operation_of, planes_of, rotor_of, shaft_of, si_of, turning_of, unit_of
from ambid.settings.caller import command, path_of
from ambid.signals.conditioning import mean_to_next
from ambid.units import UNKNOWN, parse_unit

if TYPE_CHECKING:
    from ambid.rig.schema import (
        ChannelEntry,
        DaqEntry,
        LimitsEntry,
        LoopEntry,
        MagnetEntry,
        NoiseEntry,
        ParameterEntry,
        RigFile,
    )


SELECTED = Step(name="select")
"""Says in the history of a record that its channels are named by role and calibrated."""


def load_rig(path: str | Path) -> Rig:
    """Read a rig file.

    Parameters
    ----------
    path : str or Path
        TOML file of schema ``ambid.rig/1``; paths inside it are relative to its folder.

    Returns
    -------
    Rig
        In SI units, complete: every role and every parameter of the model.

    Raises
    ------
    RigError
        If the file or one of its entries breaks a rule; the message names the place and the nearest known key.
    """
    from ambid.rig.schema import read_rig_file

    path = path_of(path, "rig")
    return _build(read_rig_file(path), path)


def rig_from_text(text: str, path: str | Path) -> Rig:
    """Read a rig from its text.

    Parameters
    ----------
    text : str
        TOML of schema ``ambid.rig/1``.
    path : str or Path
        Where it stood: paths inside it are relative to that folder, and messages name it.

    Returns
    -------
    Rig
        As `load_rig`.

    Raises
    ------
    RigError
        As `load_rig`.
    """
    from ambid.rig.schema import parse_rig

    path = Path(path)
    return _build(parse_rig(text, path), path)


def rig_from_tables(tables: str | Mapping[str, Any]) -> Rig:
    """Build a rig from what is written in a program.

    Parameters
    ----------
    tables : Mapping or str
        What a rig file holds, as nested dicts or as TOML; paths are relative to the present folder. The schema may be
        left out, and the model of one axis, or of a rotor with bearings.

    Returns
    -------
    Rig
        As `load_rig`.

    Raises
    ------
    RigError
        As `load_rig`.

    Examples
    --------
    >>> from ambid.rig import rig_from_tables
    >>> rig_from_tables({"parameters": {"m": {"value": 100, "unit": "g", "role": "fixed"}}}).parameter("m").value
    0.1
    """
    from ambid.rig.schema import SCHEMA, checked, tables_of

    where = "in a text" if isinstance(tables, str) else "in a dict"
    content = tables_of(tables, where) if isinstance(tables, str) else tables
    usual = {"schema": SCHEMA, "model": "rotor" if "bearings" in content else "one-axis"}
    return _build(checked({**usual, **content}, where), Path(where))


def default_rig(model_name: str = "one-axis") -> Rig:
    """Return the rig that is taken when none is given: columns named like the roles, every parameter free.

    Parameters
    ----------
    model_name : str
        One of :func:`ambid.physics.linear_model.model_names`.

    Returns
    -------
    Rig
        Parameters for which the model has a default are fixed at it.

    Raises
    ------
    ModelError
        If there is no such model.
    """
    plant = model(model_name)
    return Rig(
        name=f"{model_name}, nothing known",
        model=model_name,
        channels=_default_channels(plant),
        parameters=tuple(_unnamed(spec) for spec in plant.parameters),
    )


def _build(file: RigFile, path: Path) -> Rig:
    where = f"rig {path}"
    try:
        plant = rotor_of(file, where) if file.bearings else model(file.model)
    except ModelError as error:
        raise RigError(f"{where}: {error}") from None
    key = next((x for x in ("modes", "speed", "shaft", "unbalance", "operation") if getattr(file, x)), None)
    if key and not file.bearings:
        raise RigError(
            f"{where}: {key} is given, but no [bearings.X]; only a rotor on many axes has it. Add its bearings"
        )
    record = file.record
    if record.from_ is not None and record.to is not None and record.to <= record.from_:
        raise RigError(f"{where}: record.to is {record.to} s, not after record.from = {record.from_} s. Correct one")
    channels = _channels(file.channels, plant, path) if file.channels else _default_channels(plant)
    limits = _limits(file.loop.limits, where) if file.loop and file.loop.limits else None
    parameters = _parameters({**file.parameters, **planes_of(file)}, plant, where)
    unbalance, runout = turning_of(file, where)
    return Rig(
        name=file.name,
        model=file.model,
        channels=channels,
        parameters=parameters,
        rotor=plant if isinstance(plant, RotorModel) else None,
        plane_sd=plane_sd_of(file, where),
        modes=modes_of(file, plant, where),
        shaft=None if file.shaft is None else shaft_of(file.shaft, parameters, where),
        unbalance=unbalance,
        runout=runout,
        operation=None if file.operation is None else operation_of(file.operation, where),
        magnet=None if file.magnet is None else magnet_of(file.magnet, plant, where),
        operating_point=_operating_point(file.operating_point, plant, where),
        loop=_loop(file.loop, where) if file.loop else None,
        limits=limits,
        noise=_noise(file.noise) if file.noise else None,
        record=RecordSettings(
            rate_hz=record.rate_hz,
            rate_sd=record.rate_sd,
            gaps=record.gaps,
            from_s=record.from_,
            to_s=record.to,
            time=(record.time.variable, record.time.unit) if record.time else None,
            layout=MappingProxyType(record.layout),
        ),
        daq=daq_of(file.daq, channels=channels, plant=plant, limits=limits, record_rate_hz=record.rate_hz, where=where)
        if file.daq
        else None,
        open_loop=file.open_loop,
        source=path,
    )


def _default_channels(plant: LinearModel) -> tuple[RigChannel, ...]:
    inputs = tuple(RigChannel(role=x, column=x, delay=0 if x == "current" else "auto") for x in plant.inputs)
    return inputs + tuple(RigChannel(role=role, column=role) for role in plant.outputs)


def _channels(entries: Mapping[str, ChannelEntry], plant: LinearModel, path: Path) -> tuple[RigChannel, ...]:
    """Build the channels in the model's order; refuse unknown and missing roles and a column used twice."""
    units, where = role_units(plant), f"rig {path}"
    keys = {"current" if key == "command" and plant.inputs == ("current",) else key: key for key in entries}
    if len(keys) < len(entries):
        raise RigError(
            f"{where}: [channels.current] is measured and [channels.command] commanded; one of them is the input. Omit "
            "the other"
        )
    for role in keys:
        if role not in units:
            raise RigError(f"{where}: unknown role [channels.{role}]; model {plant.name!r} has {choices(role, units)}")
    channels = []
    for role in units:
        if role in keys:
            channels.append(_channel(role, keys[role], entries[keys[role]], units[role], plant, path))
        elif role not in optional_roles(plant):
            raise RigError(
                f"{where}: [channels.{role}] is missing; model {plant.name!r} needs it. Add it with its column"
            )
    owners: dict[str, str] = {}
    for c in channels:
        if c.column in owners:
            raise RigError(
                f"{where}: column {c.column!r} is both channels.{owners[c.column]} and channels.{c.key};"
                " a column has one role. Correct one"
            )
        owners[c.column] = c.key
    return tuple(channels)


def _channel(role: str, key: str, entry: ChannelEntry, unit: str, plant: LinearModel, path: Path) -> RigChannel:
    place, acts_later = f"rig {path}: channels.{key}", role in plant.inputs and key != "current"
    if entry.delay == "auto" and role not in plant.inputs:
        raise RigError(
            f"{place}.delay is 'auto'; it can be found for inputs only ({', '.join(plant.inputs)}). Give whole samples"
        )
    return RigChannel(
        role=role,
        column=entry.column or key,
        unit=unit_of(entry.unit, place).symbol if entry.unit else None,
        calibration=calibration_of(entry, unit, place, path.parent),
        delay=entry.delay if entry.delay is not None else "auto" if acts_later else 0,
        variable=entry.variable,
        commanded=key != role,
        **channel_sd_of(entry, unit, place, known=role in (*plant.inputs, *plant.outputs)),
    )


def _parameters(entries: Mapping[str, ParameterEntry], plant: LinearModel, where: str) -> tuple[Parameter, ...]:
    names = [spec.name for spec in plant.parameters]
    for name in entries:
        if name not in names:
            raise RigError(
                f"{where}: unknown parameter {name!r} in [parameters]; model {plant.name!r} has {choices(name, names)}"
            )
    return tuple(
        parameter_of(spec, entries[spec.name], f"{where}: parameters.{spec.name}")
        if spec.name in entries
        else _unnamed(spec)
        for spec in plant.parameters
    )


def _unnamed(spec: ParameterSpec) -> Parameter:
    if spec.default is None:
        return Parameter(name=spec.name, unit=spec.unit)
    return Parameter(name=spec.name, unit=spec.unit, role="fixed", value=spec.default)


def _operating_point(entry: object, plant: LinearModel, where: str) -> Mapping[str, float]:
    """Convert declared operating values to SI; what is "auto" is left out."""
    if not isinstance(entry, Mapping):
        return MappingProxyType({})
    units = {role: plant.units[role] for role in (*plant.inputs, *plant.outputs)}
    values: dict[str, float] = {}
    for role, quantity in entry.items():
        if role not in units:
            raise RigError(f"{where}: unknown key {role!r} in [operating_point]; known: {choices(role, units)}")
        if quantity == "auto":
            continue
        values[role] = si_of(quantity, units[role], f"{where}: operating_point.{role}")
    return MappingProxyType(values)


def _loop(entry: LoopEntry, where: str) -> Loop:
    """Return the controller; matrices and gains exclude each other."""
    gains = {name: getattr(entry, name) for name in ("kp", "ki", "kd", "kc", "derivative_cutoff_hz")}
    matrices = {name: getattr(entry, name) for name in (*"ABCD", "rate_hz")}
    if entry.kind == "pid":
        keys = [name for name, x in {**matrices, "G": entry.G}.items() if x is not None]
        if keys:
            raise RigError(
                f'{where}: loop.{keys[0]} is of a state-space law, and loop.kind is "pid". Omit it, or give kind = '
                '"state-space"'
            )
        cutoff = math.inf if entry.derivative_cutoff_hz is None else entry.derivative_cutoff_hz
        return Loop(**{**gains, "derivative_cutoff_hz": cutoff}, delay=entry.delay)
    missing = [name for name, x in matrices.items() if x is None]
    extra = [name for name, x in gains.items() if x]
    if missing or extra:
        what = f"has no loop.{missing[0]}" if missing else f"has loop.{extra[0]}, which is of a PID"
        raise RigError(f'{where}: [loop] of kind "state-space" {what}. Give A, B, C, D and rate_hz alone')
    try:
        return Loop(delay=entry.delay, law=StateLaw(**{**matrices, "G": entry.G}))
    except ModelError as failure:
        raise RigError(f"{where}: {failure}") from None


def _limits(entry: LimitsEntry, where: str) -> Limits:
    entries = {role: getattr(entry, role) for role in ("voltage", "current", "position")}
    return Limits(**{r: _interval(x, f"{where}: loop.limits.{r}") for r, x in entries.items() if x is not None})


def _interval(value: float | Interval, place: str) -> Interval:
    """Return both ends of an interval, of which one number is half."""
    low, high = value if isinstance(value, tuple) else (-value, value)
    if not low < high:
        raise RigError(f"{place} is [{low}, {high}]; the lower comes first. Swap or correct them")
    return low, high


def _noise(entry: NoiseEntry) -> Noise:
    steps = {f"{role}_resolution": step for role, step in entry.resolutions.model_dump().items()}
    return Noise(**entry.model_dump(exclude={"resolutions"}), **steps)


_BAUD = (300, 12_000_000)
_HOST_MS = (20, 2000)
_LIFT_MS = (0, 2000)


def daq_of(
    entry: DaqEntry,
    *,
    channels: Sequence[RigChannel],
    plant: LinearModel,
    limits: Limits | None,
    record_rate_hz: float | None,
    where: str,
) -> Daq:
    """Return ``[daq]`` in SI, counts or ms, checked against itself and the rest of the rig; `record_rate_hz` is the
    default of its rate.
    """
    place = f"{where}: daq"
    if entry.duty is not None:
        _interval(entry.duty, f"{place}.duty")
    if not _BAUD[0] <= entry.baud <= _BAUD[1]:
        raise RigError(
            f"{place}.baud is {entry.baud}; a serial line goes at {_BAUD[0]} to {_BAUD[1]} bit/s."
            " Give the firmware's, 1000000"
        )
    for name, (low, high) in (("host_ms", _HOST_MS), ("lift_ms", _LIFT_MS)):
        value = getattr(entry, name)
        if not low <= value <= high:
            raise RigError(f"{place}.{name} is {value}; the controller takes {low} to {high} ms. Correct it")
    _check_third(entry.third, channels, plant, place)
    trips = {
        f"{role}_trip": _trip(role, getattr(entry.trip, role), limits, plant, place) for role in ("position", "current")
    }
    rate_hz = entry.rate_hz or record_rate_hz or DAQ_RATE_HZ
    return Daq(**{**entry.model_dump(exclude={"trip"}), "rate_hz": rate_hz, **trips})


def _check_third(third: str | None, channels: Sequence[RigChannel], plant: LinearModel, place: str) -> None:
    """Refuse a third input under the name of a column that comes from elsewhere; speed or angle may come from it."""
    elsewhere = {*plant.inputs, *plant.outputs, "reference"}
    for c in channels:
        if c.column == third and c.role in elsewhere:
            raise RigError(
                f"{place}.third is {third!r}, the column of channels.{c.role}, which comes otherwise. Give another name"
            )


def _trip(
    role: Literal["position", "current"],
    value: float | Interval | None,
    limits: Limits | None,
    plant: LinearModel,
    place: str,
) -> Interval | None:
    """Return the interval of a trip, which has to lie inside the limits of the bench."""
    if value is None:
        return None
    if role not in plant.outputs and role not in plant.inputs:
        raise RigError(f"{place}.trip.{role} is given; model {plant.name!r} has no {role}. Remove it")
    low, high = _interval(value, f"{place}.trip.{role}")
    least, most = UNLIMITED if limits is None else getattr(limits, role)
    if low < least or high > most:
        raise RigError(
            f"{place}.trip.{role} is [{low}, {high}], outside loop.limits.{role} = [{least}, {most}]; the controller"
            " must trip before the bench is at its limit. Narrow the trip, or correct the limit"
        )
    return low, high


_EXPONENTIAL, _HYPERBOLIC = ("L_g", "zeta"), ("k", "s")


def parameter_of(spec: ParameterSpec, entry: ParameterEntry, place: str) -> Parameter:
    """Return one parameter in SI, checked against what it is; `place` is for messages."""
    unit = None
    if entry.unit is not None:
        unit = unit_of(entry.unit, place)
        if unit.si != parse_unit(spec.unit).si:
            raise RigError(
                f"{place} ({spec.meaning}) is in [{entry.unit}]; it is measured in [{spec.unit}]. Correct unit"
            )
    elif entry.value is not None:
        raise RigError(f'{place} has a value but no unit. Give unit, e.g. unit = "{spec.unit}"')
    if entry.role != "free" and entry.value is None:
        raise RigError(f'{place} is {entry.role} but has no value. Give value, or set role = "free"')
    if entry.role == "prior" and (entry.sd is None or entry.sd <= 0):
        got = "no sd" if entry.sd is None else f"sd = {entry.sd}"
        raise RigError(f"{place} is a prior with {got}; it needs a positive standard deviation. Give sd")
    if entry.role != "prior" and entry.sd is not None:
        raise RigError(f'{place} is {entry.role} but has an sd. Remove sd, or set role = "prior"')
    if spec.positive and entry.value is not None and entry.value <= 0:
        raise RigError(f"{place} ({spec.meaning}) is {entry.value} {entry.unit}; it must be positive. Correct value")
    value = unit.to_si(entry.value) if unit is not None and entry.value is not None else None
    sd = unit.to_si(entry.sd) if unit is not None and entry.sd is not None else None
    return Parameter(name=spec.name, unit=spec.unit, role=entry.role, value=value, sd=sd)


def magnet_of(entry: MagnetEntry, plant: LinearModel, where: str) -> RigMagnet:
    """Return ``[magnet]`` in SI, checked against the model and itself."""
    if plant.name != "one-axis" and not isinstance(plant, RotorModel):
        raise RigError(
            f"{where}: [magnet] is given; model {plant.name!r} has no nonlinear magnet. Remove it, or take 'one-axis'"
        )
    specs = {spec.name: spec for spec in BEARING_NUMBERS}
    if isinstance(plant, RotorModel):
        specs = {n: specs[n] for n in ("s", "sigma")}  # the others follow from k_i, k_x and L of each axis
        if entry.kind == "single":
            raise RigError(f"{where}: magnet.kind is 'single'; a rotor has pairs. Correct it")
    for name, given in entry.parameters.items():
        place = f"{where}: magnet.parameters.{name}"
        if name in ("m", "R", "c"):
            raise RigError(f"{place} is the linear model's too. Write it in [parameters]")
        if name not in specs:
            raise RigError(
                f"{where}: unknown parameter {name!r} in [magnet.parameters]; a magnet has {choices(name, specs)}"
            )
        if name in NOT_NEGATIVE and given.value is not None and not _allowed(given.value, given.role):
            rule = "must not be negative" if given.value < 0 else "must be positive unless it is fixed"
            raise RigError(f"{place} ({specs[name].meaning}) is {given.value} {given.unit}; it {rule}. Correct value")
    known = tuple(parameter_of(specs[n], p, f"{where}: magnet.parameters.{n}") for n, p in entry.parameters.items())
    try:
        return RigMagnet(**{**entry.model_dump(), "gap": _gap(entry, where), "parameters": known})
    except RigError as error:
        raise RigError(f"{where}: {error}") from None


def _allowed(value: float, role: str) -> bool:
    """The search moves the logarithm: a zero has to be fixed."""
    return value > 0 or (value == 0 and role == "fixed")


def _gap(entry: MagnetEntry, where: str) -> Literal["hyperbolic", "exponential"] | None:
    """The gap law, which numbers may tell too."""
    told: list[Literal["hyperbolic", "exponential"]] = []
    told += ["hyperbolic"] if any(n in entry.parameters for n in _HYPERBOLIC) else []
    told += ["exponential"] if any(n in entry.parameters for n in _EXPONENTIAL) else []
    if len(told) == 2:
        raise RigError(
            f"{where}: [magnet.parameters] names parameters of both gap laws (k, s and L_g, zeta). Omit one pair"
        )
    return entry.gap or (told[0] if told else None)


def read_bench(
    source: Source,
    rig: Rig | str | Path,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    beside: Sequence[str] = (),
    layout: Mapping[str, str] | None = None,
) -> Record:
    """Read a record as the rig says, and name its columns by their roles.

    Parameters
    ----------
    source : str, Path, Record, DataFrame, Dataset or Mapping of str to array
        As :func:`ambid.record.read_record` takes it. A record that went through a rig already stays as it is.
    rig : Rig, str or Path
        Its `record` settings are used where the arguments do not override them; ``record.from`` and ``to`` are left to
        the caller, who knows of other ones.
    rate_hz : float, optional
        Sampling rate in Hz.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps.
    units : Mapping of str to str, optional
        Unit by column, for a table in memory.
    beside : sequence of str, optional
        As :func:`bench_record`.
    layout : Mapping of str to str, optional
        Overrides words of the rig's ``record.layout``.

    Returns
    -------
    Record
        As :func:`bench_record` gives it.

    Raises
    ------
    AmbidError
        If the file or its columns break a rule.
    """
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    record = read_columns(source, rig, rate_hz=rate_hz, gaps=gaps, units=units, beside=beside, layout=layout)
    return bench_record(record, rig, beside=beside)


def read_columns(
    source: Source,
    rig: Rig,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    beside: Sequence[str] = (),
    layout: Mapping[str, str] | None = None,
) -> Record:
    """Read a record as `read_bench`, its columns still as they are in the file."""
    named = isinstance(source, (str, Path)) and format_of(Path(source)) in NAMED
    if rate_hz is None and not isinstance(source, Record):  # a record may have been resampled since
        rate_hz = rig.record.rate_hz
    return read_record(
        source, rate_hz=rate_hz, gaps=gaps or rig.record.gaps or "error", units=units,
        layout=None if isinstance(source, Record) else {**rig.record.layout, **(layout or {})},
        variables={**{x: (x, UNKNOWN) for x in beside}, **mat_variables(rig)} if named else None,
    )  # fmt: skip


def mat_variables(rig: Rig) -> dict[str, tuple[str, str]]:
    """Return which variable of a ``.mat`` file is which column, for :func:`ambid.record.read_record`.

    Parameters
    ----------
    rig : Rig
        With ``channels.<role>.variable`` and ``unit``.

    Returns
    -------
    dict of str to (str, str)
        Column name to (variable, unit); the unit is ``"?"`` where the rig gives none. ``time`` stands in it if the rig
        names a time variable.
    """
    variables = {c.column: (c.variable or c.column, c.unit or UNKNOWN) for c in rig.channels}
    if rig.record.time is not None:
        variables["time"] = rig.record.time
    return variables


def bench_record(record: Record, rig: Rig, *, beside: Sequence[str] = ()) -> Record:
    """Select the rig's columns, check their units, calibrate them and name them by their roles.

    Parameters
    ----------
    record : Record
        As read from a file: columns by name, SI units. One whose history says that it went through a rig already is
        not calibrated again.
    rig : Rig
        Which column is which role, and its calibration.
    beside : sequence of str, optional
        Further columns that are kept as they are.

    Returns
    -------
    Record
        Channels named by role, in the rig's order, in the units of the model; the history says what was done.

    Raises
    ------
    RecordError
        If a column is missing.
    UnitError
        If a column's unit is missing or unknown, or is not the role's and no gain or table turns it into that.
    """
    wanted = role_units(rig.plant)
    if any(step.name == SELECTED.name for step in record.history):
        return _as_it_acts(_through_a_rig(record, rig, wanted), rig)
    for c in rig.channels:
        if c.column not in record.names:
            remedy = (
                f"Correct channels.{c.key}.column" if rig.source is not None else f"Let {command('init')} draft a rig"
            )
            raise RecordError(
                f"the record has no column {c.column!r} (needed by channels.{c.key}); it has"
                f" {choices(c.column, record.names)} {remedy}"
            )
    found = {c.role: _in_declared_unit(record.channel(c.column), c, drafting=rig.source is None) for c in rig.channels}
    _refuse_swapped(found, wanted, rig)
    channels, steps = [], []
    for c in rig.channels:
        channel, step = _calibrated(found[c.role], c, wanted[c.role])
        channels.append(replace(channel, name=c.role))
        steps += [step] if step else []
    columns = MappingProxyType({c.role: c.column for c in rig.channels})
    history = (*record.history, *steps, replace(SELECTED, settings=columns))
    others = (record.channel(name) for name in beside if name not in found)
    return _as_it_acts(_taken_back(replace(record, channels=(*channels, *others), history=history), rig), rig)


def _as_it_acts(record: Record, rig: Rig) -> Record:
    """Let a measured current that drives one axis be held at its mean from each sample to the next."""
    taken = any(step.name == "mean_to_next" for step in record.history)
    if taken and not rig.measured_input:
        raise RecordError(
            "the record was read with a measured current; this rig's is commanded, or drives nothing. Read it again, "
            "through this rig"
        )
    return record if taken or not rig.measured_input else mean_to_next(record, "current")


def _taken_back(record: Record, rig: Rig) -> Record:
    """Take channels that are logged late earlier by their delays, at the cost of the record's end."""
    inputs = rig.plant.inputs
    late = {c.role: int(c.delay) for c in rig.channels if c.role not in inputs and c.delay not in ("auto", 0)}
    if not late:
        return record
    n = record.n_samples - max(late.values())
    if n < 1:
        raise RecordError(
            f"the record has {record.n_samples} samples; a channel of the rig is late by {max(late.values())}. Correct "
            "channels.<role>.delay"
        )
    parts = ((c, late.get(c.name, 0)) for c in record.channels)
    channels = tuple(replace(c, values=c.values[k : n + k].copy()) for c, k in parts)
    return record.with_step(Step(name="advance", settings=MappingProxyType(late)), channels=channels)


def _through_a_rig(record: Record, rig: Rig, wanted: Mapping[str, str]) -> Record:
    """Check a record whose channels are named by role already."""
    for c in rig.channels:
        unit = record.channel(c.role).unit if c.role in record else None
        if unit != wanted[c.role] != UNKNOWN and not (unit is None and c.role in optional_roles(rig.plant)):
            has = "is not there" if unit is None else f"is in [{unit}]"
            raise RecordError(
                f"the record went through a rig already (columns became {', '.join(record)}); its channel {c.role!r} "
                f"{has}, this rig needs it in [{wanted[c.role]}]. Read the record again, through this rig"
            )
    return record


def _in_declared_unit(channel: Channel, c: RigChannel, *, drafting: bool = False) -> Channel:
    """Apply channels.<role>.unit, which says in what unit the column was written, whatever its header says."""
    if c.unit is not None and c.unit != channel.source_unit:
        raw = channel.values
        if channel.unit != UNKNOWN:
            raw = raw / parse_unit(channel.source_unit).scale
        declared = parse_unit(c.unit)
        return Channel(name=channel.name, unit=declared.si, values=declared.to_si(raw), source_unit=declared.symbol)
    if channel.unit == UNKNOWN:
        unknown = channel.source_unit != UNKNOWN
        what = f"is in [{channel.source_unit}], an unknown unit" if unknown else "has no unit"
        drafted = f" in the rig that {command('init')} drafts" if drafting else ""
        raise UnitError(
            f"column {channel.name!r} {what} (needed by channels.{c.key}). Write '{channel.name} [unit]' in the header"
            f" ([1] for a plain number), or give channels.{c.key}.unit{drafted}"
        )
    return channel


def _refuse_swapped(channels: dict[str, Channel], wanted: dict[str, str], rig: Rig) -> None:
    """Refuse two columns each of which has exactly the unit of the other's role."""
    plain = [
        c.role for c in rig.channels if c.calibration is None and channels[c.role].unit != wanted[c.role] != UNKNOWN
    ]
    for a in plain:
        for b in plain:
            if a != b and channels[a].unit == wanted[b] and channels[b].unit == wanted[a]:
                raise UnitError(
                    f"swapped columns? channels.{a} is column {channels[a].name!r} in [{channels[a].unit}] "
                    f"and channels.{b} is column {channels[b].name!r} in [{channels[b].unit}]. Swap the two, or fix "
                    "the header"
                )


def _calibrated(channel: Channel, c: RigChannel, unit: str) -> tuple[Channel, Step | None]:
    """Return the channel in the role's unit, and the line for the history if it was calibrated."""
    if c.calibration is None and channel.unit == "A" and c.role.endswith("_command"):  # an ampere counts as a volt
        c = replace(c, calibration=Calibration(unit_in="A", unit_out=unit, gain=1.0))
    if c.calibration is None:
        if channel.unit != unit != UNKNOWN:
            raise UnitError(
                f"column {channel.name!r} is in [{channel.source_unit}]; the rig needs a {c.role} in [{unit}]."
                f" Fix the header, or give channels.{c.key}.gain or table"
            )
        return channel, None
    # A gain is per SI unit of whatever the column is in, so its input unit is known only now.
    calibration = c.calibration if c.calibration.unit_in else replace(c.calibration, unit_in=channel.unit)
    return calibration.apply(channel), calibration.step(c.column)
