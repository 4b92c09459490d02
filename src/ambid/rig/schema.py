"""What a rig file (TOML, schema ``ambid.rig/1``) may hold, and one line for everything that it may not. Only the shape
is checked here: known keys, types, finite numbers; what entries mean together is checked where the rig is built.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError

from ambid.errors import RigError, choices, nearest
from ambid.record.record import file_bytes, utf8_text

SCHEMA = "ambid.rig/1"

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(allow_inf_nan=False, strict=True, gt=0)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, strict=True, ge=0)]
Matrix = tuple[tuple[Number, ...], ...]
Samples = Annotated[int, Field(strict=True, ge=0)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Text = Annotated[str, Field(strict=True, min_length=1)]
Name = Annotated[
    str,
    Field(strict=True, min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*[^\s\x00-\x1f\x7f][^\x00-\x1f\x7f]*$"),
]


AxisName = Annotated[str, Field(strict=True, max_length=40, pattern=r"^[A-Za-z][A-Za-z0-9]*$")]


class _Entry(BaseModel):
    """Unknown keys are refused everywhere."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class QuantityEntry(_Entry):
    """``{ value = 10.0, unit = "mm" }``."""

    value: Number
    unit: Text


class SpreadEntry(QuantityEntry):
    """A standard deviation with its unit."""

    value: NotNegative


Spread = Annotated[
    Annotated[NotNegative, Tag("number")] | Annotated[SpreadEntry, Tag("quantity")],
    Discriminator(lambda x: "quantity" if isinstance(x, dict) else "number"),
]


class ChannelEntry(_Entry):
    """``[channels.<role>]``: which column is this role, and how its values become the role's unit."""

    column: Name | None = None
    variable: Text | None = None
    unit: Text | None = None
    gain: Number | None = None
    offset: Number | None = None
    table: Text | None = None
    extrapolate: Annotated[bool, Field(strict=True)] = False
    delay: Literal["auto"] | Samples | None = None
    gain_sd: NotNegative | None = None
    offset_sd: Spread | None = None


class ParameterEntry(_Entry):
    """One line of ``[parameters]``."""

    value: Number | None = None
    unit: Text | None = None
    role: Literal["free", "fixed", "prior"] = "free"
    sd: Number | None = None


Interval = Positive | tuple[Number, Number]


class LimitsEntry(_Entry):
    """``loop.limits``: SI, a positive number for ± that, or [low, high]."""

    voltage: Interval | None = None
    current: Interval | None = None
    position: Interval | None = None


class LoopEntry(_Entry):
    """``[loop]``: the controller, for simulation; see :class:`ambid.physics.loop.Loop` for its law and units."""

    kind: Literal["pid", "state-space"] = "pid"
    kp: Number = 0.0
    ki: Number = 0.0
    kd: Number = 0.0
    kc: Number = 0.0
    derivative_cutoff_hz: Positive | None = None
    delay: NotNegative = 0.0
    limits: LimitsEntry | None = None
    rate_hz: Positive | None = None
    A: Matrix | None = None
    B: Matrix | None = None
    C: Matrix | None = None
    D: Matrix | None = None
    G: Matrix | None = None


class ResolutionsEntry(_Entry):
    """``noise.resolutions``: quantisation steps of the logged values in m, A, V; 0 for none."""

    position: NotNegative = 0.0
    current: NotNegative = 0.0
    voltage: NotNegative = 0.0


class NoiseEntry(_Entry):
    """``[noise]``: for simulation; m rms, A rms, N/√Hz, V/√Hz."""

    position: NotNegative = 0.0
    current: NotNegative = 0.0
    force: NotNegative = 0.0
    voltage: NotNegative = 0.0
    resolutions: ResolutionsEntry = Field(default_factory=ResolutionsEntry)


class TimeEntry(_Entry):
    """``record.time``: the time variable of a .mat file."""

    variable: Text
    unit: Text = "s"


class RecordEntry(_Entry):
    """``[record]``: how records of this bench are read."""

    rate_hz: Positive | None = None
    rate_sd: NotNegative | None = None
    gaps: Literal["error", "interpolate", "cut"] | None = None
    from_: NotNegative | None = Field(default=None, alias="from")
    to: Positive | None = None
    time: TimeEntry | None = None
    layout: dict[str, str] = Field(default_factory=dict)


class TripEntry(_Entry):
    """``daq.trip``: SI, a positive number for ± that, or [low, high]."""

    position: Interval | None = None
    current: Interval | None = None


class DaqEntry(_Entry):
    """``[daq]``: how the controller of this bench samples, drives and protects; see :class:`ambid.rig.rig.Daq`."""

    rate_hz: Positive | None = None
    baud: Annotated[int, Field(strict=True, gt=0)] = 1_000_000
    duty: tuple[Whole, Whole] | None = None
    duty_off: Whole | None = None
    host_ms: Whole = 250
    lift_ms: Whole = 300
    third: Name | None = None
    bench: Text | None = None
    trip: TripEntry = Field(default_factory=TripEntry)


class MagnetEntry(_Entry):
    """``[magnet]``: what is known of the magnet's law; see :class:`ambid.rig.rig.RigMagnet`."""

    kind: Literal["auto", "single", "pair"] = "auto"
    gap: Literal["hyperbolic", "exponential"] | None = None
    asymmetric: Annotated[bool, Field(strict=True)] | None = None
    saturation: Annotated[bool, Field(strict=True)] | None = None
    rise: Annotated[bool, Field(strict=True)] | None = None
    eddy: Annotated[bool, Field(strict=True)] = False
    drift: Annotated[bool, Field(strict=True)] = False
    off_below: Number | None = None
    parameters: dict[str, ParameterEntry] = Field(default_factory=dict)


class PlaneEntry(_Entry):
    """Where something stands along the shaft: fixed where a value is given, unless told otherwise."""

    value: Number | None = None
    unit: Text
    role: Literal["free", "fixed", "prior"] | None = None
    sd: Number | None = None


class TurningEntry(_Entry):
    """Something that turns with the rotor: its size, and its phase in rad against the mark of the angle."""

    value: Number
    unit: Text
    phase: Number = 0.0


class UnbalanceEntry(TurningEntry):
    """``[unbalance.<name>]``: mass times eccentricity in a plane, for simulation."""

    z: QuantityEntry


class BearingEntry(_Entry):
    """``[bearings.<name>]``: a radial bearing with its planes and axes, or an axial one."""

    z: PlaneEntry | None = None
    z_sensor: PlaneEntry | None = None
    z_sensors: list[PlaneEntry] | None = None
    axes: Annotated[list[AxisName], Field(min_length=1, max_length=2)]
    axial: Annotated[bool, Field(strict=True)] = False
    runout: TurningEntry | None = None
    z_sd: SpreadEntry | None = None
    z_magnet_sd: SpreadEntry | None = None
    z_sensor_sd: SpreadEntry | None = None


class OperationEntry(_Entry):
    """``[operation]``: what a machine is accepted for; see :class:`ambid.rig.rig.Operation`."""

    maximum_speed: QuantityEntry | None = None
    minimum_speed: QuantityEntry | None = None
    touch_down: QuantityEntry | None = None
    axial_touch_down: QuantityEntry | None = None


class ModesEntry(_Entry):
    """``[modes]``: how many bending modes a rotor has, and where they may be; for simulation all their numbers."""

    count: Literal["auto"] | Whole = "auto"
    frequency_hz: list[Positive] = Field(default_factory=list)
    damping: NotNegative | list[NotNegative] | None = None
    shapes: dict[Text, list[Number]] = Field(default_factory=dict)
    gyroscopic: dict[Text, Number] = Field(default_factory=dict)


class MaterialEntry(_Entry):
    """A material of ``[shaft]``: modulus, density, Poisson's ratio."""

    E: QuantityEntry
    rho: QuantityEntry
    nu: Number = 0.3


class StepEntry(_Entry):
    """``[[shaft.steps]]``: a cylinder of the shaft, from left to right."""

    length: QuantityEntry
    diameter: QuantityEntry
    bore: QuantityEntry | None = None
    material: MaterialEntry | None = None


class DiscEntry(_Entry):
    """``[[shaft.discs]]``: a rigid disc, by its mass and moments of inertia or by its sizes."""

    z: QuantityEntry
    m: QuantityEntry | None = None
    Id: QuantityEntry | None = None
    Ip: QuantityEntry | None = None
    outer: QuantityEntry | None = None
    inner: QuantityEntry | None = None
    width: QuantityEntry | None = None
    rho: QuantityEntry | None = None


class ShaftEntry(_Entry):
    """``[shaft]``: the drawing of the rotor; see :class:`ambid.physics.Shaft`."""

    z: QuantityEntry | None = None
    material: MaterialEntry
    damping: Number | list[Number] = Field(default_factory=list)
    steps: list[StepEntry] = Field(default_factory=list)
    discs: list[DiscEntry] = Field(default_factory=list)


class RigFile(_Entry):
    """The whole file."""

    schema_: Literal["ambid.rig/1"] = Field(alias="schema")
    name: Annotated[str, Field(strict=True)] = ""
    model: Text
    channels: dict[str, ChannelEntry] = Field(default_factory=dict)
    parameters: dict[str, ParameterEntry] = Field(default_factory=dict)
    magnet: MagnetEntry | None = None
    bearings: dict[AxisName, BearingEntry] = Field(default_factory=dict)
    modes: ModesEntry | None = None
    shaft: ShaftEntry | None = None
    speed: QuantityEntry | None = None
    unbalance: dict[AxisName, UnbalanceEntry] = Field(default_factory=dict)
    operation: OperationEntry | None = None
    operating_point: Literal["auto"] | dict[str, Literal["auto"] | QuantityEntry] = "auto"
    loop: LoopEntry | None = None
    noise: NoiseEntry | None = None
    record: RecordEntry = Field(default_factory=RecordEntry)
    daq: DaqEntry | None = None
    open_loop: Annotated[bool, Field(strict=True)] = False


_MATRICES = frozenset("ABCDG")  # of a law


def read_rig_file(path: Path) -> RigFile:
    """Read a rig file and check its shape.

    `path`: TOML, UTF-8. Returns as written: units are not yet converted.
    """
    return parse_rig(utf8_text(file_bytes(path, RigError, "rig"), path, RigError, "rig"), path)


def parse_rig(text: str, path: Path) -> RigFile:
    """Check the shape of a rig's text.

    `text`: TOML; `path`: where it stands or stood, for messages. Returns as written: units are not yet converted.
    """
    if not text.strip():
        raise RigError(
            f"rig {path} is empty. Write at least schema and model, or make one with: ambid init RECORD -o RIG"
        )
    return checked(tables_of(text, str(path)), str(path))


def tables_of(text: str, where: str) -> dict[str, Any]:
    """Return the tables of a rig's text, whatever they hold; `where` it stands, for messages."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as failure:
        raise RigError(f"rig {where} is not valid TOML: {failure}. Correct that line") from None


def checked(content: dict[str, Any], where: str) -> RigFile:
    """Check the shape of a rig given as nested tables.

    `content`: what the TOML file holds; `where`: the file, for messages. Returns the same, typed.
    """
    schema = content.get("schema")
    if schema != SCHEMA:
        got = "has no schema" if schema is None else f"has schema {schema!r}"
        raise RigError(f'rig {where} {got}; this program reads {SCHEMA!r}. Write schema = "{SCHEMA}" on top')
    try:
        return RigFile.model_validate(content)
    except ValidationError as failure:
        # An unknown key is the likeliest slip, and explains what else is wrong beside it; of a choice such as
        # "auto" or a number, the complaint about the number is the telling one.
        rank = {"extra_forbidden": 0, "literal_error": 2}
        errors = sorted(failure.errors(include_url=False), key=lambda e: rank.get(e["type"], 1))
        raise RigError(f"rig {where}: {_in_words(errors[0], content)}") from None


def _in_words(error: Any, content: dict[str, Any]) -> str:
    """Turn one of pydantic's errors into place, rule, what stood there, and remedy."""
    keys = _place(error["loc"], content)
    place, kind, limits = ".".join(keys), error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        *table, key = keys
        own = list(_keys(_entry_at(table)))
        if table[:1] == ["channels"] and key == "sensors":
            return f"{'.'.join(table)}: sensors of one position are not joined. Give one column, such as their mean"
        inside = f"in [{'.'.join(table)}]" if table else "at the top"
        return f"unknown key {key!r} {inside}; known: {choices(key, own)}"
    if kind == "missing" and keys[-1] != "duty" and "limits" not in keys[:-1] and "trip" not in keys[:-1]:
        return f"{place} is missing. Add it"
    got = error["input"]
    value = "a table" if isinstance(got, dict) else f"{got!r}"
    if keys[:2] in (["loop", "limits"], ["daq", "trip"]):
        rule = "it must be a positive number, or [low, high]"
    elif keys[:2] == ["daq", "duty"]:
        rule = "it must be [low, high] in whole counts of pulse width"
    elif kind == "finite_number":
        rule = "it must be finite"
    elif kind in ("literal_error", "enum"):
        rule = f"it must be {limits['expected']}"
        if isinstance(got, str):
            words = [w.strip("' ") for w in limits["expected"].replace(" or ", ",").split(",")]
            near = nearest(got, words)
            rule += f".{near}" if near else ""
    elif kind in ("greater_than_equal", "greater_than"):
        rule = "it must not be negative" if kind == "greater_than_equal" else "it must be positive"
    elif kind in ("model_type", "dict_type"):
        known = keys[0] in ("parameters", "operating_point") or (keys[:2] == ["magnet", "parameters"] and len(keys) > 2)
        example = '{ value = 1.0, unit = "…" }' if known else "a [table]"
        rule = f"it must be {example}"
    elif kind in ("string_pattern_mismatch", "string_too_long"):
        rule = "a name of a column is up to 200 printable characters, not all of them blanks"
    elif kind in ("string_type", "string_too_short"):
        rule = "it must be a text that is not empty"
    elif kind == "bool_type":
        rule = "it must be true or false"
    elif kind.startswith("int"):
        of = "" if keys[0] == "daq" else " of samples"
        rule = f"it must be a whole number{of}" + (', or "auto"' if keys[0] == "channels" else "")
    elif keys[0] == "loop" and not _MATRICES.isdisjoint(keys) and not isinstance(got, str):
        rule = "it must be a matrix of numbers, a list of rows such as [[1.0, 2.0], [3.0, 4.0]]"
    else:
        rule = "it must be a number, without quotes"
    return f"{place} is {value}; {rule}{'' if rule.endswith('?') else '.'} Correct it"


def _place(loc: tuple[int | str, ...], content: Any) -> list[str]:
    """Keep of pydantic's location what is written in the file (it adds the branch of a union)."""
    keys: list[str] = []
    for part in loc:
        if isinstance(content, dict) and part in content:
            keys.append(str(part))
            content = content[part]
        elif isinstance(content, list) and isinstance(part, int) and part < len(content):
            keys.append(str(part + 1))  # people count from 1
            content = content[part]
        elif isinstance(content, dict) and part == loc[-1] and isinstance(part, str) and part.isidentifier():
            keys.append(part)
    return keys or ["the file"]


def _keys(entry: type[_Entry]) -> dict[str, Any]:
    """Return the keys of an entry as they are written, with their types."""
    return {field.alias or name: field.annotation for name, field in entry.model_fields.items()}


def _entry_at(table: Sequence[str]) -> type[_Entry]:
    """Return the entry that a table of the file is: names in a table of tables, numbers in an array, lead to it too."""
    entry: type[_Entry] = RigFile
    keys = iter(table)
    for key in keys:
        found = _entry_in(_keys(entry)[key])
        assert found is not None
        entry, several = found
        if several:
            next(keys, None)
    return entry


def _entry_in(annotation: Any) -> tuple[type[_Entry], bool] | None:
    """Return the entry that a type holds, and whether it holds several."""
    if isinstance(annotation, type) and issubclass(annotation, _Entry):
        return annotation, False
    inner = next((x for x in map(_entry_in, get_args(annotation)) if x is not None), None)
    return inner and (inner[0], inner[1] or get_origin(annotation) in (dict, list, tuple))
