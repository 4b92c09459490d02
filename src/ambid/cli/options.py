"""Arguments and options that several verbs share, and how their words are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ambid.errors import AmbidError, EstimationError

if TYPE_CHECKING:
    from ambid.blackbox.data import Orders
    from ambid.nonlinear.fit import Settings
    from ambid.physics.presets import Preset

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
PAGE_ENDINGS = (".html", ".htm")
FAILED_CHECK = 3
LARGEST = 1e9
"""What a time in s or an amplitude may be at most: beyond it is a slip, and numbers of samples would overflow."""


def option(names: str, metavar: str | None, about: str, shown: str | bool = False, **more: Any) -> Any:
    """Declare an option: names with a space between, what stands for its value, its help, how its default reads."""
    return typer.Option(*names.split(), metavar=metavar, help=about, show_default=shown, **more)


def switch(names: str, about: str) -> Any:
    """Declare an option without a value."""
    return typer.Option(*names.split(), help=about)


def argument(metavar: str, about: str) -> Any:
    """Declare an argument."""
    return typer.Argument(metavar=metavar, help=about, show_default=False)


RecordFile = Annotated[Path, argument("RECORD", "Record: .csv, .csv.gz, .h5 or .mat.")]
RigFile = Annotated[Path | None, option("--rig", "RIG", "Rig file (TOML), which says what is known of the bench.")]
From = Annotated[float | None, option("--from", "S", "Use the record from this time on, in s.")]
To = Annotated[float | None, option("--to", "S", "Use the record up to this time, in s.")]
Rate = Annotated[float | None, option("--rate", "HZ", "Sampling rate in Hz, for a record without time.")]
Gaps = Annotated[
    Literal["error", "interpolate", "cut"] | None,
    option(
        "--gaps",
        None,
        "What to do about missing values: refuse them, interpolate, or cut the longest part without any out.",
        "error, or as the rig says",
    ),
]
JsonFile = Annotated[str | None, option("--json", "FILE", "Write the result as JSON; - for standard output.")]
TrackFile = Annotated[
    str | None, option("--json", "FILE", "Write the track as lines of JSON while it comes; - for standard output.")
]
Strict = Annotated[bool, switch("--strict", "End with exit code 3 if the search did not converge or a check failed.")]
Inputs = Annotated[list[str] | None, option("--input", "COL", "Input column; repeat for several.")]
OutputColumns = Annotated[list[str] | None, option("--output", "COL", "Output column; repeat for several.")]
References = Annotated[
    list[str] | None,
    option("--reference", "COL", "Column of the loop's outer excitation, for methods that use it; repeat for several."),
]
OpenLoop = Annotated[bool, switch("--open-loop", "Say that no feedback was at work in this record.")]
SecondRecord = Annotated[Path | None, option("--validate", "RECORD2", "Judge on this record too, all of it.")]


def check_positive(given: Mapping[str, float | None]) -> None:
    """Refuse numbers by option that are not positive, not finite or absurd; None was not given."""
    for name, x in given.items():
        if x is not None and not 0 < x <= LARGEST:
            raise AmbidError(f"{name} is {x:g}; it must be a positive number, up to {LARGEST:g}. Correct it")


def json_path(json: str | None) -> Path | None:
    """Return the file that ``--json`` names; None where there is none, or standard output is meant."""
    return None if json in (None, "-") else Path(str(json))


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


def refuse_given(given: Mapping[str, bool], refusal: str) -> None:
    """Refuse the first option that was given although it has no use; it replaces ``{}`` in the refusal."""
    for name, was in given.items():
        if was:
            raise AmbidError(refusal.replace("{}", name))


def orders_of(text: str) -> Orders | None:
    """Read orders as they are written on the command line; None where all are to be chosen."""
    if text.strip() == "auto":
        return None
    found: dict[str, int | str | tuple[int, ...]] = {}
    for part in text.split(","):
        name, sign, value = (x.strip() for x in part.partition("="))
        numbers = value.split("/")
        if value == "auto" and sign and name and name not in found:
            found[name] = "auto"
            continue
        if not sign or not name or not all(n.strip().isdecimal() and len(n) < 7 for n in numbers):
            raise EstimationError(
                f"--orders {text!r}: {part.strip()!r} is not NAME=NUMBER. Write na=2,nb=2,nk=1 (nb=2/3 for two "
                "inputs), or auto"
            )
        if name in found:
            raise EstimationError(f"--orders {text!r}: {name} stands twice. Leave one out")
        found[name] = int(value) if len(numbers) == 1 else tuple(int(n) for n in numbers)
    return found


def settings_of(text: str) -> Settings:
    """Read settings as they are written on the command line; what is ``auto`` is left to the method."""
    found: dict[str, int | float | str | tuple[int, ...]] = {}
    if text.strip() in ("auto", ""):
        return found
    named = set[str]()
    for part in text.split(","):
        name, sign, value = (x.strip() for x in part.partition("="))
        if not (name and sign and value):
            raise EstimationError(f"--settings {text!r}: {part.strip()!r} is not NAME=VALUE. Write ny=2,nu=2,degree=3")
        if name in named:
            raise EstimationError(f"--settings {text!r}: {name} stands twice. Leave one out")
        named.add(name)
        if value != "auto":
            found[name] = _value(value)
    return found


def _value(text: str) -> int | float | str | tuple[int, ...]:
    parts = text.split("/")
    if len(parts) > 1 and all(x.strip().isdecimal() for x in parts):
        return tuple(int(x) for x in parts)
    for read in (int, float):
        try:
            return read(text)
        except ValueError:
            continue
    return text


def fixed_of(parts: list[str] | None) -> dict[str, float]:
    """Read known coefficients, ``a1=-1.5``."""
    found: dict[str, float] = {}
    for part in parts or []:
        name, _, value = (x.strip() for x in part.partition("="))
        try:
            number = float(value)
        except ValueError:
            raise EstimationError(f"--fix {part!r} is not NAME=NUMBER. Write, for example, --fix a1=-1") from None
        if name in found:
            raise EstimationError(f"--fix: {name} stands twice. Leave one out")
        found[name] = number
    return found
