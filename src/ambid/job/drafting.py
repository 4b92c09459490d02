"""What a file of numbers is taken for: time, roles, units, and the first rig file of it; or the one question that it
leaves open. ``ambid init``, ``ambid info`` and the console ask here.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.errors import AmbidError, RecordError, choices
from ambid.job.data import RigSource, known_rig
from ambid.physics.linear_model import LinearModel, model
from ambid.record import NAMED, GapPolicy, Record, Source, format_of, read_record
from ambid.record.record import Channel
from ambid.record.words import label_of, quantities, symbol, unit_or_none, unit_within
from ambid.rig import read_bench
from ambid.rig.draft import axes_of, draft_rig, model_of
from ambid.rig.roles import ROLES, Candidate, at_rest, bearing_of, close, rank_roles, swapped, unit_of
from ambid.settings.caller import setting
from ambid.settings.calls import of_job
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.validation.inspection import Inspection

_USUAL = {"voltage": 3.0, "current": 0.3, "position": 1e-4}  # standard deviations, SI, of which a thousandth is far
_KNOWN = 0.5  # largest relative standard deviation of a parameter whose size counts
_LONGEST_NAME = 200
_CONTROL = {*map(chr, range(32)), "\x7f"}
_LOOKED = 20_000  # samples that a trial fit takes
_SHOWN = 0.5  # how much columns have to be a bearing's before one is tried
_LIKELY = {
    "voltage": ("V", "mV"),
    "current": ("A", "mA"),
    "position": ("m", "mm", "um"),
}  # units of a column without one


@dataclass(frozen=True, slots=True, kw_only=True)
class Guess:
    """What the columns of a record are taken for."""

    ranked: Mapping[str, Sequence[Candidate]]  # by role, the chosen column first
    units: Mapping[str, str]  # by role, where the record says none, or another was told
    why: Mapping[str, str]  # of these units
    question: str  # what cannot be told; nothing where all is
    time: str  # what was taken as time, and why

    @property
    def notes(self) -> tuple[str, ...]:
        """Time and units that the record does not say, and what cannot be told, a line each."""
        units = [f"{role}: in [{unit}], because {self.why[role]}" for role, unit in self.units.items()]
        held = ["model: a coil, because the position does not move with it; for the magnet, record a rotor that moves"]
        return (
            *([f"time: {self.time}"] if self.time else []), *units, *(held if at_rest(self.ranked) else []),
            *([self.question] if self.question else []),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """A first rig file."""

    text: str
    record: Record
    guess: Guess | None  # None of a rotor on many axes


def draft(
    source: Source, *, columns: Mapping[str, str] | None = None, coil: bool = False, first: bool = False,
    choose: Callable[[str, Sequence[Candidate]], Sequence[Candidate]] | None = None, rate_hz: float | None = None,
    gaps: GapPolicy = "error", layout: Mapping[str, str] | None = None,
) -> Draft:  # fmt: skip
    """Guess a rig file of a record; raises RecordError with the question where one has to be answered first.

    `columns`: column, or path of a variable, by role, a unit behind it in brackets; `coil`: the coil alone; `first`: of
    columns that are as likely the first is taken, unless `choose` says.
    """
    told = {role: label_of(text) for role, text in (columns or {}).items()}
    wrong = next((role for role in told if role not in (*ROLES, "time")), None)
    if wrong is not None:
        what = choices(wrong, [*ROLES, "time"])
        raise RecordError(
            f"{setting('column', f'{wrong}={told[wrong][0]}')}: there is no role {wrong!r}; there are {what}"
        )
    layout = dict(layout or {})
    record, variables = _read(source, told, rate_hz, gaps, layout)
    told = {role: (role, unit) for role, (_, unit) in told.items()} if variables else told
    strange = next((x for x in record.names if _CONTROL & set(x) or len(x) > _LONGEST_NAME), None)
    if strange is not None:
        raise RecordError(
            f"column {strange[:40]!r}: no rig can name it, as a name has up to {_LONGEST_NAME} printable characters. "
            "Rename it"
        )
    reading: dict[str, object] = {} if rate_hz is None else {"rate_hz": rate_hz}
    reading |= {"gaps": gaps} if gaps != "error" else {}
    if len(axes_of(record)) > 1 and not told:
        return Draft(text=draft_rig(record, reading=reading), record=record, guess=None)
    found = guess(record, told, coil=coil, first=first, choose=choose, trial=True,
                  timed=rate_hz is not None or "time_unit" in layout)  # fmt: skip
    if found.question:
        raise RecordError(found.question)
    text = draft_rig(
        record, found.ranked, coil=coil, units={role: (unit, found.why[role]) for role, unit in found.units.items()},
        variables=variables, reading=reading,
    )  # fmt: skip
    return Draft(text=text, record=record, guess=found)


@of_job("init")
def init(
    record: Source, *, column: Mapping[str, str] | None = None, coil: bool = False, yes: bool = False,
    rate_hz: float | None = None, gaps: GapPolicy = "error", layout: Mapping[str, str] | None = None,
) -> str:  # fmt: skip
    """Guess a rig file of a record: which columns are voltage, current and position, and in which units.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
    column : Mapping of str to str, optional
        Column or path of a variable by role, its unit behind it: ``{"position": "gap [mm]"}``.
    coil : bool, optional
        Draft the coil alone, without a position.
    yes : bool, optional
        Of columns that are as likely take the first, without a question.
    rate_hz, gaps, layout : optional
        As `ambid.identify`.

    Returns
    -------
    str
        TOML text with a comment on each guess, which `ambid.identify` and the others take as their rig.

    Raises
    ------
    AmbidError
        With the one question that the record leaves open.

    Examples
    --------
    >>> import ambid
    >>> rec = ambid.simulate("thesis", duration=0.1, seed=1)
    >>> table = {"u": rec["voltage"], "i": rec["current"], "x": rec["position"]}
    >>> rig = ambid.init(table, rate_hz=rec.rate_hz)
    >>> ambid.identify(table, rig, rate_hz=rec.rate_hz).verdict.word
    'usable'
    """
    return draft(record, columns=column, coil=coil, first=yes, rate_hz=rate_hz, gaps=gaps, layout=layout).text


def guess(
    record: Record, told: Mapping[str, tuple[str, str | None]] | None = None, *, coil: bool = False, first: bool = True,
    choose: Callable[[str, Sequence[Candidate]], Sequence[Candidate]] | None = None, trial: bool = False,
    timed: bool = False,
) -> Guess:  # fmt: skip
    """Tell what the columns of a record are; `trial`: hold units that the record says against the sizes of bearings;
    `timed`: that of time, or a rate, was told.
    """
    told = {role: x for role, x in (told or {}).items() if role in ROLES}
    ranked = rank_roles(record, {role: name for role, (name, _) in told.items()})
    roles = [role for role in ROLES if not (coil and role == "position")]
    question = ""
    missing = [role for role in roles if not ranked[role]]
    if missing:
        alone = f", or {setting('coil')} for the coil alone" if missing == ["position"] else ""
        question = (
            f"no column looks like the {' or the '.join(missing)}; there are {_listed(record)}. Say which: "
            f"{setting('column', f'{missing[0]}=NAME')}{alone}"
        )
    for role in roles:
        if role in told or not close(ranked[role]) or first:
            continue
        if choose is not None:
            ranked = {**ranked, role: choose(role, ranked[role])}
        elif not question:
            best = ranked[role][0]
            names = " or ".join(repr(x.channel.name) for x in ranked[role] if x is best or close([best, x]))
            question = (
                f"the {role} may be {names}, which are as likely. Say which: "
                f"{setting('column', f'{role}=NAME')}, or take the first: {setting('yes')}"
            )
    if not (question or coil or {"current", "position"} & {*told}) and swapped(record, ranked):
        i, x = (ranked[role][0].channel.name for role in ("current", "position"))
        other = " and ".join(setting("column", text) for text in (f"current={x} [A]", f"position={i} [m]"))
        question = (
            f"current {i!r} and position {x!r} look swapped: {x!r} is what the voltage drives through a coil, and it "
            f"moves {i!r}. Say which: {other}, in their units, or confirm it with {setting('column', f'current={i}')}"
        )
    units = {role: symbol(unit) for role, (_, unit) in told.items() if unit}
    why = dict.fromkeys(units, "as told")
    if not question:
        plant = model(model_of(ranked, coil=coil))
        question = _unit_question(record, ranked, plant, units, why, trial=trial, timed=timed)
    settings: Mapping[str, Any] = record.history[0].settings if record.history else {}
    return Guess(ranked=ranked, units=units, why=why, question=question, time=str(settings.get("time", "")))


@of_job("info")
def info(
    record: Source,
    rig: RigSource | None = None,
    *,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
) -> Inspection:
    """Look through a record: levels, resolution, noise, saturation, drop-outs, outliers, excitation, likely roles.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
    rig : Rig, path, dict or TOML text, optional
        Names and calibrates the channels; what the inputs explain then does not count as noise.
    rate_hz, gaps, units, layout : optional
        As `ambid.identify`.

    Returns
    -------
    Inspection

    Raises
    ------
    AmbidError
        If record or rig break a rule.

    Examples
    --------
    >>> import ambid
    >>> found = ambid.info(ambid.simulate("thesis", duration=0.1, seed=1))
    >>> [c.name for c in found.channels]
    ['voltage', 'current', 'position']
    """
    from ambid.validation.inspection import inspect

    if rig is None:
        look = read_record(record, rate_hz=rate_hz, gaps=gaps or "error", units=units, layout=layout)
        return inspect(look, guess=guess(look))
    bench = known_rig(rig)
    found = read_bench(record, bench, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    return inspect(found, inputs=bench.plant.inputs)


def _read(
    source: Source, told: Mapping[str, tuple[str, str | None]], rate_hz: float | None, gaps: GapPolicy,
    layout: dict[str, str],
) -> tuple[Record, dict[str, str]]:  # fmt: skip
    """Read a record; by the paths of variables where they are told and are no columns, which are returned."""
    named = isinstance(source, (str, Path)) and format_of(Path(source)) in NAMED
    failure: AmbidError | None = None
    if "time" in told and not named:
        layout |= {"time": told["time"][0], **({"time_unit": told["time"][1]} if told["time"][1] else {})}
    try:
        record = read_record(source, rate_hz=rate_hz, gaps=gaps, layout=layout)
        lost = {role: x for role, (x, _) in told.items() if x not in record.names and role != "time"}
    except AmbidError as refusal:
        failure, lost = refusal, {role: x for role, (x, _) in told.items()}
    if not lost and failure is None and not (named and "time" in told):
        return record, {}
    if not named:
        if failure is not None:
            raise failure
        role, name = next(iter(lost.items()))
        raise RecordError(
            f"{setting('column', f'{role}={name}')}: the record has no column {name!r}; it has "
            f"{choices(name, record.names)} Correct it"
        )
    if not told:
        assert failure is not None
        raise failure
    paths = {role: x for role, (x, _) in told.items()}
    return read_record(
        source, rate_hz=rate_hz, gaps=gaps, layout=layout,
        variables={role: (x, unit or UNKNOWN) for role, (x, unit) in told.items()},
    ), paths  # fmt: skip


def _listed(record: Record) -> str:
    """Name the columns with their units and ranges."""
    ranges = ((c, np.nanmin(c.values), np.nanmax(c.values)) for c in record.channels)
    shown = [f"{c.name} [{c.source_unit}] {low:.4g} … {high:.4g}" for c, low, high in ranges]
    return ", ".join(shown[:12]) + (", …" if len(shown) > 12 else "")


def _unit_question(
    record: Record, ranked: Mapping[str, Sequence[Candidate]], plant: LinearModel, units: dict[str, str],
    why: dict[str, str], *, trial: bool, timed: bool,
) -> str:  # fmt: skip
    """Add the units of columns without one, by their names or by the sizes of a bearing; return what cannot be told."""
    chosen = {role: ranked[role][0].channel for role in (*plant.inputs, *plant.outputs)}
    for role, c in chosen.items():
        within = unit_within(c.name) if c.unit != unit_of(c) else None
        if within and role not in units:
            units[role], why[role] = symbol(within), "its name ends in it"
    strange = next((r for r, c in chosen.items() if c.unit == UNKNOWN != c.source_unit and r not in units), None)
    if strange is not None:
        c = chosen[strange]
        return (
            f"column {c.name!r} is in [{c.source_unit}], which is no known unit. Say which: "
            f"{setting('column', f'{strange}={c.name} [{ROLES[strange]}]')}"
        )
    bare = [role for role, c in chosen.items() if c.unit == UNKNOWN and role not in units]
    if any(role not in (*bare, *units) and c.unit != ROLES[role] for role, c in chosen.items()):
        return ""  # what is in another unit needs a gain or a table
    if not (bare or trial):
        return ""
    counts = next((r for r in bare if np.array_equal(chosen[r].values, np.rint(chosen[r].values))), None)
    if counts is not None:  # of a converter, whose scale only a rig knows: by luck they have the sizes of a bearing
        c = chosen[counts]
        return (
            f"column {c.name!r} has no unit and holds whole numbers, which may be counts. Say its unit: "
            f"{setting('column', f'{counts}={c.name} [{ROLES[counts]}]')}, and give channels.{counts}.gain in the rig "
            "where they are"
        )
    columns = {role: _in_si(c, units.get(role)) for role, c in chosen.items()}
    moves = {"voltage", "current", "position"} == {*chosen}
    shown = not moves or bearing_of((chosen[role].values for role in ROLES), record.rate_hz) >= _SHOWN
    found = _trial(record, columns, plant) if shown else None  # where it would take long to fail
    if bare:
        return _of_sizes(found, bare, chosen, units, why)
    return "" if found is None else _contradiction(found, chosen, units, timed=timed)


def _in_si(c: Channel, unit: str | None) -> Channel:
    """Return a column in SI by the unit that is taken for it."""
    parsed = None if unit is None else unit_or_none(unit)
    if parsed is None:
        return c
    own = unit_or_none(c.source_unit)
    raw = c.values if own is None or c.unit == UNKNOWN else c.values / own.scale
    return Channel(name=c.name, unit=parsed.si, values=parsed.to_si(np.asarray(raw)), source_unit=parsed.symbol)


def _of_sizes(
    found: _Trial | None, bare: Sequence[str], chosen: Mapping[str, Channel], units: dict[str, str],
    why: dict[str, str],
) -> str:  # fmt: skip
    """Add the units in which a bearing has usual sizes; return the question where there are none, or several."""
    if found is None:
        role = next(role for role in ("position", "current", "voltage") if role in bare)
        c = chosen[role]
        if not any(quantities(chosen[x].name) for x in bare):
            unknown = sorted(chosen.values(), key=attrgetter("name"))  # not by roles that nothing speaks for
            ranges = ", ".join(f"{x.name} {np.nanmin(x.values):.4g} … {np.nanmax(x.values):.4g}" for x in unknown)
            asked = ", ".join(setting("column", f"{x}=NAME [{ROLES[x]}]") for x in chosen if x in bare)
            return (
                f"neither name nor unit nor the record shows which column is what; there are {ranges}. Say it: {asked}"
            )
        return (
            f"column {c.name!r} has no unit, and the record does not show which (its values reach "
            f"{np.nanmin(c.values):.4g} to {np.nanmax(c.values):.4g}). Say it: "
            f"{setting('column', f'{role}={c.name} [{ROLES[role]}]')}"
        )
    fits = []
    for listed in itertools.product(*(_LIKELY[role] for role in bare)):
        scales = {role: unit_or_none(unit).scale for role, unit in zip(bare, listed, strict=True)}  # type: ignore[union-attr]
        if not found.check(scales).values["unusual"]:
            fits.append(dict(zip(bare, listed, strict=True)))
    if len(fits) == 1:
        units.update(fits[0])
        why.update(dict.fromkeys(bare, "the record names none; in another one no bearing has these sizes"))
        return ""
    role = next((r for r in bare if len({x[r] for x in fits}) > 1), bare[0])
    name = chosen[role].name
    listed_units = " or ".join(f"[{u}]" for u in dict.fromkeys(x[role] for x in fits))
    may = f"its values may be in {listed_units}" if fits else "in no usual one a bearing has such sizes"
    return f"column {name!r} has no unit, and {may}. Say which: {setting('column', f'{role}={name} [{ROLES[role]}]')}"


def _contradiction(found: _Trial, chosen: Mapping[str, Channel], units: Mapping[str, str], *, timed: bool) -> str:
    """Return the question about a unit with which no bearing has these sizes; nothing where all are usual."""
    check = found.check({})
    slips = {key.removesuffix("_factor"): x for key, x in check.values.items() if key.endswith("_factor")}
    for role, factor in slips.items():
        if role == "time" and len(slips) == 1 and not timed:
            told = " or ".join((setting("layout", "time_unit=UNIT"), setting("rate_hz")))
            return f"{check.detail.partition('. Correct')[0]}. Say what is right: {told}"
        if role not in chosen or role in units:
            continue
        said = unit_or_none(chosen[role].source_unit)
        scale = 1.0 if said is None else said.scale / factor
        unit = next((u for u in _LIKELY[role] if abs(unit_or_none(u).scale / scale - 1) < 1e-6), None)  # type: ignore[union-attr]
        if said is not None and unit is not None:
            name = chosen[role].name
            return (
                f"column {name!r} says [{said.symbol}], with which no bearing has such sizes; in [{unit}] they are "
                f"usual. Say which: {setting('column', f'{role}={name} [{unit}]')}, or confirm it with [{said.symbol}]"
            )
    return ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """An estimate from columns as they are, whose scales are still open."""

    values: Mapping[str, float]
    signals: Any
    plant: LinearModel
    scaled: Mapping[str, float]  # what each channel was multiplied by beforehand

    def check(self, scales: Mapping[str, float]) -> Any:
        """Check sizes after channels were multiplied by `scales`, which is an exact symmetry of the model."""
        from ambid.bearing.sizes import check_units
        from ambid.physics.sensor_errors import CHANNELS, unit_powers

        powers, plant = unit_powers(self.plant), self.plant
        scales = {role: scales.get(role, 1.0) / self.scaled.get(role, 1.0) for role in (*plant.inputs, *plant.outputs)}
        gains = np.array([scales.get(channel, 1.0) for channel in CHANNELS])
        values = {name: x * float(np.prod(gains ** np.array(powers[name], float))) for name, x in self.values.items()}
        u, y = (np.array([scales.get(role, 1.0) for role in roles]) for roles in (plant.inputs, plant.outputs))
        return check_units(values, (), replace(self.signals, u=self.signals.u * u, y=self.signals.y * y), plant)


def _trial(record: Record, columns: Mapping[str, Channel], plant: LinearModel) -> _Trial | None:
    """Identify from the head of a record; None where that does not determine every parameter."""
    from ambid.bearing.multistart import Signals
    from ambid.job.identification import identify
    from ambid.rig import default_rig

    heads = {role: c.values[:_LOOKED] for role, c in columns.items()}
    scaled = {  # near where bearings are: a fit of a position in µm read as m would not end where it begins
        role: 1000.0 ** -np.rint(np.log10(np.std(x) / _USUAL[role]) / 3.0) if np.std(x) > 0 else 1.0
        for role, x in heads.items()
    }
    channels = tuple(Channel(name=role, unit=ROLES[role], values=x * scaled[role]) for role, x in heads.items())
    with contextlib.suppress(AmbidError, np.linalg.LinAlgError):
        estimate = identify(Record(rate_hz=record.rate_hz, channels=channels), default_rig(plant.name))
        free = [p for p in estimate.parameters if p.role == "free"]
        if estimate.status == "converged" and all((p.sd or np.inf) < _KNOWN * abs(p.value) for p in free):
            by_role = {c.name: c.values for c in channels}
            signals = Signals(
                u=np.column_stack([by_role[role] for role in plant.inputs]),
                y=np.column_stack([by_role[role] for role in plant.outputs]), rate_hz=record.rate_hz,
            )  # fmt: skip
            return _Trial(
                values={p.name: p.value for p in estimate.parameters}, signals=signals, plant=plant, scaled=scaled
            )
    return None
