"""Arguments and options that several verbs share, and how their words are read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ambid.cli.completion import values_of
from ambid.errors import AmbidError
from ambid.settings.caller import check_band, setting
from ambid.settings.caller import check_positive as check_positive


def option(usage: str, about: str, shown: str | bool = False, **more: Any) -> Any:
    """Declare an option: its usage, such as ``--band LO:HI``; its help; how its default reads."""
    names = [word for word in usage.split() if word.startswith("-")]
    metavar = usage.removeprefix(" ".join(names)).strip() or None
    if metavar is not None:
        more["autocompletion"] = values_of(usage)
    return typer.Option(*names, metavar=metavar, help=about, show_default=shown, **more)


def switch(names: str, about: str) -> Any:
    """Declare an option without a value."""
    return typer.Option(*names.split(), help=about)


def argument(metavar: str, about: str) -> Any:
    """Declare an argument."""
    return typer.Argument(metavar=metavar, help=about, show_default=False, autocompletion=values_of(metavar))


RECORD = "Record: .csv, .csv.gz, .h5, .mat, .tdms, .mf4, .mdf, .parquet, .feather or .arrow"
RecordFile = Annotated[Path, argument("RECORD", f"{RECORD}.")]
RigFile = Annotated[Path | None, option("--rig RIG", "Rig file (TOML): what is known about the bench.")]
From = Annotated[float | None, option("--from S", "Start time in the record, in s.")]
To = Annotated[float | None, option("--to S", "End time in the record, in s.")]
Rate = Annotated[float | None, option("--rate HZ", "Sampling rate in Hz, for a record without time.")]
Gaps = Annotated[
    Literal["error", "interpolate", "cut"] | None,
    option(
        "--gaps",
        "Missing values: refuse them, interpolate, or use the longest part without any.",
        "error, or as the rig says",
    ),
]
Layout = Annotated[
    list[str] | None,
    option("--layout WORD=VALUE", "What the file leaves open, such as group=NAME or decimal=comma; repeatable."),
]
JsonFile = Annotated[str | None, option("--json FILE", "Write the result as JSON; - for standard output.")]
TrackFile = Annotated[
    str | None, option("--json FILE", "Write the track as lines of JSON as it is computed; - for standard output.")
]
Plot = Annotated[Path | None, option("--plot FILE.png", "Draw the result.")]
Report = Annotated[
    Path | None, option("--report FILE.html", "Write a report in one self-contained file, .html or .pdf.")
]
Strict = Annotated[bool, switch("--strict", "End with exit code 3 unless the verdict is usable.")]
Inputs = Annotated[list[str] | None, option("--input COL", "Input column; repeatable.")]
OutputColumns = Annotated[list[str] | None, option("--output COL", "Output column; repeatable.")]
References = Annotated[
    list[str] | None,
    option("--reference COL", "Column of the loop's external excitation, for methods that use it; repeatable."),
]
OpenLoop = Annotated[bool, switch("--open-loop", "The record was taken without feedback.")]
Force = Annotated[bool, switch("--force", "Overwrite an existing record.")]
ForceLoop = Annotated[
    bool, switch("--force", "Overwrite an existing record; go on with a loop that is predicted unstable.")
]
SecondRecord = Annotated[Path | None, option("--validate RECORD2", "Validate on this record too, on all of it.")]


Port = Annotated[str, option("--port PORT", "Serial port, or: emulated, simulated, replay:FILE.")]
RigOfDevice = Annotated[Path, option("--rig RIG", "Rig file (TOML): calibrations, [loop], [daq].")]
BandHz = Annotated[
    str | None,
    option(
        "--band LO:HI",
        "Band of the excitation in Hz.",
        "that of a multisine for levitation, where the rotor moves; else what the controller can play",
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
    switch("--pace", "Speed of an emulated, simulated or replayed device."),
]
Seed = Annotated[int, option("--seed N", "Seed of excitation and simulated noise.", True, min=0)]


def band_of(text: str | None) -> tuple[float, float] | None:
    """Read ``--band``: two frequencies in Hz with a colon between."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        found = (float(low), float(high))
    except ValueError:
        found = (0.0, 0.0)
    check_band(found, text)
    return found


def layout_of(words: Sequence[str] | None) -> dict[str, str]:
    """Read ``--layout``: words of a file's layout."""
    found = dict[str, str]()
    for text in words or ():
        word, sign, value = text.partition("=")
        if not (sign and value) or word in found:
            raise AmbidError(f"--layout {text!r}: it must be a word and its value, once. Give --layout decimal=comma")
        found[word] = value
    return found


def share_of(text: str, name: str) -> float:
    """Read a share: a number, or one with a percent sign."""
    number, percent = text.strip().removesuffix("%"), text.strip().endswith("%")
    try:
        return float(number) / (100.0 if percent else 1.0)
    except ValueError:
        raise AmbidError(f"{setting(name)} is {text!r}; it must be a share such as 0.01 or 1%. Correct it") from None


def refuse_twice(records: Sequence[Path]) -> None:
    """Refuse to count data twice: standard deviations would come out too small."""
    seen = set[Path]()
    for path in records:
        if path.resolve() in seen:
            raise AmbidError(f"record {path} is given twice and would count twice. Omit one")
        seen.add(path.resolve())
