"""The estimate of a rotor as text: the machine, each bearing, the bending modes."""

from __future__ import annotations

from ambid.report.numbers import quantity
from ambid.report.text import (
    WIDTH,
    Paint,
    check_lines,
    columns,
    delay_line,
    fit_rows,
    joined,
    other_warnings,
    parameter_lines,
    plain,
    timing_lines,
    title_line,
    warning_lines,
)
from ambid.rotor.estimate import RotorEstimate
from ambid.units import parse_unit


def rotor_text(estimate: RotorEstimate, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the estimate of a rotor, below its verdict."""
    e, rate = estimate, float(str(estimate.record["rate_hz"]))
    samples = sum(int(str(r["samples"])) for r in e.records)
    name = e.record.get("file") if len(e.records) == 1 else f"{len(e.records)} records"
    units = {role: parse_unit("A" if role.endswith("_current") else "m").si for role in e.fit}
    return joined(
        [
            [title_line(name, f"rotor on {len(e.delay)} axes", samples, rate, e.status, paint)],
            parameter_lines(e.parameters, width=width, paint=paint, found=e.verdict),
            columns(mode_rows(e)) if e.modes else [],
            [delay_line(role, d, rate) for role, d in e.delay.items()],
            columns(fit_rows(e.fit, units, "not simulated")),
            check_lines(e.checks, width=width, paint=paint, above=True),
            warning_lines(other_warnings(e.checks, e.warnings), width=width, paint=paint),
            timing_lines(e.timing_s, paint=paint),
        ]
    )


def mode_rows(estimate: RotorEstimate) -> list[tuple[str, ...]]:
    """Return a table of the bending modes."""
    rows: list[tuple[str, ...]] = [("bending mode", "frequency", "damping ratio")]
    for r, m in enumerate(estimate.modes, 1):
        f, z = m.frequency_hz, m.damping
        rows.append(
            (f"  {r}", quantity(f.value, f.sd, "Hz").text, quantity(z.value, z.sd, "1").text.removesuffix(" 1"))
        )
    return rows
