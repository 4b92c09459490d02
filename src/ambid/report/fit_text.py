"""A black-box fit as a table for the terminal: 80 columns, readable without colour."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.spread import pole_covariance
from ambid.blackbox.structures import structure
from ambid.report.numbers import quantity, sized
from ambid.report.text import WIDTH, Paint, check_lines, columns, parameter_lines, plain, timing_line, warning_lines

if TYPE_CHECKING:
    from ambid.bearing.physical import PhysicalFit

_SHOWN = 24  # coefficients that a terminal shows; the file has all


def fit_text(fit: BlackBoxFit, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a fit for people.

    `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns header,
    coefficients, poles, fit, validation, criteria, checks, warnings and timing, without a final line feed.
    """
    blocks = [
        _header(fit, width, paint),
        coefficient_lines(fit),
        pole_lines(fit, paint=paint),
        columns(_fit_rows(fit)),
        [] if fit.validation is None else [paint("on the second record", "strong"), *validation_lines(fit.validation)],
        _criteria_lines(fit, width),
        check_lines(fit.checks, width=width, paint=paint),
        warning_lines(_unsaid(fit), width=width, paint=paint),
        [paint(timing_line(fit.timing_s), "dim")] if fit.timing_s else [],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def physics_text(found: PhysicalFit, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the physical parameters that follow from a fit.

    `width`: columns of the terminal; `paint`: adds colour. Returns parameters, delay, whether the fit can be this
    physics, and warnings, without a final line feed.
    """
    d = found.delay
    total = d.samples + d.fraction
    low, high = found.band_hz
    lines = [
        paint(f"physical parameters of model {found.model}, from {found.structure}", "strong"),
        *parameter_lines(found, width=width, paint=paint),
        f"delay {total:.3g} sample{'' if total == 1 else 's'}, {d.how}; from {sized(low, 'Hz')} to {sized(high, 'Hz')}",
        *check_lines({"misfit": found.misfit}, width=width, paint=paint),
        *warning_lines([w for w in found.warnings if w != found.misfit.detail], width=width, paint=paint),
    ]
    return "\n".join(lines)


def _header(fit: BlackBoxFit, width: int, paint: Paint) -> list[str]:
    name = str(fit.record.get("file") or "record")
    samples = int(str(fit.record["samples"]))
    orders = ", ".join(f"{k} = {_order(v)}" for k, v in fit.orders.items())
    verdict = "" if fit.status == "converged" else paint(f" – {fit.status}", "bad")
    signals = f"from {', '.join(fit.inputs)} to " if fit.inputs else "of "
    first = (
        f"{paint(name, 'strong')}: {fit.structure}, {samples} samples at {1 / fit.dt:g} Hz"
        f" ({samples * fit.dt:.4g} s){verdict}"
    )
    about = f"{structure(fit.structure).summary}; {orders}; {signals}{', '.join(fit.outputs)}"
    return [first, *textwrap.wrap(about, width)]


def _order(value: int | tuple[int, ...]) -> str:
    return str(value) if isinstance(value, int) else "/".join(map(str, value))


def coefficient_lines(fit: BlackBoxFit) -> list[str]:
    """Write the coefficients that are not fixed by the structure, each with its standard deviation."""
    theta, sd = fit.model.theta, fit.sd
    free = np.nonzero(theta != np.round(theta) if sd is None else sd > 0)[0]
    rows = [
        (
            fit.model.names[k],
            _coefficient(float(theta[k]), 0.0 if sd is None else float(sd[k])),
        )
        for k in free[:_SHOWN]
    ]
    half = -(-len(rows) // 2) if len(rows) > 8 else len(rows)
    left, right = rows[:half], rows[half:]
    right += [("", "")] * (len(left) - len(right)) if right else []
    table = [(*a, *b) for a, b in zip(left, right, strict=True)] if right else left
    head = ("", "value ± sd" if sd is not None else "value", *(("", "value ± sd") if right else ()))
    rest = [f"… and {free.size - _SHOWN} more; --json has them all"] if free.size > _SHOWN else []
    return [*columns([head, *table]), *rest] if rows else []


def _coefficient(value: float, sd: float) -> str:
    """Value ± sd; in a power of ten where decimals would be too many to read, or cut off."""
    exponent = int(np.floor(np.log10(max(abs(value), sd)))) if value or sd else 0
    if -4 <= exponent < 7:
        return quantity(value, sd, "1").text.removesuffix(" 1")
    scale = 10.0**exponent
    return f"({quantity(value / scale, sd / scale, '1').text.removesuffix(' 1')})e{exponent}"


def pole_lines(fit: BlackBoxFit, *, paint: Paint = plain) -> list[str]:
    """Write the poles with frequency, damping and standard deviation, one of each pair.

    `paint`: adds colour.
    """
    poles, discrete = fit.model.poles(), fit.model.dt is not None
    shown = [k for k in range(poles.size) if poles[k].imag >= 0][: _SHOWN // 2]
    if not shown:
        return []
    spread = None if fit.covariance is None else pole_covariance(fit.model, fit.covariance)
    rows = [(f"poles [{'z' if discrete else 'rad/s'}]", "frequency", "damping", "")]
    for k in shown:
        p = complex(poles[k])
        sd = np.zeros(2) if spread is None else np.sqrt(np.maximum(np.diag(spread[k]), 0.0))
        text = quantity(p.real, float(sd[0]), "1").text.removesuffix(" 1")
        if p.imag:
            text += f" ± j({quantity(p.imag, float(sd[1]), '1').text.removesuffix(' 1')})"
        if p == 0:
            rows.append((text, "", "", "delay"))
            continue
        s = np.log(p) / fit.dt if discrete else p
        unstable = abs(p) > 1 if discrete else p.real > 0
        frequency = sized(abs(s) / (2 * np.pi), "Hz") if abs(s) else "0 Hz"
        damping = f"{-s.real / abs(s):.3g}" if abs(s) else ""
        rows.append((text, frequency, damping, paint("unstable", "bad") if unstable else ""))
    return columns(rows)


def _fit_rows(fit: BlackBoxFit) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("fit", "one step", "simulation", "innovations")]
    for output, f in fit.fit.items():
        rows.append(
            (output, _number(f.one_step), _simulation(f.simulation), f"{sized(f.innovation_sd, fit.units[output])} rms")
        )
    return rows


def _simulation(fit: float | None) -> str:
    return "none (unstable, or no input)" if fit is None else f"{fit:.4f}"


def validation_lines(validation: Mapping[str, Any]) -> list[str]:
    """Write how a fit does on a second record.

    `validation`: by output, as `ambid.validate.blackbox.validation` gives it. Returns a header and a line for each
    output; errors in SI.
    """
    rows = [("fit", "one step", "rmse", "simulation", "rmse")]
    for output, found in validation.items():
        rows.append((output, *_pair(found["one_step"]), *_pair(found.get("simulation"))))
    return columns(rows)


def _pair(found: Mapping[str, Any] | None) -> tuple[str, str]:
    return ("–", "–") if found is None or found["fit"] is None else (_number(found["fit"]), f"{found['rmse']:.4g}")


def _criteria_lines(fit: BlackBoxFit, width: int) -> list[str]:
    if not fit.criteria:
        return []
    text = ", ".join(f"{name} {value:.6g}" for name, value in fit.criteria.items())
    return textwrap.wrap(f"criteria: {text}; {fit.n_estimated} numbers estimated", width)


def _number(x: float | None) -> str:
    return "–" if x is None else f"{x:.4f}"


def _unsaid(fit: BlackBoxFit) -> list[str]:
    """Warnings that are not the detail of a check, which stands with the checks."""
    said = {c.detail for c in fit.checks.values()}
    return [w for w in fit.warnings if w not in said]
