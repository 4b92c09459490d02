"""Arguments and options that several verbs share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.physics.presets import Preset

RecordFile = Annotated[
    Path, typer.Argument(metavar="RECORD", help="Record: .csv, .csv.gz, .h5 or .mat.", show_default=False)
]
RigFile = Annotated[
    Path | None,
    typer.Option(
        "--rig", metavar="RIG", help="Rig file (TOML), which says what is known of the bench.", show_default=False
    ),
]
From = Annotated[
    float | None,
    typer.Option("--from", metavar="S", help="Use the record from this time on, in s.", show_default=False),
]
To = Annotated[
    float | None, typer.Option("--to", metavar="S", help="Use the record up to this time, in s.", show_default=False)
]
Rate = Annotated[
    float | None,
    typer.Option("--rate", metavar="HZ", help="Sampling rate in Hz, for a record without time.", show_default=False),
]
Gaps = Annotated[
    Literal["error", "interpolate", "cut"] | None,
    typer.Option(
        "--gaps",
        help="What to do about missing values: refuse them, interpolate, or cut the longest part without any out.",
        show_default="error, or as the rig says",
    ),
]
JsonFile = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - for standard output.", show_default=False),
]
Strict = Annotated[
    bool, typer.Option("--strict", help="End with exit code 3 if the search did not converge or a check failed.")
]

FAILED_CHECK = 3
LARGEST = 1e9
"""What a time in s or an amplitude may be at most: beyond it is a slip, and numbers of samples would overflow."""


def check_positive(given: Mapping[str, float | None]) -> None:
    """Refuse numbers that are not positive, not finite or absurd.

    `given`: by option; None where it was not given.
    """
    for option, x in given.items():
        if x is not None and not 0 < x <= LARGEST:
            raise AmbidError(f"{option} is {x:g}; it must be a positive number, up to {LARGEST:g}. Correct it")


def json_path(json: str | None) -> Path | None:
    """Return the file that ``--json`` names.

    `json`: as given; ``"-"`` is standard output. Returns none where no file is to be written.
    """
    return None if json in (None, "-") else Path(str(json))


def band_of(text: str | None) -> tuple[float, float] | None:
    """Read ``--band``.

    `text`: two frequencies in Hz with a colon between. Returns none where none was given.
    """
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
    """Take a word for a preset if it is one, or cannot be a file.

    `name`: a preset or the path of a rig file. Returns none for a path.
    """
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
