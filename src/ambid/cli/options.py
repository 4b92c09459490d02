"""Arguments and options that several verbs share, and how their words are read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.errors import AmbidError, EstimationError

if TYPE_CHECKING:
    from ambid.blackbox.data import Orders
    from ambid.nonlinear.fit import Settings
    from ambid.physics.presets import Preset

LARGEST = 1e9
"""What a time in s or an amplitude may be at most: beyond it is a slip, and numbers of samples would overflow."""


def option(usage: str, about: str, shown: str | bool = False, **more: Any) -> Any:
    """Declare an option: its usage, such as ``--band LO:HI``; its help; how its default reads."""
    names = [word for word in usage.split() if word.startswith("-")]
    metavar = usage.removeprefix(" ".join(names)).strip() or None
    return typer.Option(*names, metavar=metavar, help=about, show_default=shown, **more)


def switch(names: str, about: str) -> Any:
    """Declare an option without a value."""
    return typer.Option(*names.split(), help=about)


def argument(metavar: str, about: str) -> Any:
    """Declare an argument."""
    return typer.Argument(metavar=metavar, help=about, show_default=False)


RecordFile = Annotated[Path, argument("RECORD", "Record: .csv, .csv.gz, .h5 or .mat.")]
RigFile = Annotated[Path | None, option("--rig RIG", "Rig file (TOML), which says what is known of the bench.")]
From = Annotated[float | None, option("--from S", "Use the record from this time on, in s.")]
To = Annotated[float | None, option("--to S", "Use the record up to this time, in s.")]
Rate = Annotated[float | None, option("--rate HZ", "Sampling rate in Hz, for a record without time.")]
Gaps = Annotated[
    Literal["error", "interpolate", "cut"] | None,
    option(
        "--gaps",
        "What to do about missing values: refuse them, interpolate, or cut the longest part without any out.",
        "error, or as the rig says",
    ),
]
JsonFile = Annotated[str | None, option("--json FILE", "Write the result as JSON; - for standard output.")]
TrackFile = Annotated[
    str | None, option("--json FILE", "Write the track as lines of JSON while it comes; - for standard output.")
]
Strict = Annotated[bool, switch("--strict", "End with exit code 3 if the search did not converge or a check failed.")]
Inputs = Annotated[list[str] | None, option("--input COL", "Input column; repeat for several.")]
OutputColumns = Annotated[list[str] | None, option("--output COL", "Output column; repeat for several.")]
References = Annotated[
    list[str] | None,
    option("--reference COL", "Column of the loop's outer excitation, for methods that use it; repeat for several."),
]
OpenLoop = Annotated[bool, switch("--open-loop", "Say that no feedback was at work in this record.")]
Force = Annotated[bool, switch("--force", "Write over a record that exists.")]
SecondRecord = Annotated[Path | None, option("--validate RECORD2", "Judge on this record too, all of it.")]


Port = Annotated[str, option("--port PORT", "Serial port, or: emulated, simulated, replay:FILE.")]
RigOfDevice = Annotated[Path, option("--rig RIG", "Rig file (TOML): calibrations, [loop], [daq].")]
BandHz = Annotated[
    str | None,
    option(
        "--band LO:HI",
        "Band of the excitation in Hz.",
        "of a multisine to levitate, where the rotor moves; else what the controller can play",
    ),
]
BenchName = Annotated[
    str | None,
    option(
        "--bench PRESET|RIG",
        "Plant behind an emulated or simulated controller.",
        "daq.bench of the rig, or its own values",
    ),
]
Pace = Annotated[
    Literal["fastest", "real-time"],
    switch("--pace", "Of an emulated, simulated or replayed device: as fast as possible, or in real time."),
]
Seed = Annotated[int, option("--seed N", "Seed of excitation and simulated noise.", True, min=0)]


def check_positive(given: Mapping[str, float | None]) -> None:
    """Refuse numbers by option that are not positive, not finite or absurd; None was not given."""
    for name, x in given.items():
        if x is not None and not 0 < x <= LARGEST:
            raise AmbidError(f"{name} is {x:g}; it must be a positive number, up to {LARGEST:g}. Correct it")


def band_of(text: str | None) -> tuple[float, float] | None:
    """Read ``--band``: two frequencies in Hz with a colon between."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        found = (float(low), float(high))
    except ValueError:
        found = (0.0, 0.0)
    if not 0.0 <= found[0] < found[1] < float("inf"):
        raise AmbidError(
            f"--band is {text!r}; it is two frequencies in Hz with a colon between. Give e.g. --band 1:2000"
        )
    return found


def preset_of(name: str) -> Preset | None:
    """Take a word for a preset if it is one, or cannot be a file; None for a path."""
    from ambid.physics.presets import preset, preset_names

    if name in preset_names() or not (Path(name).exists() or Path(name).suffix or len(Path(name).parts) > 1):
        return preset(name)
    return None


def refuse_twice(records: Sequence[Path]) -> None:
    """Refuse to count data twice: standard deviations would come out too small."""
    seen = set[Path]()
    for path in records:
        if path.resolve() in seen:
            raise AmbidError(f"record {path} is given twice; it would count twice. Leave one out")
        seen.add(path.resolve())


def _pairs(parts: Iterable[str], where: str, said: str, remedy: str) -> dict[str, str]:
    """Read NAME=VALUE, each name once; ``{}`` in `said` stands for a part that is not of that form."""
    found: dict[str, str] = {}
    for part in parts:
        name, _, value = (x.strip() for x in part.partition("="))
        if not (name and value):
            raise EstimationError(f"{said.format(repr(part.strip()))}. {remedy}")
        if name in found:
            raise EstimationError(f"{where}: {name} stands twice. Leave one out")
        found[name] = value
    return found


def _read_first(text: str, *kinds: Callable[[str], Any]) -> Any:
    """Read a text as the first kind that takes it; as it is where none does."""
    for kind in kinds:
        with suppress(ValueError):
            return kind(text)
    return text


def _whole_numbers(text: str) -> tuple[int, ...]:
    parts = [x.strip() for x in text.split("/")]
    if len(parts) < 2 or not all(x.isdecimal() for x in parts):
        raise ValueError(text)
    return tuple(map(int, parts))


def orders_of(text: str) -> Orders | None:
    """Read orders as they are written on the command line; None where all are to be chosen."""
    if text.strip() == "auto":
        return None
    where, remedy = f"--orders {text!r}", "Write na=2,nb=2,nk=1 (nb=2/3 for two inputs), or auto"
    given = _pairs(text.split(","), where, f"{where}: {{}} is not NAME=NUMBER", remedy)
    found: dict[str, int | str | tuple[int, ...]] = {}
    for name, value in given.items():
        if value != "auto" and not all(n.strip().isdecimal() and len(n) < 7 for n in value.split("/")):
            raise EstimationError(f"{where}: {f'{name}={value}'!r} is not NAME=NUMBER. {remedy}")
        found[name] = _read_first(value, int, _whole_numbers)
    return found


def settings_of(text: str) -> Settings:
    """Read settings as they are written on the command line; what is ``auto`` is left to the method."""
    if text.strip() in ("auto", ""):
        return {}
    where = f"--settings {text!r}"
    given = _pairs(text.split(","), where, f"{where}: {{}} is not NAME=VALUE", "Write ny=2,nu=2,degree=3")
    return {name: _read_first(x, _whole_numbers, int, float) for name, x in given.items() if x != "auto"}


def fixed_of(parts: list[str] | None) -> dict[str, float]:
    """Read known coefficients, ``a1=-1.5``."""
    said, remedy = "--fix {} is not NAME=NUMBER", "Write, for example, --fix a1=-1"
    given = _pairs(parts or [], "--fix", said, remedy)
    found = {name: _read_first(value, float) for name, value in given.items()}
    for name, number in found.items():
        if isinstance(number, str):
            raise EstimationError(f"{said.format(repr(f'{name}={number}'))}. {remedy}")
    return found
