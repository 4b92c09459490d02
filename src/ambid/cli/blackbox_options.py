"""Options that ``fit`` and ``compare`` share, and how orders are written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ambid.errors import EstimationError

if TYPE_CHECKING:
    from ambid.blackbox.data import Orders

Inputs = Annotated[
    list[str] | None,
    typer.Option("--input", metavar="COL", help="Input column; repeat for several.", show_default=False),
]
OutputColumns = Annotated[
    list[str] | None,
    typer.Option("--output", metavar="COL", help="Output column; repeat for several.", show_default=False),
]
References = Annotated[
    list[str] | None,
    typer.Option(
        "--reference",
        metavar="COL",
        help="Column of the loop's outer excitation, for methods that use it; repeat for several.",
        show_default=False,
    ),
]
OpenLoop = Annotated[bool, typer.Option("--open-loop", help="Say that no feedback was at work in this record.")]
SecondRecord = Annotated[
    Path | None,
    typer.Option("--validate", metavar="RECORD2", help="Judge on this record too, all of it.", show_default=False),
]


def orders_of(text: str) -> Orders | None:
    """Read orders as they are written on the command line.

    Returns none where all are to be chosen.
    """
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
