"""A designed experiment as tables for the terminal: what it moves, and what a record of it will show."""

from __future__ import annotations

from ambid.control.experiment import Experiment
from ambid.report.numbers import quantity, sized
from ambid.report.text import (
    WIDTH,
    Paint,
    columns,
    ending,
    joined,
    plain,
    wrapped,
)

_NONE = "–"
_CRITERIA = {"all": "all parameters", "worst": "the worst parameter"}


def experiment_text(found: Experiment, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a design, below its verdict."""
    return joined(
        [
            _head(found, width, paint),
            _expected(found, width, paint),
            _signals(found, paint),
            *ending(found, width=width, paint=paint),
        ]
    )


def title_of(found: Experiment) -> str:
    """Return what was designed, in a few words."""
    loop = "closed" if found.closed else "open"
    return f"experiment for {_CRITERIA.get(found.criterion, found.criterion)} of model {found.model}, {loop} loop"


def _head(found: Experiment, width: int, paint: Paint) -> list[str]:
    first, last = (sized(float(x), "Hz") for x in (found.frequency_hz[0], found.frequency_hz[-1]))
    lines = [
        f"{found.frequency_hz.size} lines, {first} to {last}, period {found.period} samples at {found.rate_hz:g} Hz",
        f"record of {sized(found.seconds, 's')}, {found.periods} periods; limits kept for {found.drawn} drawn plants",
    ]
    if found.table is not None:
        lines.append(
            f"table for the controller: {len(found.table.elements)} elements of {found.table.hold} ticks, "
            f"amplitude {sized(found.table.amplitude, 'V')}"
        )
    return [paint(title_of(found), "strong"), *wrapped(lines, width)]


def _expected(found: Experiment, width: int, paint: Paint) -> list[str]:
    aim = f"{100.0 * found.target:.3g} % after"
    rows: list[tuple[str, ...]] = [("", "designed for", "relative", "flat", "curvature", aim)]
    for name, x in found.expected.items():
        needed = _NONE if x.seconds is None or not x.identifiable else sized(x.seconds, "s")
        said = quantity(x.value, x.sd, x.unit).text.removesuffix(" 1")
        moved = _NONE if x.shift is None else f"{x.shift:+.1f} sd"
        rows.append((name, said, f"{100.0 * x.relative_sd:.2g} %", f"{x.flat_sd / x.sd:.2g} times", moved, needed))
    return [
        paint("what the record will show", "strong"),
        *columns(rows),
        *wrapped(["flat: standard deviation with a flat multisine of the same band and use of the limits"], width),
    ]


def _signals(found: Experiment, paint: Paint) -> list[str]:
    rows: list[tuple[str, ...]] = [("", "peak", "limits", "in use", "drawn plants")]
    for name, x in found.signals.items():
        if x.low is None and x.high is None:
            continue
        ends = " … ".join("any" if e is None else sized(e, x.unit) for e in (x.low, x.high))
        most = f"{100.0 * max(x.steady, x.from_rest):.0f} %"
        rows.append((name, sized(x.peak, x.unit), ends, most, f"{100.0 * x.drawn:.0f} %"))
    return [paint("deviations from rest, four standard deviations of noise kept free", "strong"), *columns(rows)]
