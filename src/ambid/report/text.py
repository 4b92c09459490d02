"""An estimate as a table for the terminal: 80 columns, readable without colour."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol

from ambid.estimation.estimate import Check, Estimate, EstimatedParameter
from ambid.physics.models import model
from ambid.report.numbers import Quantity, quantity, sized

Style = Literal["good", "bad", "dim", "strong"]
Paint = Callable[[str, Style], str]

WIDTH = 80


class Parameters(Protocol):
    """Anything that has estimated parameters."""

    @property
    def parameters(self) -> tuple[EstimatedParameter, ...]: ...  # noqa: D102


def plain(text: str, style: Style) -> str:
    """Return a text without any colour; the default way of painting.

    `text`: anything; `style`: not used. Returns `text`.
    """
    del style
    return text


def estimate_text(estimate: Estimate, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write an estimate for people.

    `estimate`: any; `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns
    header, parameters, delay, fit, checks, validation, warnings and timing, without a final line feed.
    """
    blocks = [
        [header_line(estimate, paint)],
        parameter_lines(estimate, width=width, paint=paint, finished=estimate.status == "converged"),
        delay_lines(estimate),
        columns(fit_rows(estimate)),
        check_lines(estimate.checks, width=width, paint=paint),
        [] if estimate.validation is None else validation_lines(estimate.validation, width=width, paint=paint),
        warning_lines(other_warnings(estimate), width=width, paint=paint),
        [paint(timing_line(estimate.timing_s), "dim")] if estimate.timing_s else [],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def header_line(estimate: Estimate, paint: Paint = plain) -> str:
    """Say what was identified from what, and whether the search converged.

    `estimate`: any; `paint`: adds colour. Returns one line.
    """
    record = estimate.record
    name = record.get("file") or "record"
    samples, rate = int(str(record["samples"])), float(str(record["rate_hz"]))
    verdict = "" if estimate.status == "converged" else paint(f" – {estimate.status}", "bad")
    return (
        f"{paint(str(name), 'strong')}: model {estimate.model}, {samples} samples at {rate:g} Hz"
        f" ({samples / rate:.4g} s){verdict}"
    )


def parameter_lines(
    estimate: Parameters, *, width: int = WIDTH, paint: Paint = plain, finished: bool = True
) -> list[str]:
    """Write the table of the parameters.

    `estimate`: anything that has estimated parameters; `paint`: adds colour; `finished`: whether the search converged:
    otherwise nothing is called identified. Returns a header and a line for each parameter.
    """
    shown = [quantity(p.value, p.sd, p.unit, ci95=p.ci95) for p in estimate.parameters]
    rows = [_row(p, q, finished) for p, q in zip(estimate.parameters, shown, strict=True)]
    rows.insert(0, ("", "value ± sd", "95 % interval", "in SI", "verdict"))
    lines = columns(rows, right=(2,))
    if max(map(len, lines)) > width:
        lines = columns([(*row[:3], row[4]) for row in rows], right=(2,))
    styles = [style_of(p, finished=finished) for p in estimate.parameters]
    painted = [_painted_end(line, row[-1], s, paint) for line, row, s in zip(lines[1:], rows[1:], styles, strict=True)]
    return [lines[0], *painted]


def _row(p: EstimatedParameter, q: Quantity, finished: bool) -> tuple[str, ...]:
    interval = f"{q.low} … {q.high}" if q.low else ""
    return p.name, q.text, interval, q.si, verdict(p, finished=finished)


def style_of(p: EstimatedParameter, *, finished: bool = True) -> Style:
    """Return how a parameter is painted.

    `finished`: whether the search converged.
    """
    return "dim" if p.role == "fixed" else "good" if p.identifiable and finished else "bad"


def verdict(p: EstimatedParameter, *, finished: bool = True) -> str:
    """Say in a word or two where a parameter's value comes from.

    `p`: any; `finished`: whether the search converged. Returns ``"identified"``, ``"NOT SHOWN"``, ``"fixed"`` or
    ``"prior, 87 % data"``; ``"UNFINISHED"`` of a search that did not end where it should.
    """
    if p.role == "fixed":
        return "fixed"
    if not finished:
        return "UNFINISHED"
    if p.role == "prior":
        share = "" if p.data_share is None else f", {100 * p.data_share:.0f} % data"
        return f"prior{share}" if p.identifiable else f"prior, NOT SHOWN{share}"
    return "identified" if p.identifiable else "NOT SHOWN"


def _painted_end(line: str, end: str, style: Style, paint: Paint) -> str:
    return line.removesuffix(end) + paint(end, style) if end else line


def columns(rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()) -> list[str]:
    """Lay cells out in columns that are two spaces apart.

    `rows`: cells; all rows of the same length; `right`: columns that are aligned to the right. Returns one line for
    each row, without spaces at its end.
    """
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    cells = [
        [cell.rjust(w) if j in right else cell.ljust(w) for j, (cell, w) in enumerate(zip(row, widths, strict=True))]
        for row in rows
    ]
    return ["  ".join(row).rstrip() for row in cells]


def delay_lines(estimate: Estimate) -> list[str]:
    """Say by how much each input is delayed.

    `estimate`: any. Returns one sentence for each input.
    """
    rate = float(str(estimate.record["rate_hz"]))
    lines = []
    for role, d in estimate.delay.items():
        total = d.samples + d.fraction
        count = f"{total:.3g}" if d.sd is None else quantity(total, d.sd, "1").text.removesuffix(" 1")
        plural = "" if count == "1" else "s"
        time = f" ({sized(total / rate, 's')})" if total else ""
        lines.append(f"delay of {role}: {count} sample{plural}{time}, {d.how}")
    return lines


def fit_rows(estimate: Estimate) -> list[tuple[str, ...]]:
    """Make a table of the fit of each output.

    `estimate`: any. Returns a header and a row for each output.
    """
    units = model(estimate.model).units
    rows: list[tuple[str, ...]] = [("fit", "one step", "simulation", "innovations")]
    for role, f in estimate.fit.items():
        rows.append(
            (role, _number(f.one_step), _simulation(f.simulation), f"{sized(f.innovation_sd, units[role])} rms")
        )
    return rows


def _simulation(fit: float | None) -> str:
    return "unstable in open loop" if fit is None else f"{fit:.4f}"


def check_lines(checks: Mapping[str, Check], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write checks, one after the other, each with its mark and what it found.

    `checks`: by name; `width`: columns of the terminal; longer details go on under themselves; `paint`: adds colour.
    Returns lines.
    """
    wide = max((len(name) for name in checks), default=0)
    lines: list[str] = []
    for name, check in checks.items():
        mark, style = ("✓", "good") if check.passed else ("✗", "bad")
        first, *more = _wrapped(check.detail, width, wide + 4)
        lines.append(f"{paint(mark, style)} {name.ljust(wide)}  {first}")  # type: ignore[arg-type]
        lines += [" " * (wide + 4) + line for line in more]
    return lines


def validation_lines(validation: Mapping[str, Any], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write how an estimate does on a second record.

    `validation`: as `ambid.validate.second_record.validation` gives it; `width`: columns of the terminal; `paint`: adds
    colour. Returns fits of each output, then the checks.
    """
    checks = {
        name: Check(passed=bool(c["passed"]), detail=str(c["detail"]), p=c.get("p"))
        for name, c in validation["checks"].items()
    }
    head = f"on the second record ({validation['samples']} samples)"
    return [
        paint(head, "strong"),
        *columns(validation_rows(validation)),
        *check_lines(checks, width=width, paint=paint),
    ]


def validation_rows(validation: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Make a table of the fit of each output on a second record.

    `validation`: as `ambid.validate.second_record.validation` gives it. Returns a header and a row for each output.
    """
    horizons = list(next(iter(validation["fit"].values()))["k_step"])
    rows = [("fit", *(f"{k} ahead" for k in horizons), "simulation")]
    for role, f in validation["fit"].items():
        rows.append((role, *(_number(f["k_step"][k]) for k in horizons), _simulation(f["simulation"])))
    return rows


def _number(x: float | None) -> str:
    return "–" if x is None else f"{x:.4f}"


def _wrapped(text: str, width: int, indent: int) -> list[str]:
    return textwrap.wrap(text, max(width - indent, 30), break_long_words=False, break_on_hyphens=False) or [""]


def warning_lines(warnings: Sequence[str], *, width: int = WIDTH, paint: Paint = plain) -> list[str]:
    """Write warnings, one after the other.

    `width`: columns of the terminal; longer ones go on under themselves; `paint`: adds colour. Returns lines.
    """
    lines: list[str] = []
    for warning in warnings:
        first, *more = _wrapped(warning, width, 9)
        lines += [f"{paint('warning:', 'bad')} {first}", *(" " * 9 + line for line in more)]
    return lines


def other_warnings(estimate: Estimate) -> list[str]:
    """Return the warnings that say more than the detail of a failed check, which stands with the checks.

    `estimate`: any. Returns in their order.
    """
    said = {c.detail for c in estimate.checks.values()}
    return [warning for warning in estimate.warnings if warning not in said]


def timing_line(timing_s: Mapping[str, float]) -> str:
    """Say how long each stage took, and all together.

    Returns one line.
    """
    parts = [f"{name} {seconds:.2g} s" for name, seconds in timing_s.items()]
    return f"{', '.join(parts)}; {sum(timing_s.values()):.2g} s in all"
